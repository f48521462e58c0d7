# SPDX-License-Identifier: Apache-2.0
"""LeRobot's configurations of the environments (``--env.type=...``), by task."""

# LeRobot must come before any module of this folder, because its import imports all of them (see `registration`).
import lerobot  # noqa: F401
