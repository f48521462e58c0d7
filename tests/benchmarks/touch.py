# SPDX-License-Identifier: Apache-2.0
"""The deepest touch of Fetch's wall in an episode, and how far the touching part is from the wall elsewhere."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from scipy.spatial import ConvexHull

from lerobot_pf2mp.envs.fetch.fetch_model import WALL
from lerobot_pf2mp.envs.obstacle import Obstacle

_HAND = ("robot0:gripper_link", "robot0:r_gripper_finger_link", "robot0:l_gripper_finger_link")
_BLOCK = "object0"


@dataclass(frozen=True)
class Touch:
    """The deepest touch of an episode.

    Args:
        depth: How deep the part is in the wall [m].
        point: ``(3,)`` the point of contact [m].
        geom: Name of the geom that touches.
        gripper: ``(3,)`` the gripper's position then [m].
        centre: ``(3,)`` the part's own position: the gripper's, or the block's centre [m].
        model: The MuJoCo model.
        data: A copy of its state then.
    """

    depth: float
    point: np.ndarray
    geom: str
    gripper: np.ndarray
    centre: np.ndarray
    model: mujoco.MjModel
    data: mujoco.MjData

    @property
    def part(self) -> str:
        """``hand``, with the fingers, or ``block``."""
        return "block" if self.geom == _BLOCK else "hand"

    def clearances(self, positions: np.ndarray) -> np.ndarray:
        """The distance ``(N,)`` from the wall if the part, turned as it is now, were at positions ``(N, 3)`` [m]."""
        wall = self.data.geom_xpos[self.model.geom(WALL).id]
        names = _HAND if self.part == "hand" else (_BLOCK,)
        obstacle = Obstacle(self.model, self.data, WALL, [self.model.geom(name).id for name in names])
        before, distances = wall.copy(), []
        for position in positions:
            wall[:] = before + self.centre - position  # the wall moves the other way
            distances.append(obstacle.clearance())
        wall[:] = before
        return np.array(distances)

    def outline(self, height: float) -> np.ndarray:
        """``(N, 2)`` corners around what of the touching geom is below a height [m], from above [m]."""
        corners = self._corners()
        hull = ConvexHull(corners)
        edges = np.concatenate([hull.simplices[:, [i, j]] for i, j in ((0, 1), (1, 2), (2, 0))])
        first, second = corners[edges[:, 0]], corners[edges[:, 1]]
        crosses = (first[:, 2] - height) * (second[:, 2] - height) < 0
        first, second = first[crosses], second[crosses]
        share = ((height - first[:, 2]) / (second[:, 2] - first[:, 2]))[:, None]
        below = np.concatenate([corners[corners[:, 2] <= height], first + share * (second - first)])[:, :2]
        return below[ConvexHull(below).vertices]

    def _corners(self) -> np.ndarray:
        model, geom = self.model, self.model.geom(self.geom).id
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.mesh(model.geom_dataid[geom])
            start, n = int(mesh.vertadr[0]), int(mesh.vertnum[0])
            corners = model.mesh_vert[start : start + n]
        else:
            signs = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
            corners = signs * model.geom_size[geom]
        return corners @ self.data.geom_xmat[geom].reshape(3, 3).T + self.data.geom_xpos[geom]


class TouchRecorder:
    """Watches one Fetch environment from its next step on, in every physics step.

    Args:
        env: The environment, a `FetchEnv`.
    """

    def __init__(self, env: Any) -> None:
        self.touch: Touch | None = None
        self._grippers: list[np.ndarray] = []
        self._centres: list[np.ndarray] = []
        self._env = env
        obstacle = env._fetch.obstacle
        contact_depth = obstacle.contact_depth

        def watched() -> float:
            depth = contact_depth()
            if env._is_running:  # not while the gripper moves to its start
                self._watch(depth)
            return depth

        obstacle.contact_depth = watched

    @property
    def gripper_path(self) -> np.ndarray:
        """``(N, 3)`` positions of the gripper [m]."""
        return np.array(self._grippers)

    @property
    def block_path(self) -> np.ndarray:
        """``(N, 3)`` positions of the block's centre [m]; the gripper's without a block."""
        return np.array(self._centres)

    def _watch(self, depth: float) -> None:
        env, model, data = self._env, self._env._fetch.model, self._env._fetch.data
        gripper = env._grip.copy()
        block = gripper if env._block is None else env._block.copy()
        self._grippers.append(gripper)
        self._centres.append(block)
        if depth > (0.0 if self.touch is None else self.touch.depth):
            wall = model.geom(WALL).id
            contacts = [data.contact[i] for i in range(data.ncon) if wall in data.contact[i].geom]
            deepest = min(contacts, key=lambda contact: contact.dist)
            other = model.geom(int(deepest.geom[deepest.geom != wall][0])).name
            centre = block if other == _BLOCK else gripper
            self.touch = Touch(depth, deepest.pos.copy(), other, gripper, centre, model, copy.copy(data))
