# SPDX-License-Identifier: Apache-2.0
"""The settings with which a policy's potential field is fitted."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot_pf2mp.density.bandwidth import DEFAULT_BANDWIDTH, check_bandwidth_rule
from lerobot_pf2mp.potential_field import (
    THRESHOLD_QUANTILE,
    check_alpha,
    check_threshold_quantile,
)


@dataclass(frozen=True)
class FieldSettings:
    """The settings with which a field is fitted.

    Args:
        n_points: Largest number of demonstrated actions that are kept as anchors (M in the paper, which uses 3000).
        action_dims: Action dimensions that the field covers; None covers all.
        bandwidth: A rule of `BANDWIDTH_RULES`, or the kernel bandwidth h itself [normalised].
        threshold_quantile: Quantile of the anchors' own log densities that bounds the safe set.
        alpha: Weight of the distance term, at most 0.

    Raises:
        ValueError: If a value breaks its rule. The message names the option of the policy's configuration.
    """

    n_points: int = 3000
    action_dims: tuple[int, ...] | None = None
    bandwidth: float | str = DEFAULT_BANDWIDTH
    threshold_quantile: float = THRESHOLD_QUANTILE
    alpha: float = -0.1

    def __post_init__(self) -> None:
        if self.n_points < 1:
            raise ValueError(f"n_field_points must be at least 1, got {self.n_points}")
        if self.action_dims is not None:
            object.__setattr__(self, "action_dims", tuple(self.action_dims))
            if (
                not self.action_dims
                or min(self.action_dims) < 0
                or len(set(self.action_dims)) < len(self.action_dims)
            ):
                raise ValueError(
                    f"field_action_dims must be distinct indices from 0 on, got {self.action_dims}"
                )
        check_bandwidth_rule(self.bandwidth, "field_bandwidth")
        check_threshold_quantile(self.threshold_quantile, "field_threshold_quantile")
        check_alpha(self.alpha, "field_alpha")
