# SPDX-License-Identifier: Apache-2.0
"""The threshold for plans, calibrated on demonstrated plans, and where a robot is when its plan begins."""

from __future__ import annotations

from collections.abc import Callable, Hashable

import torch
from torch import Tensor

from lerobot_pf2mp.policies.plans.demonstrated_plans import DemonstratedPlans, states_are_places
from lerobot_pf2mp.policies.plans.plan_threshold import PlanThreshold

_REMEDY = "pf2mp-fit-field makes a field that has them, and max_plans=1 with on_unsupported=ignore needs none"


class PlanCalibration:
    """Demonstrated plans, kept with a field, and what follows from them."""

    def __init__(self) -> None:
        self.plans = DemonstratedPlans()
        self.places = torch.empty(
            0, 0
        )  # (2, D) how states become actions, see `places_of_states`; empty if unknown
        self.n_executed = 1  # actions of a plan that training's policy executes
        self.forget_scores()

    def forget_scores(self) -> None:
        """Forgets how plans are supported, because the field or the plans have changed."""
        self._scores: tuple[Hashable, int, Tensor] | None = None  # by density, and for how many actions
        self._threshold: tuple[Hashable, PlanThreshold] | None = None  # the last one
        self._starts: tuple[Hashable, bool] | None = None  # whether plans start at the state, by periods

    def observe(
        self,
        actions: Tensor,
        frames: Tensor,
        episodes: Tensor,
        *,
        states: Tensor | None,
        places: Tensor | None,
        n_executed: int,
    ) -> None:
        """Adds demonstrated plans.

        Args:
            actions: ``(B, T, D)`` actions from the current step on [normalised].
            frames: ``(B,)`` index in the dataset of the current step.
            episodes: ``(B,)`` episode numbers.
            states: ``(B, D)`` observed states at the current step [normalised]; None if there are none.
            places: ``(2, D)`` how states become actions; None if it is unknown.
            n_executed: Number of these actions that the policy executes.
        """
        self.n_executed = n_executed
        if not len(actions):
            return
        start = actions[:, 0]
        self.places = torch.empty(0, 0)
        if places is not None and states is not None:
            self.places = places.cpu()
            start = self.place_of(states.detach().to(start))
        ways = torch.cat([start.unsqueeze(1), actions], dim=1)
        if self.plans.observe(ways, episodes.reshape(-1), frames.reshape(-1)):
            self.forget_scores()

    def place_of(self, states: Tensor) -> Tensor:
        """Where robots are, as actions ``(B, D)``, of observed states ``(B, D)`` whose `places` are known [normalised]."""
        factors, offsets = self.places.to(states)
        return factors * states + offsets

    def starts_at_state(self, periods: Tensor | None) -> bool:
        """Whether an observed state tells where the robot is, in the units of its actions.

        Args:
            periods: ``(D,)`` periods of angles [normalised], 0 for other dimensions; None if there are no angles.
        """
        asked = None if periods is None else tuple(periods.tolist())
        if self._starts is None or self._starts[0] != asked:
            is_known = bool(self.places.numel()) and len(self.plans) > 0
            self._starts = asked, is_known and states_are_places(self.plans.ways.cpu(), periods)
        return self._starts[1]

    def threshold(
        self,
        density: Hashable,
        n_actions: int,
        false_alarm_rate: float,
        score: Callable[[], Tensor],
        can_judge: bool = True,
    ) -> PlanThreshold:
        """The threshold for the support of plans.

        Args:
            density: Identifies the density. If it is that of before, plans are not scored again.
            n_actions: Number of actions of a plan that are executed.
            false_alarm_rate: Largest probability with which a plan as good as a fresh demonstration is flagged.
            score: Gives the support of the demonstrated plans, see `DemonstratedPlans.scores`.
            can_judge: Whether the field knows the episodes of its actions.

        Raises:
            ValueError: If there are no demonstrated plans, none that other episodes can judge, or they have fewer actions.
        """
        asked = density, n_actions, false_alarm_rate
        if self._threshold is not None and self._threshold[0] == asked:
            return self._threshold[1]  # as in nearly every call of a policy
        if not can_judge:
            raise ValueError(
                "the check of plans needs the episodes of a field's actions, got a potential field that does not know all "
                f"of them: {_REMEDY}"
            )
        if not len(self.plans):
            raise ValueError(
                f"the check of plans needs demonstrated plans, got a potential field without them: {_REMEDY}"
            )
        if n_actions > self.plans.n_actions:
            raise ValueError(
                f"the check of plans needs demonstrated plans of {n_actions} actions, got a potential field with plans of "
                f"{self.plans.n_actions}: {_REMEDY}"
            )
        scores = self.scores(density, n_actions, score)
        if not len(scores):
            raise ValueError(
                "the check of plans needs demonstrations that other episodes can judge, got a potential field in which "
                f"nothing is left without a plan's own episode: more demonstrations, or {_REMEDY}"
            )
        self._threshold = asked, PlanThreshold.of(scores, false_alarm_rate)
        return self._threshold[1]

    def scores(self, density: Hashable, n_actions: int, score: Callable[[], Tensor]) -> Tensor:
        """The support of the demonstrated plans, ``(n,)``. Arguments as for `threshold`."""
        if self._scores is None or self._scores[:2] != (density, n_actions):
            self._scores = density, n_actions, score()
        return self._scores[2]

    def restore(
        self, plans: DemonstratedPlans, places: Tensor, n_executed: int, density: Hashable, scores: Tensor
    ) -> None:
        """Restores what was saved: plans, places, the number of actions executed, and the scores of a density."""
        self.plans, self.places, self.n_executed = plans, places, n_executed
        self.forget_scores()
        if len(scores):
            self._scores = density, n_executed, scores
