# SPDX-License-Identifier: Apache-2.0
"""LeRobot's configurations of the environments (``--env.type=...``), by task."""

# Before any module of this folder, because the import of LeRobot imports them all (see `registration`).
import lerobot  # noqa: F401
