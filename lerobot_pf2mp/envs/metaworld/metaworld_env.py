# SPDX-License-Identifier: Apache-2.0
"""Meta-World's tasks with a wall, with collision reports."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from lerobot_pf2mp.envs.image_size import image_size_of
from lerobot_pf2mp.envs.metaworld.wall_tasks import WallTask
from lerobot_pf2mp.envs.offscreen_camera import OffscreenCamera, View
from lerobot_pf2mp.envs.tasks import METAWORLD_TASKS

# What an action of 1 moves the hand's target by [m], as Meta-World's tasks have it.
DISPLACEMENT = 0.01
# Its own cameras show the table upside down, or from far away.
_VIEW: View = ((0.05, 0.72, 0.12), 1.0, 155.0, -22.0)


class MetaWorldEnv(gym.Env):
    """A Sawyer arm that must reach a goal, or push an object or carry it there, without touching a wall.

    ## Description
    Meta-World's own environments (McLean et al., 2025), with one difference: contacts with the wall are reported. Actions
    are displacements of the hand's target, which the hand follows with a lag of up to 11 cm. The target stays in a box: a
    displacement that leads out of it is cut.

    ## Action space
    ``Box(4)`` in [-1, 1]: displacement x, y, z of the hand's target [cm], and effort of the gripper.

    ## Observation space
    ``Dict``: ``agent_pos`` ``(4,)``, the hand's position [m] and how far the gripper is open (0 to 1), and
    ``environment_state`` ``(6,)``, the positions of object and goal [m].

    ## Rewards
    -1.0 on the first step with a collision in an episode, 0.0 otherwise. So the return of an episode is -1 with a collision
    and 0 without.

    ## Information
    ``is_success``: Meta-World's own success. ``is_collision``: the robot or the object has touched the wall in this
    episode, in any physics step. ``clearance``: the smallest distance from the wall to robot and object [m], negative
    inside it. ``path_length``: the length of the hand's path in this episode [m].

    ## Starting state
    The hand's is always the same. Object and goal are drawn from Meta-World's ranges.

    ## Episode end
    After the registered number of steps; with success too with `terminate_on_success`. A collision does not end it.

    Args:
        task: reach-wall-v3, push-wall-v3 or pick-place-wall-v3.
        terminate_on_success: Whether an episode ends with success.
        render_mode: ``rgb_array`` or None.
        render_size: Width of the image [pixels]; its height is three quarters of that.

    Raises:
        ValueError: If an argument breaks its rule.
        ImportError: If Meta-World is not installed.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 80}  # noqa: RUF012

    def __init__(
        self,
        task: str = "reach-wall-v3",
        terminate_on_success: bool = False,
        render_mode: str | None = None,
        render_size: int = 480,
    ) -> None:
        if task not in METAWORLD_TASKS:
            raise ValueError(f"task must be one of {list(METAWORLD_TASKS)}, got {task!r}")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(
                f"render_mode must be None or one of {self.metadata['render_modes']}, got {render_mode!r}"
            )
        self.render_mode = render_mode
        self.task = f"metaworld-{task}"
        self.task_description = METAWORLD_TASKS[task]
        self._terminate_on_success = terminate_on_success
        self._wall_task = WallTask(task)
        self._camera = OffscreenCamera(self._wall_task.model, _VIEW, image_size_of(render_size))
        self.action_space: spaces.Box = spaces.Box(-1.0, 1.0, (4,), dtype=np.float32)
        self.observation_space = spaces.Dict(
            {
                "agent_pos": spaces.Box(-np.inf, np.inf, (4,), dtype=np.float32),
                "environment_state": spaces.Box(-np.inf, np.inf, (6,), dtype=np.float32),
            }
        )
        # What Meta-World's own policies observe, ``(39,)``.
        self.own_observation = np.zeros(39)
        self._is_running = self._is_collision = False
        self._path_length = 0.0

    @property
    def hand_target(self) -> np.ndarray:
        """``(3,)`` the position to which the hand is pulled [m]."""
        return self._wall_task.hand_target.copy()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Starts an episode. There are no options."""
        super().reset(seed=seed)
        self.own_observation = self._wall_task.reset(self.np_random.uniform(*self._wall_task.positions))
        self._is_running, self._is_collision, self._path_length = True, False, 0.0
        return self._observation(), self._info(False, self._wall_task.clearance())

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Moves the hand's target by ``action[:3]`` [cm], and closes the gripper with an effort of ``action[3]``.

        Raises:
            ValueError: If the action is not four finite numbers.
        """
        if not self._is_running:
            raise gym.error.ResetNeeded("call reset() before step()")
        given = np.asarray(action, dtype=np.float64)
        if given.shape != (4,) or not np.isfinite(given).all():
            raise ValueError(f"an action must be four finite numbers, got {action}")
        before = self.own_observation[:3]
        self.own_observation, is_success, depth = self._wall_task.step(given.clip(-1, 1))
        self._path_length += math.dist(before, self.own_observation[:3])
        is_first = depth > 0 and not self._is_collision
        self._is_collision |= depth > 0
        clearance = min(self._wall_task.clearance(), -depth if depth > 0 else math.inf)
        info = self._info(is_success, clearance)
        terminated = self._terminate_on_success and is_success
        return self._observation(), -1.0 if is_first else 0.0, terminated, False, info

    def render(self) -> np.ndarray | None:
        """An image ``(H, W, 3)`` uint8 of gripper, wall, object and goal.

        Raises:
            RuntimeError: If this machine cannot render; the message says what to install.
        """
        if self.render_mode is None:
            return None
        if not self._is_running:
            raise gym.error.ResetNeeded("call reset() before render()")
        return self._camera.render(self._wall_task.data)

    def close(self) -> None:
        """Frees the simulation."""
        self._camera.close()

    def _observation(self) -> dict[str, np.ndarray]:
        seen = self.own_observation
        return {
            "agent_pos": seen[:4].astype(np.float32),
            "environment_state": np.concatenate([seen[4:7], self._wall_task.goal]).astype(np.float32),
        }

    def _info(self, is_success: bool, clearance: float) -> dict[str, Any]:
        return {
            "is_success": is_success,
            "is_collision": self._is_collision,
            "clearance": clearance,
            "path_length": self._path_length,
        }
