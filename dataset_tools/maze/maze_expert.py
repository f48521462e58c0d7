# SPDX-License-Identifier: Apache-2.0
"""A scripted expert that drives a ball through a maze, like D4RL's maze2d generator (Fu et al., 2020)."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from lerobot_pf2mp.dataset_tools.writing.episodes import Trajectory
from lerobot_pf2mp.envs.maze.point_maze import make_point_maze, step_physics
from lerobot_pf2mp.envs.maze.shortest_path import Cell, shortest_path

WAYPOINT_RADIUS = 0.1  # within this distance a waypoint counts as reached, as in D4RL [m]
WAYPOINT_JITTER = 0.1  # largest distance of waypoints to the cell centres, on each axis [m]
GOAL_JITTER = 0.25  # the same for goals and starts, as in PointMaze [m]
MAX_PHYSICS_STEPS = 3000  # [0.01 s]


class MazeExpert:
    """Drives the ball of PointMaze from goal to goal along shortest paths through cell centres.

    A PD controller with clipped force drives it, in full physics. When a goal is reached, the next one is drawn, and the
    ball continues from its position. D4RL's goals are up to 0.1 m from the cell centres. Here they are distributed as in
    PointMaze at evaluation.

    Args:
        maze_map: As for `parse_maze_map`.
        action_noise: Standard deviation of Gaussian noise on the normalised force (D4RL's noisy data uses 0.5).
        seed: Seed of all random numbers.

    Raises:
        ValueError: If the noise or the seed is negative, or the map is not a maze.
    """

    def __init__(self, maze_map: str, action_noise: float, seed: int) -> None:
        if not (np.isfinite(action_noise) and action_noise >= 0):
            raise ValueError(f"action_noise must be finite and at least 0, got {action_noise}")
        if seed < 0:
            raise ValueError(f"seed must be at least 0, got {seed}")
        self._env, _ = make_point_maze(maze_map)
        self._maze = self._env.maze
        self._noise = action_noise
        self._rng = np.random.default_rng(seed)
        rows = self._maze.maze_map
        self._cells = [(i, j) for i, row in enumerate(rows) for j, cell in enumerate(row) if cell == 0]
        self._is_free = set(self._cells)
        self._place_randomly()
        self._n_ground_contacts = self._env.data.ncon
        self.n_collisions = 0

    def trajectories(self) -> Iterator[Trajectory]:
        """An endless stream of collision-free trajectories, one position [m] for every 0.01 s."""
        while True:
            start = tuple(self._maze.cell_xy_to_rowcol(self._position()))
            cell = self._rng.choice([c for c in self._cells if c != start])
            goal = self._off_centre(tuple(cell), GOAL_JITTER)
            positions = self._drive(start, tuple(cell), goal)
            if positions is None:
                self.n_collisions += 1
                self._place_randomly()
            else:
                yield Trajectory(np.array(positions), goal)

    def _drive(self, start: Cell, cell: Cell, goal: np.ndarray) -> list[list[float]] | None:
        """The positions of the ball until it reaches the goal [m]; None after a collision."""
        waypoints = [
            self._off_centre(c, WAYPOINT_JITTER) for c in shortest_path(self._is_free, start, cell)[1:-1]
        ]
        positions = [self._position().tolist()]
        model, data = self._env.model, self._env.data
        for waypoint in [*waypoints, goal]:
            target = waypoint.tolist()
            while math.dist(target, positions[-1]) > WAYPOINT_RADIUS:
                noise = self._rng.normal(scale=self._noise, size=2) if self._noise else (0.0, 0.0)
                step_physics(model, data, target, force_noise=noise)
                positions.append(data.qpos.tolist())
                # The ball always rests on the ground; any other contact is a wall within 3 mm.
                if data.ncon > self._n_ground_contacts or len(positions) > MAX_PHYSICS_STEPS:
                    return None
        return positions

    def _off_centre(self, cell: Cell, jitter: float) -> np.ndarray:
        return self._maze.cell_rowcol_to_xy(np.array(cell)) + self._rng.uniform(-jitter, jitter, size=2)

    def _place_randomly(self) -> None:
        cell = self._cells[self._rng.integers(len(self._cells))]
        self._env.point_env.set_state(self._off_centre(cell, GOAL_JITTER), np.zeros(2))

    def _position(self) -> np.ndarray:
        return self._env.data.qpos.copy()
