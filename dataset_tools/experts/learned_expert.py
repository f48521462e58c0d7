# SPDX-License-Identifier: Apache-2.0
"""An expert for Fetch with a wall that was trained by reinforcement learning."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np

from lerobot_pf2mp.dataset_tools.experts.expert_checkpoint import ExpertCheckpoint
from lerobot_pf2mp.dataset_tools.experts.expert_settings import to_plain
from lerobot_pf2mp.dataset_tools.experts.goal_env import EPISODE_STEPS, FetchGoalEnv
from lerobot_pf2mp.dataset_tools.experts.recording import Recording
from lerobot_pf2mp.envs.fetch.fetch_env import FetchEnv
from lerobot_pf2mp.envs.fetch.fetch_scene import FetchScene


class LearnedFetchExpert:
    """Takes the deterministic actions, without noise, of a policy that `train_expert` wrote.

    Args:
        env: The environment, with the scene in which the expert was trained.
        folder: The expert's folder.
        seed: Seed of all demonstrations. Each demonstration has its own random numbers, so they do not depend on each
            other.

    Raises:
        ImportError: If Stable-Baselines3 is missing.
        OSError: If the folder lacks a file.
        ValueError: If the expert cannot be read, or was trained in another scene.
    """

    def __init__(self, env: FetchEnv, folder: Path, seed: int = 0) -> None:
        checkpoint = ExpertCheckpoint.read(folder)
        check_scene(checkpoint, env.scene)
        self._policy = checkpoint.load_policy()
        self._env = env
        self._goal_env = FetchGoalEnv(env)
        self._seed = seed

    def demonstrate(self, number: int) -> Recording:
        """Demonstrates one episode; `number` is part of its seed."""
        layout = self._env.scene.sample(np.random.default_rng([self._seed, number]))
        observation, info = self._goal_env.reset(
            options={"start": layout.start, "goal": layout.goal, "block": layout.block}
        )
        recording = Recording(layout.goal)
        recording.note(self._goal_env.seen, info, self._env.render())
        for _ in range(EPISODE_STEPS):
            action, _ = self._policy.predict(observation, deterministic=True)
            observation, _, _, _, info = self._goal_env.step(action)
            recording.note(self._goal_env.seen, info, self._env.render())
            if recording.is_collision:
                break
        return recording


def check_scene(checkpoint: ExpertCheckpoint, scene: FetchScene) -> None:
    """Checks that an expert was trained in a scene.

    Raises:
        ValueError: If it was trained in another one.
    """
    trained, given = checkpoint.settings.plain["scene"], to_plain(asdict(scene))
    for name, value in trained.items():
        if value != given[name]:
            raise ValueError(
                f"the expert in {checkpoint.folder} was trained for {checkpoint.settings.task} with {name} {value}, and "
                f"must be used in the same scene, got {given[name]}"
            )
