# SPDX-License-Identifier: Apache-2.0
"""The Fetch tasks for reinforcement learning: small displacements as actions, goals, and a reward for their distance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from lerobot_pf2mp.envs.fetch.fetch_env import FetchEnv
from lerobot_pf2mp.envs.fetch.fetch_scene import SUCCESS_RADIUS, WORKSPACE
from lerobot_pf2mp.envs.tasks import FETCH_STEPS

EPISODE_STEPS = FETCH_STEPS
# Largest step of the gripper [m]. Where it turns, it overshoots by up to 0.4 mm, and steps above 0.03 m, `MAX_STEP` of
# `FetchEnv`, are too long for a demonstration.
LARGEST_STEP = 0.028
REWARDS = ("sparse", "dense")
_DT = 0.04  # duration of a step [s]

Observation = dict[str, np.ndarray]


class FetchGoalEnv(gym.Env):
    """`FetchEnv` with the interface of goal-based environments, which hindsight experience replay needs.

    ## Action space
    ``Box(-1, 1, (3,))``: the displacement of the gripper in units of `LARGEST_STEP` [m]. A longer one is
    shortened to length 1.

    ## Observation space
    ``Dict`` of ``observation``, ``achieved_goal`` ``(3,)`` and ``desired_goal`` ``(3,)`` [m], float32. The achieved
    goal is the gripper's position for Reach, the block's for Push. ``observation`` is for Reach ``(6,)`` the gripper's
    position [m] and velocity [m/s]; for Push ``(15,)`` the positions of gripper and block [m], block minus gripper [m], and
    their velocities [m/s]; x, y, z each. Velocities are finite differences over a step, 0 at the start.

    ## Rewards
    sparse: 0 within 0.05 m of the goal, -1 elsewhere. dense: minus the distance [m]. In each step that touches the wall,
    `collision_penalty` is subtracted from both.

    ## Information
    That of `FetchEnv`, and ``is_touching``: the robot or the block has touched the wall in this step.

    ## Episode end
    Never: `make_goal_env` adds the time limit. The wall stops the robot, but the episode continues.

    Args:
        env: The environment, with one inner step for each action.
        reward: One of `REWARDS`.
        collision_penalty: Penalty for each step that touches the wall. 0 as in the paper, where the wall only stops the
            robot.

    Raises:
        ValueError: If there is no such reward, or the penalty is negative.
    """

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, env: FetchEnv, reward: str = "sparse", collision_penalty: float = 0.0) -> None:
        check_reward(reward, collision_penalty)
        self._env = env
        self._is_sparse = reward == "sparse"
        self._collision_penalty = collision_penalty
        self.observation_space, self.action_space = goal_spaces(env.scene.has_block)
        self.seen: Observation = {}  # the last observation of FetchEnv

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode; the options are those of `FetchEnv`."""
        super().reset(seed=seed)
        self.seen, info = self._env.reset(seed=seed, options=options)
        return self._observation(self.seen), {**info, "is_touching": False}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Moves the gripper by a displacement ``(3,)`` [`LARGEST_STEP`]."""
        displacement = np.asarray(action, dtype=np.float64)
        displacement = LARGEST_STEP * displacement / max(1.0, math.hypot(*displacement))
        before = self.seen
        self.seen, _, _, _, info = self._env.step(before["agent_pos"] + displacement)
        info["is_touching"] = info["clearance"] < 0
        observation = self._observation(before)
        reward = self.compute_reward(observation["achieved_goal"], observation["desired_goal"], info)
        return observation, float(reward), False, False, info

    def compute_reward(
        self,
        achieved_goal: np.ndarray,
        desired_goal: np.ndarray,
        info: dict[str, Any] | Sequence[dict[str, Any]],
    ) -> np.ndarray:
        """The reward ``(...)`` of achieved goals.

        Args:
            achieved_goal: ``(..., 3)`` [m].
            desired_goal: ``(..., 3)`` [m].
            info: The step's information, or one for each of ``(B, 3)`` goals. Without ``is_touching`` there is no penalty.
        """
        distance = np.linalg.norm(np.subtract(achieved_goal, desired_goal, dtype=np.float64), axis=-1)
        reward = -(distance >= SUCCESS_RADIUS).astype(np.float64) if self._is_sparse else -distance
        if self._collision_penalty:
            infos = [info] if isinstance(info, dict) else info
            touching = np.array([bool(each.get("is_touching", False)) for each in infos])
            reward = reward - self._collision_penalty * touching.reshape(distance.shape)
        return np.asarray(reward)

    def close(self) -> None:
        """Frees the simulation."""
        self._env.close()

    def _observation(self, before: Observation) -> Observation:
        grip, environment_state = self.seen["agent_pos"], self.seen["environment_state"]
        grip_velocity = (grip - before["agent_pos"]) / _DT
        if not self._env.scene.has_block:
            parts, achieved = [grip, grip_velocity], grip
        else:
            block = environment_state[:3]
            block_velocity = (block - before["environment_state"][:3]) / _DT
            parts, achieved = [grip, block, block - grip, grip_velocity, block_velocity], block
        return {
            "observation": np.concatenate(parts).astype(np.float32),
            "achieved_goal": achieved.copy(),
            "desired_goal": environment_state[-3:].copy(),
        }


def make_goal_env(
    task: str, scene_changes: dict[str, Any], reward: str, collision_penalty: float = 0.0
) -> gym.Env:
    """Makes a `FetchGoalEnv` with episodes of `EPISODE_STEPS` steps.

    Args:
        task: reach or push.
        scene_changes: Arguments of `FetchScene` that replace those of the task; None keeps the value of the task.
        reward: One of `REWARDS`.
        collision_penalty: Penalty for each step that touches the wall.
    """
    env = FetchGoalEnv(FetchEnv(task, **scene_changes), reward, collision_penalty)
    return gym.wrappers.TimeLimit(env, EPISODE_STEPS)


def goal_spaces(has_block: bool) -> tuple[spaces.Dict, spaces.Box]:
    """The observation and action space of `FetchGoalEnv`."""
    sizes = {"observation": 15 if has_block else 6, "achieved_goal": 3, "desired_goal": 3}
    observation_space = spaces.Dict(
        {name: spaces.Box(-np.inf, np.inf, (size,), dtype=np.float32) for name, size in sizes.items()}
    )
    return observation_space, spaces.Box(-1.0, 1.0, (3,), dtype=np.float32)


def observation_units(has_block: bool) -> tuple[np.ndarray, np.ndarray]:
    """Centre and unit ``(D,)`` such that (x - centre) / unit is about -1 to 1 for each entry of ``observation``."""
    middle, half = np.asarray(WORKSPACE.centre), np.asarray(WORKSPACE.size) / 2
    still, fast = np.zeros(3), np.full(3, LARGEST_STEP / _DT)
    if not has_block:
        return np.concatenate([middle, still]), np.concatenate([half, fast])
    return np.concatenate([middle, middle, still, still, still]), np.concatenate(
        [half, half, half, fast, fast]
    )


def check_reward(reward: str, collision_penalty: float) -> None:
    """Checks the kind of reward.

    Raises:
        ValueError: If there is no such reward, or the penalty is negative.
    """
    if reward not in REWARDS:
        raise ValueError(f"reward must be one of {list(REWARDS)}, got {reward!r}")
    if not (math.isfinite(collision_penalty) and collision_penalty >= 0):
        raise ValueError(f"collision_penalty must be finite and at least 0, got {collision_penalty}")
