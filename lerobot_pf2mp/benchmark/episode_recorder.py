# SPDX-License-Identifier: Apache-2.0
"""Records the info and plans of every episode of a vectorised environment.

LeRobot's evaluation keeps only rewards and success.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from lerobot_pf2mp.benchmark.executed_plans import ExecutedPlans

# The keys of an environment's info that are recorded, and how the values of all steps are combined.
_OVER_STEPS: dict[str, Callable[[float, float], float]] = {
    "is_collision": max,
    "is_obstacle_collision": max,
    "is_plan_in_wall": max,
    "clearance": min,
    "path_length": max,
    "stroke_error": lambda _, latest: latest,
    "plans_drawn": max,
    "n_plans": max,
    "is_plan_flagged": max,
}


@dataclass(frozen=True)
class Episode:
    """The outcome of one episode. Numbers that the environment does not report are None.

    Args:
        collision: Whether there was a collision (``is_collision`` of any step in the environment's info).
        min_clearance: Smallest ``clearance`` of all steps [m].
        path_length: ``path_length`` at the end [m].
        steps: Control steps.
        plan_in_wall: Whether an action lay inside an obstacle (``is_plan_in_wall`` of any step).
        stroke_error: ``stroke_error`` at the end [m].
        plans_drawn: Plans that the policy drew; None if it does not say.
        n_plans: Plans of which actions were executed; None in the same case.
        plan_flagged: Whether one of those still left the demonstrated region; None in the same case.
        obstacle_collision: Whether there was a collision with an obstacle that the demonstrations did not have.
    """

    collision: bool | None
    min_clearance: float | None
    path_length: float | None
    steps: int
    plan_in_wall: bool | None = None
    stroke_error: float | None = None
    plans_drawn: int | None = None
    n_plans: int | None = None
    plan_flagged: bool | None = None
    obstacle_collision: bool | None = None


class EpisodeRecorder(gym.vector.VectorWrapper):
    """A vectorised environment that records its episodes.

    Args:
        env: The environment. Its sub-environments must not change after the end of their episode.
    """

    def __init__(self, env: gym.vector.VectorEnv) -> None:
        super().__init__(env)
        self._finished: list[Episode] = []
        self._plans: ExecutedPlans | None = None
        self._steps = np.zeros(env.num_envs, dtype=int)
        self._ended = np.ones(env.num_envs, dtype=bool)
        self._reported: list[dict[str, float]] = [{} for _ in range(env.num_envs)]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "env":
            raise AttributeError(name)
        # Gymnasium's wrapper does not forward `call` and `envs`, which LeRobot uses.
        return getattr(self.env, name)

    def watch(self, policy: Any) -> None:
        """Records also the plans of the policy that steps this environment, from the next reset on.

        The info of each step then says what `ExecutedPlans.count` returns.
        """
        self._plans = ExecutedPlans(policy, self.num_envs)

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Starts the next episodes. The episodes before count as finished."""
        self._finish()
        observation, info = self.env.reset(**kwargs)
        self._steps[:] = 0
        self._ended[:] = False
        self._reported = [{} for _ in range(self.num_envs)]
        if self._plans is not None:
            self._plans.forget()
        self._record(info)
        return observation, info

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Steps all sub-environments; a sub-environment is not recorded after the end of its episode."""
        observation, reward, terminated, truncated, info = self.env.step(actions)
        self._steps += ~self._ended
        if self._plans is not None:
            info = {**info, **self._plans.count(~self._ended)}
        self._record(info)
        self._ended |= np.asarray(terminated) | np.asarray(truncated)
        return observation, reward, terminated, truncated, info

    def take_episodes(self, n_episodes: int) -> list[Episode]:
        """Returns the first episodes since the last call, in the order of the sub-environments of each rollout."""
        self._finish()
        episodes, self._finished = self._finished[:n_episodes], []
        return episodes

    def _record(self, info: dict[str, Any]) -> None:
        for key, combine in _OVER_STEPS.items():
            values = info.get(key)
            if values is None:
                continue
            is_given = info.get(f"_{key}", np.ones(self.num_envs, dtype=bool))
            for i in np.flatnonzero(is_given & ~self._ended):
                reported = self._reported[i]
                value = float(values[i])
                reported[key] = combine(reported.get(key, value), value)

    def _finish(self) -> None:
        if not self._steps.any():
            return
        for steps, reported in zip(self._steps.tolist(), self._reported, strict=True):
            self._finished.append(
                Episode(
                    collision=_bool_or_none(reported.get("is_collision")),
                    plan_in_wall=_bool_or_none(reported.get("is_plan_in_wall")),
                    min_clearance=reported.get("clearance"),
                    path_length=reported.get("path_length"),
                    stroke_error=reported.get("stroke_error"),
                    steps=steps,
                    plans_drawn=_int_or_none(reported.get("plans_drawn")),
                    n_plans=_int_or_none(reported.get("n_plans")),
                    plan_flagged=_bool_or_none(reported.get("is_plan_flagged")),
                    obstacle_collision=_bool_or_none(reported.get("is_obstacle_collision")),
                )
            )
        self._steps[:] = 0


def _bool_or_none(value: float | None) -> bool | None:
    return None if value is None else bool(value)


def _int_or_none(value: float | None) -> int | None:
    return None if value is None else int(value)
