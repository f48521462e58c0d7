# SPDX-License-Identifier: Apache-2.0
"""Handwriting with many arms in one scene of a simulator; letters, regions and metrics are those of `HandwritingEnv`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding

from lerobot_pf2mp.envs.handwriting.handwriting_env import HandwritingEnv, physics_steps
from lerobot_pf2mp.envs.handwriting.ink import Ink
from lerobot_pf2mp.envs.handwriting.writing_episode import WritingEpisode, first_position

_TOUCH = -1e-6  # clearance of a step in which the simulator saw a contact that is over at its end [m]


class Arms(Protocol):
    """Arms of a simulator, each with a pen at a table of its own. Joint positions are those of `panda` [rad; m]."""

    timestep: float
    """Duration of a physics step [s]."""

    def place(self, joints: np.ndarray) -> None:
        """Puts all arms at rest at joint positions ``(N, J)``."""

    def drive(self, target: np.ndarray, n_steps: int) -> tuple[np.ndarray, np.ndarray]:
        """Drives all arms towards joint positions.

        Args:
            target: ``(N, J)`` joint positions, to which the controllers' set points move at constant speed.
            n_steps: Physics steps.

        Returns:
            ``(N, T, 3)`` positions of the tips during the motion [m], the first of them those before it, and ``(N,)``
            whether an arm or its pen's barrel has touched the table.
        """

    def joints(self) -> np.ndarray:
        """The measured joint positions ``(N, J)``."""

    def tips(self) -> np.ndarray:
        """The positions ``(N, 3)`` of the pens' tips [m]."""

    def close(self) -> None:
        """Frees what the simulator holds."""


@dataclass(frozen=True)
class OneArm:
    """One of the arms at the time when it was asked for.

    Args:
        judge: The environment that draws it.
        joints: ``(J,)`` joint positions [rad; m].
        pen: ``(3,)`` position of the pen's tip [m].
        ink: The line that it has drawn.
    """

    judge: HandwritingEnv
    joints: np.ndarray
    pen: np.ndarray
    ink: Ink

    @property
    def unwrapped(self) -> OneArm:
        """Itself."""
        return self

    def render(self) -> np.ndarray:
        """An image ``(H, W, 3)`` uint8."""
        return self.judge.draw(self.joints, self.ink)


