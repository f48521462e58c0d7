# SPDX-License-Identifier: Apache-2.0
"""The base class of LeRobot's configurations of our environments (``--env.type=...``)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import gymnasium as gym
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGE, OBS_STATE

from lerobot_pf2mp.envs.tasks import OBS_TYPES
from lerobot_pf2mp.errors import ConfigError


@dataclass
class CollisionEnvConfig(EnvConfig):
    """Configuration of an environment that reports collisions.

    Args:
        features_map: LeRobot's name of each feature. An environment does not need to have all of them.
        obs_type: state (of the robot and of the environment) or pixels_agent_pos (state of the robot and rendered images).
    """

    features_map: dict[str, str] = field(
        default_factory=lambda: {
            ACTION: ACTION,
            "agent_pos": OBS_STATE,
            "environment_state": OBS_ENV_STATE,
            "pixels": OBS_IMAGE,
        }
    )
    obs_type: str = "state"

    @property
    def package_name(self) -> str:
        """The package that registers the environments with Gymnasium."""
        return "lerobot_pf2mp"

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """The vectorised environment, ``{type: {0: env}}``.

        Finished sub-environments are frozen until the next rollout. LeRobot's default resets them at once. It then adds
        the first reward of the next episode, here a collision, to the finished episode.
        """
        # The prefix makes a worker process import the module that registers the environment.
        make_env = partial(
            gym.make,
            f"lerobot_pf2mp:{self.gym_id}",
            disable_env_checker=self.disable_env_checker,
            obs_type=self.obs_type,
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

    def _describe(
        self, action_dim: int, environment_dim: int, image_size: Callable[[], tuple[int, int]]
    ) -> None:
        """Sets `features`.

        Args:
            action_dim: Dimension of the action, and of the robot's state.
            environment_dim: Dimension of the environment's state; 0 without one.
            image_size: Height and width of rendered images [pixels].

        Raises:
            ConfigError: If `obs_type` does not exist.
        """
        if self.obs_type not in OBS_TYPES:
            raise ConfigError(f"obs_type must be one of {list(OBS_TYPES)}, got {self.obs_type!r}")
        self.features = {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(action_dim,)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(action_dim,)),
        }
        if self.obs_type == "pixels_agent_pos":
            pixels = PolicyFeature(type=FeatureType.VISUAL, shape=(*image_size(), 3))
            self.features["pixels"] = pixels
        elif environment_dim:
            shape = (environment_dim,)
            self.features["environment_state"] = PolicyFeature(type=FeatureType.ENV, shape=shape)
