# SPDX-License-Identifier: Apache-2.0
"""The policies, each in LeRobot's three files."""

# LeRobot must come before any module of this folder, because its import imports those that register (see `registration`).
import lerobot  # noqa: F401
