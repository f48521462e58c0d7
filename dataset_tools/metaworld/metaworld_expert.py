# SPDX-License-Identifier: Apache-2.0
"""Meta-World's shipped experts, recorded as they act."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from metaworld import policies

from lerobot_pf2mp.envs.metaworld.metaworld_env import DISPLACEMENT, MetaWorldEnv

_EXPERTS: dict[str, Any] = {
    "reach-wall-v3": policies.SawyerReachWallV3Policy,
    "push-wall-v3": policies.SawyerPushWallV3Policy,
    "pick-place-wall-v3": policies.SawyerPickPlaceWallV3Policy,
}


@dataclass
class Attempt:
    """What an expert saw and did in one episode.

    Args:
        observations: The environment's observation before each action.
        actions: ``(4,)`` the actions that were executed.
        images: ``(H, W, 3)`` uint8, one for each action; empty if the environment does not render.
        is_success: Whether Meta-World says so after the last step.
        is_collision: Whether the robot or the object touched the wall.
    """

    observations: list[dict[str, np.ndarray]] = field(default_factory=list)
    actions: list[np.ndarray] = field(default_factory=list)
    images: list[np.ndarray] = field(default_factory=list)
    is_success: bool = False
    is_collision: bool = False


class MetaWorldExpert:
    """Meta-World's own scripted policy for a task.

    Args:
        env: The environment.
        task: The task's name in Meta-World.
        seed: Seed of all demonstrations.
    """

    def __init__(self, env: MetaWorldEnv, task: str, seed: int = 0) -> None:
        self._env = env
        self._policy = _EXPERTS[task]()
        self._seed = seed

    def demonstrate(self, number: int, n_steps: int) -> Attempt:
        """Demonstrates one episode of `n_steps` steps; `number` is part of its seed.

        The expert asks for more than the environment does: for displacements beyond the range of actions, and out of the
        box of the hand's target. What the environment executes is recorded. It has the same effect, and its sum is the way
        of the hand's target.
        """
        (seed,) = np.random.SeedSequence([self._seed, number]).generate_state(1)
        observation, info = self._env.reset(seed=int(seed))
        attempt = Attempt()
        for _ in range(n_steps):
            image = self._env.render()
            if image is not None:
                attempt.images.append(image)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that the environment clips its actions
                action = self._policy.get_action(self._env.own_observation)
            attempt.observations.append(observation)
            before = self._env.hand_target
            observation, _, _, _, info = self._env.step(action)
            displacement = (self._env.hand_target - before) / DISPLACEMENT
            executed = np.array([*displacement, action[3]]).clip(-1, 1)
            attempt.actions.append(executed.astype(np.float32))
            if info["is_collision"]:
                break
        attempt.is_success, attempt.is_collision = info["is_success"], info["is_collision"]
        return attempt
