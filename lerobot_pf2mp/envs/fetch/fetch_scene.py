# SPDX-License-Identifier: Apache-2.0
"""The scenes of the Fetch tasks: the wall, and the ranges of positions of the gripper, the block and the goal."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lerobot_pf2mp.envs.box import Box

TABLE = Box.between((1.05, 0.40, 0.0), (1.55, 1.10, 0.40))
# Limits of the gripper's position. Measured: the gripper reaches every corner within 1 cm.
WORKSPACE = Box.between((1.05, 0.45, 0.415), (1.55, 1.05, 0.80))
# The hand and the closed fingers around the gripper's position (the site robot0:grip); measured in the model.
HAND = Box.between((-0.040, -0.063, 0.052), (0.040, 0.063, 0.174))
FINGERS = Box.between((-0.014, -0.015, -0.019), (0.014, 0.015, 0.059))
BLOCK_SIZE = 0.05  # [m]
BLOCK_HEIGHT = 0.425  # z of the block's centre on the table [m]

FETCH_FPS = 25  # [Hz], gymnasium-robotics' own
SUCCESS_RADIUS = 0.05  # [m], gymnasium-robotics' own
_MARGIN = 0.01  # smallest distance of sampled positions of the hand to the wall [m]
_MIN_PUSH = 0.1  # smallest distance from the block to the goal [m]
_MAX_WALL_TOP = 0.72  # above a higher wall the gripper could not pass [m]
_N_TRIES = 1000
_TINY = 1e-9

Corners = tuple[tuple[float, ...], tuple[float, ...]]


@dataclass(frozen=True)
class Layout:
    """The positions of one episode.

    Args:
        start: ``(3,)`` start of the gripper [m].
        goal: ``(3,)`` goal of the gripper, or of the block [m].
        block: ``(3,)`` centre of the block [m]; None without a block.
    """

    start: np.ndarray
    goal: np.ndarray
    block: np.ndarray | None = None


@dataclass(frozen=True)
class FetchScene:
    """A wall on Fetch's table, and the ranges from which starts, goals and blocks are drawn uniformly.

    The table's top is at z = 0.40 m, x in 1.05 to 1.55 m (away from the robot), y in 0.40 to 1.10 m (to its left).

    Args:
        wall_position: x, y of the wall's centre [m]; it stands on the table.
        wall_size: The wall's sides [m].
        start_range: Two opposite corners of the box of start positions of the gripper [m].
        goal_range: The same for the goal [m]; with a block x and y only, because goals then lie on the table.
        block_range: The same for the block, x and y [m]; None without a block.

    Raises:
        ValueError: If the gripper cannot pass above the wall, or a range has no position that is in the workspace and clear
            of the wall.
    """

    wall_position: tuple[float, float]
    wall_size: tuple[float, float, float]
    start_range: Corners
    goal_range: Corners
    block_range: Corners | None = None

    def __post_init__(self) -> None:
        _check_numbers("wall_position", self.wall_position, 2)
        _check_numbers("wall_size", self.wall_size, 3)
        if min(self.wall_size) <= 0:
            raise ValueError(f"wall_size must be positive [m], got {self.wall_size}")
        wall = self.wall
        if np.any(wall.low[:2] < TABLE.low[:2] - _TINY) or np.any(wall.high[:2] > TABLE.high[:2] + _TINY):
            raise ValueError(
                "a wall must stand on the table, x, y from "
                f"{TABLE.low[:2].round(3).tolist()} to {TABLE.high[:2].round(3).tolist()} m, got one from "
                f"{wall.low[:2].round(3).tolist()} to {wall.high[:2].round(3).tolist()}"
            )
        if wall.high[2] > _MAX_WALL_TOP + _TINY:
            raise ValueError(
                f"a wall must be at most {_MAX_WALL_TOP - TABLE.high[2]:.2f} m high so that the gripper can pass above it, "
                f"got wall_size {self.wall_size}"
            )
        for name, n_coordinates in (
            ("start_range", 3),
            ("goal_range", 3 - self.has_block),
            ("block_range", 2),
        ):
            corners = getattr(self, name)
            if corners is not None:
                _check_range(name, corners, n_coordinates)
        self.sample(np.random.default_rng(0))

    @property
    def has_block(self) -> bool:
        """Whether there is a block to push."""
        return self.block_range is not None

    @property
    def wall(self) -> Box:
        """The wall [m]."""
        bottom = float(TABLE.high[2])
        return Box((*self.wall_position, bottom + self.wall_size[2] / 2), self.wall_size)

    def sample(
        self,
        rng: np.random.Generator,
        start: Sequence[float] | np.ndarray | None = None,
        goal: Sequence[float] | np.ndarray | None = None,
        block: Sequence[float] | np.ndarray | None = None,
    ) -> Layout:
        """Draws the positions of an episode.

        Args:
            rng: Source of randomness.
            start: ``(3,)`` start of the gripper [m]. For this and the next two, None draws it.
            goal: ``(3,)`` the goal [m].
            block: ``(3,)`` centre of the block [m], or ``(2,)`` x and y on the table.

        Raises:
            ValueError: If a position is outside the workspace, or no layout is found that is clear of the wall.
        """
        if block is not None and not self.has_block:
            raise ValueError(f"block is for push only, got {block}")
        lies_on_table = {"start": False, "goal": self.has_block, "block": True}
        given = {
            name: _check_position(name, position, lies_on_table[name])
            for name, position in (("start", start), ("goal", goal), ("block", block))
            if position is not None
        }
        for _ in range(_N_TRIES):
            positions = {"start": rng.uniform(*self.start_range), "goal": rng.uniform(*self.goal_range)}
            if self.block_range is not None:
                positions["goal"] = np.array([*positions["goal"], BLOCK_HEIGHT])
                positions["block"] = np.array([*rng.uniform(*self.block_range), BLOCK_HEIGHT])
            layout = Layout(**{**positions, **given})
            if self.fits(layout):
                return layout
        if given:
            raise ValueError(
                "start, goal and block must be clear of the wall, the block with room behind it and a free line to the "
                f"goal of at least {_MIN_PUSH} m; none found with { ({k: v.tolist() for k, v in given.items()}) }"
            )
        raise ValueError(
            f"start, goal and block ranges must leave positions clear of the wall, and free lines to push along; none "
            f"found in {_N_TRIES} tries with the wall at {self.wall_position} of size {self.wall_size}"
        )

    def fits(self, layout: Layout) -> bool:
        """Whether start and goal are clear of the wall, and the block can be pushed to the goal in a straight line."""
        if self.hits_wall(layout.start, layout.start, _MARGIN):
            return False
        if layout.block is None:
            return not self.hits_wall(layout.goal, layout.goal, _MARGIN)
        push = layout.goal - layout.block
        length = math.hypot(*push)
        if length < _MIN_PUSH or math.dist(layout.start[:2], layout.block[:2]) < _MIN_PUSH:
            return False
        # The gripper starts to push from behind the block, at two block sizes from its centre.
        behind = layout.block - push / length * 2 * BLOCK_SIZE
        if np.any(behind[:2] < WORKSPACE.low[:2]) or np.any(behind[:2] > WORKSPACE.high[:2]):
            return False
        radius = BLOCK_SIZE / math.sqrt(2) + _MARGIN  # for every rotation of the block
        pushed = Box((0, 0, 0), (2 * radius, 2 * radius, BLOCK_SIZE))
        return not (
            self.hits_wall(behind, layout.goal, _MARGIN)
            or self.wall.grown_by(pushed).blocks(layout.block, layout.goal)
        )

    def is_blocked(self, layout: Layout) -> bool:
        """Whether the gripper hits the wall on the straight path to the goal; with a block, on the path via the block."""
        stations = [layout.start, *([] if layout.block is None else [layout.block]), layout.goal]
        return any(self.hits_wall(a, b) for a, b in itertools.pairwise(stations))

    def hits_wall(self, start: np.ndarray, end: np.ndarray, margin: float = 0.0) -> bool:
        """Whether hand or fingers touch the wall when the gripper moves straight from one position to another.

        Args:
            start: ``(3,)`` first position of the gripper [m].
            end: ``(3,)`` last position [m].
            margin: Distance to the wall below which they count as touching it [m].
        """
        spread = Box((0, 0, 0), (2 * margin,) * 3)
        return any(self.wall.grown_by(part).grown_by(spread).blocks(start, end) for part in (HAND, FINGERS))


def _check_numbers(name: str, values: object, n: int) -> None:
    numbers = np.asarray(values, dtype=float)
    if numbers.shape != (n,) or not np.isfinite(numbers).all():
        raise ValueError(f"{name} must be {n} finite numbers [m], got {values}")


def _check_range(name: str, corners: Corners, n_coordinates: int) -> None:
    try:
        low, high = np.asarray(corners, dtype=float)
    except (TypeError, ValueError):
        low = high = np.empty(0)
    if low.shape != (n_coordinates,) or not np.isfinite([low, high]).all() or np.any(low > high):
        raise ValueError(
            f"{name} must be two corners of {n_coordinates} coordinates each [m], the smaller ones first, got {corners}"
        )
    lowest, highest = WORKSPACE.low[:n_coordinates], WORKSPACE.high[:n_coordinates]
    if np.any(low < lowest) or np.any(high > highest):
        raise ValueError(
            f"{name} must be in the gripper's workspace, from {lowest.tolist()} to {highest.tolist()} m, got {corners}"
        )


def _check_position(name: str, given: Sequence[float] | np.ndarray, lies_on_table: bool) -> np.ndarray:
    position = np.asarray(given, dtype=float)
    if lies_on_table and position.shape == (2,):
        position = np.array([*position, BLOCK_HEIGHT])
    is_reachable = position.shape == (3,) and bool(
        np.all((position >= WORKSPACE.low) & (position <= WORKSPACE.high))
    )
    if not is_reachable or (lies_on_table and abs(position[2] - BLOCK_HEIGHT) > 1e-3):
        height = f", z = {BLOCK_HEIGHT} on the table" if lies_on_table else ""
        raise ValueError(
            f"{name} must be a position x, y, z in the gripper's workspace, from {WORKSPACE.low.round(3).tolist()} to "
            f"{WORKSPACE.high.round(3).tolist()} m{height}, got {given}"
        )
    return position


def check_inner_steps(n_inner_steps: int) -> None:
    """Checks the number of steps of the inner loop for each action.

    Raises:
        ValueError: If it is not a whole number from 1 to `FETCH_FPS`.
    """
    if not isinstance(n_inner_steps, int) or not 1 <= n_inner_steps <= FETCH_FPS:
        raise ValueError(f"n_inner_steps must be a whole number from 1 to {FETCH_FPS}, got {n_inner_steps}")


FETCH_SCENES = {
    "reach": FetchScene(
        wall_position=(1.30, 0.75),
        wall_size=(0.30, 0.04, 0.20),
        start_range=((1.20, 0.52, 0.45), (1.45, 0.64, 0.70)),
        goal_range=((1.20, 0.86, 0.43), (1.45, 0.98, 0.68)),
    ),
    "push": FetchScene(
        wall_position=(1.30, 0.75),
        wall_size=(0.16, 0.04, 0.10),
        start_range=((1.20, 0.52, 0.45), (1.40, 0.62, 0.55)),
        goal_range=((1.10, 0.56), (1.50, 0.94)),
        block_range=((1.10, 0.84), (1.50, 0.94)),
    ),
}


def make_scene(task: str, **changes: Any) -> FetchScene:
    """Makes the scene of a task.

    Args:
        task: A key of `FETCH_SCENES`.
        **changes: Arguments of `FetchScene` that replace those of the task; None keeps the value of the task.

    Raises:
        ValueError: If there is no such task, or the changed scene breaks a rule of `FetchScene`.
    """
    if task not in FETCH_SCENES:
        raise ValueError(f"task must be one of {list(FETCH_SCENES)}, got {task!r}")
    scene = FETCH_SCENES[task]
    changes = {name: value for name, value in changes.items() if value is not None}
    if "block_range" in changes and not scene.has_block:
        raise ValueError(f"block_range is for push only, got {changes['block_range']}")
    return replace(scene, **changes)
