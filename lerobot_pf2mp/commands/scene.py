# SPDX-License-Identifier: Apache-2.0
"""Options of several commands: where things are on Fetch's table."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class SceneConfig:
    """Where things are on Fetch's table; what is not given is as in the task's environment."""

    # x, y of the wall's centre [m]; it stands on the table.
    wall_position: tuple[float, float] | None = None
    # The wall's sides [m].
    wall_size: tuple[float, float, float] | None = None
    # Two opposite corners x, y, z of where the gripper starts [m].
    start_range: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    # The same of the goal [m]; for fetch_push x and y only.
    goal_range: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    # The same of the block, x and y [m].
    block_range: tuple[tuple[float, ...], tuple[float, ...]] | None = None
