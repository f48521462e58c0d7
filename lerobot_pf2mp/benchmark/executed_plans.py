# SPDX-License-Identifier: Apache-2.0
"""Counts the plans that a policy draws and executes, robot by robot."""

from __future__ import annotations

from typing import Any

import numpy as np

from lerobot_pf2mp.policies.plans.plans import Plans


class ExecutedPlans:
    """The plans of the current episodes, in the order of the robots in a batch.

    A policy makes new `Plans` for every chunk and keeps them until the next one. So the first step that sees them is the
    first one that executes their chunk.

    Args:
        policy: The policy. Policies that say nothing of their plans have none.
        n_robots: Number of robots B.
    """

    def __init__(self, policy: Any, n_robots: int) -> None:
        self._policy = policy
        self._n_robots = n_robots
        self.forget()

    def forget(self) -> None:
        """Forgets the plans so far. Must be called at the start of the episodes."""
        self._latest = self._plans_of_policy()
        self._is_measured = False
        self._n_drawn, self._n_plans = np.zeros((2, self._n_robots), dtype=np.int64)
        self._is_flagged = np.zeros(self._n_robots, dtype=bool)

    def count(self, is_running: np.ndarray) -> dict[str, np.ndarray]:
        """Counts the policy's plans if they are new. Must be called in every step.

        Args:
            is_running: ``(B,)`` bool, whose episode has not ended. The plans of others do not count.

        Returns:
            As a vectorised environment's info, with the mask of each key: ``plans_drawn`` ``(B,)`` plans drawn in the
            episode so far, ``n_plans`` ``(B,)`` plans executed, ``is_plan_flagged`` ``(B,)`` whether one of those was
            flagged. Empty if the policy has not said anything of its plans.
        """
        plans = self._plans_of_policy()
        if plans is not None and plans is not self._latest:
            self._is_measured = True
            self._n_drawn += np.where(is_running, plans.n_drawn.cpu().numpy(), 0)
            self._n_plans += is_running
            self._is_flagged |= is_running & plans.is_flagged.cpu().numpy()
        self._latest = plans
        if not self._is_measured:
            return {}
        info = {
            "plans_drawn": self._n_drawn.copy(),
            "n_plans": self._n_plans.copy(),
            "is_plan_flagged": self._is_flagged.copy(),
        }
        return info | {f"_{key}": np.ones(self._n_robots, dtype=bool) for key in info}

    def _plans_of_policy(self) -> Plans | None:
        plans = getattr(self._policy, "plans", None)
        return plans if isinstance(plans, Plans) else None
