# SPDX-License-Identifier: Apache-2.0
"""Stable-Baselines3's PPO, and its SAC with hindsight experience replay, configured for the Fetch tasks."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch
from gymnasium import spaces

from lerobot_pf2mp.dataset_tools.experts.expert_settings import ExpertSettings
from lerobot_pf2mp.dataset_tools.experts.goal_env import goal_spaces, make_goal_env, observation_units

try:
    from stable_baselines3 import PPO, SAC, HerReplayBuffer
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.logger import Logger
    from stable_baselines3.common.policies import BasePolicy
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
    from stable_baselines3.common.vec_env import DummyVecEnv
except ModuleNotFoundError as error:
    raise ImportError(
        'experts trained by reinforcement learning need: pip install "lerobot_policy_pf2mp[experts]"'
    ) from error

ALGORITHMS: dict[str, type[BaseAlgorithm]] = {"ppo": PPO, "sac_her": SAC}


class GoalFeatures(BaseFeaturesExtractor):
    """Observation, goal, and the offset to the goal, in fixed units.

    Positions within 0.3 m around 1 m are hard to learn from. rl-baselines3-zoo normalises FetchReach by running statistics
    for the same reason.

    Args:
        observation_space: The observation space of `FetchGoalEnv`.
    """

    # These names are in the files of saved experts.
    _centre: torch.Tensor
    _scale: torch.Tensor

    def __init__(self, observation_space: spaces.Dict) -> None:
        size = observation_space["observation"].shape[0]  # type: ignore[index]
        super().__init__(observation_space, size + 6)
        centre, unit = observation_units(has_block=size > 6)
        # Positions of the gripper come first.
        self.register_buffer("_centre", torch.tensor([*centre, *centre[:3], 0, 0, 0], dtype=torch.float32))
        self.register_buffer("_scale", torch.tensor([*unit, *unit[:3], *unit[:3]], dtype=torch.float32))

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """Features ``(B, D + 6)``."""
        goal = observations["desired_goal"]
        parts = [observations["observation"], goal, goal - observations["achieved_goal"]]
        return (torch.cat(parts, dim=1) - self._centre) / self._scale  # (B, D + 6)


class PenalisingReplayBuffer(HerReplayBuffer):
    """A replay buffer that keeps the penalty for touching the wall when it relabels a step with another goal.

    Stable-Baselines3 can store the whole information of each step for that. But this is slow, and it would have to be
    pickled.

    Args:
        *args: Arguments of `HerReplayBuffer`.
        collision_penalty: See `FetchGoalEnv`.
        **options: Arguments of `HerReplayBuffer`.
    """

    def __init__(self, *args: Any, collision_penalty: float, **options: Any) -> None:
        super().__init__(*args, **options)
        self._collision_penalty = collision_penalty
        self.touching = np.zeros((self.buffer_size, self.n_envs), dtype=bool)

    def add(self, *args: Any) -> None:
        """Adds a step; the last argument is its information, one dict for each environment."""
        self.touching[self.pos] = [info["is_touching"] for info in args[-1]]
        super().add(*args)

    def _get_virtual_samples(
        self, batch_indices: np.ndarray, env_indices: np.ndarray, env: Any = None
    ) -> Any:
        samples = super()._get_virtual_samples(batch_indices, env_indices, env)
        touching = self.to_torch(self.touching[batch_indices, env_indices].astype(np.float32))
        return samples._replace(rewards=samples.rewards - self._collision_penalty * touching[:, None])


def make_algorithm(settings: ExpertSettings, device: str) -> BaseAlgorithm:
    """Makes an untrained algorithm with its environments."""
    parameters = settings.hyperparameters
    scene_changes = settings.plain["scene"]
    make = partial(make_goal_env, settings.task, scene_changes, settings.reward, settings.collision_penalty)
    env = DummyVecEnv([make] * parameters.pop("n_envs", 1))
    del parameters["net_arch"]
    if settings.algo == "sac_her":
        parameters["replay_buffer_class"] = PenalisingReplayBuffer
        parameters["replay_buffer_kwargs"] = {
            "n_sampled_goal": parameters.pop("n_sampled_goal"),
            "goal_selection_strategy": "future",
            "collision_penalty": settings.collision_penalty,
        }
    algorithm = ALGORITHMS[settings.algo](
        "MultiInputPolicy",
        env,
        policy_kwargs=_policy_options(settings),
        seed=settings.seed,
        device=device,
        **parameters,
    )
    algorithm.set_logger(Logger(folder=None, output_formats=[]))  # by default it makes a folder in /tmp
    return algorithm


def make_policy(settings: ExpertSettings) -> BasePolicy:
    """Makes the untrained policy of the algorithm, without environments, on the CPU."""
    policy_class = ALGORITHMS[settings.algo].policy_aliases["MultiInputPolicy"]
    observation_space, action_space = goal_spaces(settings.scene.has_block)
    return policy_class(
        observation_space,
        action_space,
        lambda _: settings.hyperparameters["learning_rate"],
        **_policy_options(settings),
    )


def _policy_options(settings: ExpertSettings) -> dict[str, Any]:
    return {"net_arch": settings.hyperparameters["net_arch"], "features_extractor_class": GoalFeatures}
