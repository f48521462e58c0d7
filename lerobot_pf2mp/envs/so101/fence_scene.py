# SPDX-License-Identifier: Apache-2.0
"""The scene of the SO-101 task: the wall, and the ranges of positions of the cube and of its goal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

SO101_FPS = 20  # [Hz]
CUBE_SIZE = 0.025  # [m]
GOAL_RADIUS = 0.03  # of the disc on the table, within which the cube's centre must lie [m]
# The arm stands at the origin and looks along x. Its first joint turns about a vertical axis at this x [m].
PAN_AXIS = 0.0388353
REACH = (0.16, 0.30)  # distances from that axis at which the gripper can point down onto the table [m]
_MAX_ANGLE = math.radians(75)  # to each side
_MAX_WALL_HEIGHT = 0.06  # above a higher wall the cube could not be carried [m]
_HAND_WIDTH = 0.03  # free space that the hand needs beside the wall when it grasps [m]

Range = tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True)
class FenceLayout:
    """The positions of one episode.

    Args:
        cube: ``(2,)`` x, y of the cube's centre on the table [m].
        goal: ``(2,)`` x, y of the goal [m].
        yaw: Rotation of the cube about the vertical, relative to the direction from the arm's axis to it [rad].
    """

    cube: np.ndarray
    goal: np.ndarray
    yaw: float = 0.0


@dataclass(frozen=True)
class FenceScene:
    """A wall in front of the arm, and the ranges from which positions are drawn uniformly; x forward, y to the left [m].

    Args:
        wall_position: x, y of the wall's centre; it stands on the table.
        wall_size: Lengths of the wall's sides.
        cube_range: Two opposite corners of the rectangle of the cube's positions.
        goal_range: The same for the goal.

    Raises:
        ValueError: If the cube cannot be carried over the wall, or a position is out of reach or too near the wall.
    """

    wall_position: tuple[float, float] = (0.25, 0.0)
    wall_size: tuple[float, float, float] = (0.22, 0.016, 0.05)
    cube_range: Range = ((0.20, 0.08), (0.27, 0.16))
    goal_range: Range = ((0.20, -0.16), (0.27, -0.08))

    def __post_init__(self) -> None:
        for name, shape in (
            ("wall_position", (2,)),
            ("wall_size", (3,)),
            ("cube_range", (2, 2)),
            ("goal_range", (2, 2)),
        ):
            _check_numbers(name, getattr(self, name), shape)
        if min(self.wall_size) <= 0 or self.wall_size[2] > _MAX_WALL_HEIGHT:
            raise ValueError(
                f"wall_size must be positive, and at most {_MAX_WALL_HEIGHT} m high so that the cube can be carried over "
                f"it, got {self.wall_size}"
            )
        for name in ("cube_range", "goal_range"):
            low, high = np.array(getattr(self, name))
            if np.any(low > high):
                raise ValueError(f"{name} must be two corners, the smaller one first [m], got {(low, high)}")
            for corner in ((low[0], low[1]), (low[0], high[1]), (high[0], low[1]), (high[0], high[1])):
                self._check_place(name, corner)

    def sample(
        self,
        rng: np.random.Generator,
        cube: Sequence[float] | None = None,
        goal: Sequence[float] | None = None,
    ) -> FenceLayout:
        """Draws the positions of an episode.

        Args:
            rng: Source of randomness.
            cube: ``(2,)`` x, y of the cube [m]. For this and the next one, None draws it.
            goal: ``(2,)`` x, y of the goal [m].

        Raises:
            ValueError: If a given position is out of reach or too near the wall.
        """
        places = {}
        for name, given, corners in (("cube", cube, self.cube_range), ("goal", goal, self.goal_range)):
            drawn = rng.uniform(*corners)
            if given is not None:
                _check_numbers(name, given, (2,))
                self._check_place(name, given)
            places[name] = drawn if given is None else np.asarray(given, dtype=float)
        return FenceLayout(**places, yaw=float(rng.uniform(-0.2, 0.2)))

    def _check_place(self, name: str, place: Sequence[float]) -> None:
        reach, angle = cylindrical(np.asarray(place, dtype=float))
        if not (REACH[0] <= reach <= REACH[1] and abs(angle) <= _MAX_ANGLE):
            raise ValueError(
                f"{name} must be {REACH[0]} to {REACH[1]} m away from the arm's axis at ({PAN_AXIS:.3f}, 0) and at most "
                f"{math.degrees(_MAX_ANGLE):.0f} degrees to a side, got {tuple(map(float, place))}"
            )
        away = np.abs(np.asarray(place) - self.wall_position) - np.array(self.wall_size[:2]) / 2
        if away.max() < _HAND_WIDTH:
            raise ValueError(
                f"{name} must be {_HAND_WIDTH} m away from the wall, got {tuple(map(float, place))}"
            )


def make_scene(**changes: Any) -> FenceScene:
    """The scene of the task with changes.

    Args:
        **changes: Arguments of `FenceScene`; None keeps the value of the task.

    Raises:
        ValueError: If the changed scene breaks a rule of `FenceScene`.
    """
    return replace(FenceScene(), **{name: value for name, value in changes.items() if value is not None})


def cylindrical(place: np.ndarray) -> tuple[float, float]:
    """Distance from the axis of the arm's first joint [m] and angle about it [rad] of a place ``(2,)`` or ``(3,)``."""
    return math.hypot(place[0] - PAN_AXIS, place[1]), math.atan2(place[1], place[0] - PAN_AXIS)


def _check_numbers(name: str, values: object, shape: tuple[int, ...]) -> None:
    try:
        numbers = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape != shape or not np.isfinite(numbers).all():
        raise ValueError(f"{name} must be finite numbers of shape {shape} [m], got {values}")