class ManyArmsEnv(gym.vector.VectorEnv):
    """Franka Pandas that must draw a letter without entering restricted regions, all moved by one simulator.

    Spaces, rewards, info and options are those of `HandwritingEnv` with ``control="physics"``, for each arm; joint positions
    too. The simulator moves the arms and sees their contacts with the table. The model of `HandwritingEnv` measures
    clearances at the simulator's joint positions at the end of a step, and draws the images.

    All episodes end together. Then nothing happens until the next reset.

    Args:
        arms: The arms of the simulator.
        num_envs: How many there are.
        max_episode_steps: Number of steps after which the episodes end.
        fps: Control frequency [Hz], a divisor of the physics' frequency.
        **options: Other arguments of `HandwritingEnv`.

    Raises:
        ValueError: If an argument breaks its rule.
    """

    def __init__(
        self, arms: Arms, num_envs: int, *, max_episode_steps: int, fps: int, **options: Any
    ) -> None:
        for name, needed in {"robot": "panda", "control": "physics"}.items():
            if options.get(name, needed) != needed:
                raise ValueError(f"{name} must be {needed} with many arms, got {options[name]!r}")
        self._arms = arms
        self._judge = HandwritingEnv(fps=fps, **options)
        self.num_envs = num_envs
        self.metadata = {
            **self._judge.metadata,
            "autoreset_mode": gym.vector.AutoresetMode.DISABLED,
        }
        self.render_mode = self._judge.render_mode
        self.scene, self.kinematics = self._judge.scene, self._judge.kinematics
        self.task, self.task_description = self._judge.task, self._judge.task_description
        self.single_action_space: spaces.Box = self._judge.action_space
        self.single_observation_space = self._judge.observation_space
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, num_envs)
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, num_envs)
        self._max_episode_steps = max_episode_steps
        self._is_joint_space = self.single_action_space.shape != (2,)
        self._n_substeps = physics_steps(fps, arms.timestep)
        self._generators: list[np.random.Generator] = []
        self._episodes: list[WritingEpisode] = []
        self._n_steps = 0

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Starts an episode with every arm.

        Args:
            seed: Seeds of the arms; one number n gives them n, n + 1, ... None goes on.
            options: ``start``: positions of the pens ``(num_envs, 2)`` [m]; or ``joints``: positions of the joints
                ``(num_envs, 9)`` [rad; m].

        Raises:
            ValueError: If a start is not on the sheet, or joints are beyond their limits.
        """
        self._seed(seed)
        self._arms.place(self._first_joints(options or {}))
        tips, joints = self._arms.tips(), self._arms.joints()
        self._episodes = [
            WritingEpisode(self.scene, tip, self._judge.table_clearance(each))
            for tip, each in zip(tips, joints, strict=True)
        ]
        self._n_steps = 0
        return self._observation(joints), self._info()

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Moves the arms towards joint positions ``(num_envs, 9)`` [rad; m] or positions of the pens ``(num_envs, 2)`` [m].

        Raises:
            ValueError: If the actions have another shape or are not finite.
        """
        if not self._episodes:
            raise gym.error.ResetNeeded("call reset() before step()")
        targets = np.asarray(actions, dtype=np.float64)
        if targets.shape != self.action_space.shape or not np.isfinite(targets).all():
            raise ValueError(
                f"actions must be finite positions {self.action_space.shape}, got {targets.shape}"
            )
        rewards = np.zeros(self.num_envs)
        if self._n_steps < self._max_episode_steps:
            rewards = self._move(targets.clip(self.single_action_space.low, self.single_action_space.high))
            self._n_steps += 1
        is_over = np.full(self.num_envs, self._n_steps >= self._max_episode_steps)
        observation = self._observation(self._arms.joints())
        return observation, rewards, np.zeros(self.num_envs, dtype=bool), is_over, self._info()

    def render(self) -> tuple[np.ndarray, ...] | None:
        """An image ``(H, W, 3)`` uint8 of each arm, drawn as `HandwritingEnv` draws its own."""
        return None if self.render_mode is None else tuple(env.render() for env in self.envs)

    @property
    def envs(self) -> list[OneArm]:
        """The environments of the arms, as far as figures need them."""
        joints, tips = self._arms.joints(), self._arms.tips()
        return [
            OneArm(self._judge, each, tip, episode.ink)
            for each, tip, episode in zip(joints, tips, self._episodes, strict=True)
        ]

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """What the attribute or method of this name is or returns for each arm, as in Gymnasium's `SyncVectorEnv`."""
        found = getattr(self, name)
        return tuple(found(*args, **kwargs)) if callable(found) else (found,) * self.num_envs

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """The attribute of this name of each environment."""
        return self.call(name)

    def close_extras(self, **kwargs: Any) -> None:
        """Frees the scene and the camera."""
        self._arms.close()
        self._judge.close()

    def _seed(self, seed: int | Sequence[int | None] | None) -> None:
        seeds: Sequence[int | None]
        if isinstance(seed, int | np.integer):
            seeds = [int(seed) + number for number in range(self.num_envs)]
        else:
            seeds = [None] * self.num_envs if seed is None else seed
        if not self._generators:
            self._generators = [seeding.np_random(None)[0] for _ in range(self.num_envs)]
        for number, each in enumerate(seeds):
            if each is not None:
                self._generators[number] = seeding.np_random(each)[0]

    def _first_joints(self, options: dict[str, Any]) -> np.ndarray:
        joints = options.get("joints")
        if joints is not None:
            self._judge.check_joints(np.asarray(joints), "joints")
            return np.asarray(joints, dtype=np.float64)
        starts = options.get("start")
        starts = [None] * self.num_envs if starts is None else starts
        places = map(first_position, [self.scene] * self.num_envs, starts, self._generators)
        return self.kinematics.joint_trajectory(np.array(list(places)))

    def _move(self, targets: np.ndarray) -> np.ndarray:
        joints, beyond = targets, [0.0] * self.num_envs
        if not self._is_joint_space:
            found = [self.kinematics.nearest_joints(target) for target in targets]
            joints, beyond = np.array([each[0] for each in found]), [each[1] for each in found]
        tips, has_touched = self._arms.drive(joints, self._n_substeps)
        clearances = [
            min(self._judge.table_clearance(each), _TOUCH if touched else np.inf)
            for each, touched in zip(self._arms.joints(), has_touched, strict=True)
        ]
        recorded = zip(self._episodes, tips, clearances, beyond, strict=True)
        return np.array([episode.record(*step) for episode, *step in recorded])

    def _observation(self, joints: np.ndarray) -> dict[str, np.ndarray]:
        measured = joints if self._is_joint_space else self._arms.tips()[:, :2]
        return {"agent_pos": measured.astype(np.float32)}

    def _info(self) -> dict[str, Any]:
        infos = [episode.info for episode in self._episodes]
        info: dict[str, Any] = {key: np.array([each[key] for each in infos]) for key in infos[0]}
        return info | {f"_{key}": np.ones(self.num_envs, dtype=bool) for key in infos[0]}
