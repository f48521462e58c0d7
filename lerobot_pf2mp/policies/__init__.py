# SPDX-License-Identifier: Apache-2.0
"""The policies, each in LeRobot's three files."""

# Before any module of this folder, because the import of LeRobot imports those that register (see `registration`).
import lerobot  # noqa: F401
