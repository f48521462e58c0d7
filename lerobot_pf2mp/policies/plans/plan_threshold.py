# SPDX-License-Identifier: Apache-2.0
"""The support below which a plan is flagged."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from lerobot_pf2mp.potential_field import just_below
from lerobot_pf2mp.potential_field.ways import conformal_threshold


@dataclass(frozen=True)
class PlanThreshold:
    """The smallest log density that a plan may have on its way, calibrated on demonstrations that the field did not know.

    Args:
        log_density: The threshold [nats].
        false_alarm_rate: Largest probability with which a plan as good as a fresh demonstration is flagged. With n
            demonstrated plans it is a multiple of 1/(n + 1), and may be larger than the rate asked for.
        n_plans: Number of demonstrated plans n.
    """

    log_density: float
    false_alarm_rate: float
    n_plans: int

    @classmethod
    def of(cls, scores: Tensor, false_alarm_rate: float) -> PlanThreshold:
        """The threshold for the scores ``(n,)`` of demonstrated plans [nats]."""
        log_density, kept = conformal_threshold(scores, false_alarm_rate)
        return cls(just_below(log_density), kept, len(scores))
