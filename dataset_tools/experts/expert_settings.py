# SPDX-License-Identifier: Apache-2.0
"""The settings of an expert trained by reinforcement learning, except the number of steps."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from lerobot_pf2mp.dataset_tools.experts.goal_env import EPISODE_STEPS, check_reward
from lerobot_pf2mp.envs.fetch.fetch_scene import FETCH_SCENES, FetchScene, make_scene

# Hyperparameters by algorithm, with the names and meanings of Stable-Baselines3. `options` changes them.
HYPERPARAMETERS: dict[str, dict[str, Any]] = {
    # rl-baselines3-zoo has no entry for PPO on Fetch, because PPO learns little from Fetch's sparse reward. These are the
    # defaults of Stable-Baselines3 (rollouts of 2048 steps in total, 10 epochs, clipping at 0.2) with three exceptions:
    # gamma and the learning rate are those of the zoo's Fetch entries, and batches are larger, which takes less time.
    "ppo": {
        "n_envs": 4,
        "n_steps": 512,
        "batch_size": 256,
        "n_epochs": 10,
        "learning_rate": 1e-3,
        "gamma": 0.95,
        "gae_lambda": 0.95,
        "clip_range": 0.2,
        "net_arch": [64, 64],
    },
    # "her-defaults" of rl-baselines3-zoo 22e3ff2, hyperparams/tqc.yml, which FetchPush uses for 1e6 steps; TQC is SAC with
    # another critic. learning_starts is from its FetchReach entry.
    "sac_her": {
        "buffer_size": 1_000_000,
        "learning_starts": 1000,
        "batch_size": 2048,
        "learning_rate": 1e-3,
        "gamma": 0.95,
        "tau": 0.05,
        "train_freq": 1,
        "gradient_steps": 1,
        "n_sampled_goal": 4,
        "net_arch": [512, 512, 512],
    },
}
DEFAULT_ALGO = {"reach": "ppo", "push": "sac_her"}
DEFAULT_REWARD = {"ppo": "dense", "sac_her": "sparse"}

_AT_MOST_1 = ("gamma", "gae_lambda", "clip_range", "tau")


@dataclass(frozen=True)
class ExpertSettings:
    """The settings of an expert. The same settings and the same number of steps give the same expert.

    Args:
        task: reach or push.
        algo: ppo, or sac_her: SAC with hindsight experience replay.
        reward: sparse or dense, see `FetchGoalEnv`.
        collision_penalty: Subtracted from the reward of each step that touches the wall.
        seed: Seed of all random numbers.
        scene: The wall, and the ranges of starts and goals.
        options: Changes to the algorithm's `HYPERPARAMETERS`.

    Raises:
        ValueError: If one of them breaks its rule.
    """

    task: str
    algo: str
    reward: str
    collision_penalty: float
    seed: int
    scene: FetchScene
    options: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_reward(self.reward, self.collision_penalty)
        if self.seed < 0:
            raise ValueError(f"seed must be at least 0, got {self.seed}")
        for name, value in self.options.items():
            _check_option(self.algo, name, value)
        size = self.hyperparameters["batch_size"]
        if self.algo == "ppo" and (size < 2 or self.rollout_steps % size):
            raise ValueError(
                f"batch_size must be at least 2 and divide n_envs x n_steps = {self.rollout_steps}, got {size}"
            )

    @classmethod
    def of(
        cls,
        task: str,
        algo: str | None = None,
        *,
        reward: str | None = None,
        collision_penalty: float = 0.0,
        seed: int = 0,
        scene_changes: dict[str, Any] | None = None,
        options: dict[str, Any] | None = None,
    ) -> ExpertSettings:
        """Makes settings, with defaults for arguments that are None. `scene_changes` are arguments of `FetchScene`.

        Raises:
            ValueError: If one of them breaks its rule.
        """
        if task not in FETCH_SCENES:
            raise ValueError(f"task must be one of {list(FETCH_SCENES)}, got {task!r}")
        algo = DEFAULT_ALGO[task] if algo is None else algo
        if algo not in HYPERPARAMETERS:
            raise ValueError(f"algo must be one of {list(HYPERPARAMETERS)}, got {algo!r}")
        reward = DEFAULT_REWARD[algo] if reward is None else reward
        scene = make_scene(task, **(scene_changes or {}))
        return cls(task, algo, reward, float(collision_penalty), seed, scene, options or {})

    @classmethod
    def from_plain(cls, content: dict[str, Any]) -> ExpertSettings:
        """Makes settings from the content of `plain`."""
        unknown = sorted(set(content) ^ {each.name for each in fields(cls)})
        if unknown:
            raise ValueError(f"settings are missing or unknown: {', '.join(unknown)}")
        scene = content["scene"]
        return cls.of(
            **{name: value for name, value in content.items() if name != "scene"}, scene_changes=scene
        )

    @property
    def plain(self) -> dict[str, Any]:
        """The settings as dicts, lists and numbers."""
        return to_plain(asdict(self))

    @property
    def hyperparameters(self) -> dict[str, Any]:
        """The hyperparameters of the algorithm, with the changes of `options`."""
        return {**HYPERPARAMETERS[self.algo], **self.options}

    @property
    def rollout_steps(self) -> int:
        """Environment steps between updates. The total number of steps is a multiple of it."""
        parameters = self.hyperparameters
        if self.algo == "ppo":
            return parameters["n_envs"] * parameters["n_steps"]
        return parameters["train_freq"]

    def difference(self, other: ExpertSettings) -> str | None:
        """The name of the first setting with another value in `other`; None if all are equal."""
        mine, others = self.plain, other.plain
        return next((name for name in mine if mine[name] != others[name]), None)


def to_plain(content: dict[str, Any]) -> dict[str, Any]:
    """The content after a round trip through JSON, with lists instead of tuples."""
    return json.loads(json.dumps(content))


def _check_option(algo: str, name: str, value: Any) -> None:
    known = HYPERPARAMETERS[algo]
    if name not in known:
        raise ValueError(f"options of {algo} must be among {list(known)}, got {name!r}")
    if name == "net_arch":
        rule = "a list of positive sizes"
        holds = isinstance(value, list) and len(value) > 0 and all(_is_count(size) for size in value)
    elif isinstance(known[name], int):
        # Training can start only after the first episode, and the buffer must hold a whole episode.
        least = EPISODE_STEPS if name in ("learning_starts", "buffer_size") else 1
        rule, holds = f"a whole number and at least {least}", _is_count(value) and value >= least
    else:
        rule = "above 0 and at most 1" if name in _AT_MOST_1 else "above 0 and finite"
        holds = type(value) in (int, float) and 0 < value <= (1 if name in _AT_MOST_1 else sys.float_info.max)
    if not holds:
        raise ValueError(f"{name} must be {rule}, got {value}")


def _is_count(value: Any) -> bool:
    return type(value) is int and value > 0
