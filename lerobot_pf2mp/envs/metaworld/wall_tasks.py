# SPDX-License-Identifier: Apache-2.0
"""Meta-World's own environments with a wall, with the goal observed, and contacts watched in every physics step."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import mujoco
import numpy as np

from lerobot_pf2mp.envs.obstacle import Obstacle
from lerobot_pf2mp.envs.tasks import METAWORLD_MISSING

try:
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS
except ModuleNotFoundError as error:
    raise ImportError(METAWORLD_MISSING) from error


class WallTask:
    """One of Meta-World's environments with a wall, as it is shipped.

    Meta-World hides the goal unless it is told otherwise, and draws positions of its own. Here the goal is observed, and
    `reset` is given the positions. A physics step detects contacts before it moves, so they are looked at after each step
    and once more after the last.

    Args:
        task: Its name in Meta-World, for example ``reach-wall-v3``.
    """

    def __init__(self, task: str) -> None:
        self.sawyer: Any = ALL_V3_ENVIRONMENTS[task]()
        # Meta-World's own way to these switches reads a pickle.
        self.sawyer._partially_observable = False
        vars(self.sawyer).pop("sawyer_observation_space", None)  # computed while the goal was hidden
        self.sawyer._set_task_called = self.sawyer._freeze_rand_vec = True
        self.model: mujoco.MjModel = self.sawyer.model
        self.data: mujoco.MjData = self.sawyer.data
        walls, movers = _geoms_of_wall(self.model), _movers(self.model)
        # The wall's geoms, one to be seen and one to be touched, are the same box.
        self._obstacles = [Obstacle(self.model, self.data, wall, movers) for wall in walls]
        self._depth: float | None = None

    @property
    def positions(self) -> tuple[np.ndarray, np.ndarray]:
        """The lowest and highest positions ``(6,)`` of object and goal, between which Meta-World draws them [m]."""
        space = self.sawyer._random_reset_space
        return space.low, space.high

    @property
    def goal(self) -> np.ndarray:
        """``(3,)`` the goal [m]."""
        return self.sawyer._target_pos

    @property
    def hand_target(self) -> np.ndarray:
        """``(3,)`` the position to which the hand is pulled [m]."""
        return self.data.mocap_pos[0]

    def reset(self, positions: np.ndarray) -> np.ndarray:
        """Meta-World's observation ``(39,)`` at the start of an episode with these positions ``(6,)`` [m]."""
        self.sawyer._last_rand_vec = positions
        return self.sawyer.reset()[0]

    def step(self, action: np.ndarray) -> tuple[np.ndarray, bool, float]:
        """Takes one step, 12.5 ms, with an action ``(4,)``.

        Returns:
            Meta-World's observation ``(39,)``, whether it counts as success, and the largest depth of robot or object in
            the wall [m], at most 0 without contact.
        """
        with self._watched():
            observation, _, _, _, info = self.sawyer.step(action)
            depth = max(self._depth or 0.0, self._depth_now())
        return observation, bool(info["success"]), depth

    def clearance(self) -> float:
        """The smallest distance of robot and object to the wall [m], negative inside."""
        return self._obstacles[0].clearance()

    def _depth_now(self) -> float:
        return max(obstacle.contact_depth() for obstacle in self._obstacles)

    @contextmanager
    def _watched(self) -> Iterator[None]:
        """A block in which Meta-World's simulation is done one physics step at a time."""
        simulate = self.sawyer.do_simulation

        def watched(ctrl: Any, n_frames: int) -> None:
            for _ in range(n_frames):
                simulate(ctrl, 1)
                self._depth = max(self._depth or 0.0, self._depth_now())

        self._depth = None
        self.sawyer.do_simulation = watched
        try:
            yield
        finally:
            del self.sawyer.do_simulation


def _geoms_of_wall(model: mujoco.MjModel) -> list[int]:
    wall = model.body("wall").id
    return [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] == wall]


def _movers(model: mujoco.MjModel) -> list[int]:
    """The geoms of robot and object that can touch the wall."""
    roots = [model.body_rootid[model.body(name).id] for name in ("hand", "obj")]
    walls = _geoms_of_wall(model)

    def can_touch(geom: int, wall: int) -> bool:
        kinds, others = model.geom_contype, model.geom_conaffinity
        return bool(kinds[geom] & others[wall] or kinds[wall] & others[geom])

    return [
        geom
        for geom in range(model.ngeom)
        if model.body_rootid[model.geom_bodyid[geom]] in roots
        and geom not in walls
        and any(can_touch(geom, wall) for wall in walls)
    ]
