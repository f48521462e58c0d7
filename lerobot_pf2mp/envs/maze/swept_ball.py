# SPDX-License-Identifier: Apache-2.0
"""The distance between a moving ball and the walls of a maze, measured by MuJoCo."""

from __future__ import annotations

import math
from itertools import pairwise

import mujoco
import numpy as np

from lerobot_pf2mp.envs.maze.point_maze import BALL_RADIUS

_TALL_WALL = 10.0  # half height [m]
# MuJoCo's distance between a capsule and a box uses only the capsule's ends. It finds no contact if a long capsule crosses
# the box in the middle. Short pieces are measured to within about 1e-5 m.
_LONGEST_PIECE = 0.25  # [m]
# MuJoCo's distance to a box is wrong for capsules of length zero.
_SHORTEST_HALF_LENGTH = 1e-5


class SweptBall:
    """Measures the distance to the walls of a ball that moves along a straight line. MuJoCo models it as a capsule.

    Args:
        spec: Specification of a PointMaze model; its walls are the geoms ``block_*``.
        radius: Radius of the ball [m]; 0 for a point.
    """

    def __init__(self, spec: mujoco.MjSpec, radius: float) -> None:
        for geom in spec.geoms:
            if geom.name.startswith("block_"):
                # So tall that the shortest path out of a wall is sideways, never over the top.
                geom.size[2] = _TALL_WALL
        body = spec.worldbody.add_body(name="swept_ball")
        body.add_geom(
            name="swept_ball",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=[BALL_RADIUS, BALL_RADIUS, 0],
            contype=0,
            conaffinity=0,
        )
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._data)
        self._geom = self._model.geom("swept_ball").id
        self._walls = np.array(
            [i for i in range(self._model.ngeom) if self._model.geom(i).name.startswith("block_")]
        )
        centres, half_sizes = self._model.geom_pos[self._walls, :2], self._model.geom_size[self._walls, :2]
        self._low, self._high = centres - half_sizes, centres + half_sizes  # (walls, 2) corners
        self._border = self._low.min(axis=0), self._high.max(axis=0)
        self._diagonal = float(np.linalg.norm(self._border[1] - self._border[0]))  # no wall is farther [m]
        # The walls are prisms, so any height between their ends is right.
        self._height = float(self._model.geom_pos[self._walls[0], 2])
        self._radius = radius

    def clearance(self, start: np.ndarray, end: np.ndarray) -> float:
        """The smallest distance between the moving ball and a wall [m]; inside a wall minus the depth.

        Args:
            start: ``(2,)`` position of its centre before the move [m].
            end: ``(2,)`` position after it [m]. Positions outside the map are clipped to its border.
        """
        start, end = np.clip(start, *self._border), np.clip(end, *self._border)
        n_pieces = math.ceil(math.dist(start, end) / _LONGEST_PIECE)
        if n_pieces <= 1:
            return self._clearance_of_piece(start, end)
        cuts = np.linspace(start, end, n_pieces + 1)
        return min(self._clearance_of_piece(*piece) for piece in pairwise(cuts))

    def _clearance_of_piece(self, start: np.ndarray, end: np.ndarray) -> float:
        low, high = np.minimum(start, end), np.maximum(start, end)
        # The gap between bounding boxes is a lower bound of the distance. The walls are measured in its order.
        gaps = np.maximum(np.maximum(self._low - high, low - self._high), 0.0)  # (walls, 2)
        bounds = np.sqrt((gaps * gaps).sum(axis=1)) - self._radius
        self._set_capsule(start, end)
        smallest = self._diagonal
        for wall in np.argsort(bounds):
            if bounds[wall] >= smallest:
                break
            distance = mujoco.mj_geomDistance(
                self._model, self._data, self._geom, self._walls[wall], self._diagonal, None
            )
            smallest = min(smallest, distance)
        return smallest

    def collides(self, path: np.ndarray) -> bool:
        """Whether the ball touches a wall along a polyline ``(N, 2)`` of positions [m], N >= 2."""
        if not ((path >= self._border[0]) & (path <= self._border[1])).all():
            return True  # the border is wall
        low, high = np.minimum(path[:-1], path[1:]).T, np.maximum(path[:-1], path[1:]).T  # (2, N - 1)
        gaps = np.maximum(self._low.T[..., None] - high[:, None], low[:, None] - self._high.T[..., None])
        # A lower bound of the distance to the path of the ball's centre.
        gaps = np.maximum(*gaps)  # (walls, N - 1)
        close = np.flatnonzero((gaps < self._radius).any(axis=0))
        return any(self.clearance(path[i], path[i + 1]) < 0 for i in close)

    def path_clearance(self, path: np.ndarray) -> float:
        """The smallest clearance along a polyline ``(N, 2)`` of positions [m], N >= 2."""
        return min(self.clearance(start, end) for start, end in pairwise(path))

    def _set_capsule(self, start: np.ndarray, end: np.ndarray) -> None:
        step = end - start
        length = float(np.hypot(*step))
        x, y = step / length if length > 0 else (1.0, 0.0)
        half_length = max(length / 2, _SHORTEST_HALF_LENGTH)
        self._model.geom_size[self._geom, :2] = max(self._radius, 1e-6), half_length
        self._model.geom_rbound[self._geom] = self._radius + half_length
        self._data.geom_xpos[self._geom] = *(start + end) / 2, self._height
        # A capsule lies along its z axis: the columns are its x, y and z axes in the world.
        self._data.geom_xmat[self._geom] = (y, 0.0, x, -x, 0.0, y, 0.0, -1.0, 0.0)
