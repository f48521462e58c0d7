# SPDX-License-Identifier: Apache-2.0
"""Where robots are when their next plan begins, as the actions that they executed tell."""

from __future__ import annotations

import torch
from torch import Tensor

from lerobot_pf2mp.policies.fmp.real_time_chunking import is_committed, n_executed_of
from lerobot_pf2mp.policies.plans.plan_choice import LatencyBudget


class RobotPlaces:
    """Follows what a robot, or a batch of robots, executes of its plans.

    A caller that queues actions tells each one that it gives away. A caller of real-time chunking, whose robot moves while
    the next plan is generated, tells what is left of the last plan.
    """

    def __init__(self) -> None:
        self.budget = LatencyBudget()
        self._executed: Tensor | None = None  # (B, A) the last action that was given away
        self._plan: tuple[Tensor, Tensor] | None = None  # the last chunk (B, T, A) and where it began (B, A)
        # Of the call that began: actions of the last chunk that were executed, and those that will be until the end of the
        # call; None if that is unknown, or the robot waits.
        self._n_executed: int | None = None
        self.n_steps: int | None = None

    def executed(self, action: Tensor) -> None:
        """Tells that robots are given an action ``(B, A)`` to execute [normalised]."""
        self._executed = action

    def begin(self, left_over: Tensor | None, inference_delay: int) -> None:
        """A call for a plan begins. Arguments as for `FieldGuidance.begin`."""
        self._n_executed = self.n_steps = None
        if left_over is not None:
            if self._plan is not None:
                self._n_executed = n_executed_of(self._plan[0], left_over)
            if bool(is_committed(left_over).any()):  # otherwise the robot waits
                self.n_steps = inference_delay
        self.budget.begin(self._n_executed)

    def end(self, chunk: Tensor, places: Tensor | None) -> None:
        """The call ends with a chunk ``(B, T, A)`` that begins at places ``(B, A)``; None if the plan was not checked."""
        if places is not None:
            self._plan = chunk, places
        self._executed = self._n_executed = self.n_steps = None

    def __call__(self, chunk: Tensor) -> Tensor | None:
        """Where the robots are, as actions ``(B, A)`` [normalised]; None if they have not executed any.

        Args:
            chunk: ``(B, T, A)`` their next plans.

        Raises:
            ValueError: If the batch has another size than that of the actions executed before.
        """
        n_robots = len(chunk)
        if self._executed is not None:
            if len(self._executed) != n_robots:
                raise ValueError(
                    f"a batch must have as many robots as before, {len(self._executed)}, until reset() is called, got "
                    f"{n_robots}"
                )
            return self._executed.to(chunk)
        if self._plan is not None and self._n_executed is not None and len(self._plan[0]) == n_robots:
            before, place = self._plan
            return (before[:, self._n_executed - 1] if self._n_executed else place).to(chunk)
        return None


def seen_place(state: Tensor, first: Tensor, dims: tuple[int, ...] | None) -> Tensor:
    """An observed place ``(B, D)`` as actions ``(B, A)``: in dimensions that the field does not cover, the first action's.

    Args:
        state: ``(B, D)`` where the robots are seen, as actions over the field's dimensions [normalised].
        first: ``(B, A)`` the first actions of their plans [normalised].
        dims: Action dimensions that the field covers; None for all.
    """
    return state if dims is None else first.index_copy(1, torch.tensor(dims, device=first.device), state)
