# SPDX-License-Identifier: Apache-2.0
"""gymnasium-robotics' Fetch environments with a wall on the table."""

from __future__ import annotations

import contextlib
import io
from typing import Any

import mujoco
import numpy as np

from lerobot_pf2mp.envs.box import Box
from lerobot_pf2mp.envs.obstacle import Obstacle

with contextlib.redirect_stderr(io.StringIO()):  # the import prints a notice about other environments
    from gymnasium_robotics.envs.fetch.fetch_env import MujocoFetchEnv
    from gymnasium_robotics.envs.fetch.push import MujocoFetchPushEnv
    from gymnasium_robotics.envs.fetch.reach import MujocoFetchReachEnv

WALL = "wall"  # name of the wall's geom
_RED = (0.80, 0.10, 0.08, 1.0)


class _WithWall(MujocoFetchEnv):
    """Adds the wall to the model before it is compiled.

    Args:
        wall: The wall [m].
        **options: Arguments of the environment.
    """

    initial_qpos: Any

    def __init__(self, wall: Box, **options: Any) -> None:
        self._wall = wall
        super().__init__(**options)

    def _initialize_simulation(self) -> None:
        spec = mujoco.MjSpec.from_file(self.fullpath)
        body = spec.worldbody.add_body(name=WALL, pos=self._wall.centre)
        half = [side / 2 for side in self._wall.size]
        body.add_geom(name=WALL, type=mujoco.mjtGeom.mjGEOM_BOX, size=half, rgba=_RED)
        for axis in spec.body("robot0:mocap").geoms:
            axis.rgba[3] = 0.0  # the cross that marks the hand's target
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.obstacle = Obstacle(self.model, self.data, WALL, _movers(self.model))
        # The rest is copied from the method of the same name in gymnasium-robotics, which loads the model from a file.
        # The wall lets the robot pass, because the gripper is inside the wall in the robot's first posture.
        self._model_names = self._utils.MujocoModelNames(self.model)
        self.model.vis.global_.offwidth = self.width
        self.model.vis.global_.offheight = self.height
        with self.obstacle.passable():
            self._env_setup(initial_qpos=self.initial_qpos)
        self.initial_time = self.data.time
        self.initial_qpos = np.copy(self.data.qpos)
        self.initial_qvel = np.copy(self.data.qvel)


class _Reach(_WithWall, MujocoFetchReachEnv):
    pass


class _Push(_WithWall, MujocoFetchPushEnv):
    pass


def make_fetch(wall: Box, has_block: bool, **options: Any) -> _WithWall:
    """Makes a Fetch environment with a wall. Its `obstacle` reports contacts with the wall.

    Args:
        wall: The wall [m].
        has_block: Whether to make FetchPush, not FetchReach.
        **options: Arguments of the environment, for example ``width``.
    """
    return (_Push if has_block else _Reach)(wall, **options)


def _movers(model: mujoco.MjModel) -> list[int]:
    """The geoms of the robot and the block that can touch something."""
    return [
        geom
        for geom in range(model.ngeom)
        if model.body(model.geom_bodyid[geom]).name.startswith(("robot0:", "object0"))
        and (model.geom_contype[geom] or model.geom_conaffinity[geom])
    ]
