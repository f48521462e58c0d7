# SPDX-License-Identifier: Apache-2.0
"""Discs in the corridors of a maze, which no demonstration knew."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from lerobot_pf2mp.envs.maze.shortest_path import shortest_path

DISC_RADIUS = 0.1  # [m]

# Largest distance of a disc that stands still, and of one that moves, from the line through the cells' centres [m].
_OFF_CENTRE, _AMPLITUDE = 0.05, 0.25

# Smallest distance of a disc's place from start and goal, and from the next disc's [m].
_FROM_ENDS, _APART = 0.6, 0.9

# Number of features of a row: present, centre, half sides, axis, velocity, radius.
N_FEATURES = 10


class Discs:
    """Discs on the shortest way from start to goal, at equal parts of it.

    A free way exists: corridors are 1 m wide, and a disc that stands still is within 0.05 m of the middle, so the gaps to
    both walls are at least 0.35 m, and the ball's diameter is 0.2 m. One that moves goes to and fro across the corridor, up
    to 0.25 m from the middle, so at any time one gap is at least 0.4 m. Discs are 0.9 m apart, and 0.6 m from start and
    goal. Those for which the way is too short are absent.

    Args:
        maze: gymnasium-robotics' maze.
        n_discs: Number K of discs.
        speed: Of all discs [m/s].
    """

    def __init__(self, maze: Any, n_discs: int, speed: float) -> None:
        self._maze = maze
        self._speed = speed
        rows = maze.maze_map
        self._free = {(i, j) for i, row in enumerate(rows) for j, cell in enumerate(row) if cell != 1}
        self._places = np.zeros((n_discs, 2))
        self._across = np.zeros((n_discs, 2))
        # Across the corridor; of moving discs the phase, as a length [m].
        self._offsets: np.ndarray = np.zeros(n_discs)
        self.is_present = np.zeros(n_discs, dtype=bool)

    def place(self, start: np.ndarray, goal: np.ndarray, rng: np.random.Generator) -> None:
        """Places them for an episode, from ``(2,)`` to ``(2,)`` [m]."""
        cells = [tuple(self._maze.cell_xy_to_rowcol(point)) for point in (start, goal)]
        path = shortest_path(self._free, cells[0], cells[1])
        centres = [self._maze.cell_rowcol_to_xy(np.array(cell)) for cell in path[1:-1]]
        way = np.array([start, *centres, goal])
        reach = 2 * _AMPLITUDE if self._speed > 0 else _OFF_CENTRE
        self._offsets = rng.uniform(-reach, reach, len(self._offsets))
        lengths = np.append(0.0, np.linalg.norm(np.diff(way, axis=0), axis=1).cumsum())
        self.is_present[:] = False
        for k in range(len(self._places)):
            at = lengths[-1] * (k + 1) / (len(self._places) + 1)
            piece = int(np.clip(np.searchsorted(lengths, at) - 1, 0, len(way) - 2))
            step = way[piece + 1] - way[piece]
            length = max(float(np.hypot(*step)), 1e-9)
            place = way[piece] + (at - lengths[piece]) / length * step
            others = self._places[self.is_present]
            is_clear = min(math.dist(place, start), math.dist(place, goal)) >= _FROM_ENDS
            if is_clear and all(math.dist(place, other) >= _APART for other in others):
                self._places[k], self.is_present[k] = place, True
                self._across[k] = -step[1] / length, step[0] / length

    def centres(self, time: float) -> np.ndarray:
        """``(K, 2)`` where they are at a time of the episode [m]."""
        return self._places + self._wave(time)[0][:, None] * self._across

    def rows(self, time: float) -> np.ndarray:
        """``(K, 10)`` float32 rows of the observation, see `obstacle_field.Obstacles.rows`; those of absent discs are 0."""
        rows = np.zeros((len(self._places), N_FEATURES), dtype=np.float32)
        rows[:, 0], rows[:, 5], rows[:, 9] = 1.0, 1.0, DISC_RADIUS
        rows[:, 1:3] = self.centres(time)
        rows[:, 7:9] = self._wave(time)[1][:, None] * self._across
        return rows * self.is_present[:, None]

    def clearance(self, path: np.ndarray, radius: float, time: float, end_time: float) -> float:
        """The smallest distance between a moving ball and a disc [m], negative inside; inf without discs.

        Args:
            path: ``(N, 2)`` the ball's positions, N >= 2, at equal times.
            radius: The ball's [m].
            time: When it is at the first one [s].
            end_time: When it is at the last one [s].
        """
        if not self.is_present.any():
            return math.inf
        relative = [
            point - self.centres(t)[self.is_present]
            for point, t in zip(path, np.linspace(time, end_time, len(path)), strict=True)
        ]
        return min(_nearest(*pair) for pair in pairwise(relative)) - radius - DISC_RADIUS

    def _wave(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """``(K,)`` offsets across the corridor [m] and their velocities [m/s]; a triangle wave if they move."""
        if self._speed == 0:
            return self._offsets, np.zeros_like(self._offsets)
        phase = np.mod(self._offsets + self._speed * time, 4 * _AMPLITUDE)
        rises = phase < 2 * _AMPLITUDE
        offsets = np.where(rises, phase - _AMPLITUDE, 3 * _AMPLITUDE - phase)
        return offsets, np.where(rises, self._speed, -self._speed)


def _nearest(start: np.ndarray, end: np.ndarray) -> float:
    """The smallest distance to the origin on some straight moves ``(K, 2)`` to ``(K, 2)``."""
    step = end - start
    share = np.clip(-(start * step).sum(1) / np.maximum((step * step).sum(1), 1e-12), 0.0, 1.0)
    return float(np.linalg.norm(start + share[:, None] * step, axis=1).min())


def discs_to_draw(discs: Discs | None, time: float) -> Sequence[np.ndarray]:
    """The centres [m] of the discs that are present."""
    return () if discs is None else list(discs.centres(time)[discs.is_present])
