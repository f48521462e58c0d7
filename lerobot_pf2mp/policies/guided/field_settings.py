# SPDX-License-Identifier: Apache-2.0
"""The settings with which a policy's potential field is fitted."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

from lerobot_pf2mp.density.bandwidth import DEFAULT_BANDWIDTH, check_bandwidth_rule
from lerobot_pf2mp.potential_field import (
    LEFT_OUT,
    THRESHOLD_QUANTILE,
    check_alpha,
    check_left_out,
    check_threshold_quantile,
)

REGIONS = ("everywhere", "unsupported", "fading")
ACTIONS, INTEGRATED = FIELD_OVER = "actions", "integrated"


@dataclass(frozen=True)
class FieldSettings:
    """The settings with which a field is fitted.

    Args:
        n_points: Largest number of demonstrated actions that are kept as anchors (M in the paper, which uses 3000).
        action_dims: Action dimensions that the field covers; None covers all.
        bandwidth: A rule of `BANDWIDTH_RULES`, or the kernel bandwidth h itself [normalised].
        threshold_quantile: Quantile of the actions' log densities that bounds the safe set.
        alpha: Weight of the distance term, at most 0.
        leave_out: What is left out of the density where it judges its own actions, one of `LEFT_OUT`.
        angle_dims: Action dimensions that are angles, among those that the field covers. None: those in which recorded
            actions jump by a period from one frame to the next.
        angle_period: The period of these angles, in the units of the recorded actions [rad, or degrees with 360].
        region: Where the field pulls, one of `REGIONS`: everywhere; unsupported, where the log density is below that of
            `quantile`; or fading, fully outside the safe set and the less the nearer the log density is to that quantile.
        quantile: The quantile of the actions' log densities above which the field does not pull, in (0, 1).
        over: What the field is over, one of `FIELD_OVER`: actions, which are positions, or the positions to which
            displacements lead from the observed state (integrated), see `integrated_actions`.
        displacement_scale: What a displacement of 1 moves the observed state by, in the state's units per unit of action.
        state_dims: The dimensions of the observed state that are the positions of ``action_dims``; None for the first ones.

    Raises:
        ValueError: If a value breaks its rule. The message names the option of the policy's configuration.
    """

    n_points: int = 20000
    action_dims: tuple[int, ...] | None = None
    bandwidth: float | str = DEFAULT_BANDWIDTH
    threshold_quantile: float = THRESHOLD_QUANTILE
    alpha: float = -0.1
    leave_out: str = LEFT_OUT[0]
    angle_dims: tuple[int, ...] | None = None
    angle_period: float = 2 * math.pi
    region: str = "unsupported"
    quantile: float = 0.95
    over: str = ACTIONS
    displacement_scale: float = 1.0
    state_dims: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        if self.n_points < 1:
            raise ValueError(f"n_field_points must be at least 1, got {self.n_points}")
        if self.action_dims is not None:
            object.__setattr__(self, "action_dims", tuple(self.action_dims))
            if not self.action_dims:
                raise ValueError("field_action_dims must be distinct indices from 0 on, got ()")
            _check_dims("field_action_dims", self.action_dims)
        if self.angle_dims is not None:
            object.__setattr__(self, "angle_dims", tuple(self.angle_dims))
            _check_dims("field_angle_dims", self.angle_dims)
            if self.action_dims is not None and not set(self.angle_dims) <= set(self.action_dims):
                raise ValueError(
                    f"field_angle_dims must be among field_action_dims {self.action_dims}, got {self.angle_dims}"
                )
        if not (self.angle_period > 0 and math.isfinite(self.angle_period)):
            raise ValueError(f"field_angle_period must be finite and positive, got {self.angle_period}")
        if self.region not in REGIONS:
            raise ValueError(f"guidance_region must be one of {REGIONS}, got {self.region!r}")
        if not 0 < self.quantile < 1:
            raise ValueError(f"guidance_quantile must lie between 0 and 1, got {self.quantile}")
        self._check_over()
        check_left_out(self.leave_out, "field_leave_out")
        check_bandwidth_rule(self.bandwidth, "field_bandwidth")
        check_threshold_quantile(self.threshold_quantile, "field_threshold_quantile")
        check_alpha(self.alpha, "field_alpha")

    def _check_over(self) -> None:
        if self.over not in FIELD_OVER:
            raise ValueError(f"field_over must be one of {FIELD_OVER}, got {self.over!r}")
        if not (self.displacement_scale > 0 and math.isfinite(self.displacement_scale)):
            raise ValueError(
                f"field_displacement_scale must be finite and positive, got {self.displacement_scale}"
            )
        if self.state_dims is not None:
            object.__setattr__(self, "state_dims", tuple(self.state_dims))
            _check_dims("field_state_dims", self.state_dims)
            if self.action_dims is not None and len(self.state_dims) != len(self.action_dims):
                raise ValueError(
                    f"field_state_dims must be as many as field_action_dims {self.action_dims}, got {self.state_dims}"
                )
        if self.over == INTEGRATED and self.angle_dims:
            raise ValueError(
                f"field_angle_dims must be empty or null with field_over=integrated, got {self.angle_dims}: sums of "
                "displacements do not jump by a turn"
            )

    @property
    def positions(self) -> tuple[str, float, tuple[int, ...] | None]:
        """What says which positions the field is over, besides its action dimensions."""
        return (
            (self.over, self.displacement_scale, self.state_dims)
            if self.over == INTEGRATED
            else (self.over, 1.0, None)
        )


@lru_cache(maxsize=64)
def density_of(settings: FieldSettings) -> FieldSettings:
    """The settings without what is built on the density: the distance term and where the field pulls."""
    return replace(settings, alpha=0.0, region=REGIONS[0], quantile=0.5)


def _check_dims(name: str, dims: tuple[int, ...]) -> None:
    if any(isinstance(dim, bool) or not isinstance(dim, int) for dim in dims):
        raise ValueError(f"{name} must be whole numbers, got {dims}")
    if min(dims, default=0) < 0 or len(set(dims)) < len(dims):
        raise ValueError(f"{name} must be distinct indices from 0 on, got {dims}")
