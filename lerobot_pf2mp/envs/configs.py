# SPDX-License-Identifier: Apache-2.0
"""LeRobot's configurations of the environments (``--env.type=...``)."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from lerobot_pf2mp.errors import ConfigError

MAZE_TASKS = {"MazeUMaze-v0": "umaze", "MazeMedium-v0": "medium", "MazeLarge-v0": "large"}


@EnvConfig.register_subclass("pf2mp_maze")
@dataclass
class PF2MPMazeEnv(EnvConfig):
    """The maze environments, `lerobot_pf2mp.envs.maze.MazeEnv`.

    Args:
        task: MazeUMaze-v0, MazeMedium-v0 or MazeLarge-v0.
        fps: Control frequency [Hz].
        episode_length: Steps after which an episode ends.
        maze_map: A map of your own instead of the task's: rows of 0 (free) and 1 (wall) separated by "/", for example
            11111/10001/11111.
        control: exact (the ball reaches each action) or pd (a PD controller drives it in full physics).
        collision_radius: What must not touch a wall [m]: 0.1 is the ball, 0 its centre.
        terminate_on_success: Whether an episode ends at the goal rather than after `episode_length` steps.
        render_size: Longer side of the rendered picture [pixels].
    """

    task: str | None = "MazeLarge-v0"
    fps: int = 10
    episode_length: int = 80
    maze_map: str | None = None
    control: str = "exact"
    collision_radius: float = 0.1
    terminate_on_success: bool = False
    render_size: int = 480
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(2,)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(2,)),
            "environment_state": PolicyFeature(type=FeatureType.ENV, shape=(2,)),
        }
    )
    features_map: dict[str, str] = field(
        default_factory=lambda: {
            ACTION: ACTION,
            "agent_pos": OBS_STATE,
            "environment_state": OBS_ENV_STATE,
        }
    )

    def __post_init__(self) -> None:
        """Validates the task.

        Raises:
            ConfigError: If there is no such task.
        """
        if self.task not in MAZE_TASKS:
            raise ConfigError(f"task must be one of {list(MAZE_TASKS)}, got {self.task!r}")

    @property
    def package_name(self) -> str:
        """The package that registers the environments with Gymnasium."""
        return "lerobot_pf2mp"

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments for ``gymnasium.make``."""
        kwargs: dict[str, Any] = {
            "max_episode_steps": self.episode_length,
            "control": self.control,
            "fps": self.fps,
            "collision_radius": self.collision_radius,
            "terminate_on_success": self.terminate_on_success,
            "render_mode": "rgb_array",
            "render_size": self.render_size,
        }
        if self.maze_map is not None:
            kwargs["maze_map"] = self.maze_map
        return kwargs

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """The vectorised environment, ``{type: {0: env}}``.

        Finished sub-environments are frozen until the next rollout. LeRobot's default resets them at once and then
        counts the first reward of the next episode, here a collision, into the finished one.
        """
        # The prefix makes a worker process import the module that registers the environment.
        make_env = partial(
            gym.make,
            f"lerobot_pf2mp:{self.gym_id}",
            disable_env_checker=self.disable_env_checker,
            **self.gym_kwargs,
        )
        env_fns = [freeze_after_episode_end(make_env)] * n_envs
        env: gym.vector.VectorEnv
        autoreset_mode = gym.vector.AutoresetMode.NEXT_STEP
        if use_async_envs and n_envs > 1:
            env = gym.vector.AsyncVectorEnv(env_fns, context="forkserver", autoreset_mode=autoreset_mode)
        else:
            env = gym.vector.SyncVectorEnv(env_fns, autoreset_mode=autoreset_mode)
        return {self.type: {0: env}}
