# SPDX-License-Identifier: Apache-2.0
"""Makes an environment by its name in Gymnasium, with the observations that are asked for."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import gymnasium as gym
from gymnasium.wrappers import AddRenderObservation, FilterObservation

from lerobot_pf2mp.envs.tasks import OBS_TYPES


def make_observed_env(env_class: str, obs_type: str = "state", **kwargs: Any) -> gym.Env:
    """An environment, for ``gymnasium.make(name, obs_type=...)``.

    Args:
        env_class: Its class in this package, ``module:Class``.
        obs_type: state (of the robot and of the environment), or pixels_agent_pos (the robot's state and rendered images).
        **kwargs: Arguments of the class.

    Raises:
        ValueError: If an argument breaks its rule.
    """
    if obs_type not in OBS_TYPES:
        raise ValueError(f"obs_type must be one of {list(OBS_TYPES)}, got {obs_type!r}")
    module, name = env_class.split(":")
    make_env = getattr(import_module(f"lerobot_pf2mp.envs.{module}"), name)
    if obs_type == "state":
        return make_env(**kwargs)
    env = make_env(**{**kwargs, "render_mode": "rgb_array"})
    kept = [key for key in ("agent_pos", "obstacles") if key in env.observation_space.spaces]
    return FilterObservation(AddRenderObservation(env, render_only=False), [*kept, "pixels"])
