# SPDX-License-Identifier: Apache-2.0
"""Options of several commands: the wall on Fetch's table, and the ranges of starts and goals."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class SceneConfig:
    """The scene on Fetch's table. Unset options keep the value of the task's environment."""

    # x, y of the wall's centre [m]; it stands on the table.
    wall_position: tuple[float, float] | None = None
    # The wall's sides [m].
    wall_size: tuple[float, float, float] | None = None
    # Two opposite corners x, y, z of the box of start positions of the gripper [m].
    start_range: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    # The same for the goal [m]; for fetch_push x and y only.
    goal_range: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    # The same for the block, x and y [m]; for fetch_push only.
    block_range: tuple[tuple[float, ...], tuple[float, ...]] | None = None
