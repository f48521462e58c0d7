# SPDX-License-Identifier: Apache-2.0
"""The options of guidance by a potential field, added to the configuration of a generative policy."""

import math
from dataclasses import dataclass

from lerobot.configs import PolicyFeature

from lerobot_pf2mp.guidance import GUIDANCE_INTEGRATORS, GUIDANCE_POINTS
from lerobot_pf2mp.policies.guided.potential_field_step import FieldSettings
from lerobot_pf2mp.policies.guided.support_monitor import ON_UNSUPPORTED


@dataclass
class GuidedConfig:
    """The options of guidance (Section IV-B of the paper), to be mixed into the configuration of a policy.

    The field is a density over actions, so the actions it covers must be positions in the place that holds the
    obstacles (ball, gripper or joint positions). A density over displacements says nothing about obstacles.

    All values can be changed at evaluation, for example with ``--policy.guidance_scale=0.4``; all but
    `field_action_dims` then take effect without training.

    Args:
        guidance_scale: lambda, the strength of the guidance; 0 is exactly the unguided policy.
        guidance_integrator: proximal (solved exactly over a step, flat in lambda) or euler (Algorithm 2 as printed).
        guidance_point: Where the field is evaluated in each step: current (at A_t), end (at the end point that the step
            predicts) or next (after the step). None is the integrator's own: current for euler, end for proximal.
        on_unsupported: What happens when planned actions leave the demonstrated region: ignore, warn or hold, see
            `SupportMonitor`. It needs the field, also where guidance_scale is 0.
        n_field_points: Demonstrated actions M kept as anchors of the field.
        field_action_dims: Action dimensions the field covers; None covers all. A gripper's opening is usually left out.
        field_bandwidth: Kernel bandwidth h [normalised action units], or how to choose it: likelihood (leave-one-out
            maximum likelihood), scott or silverman.
        field_threshold_quantile: Quantile of the anchors' own densities above which an action counts as safe.
        field_alpha: Weight of the distance to the safe set, at most 0; 0 leaves that term out.
    """

    guidance_scale: float = 0.8
    guidance_integrator: str = "proximal"
    guidance_point: str | None = None
    on_unsupported: str = "ignore"
    n_field_points: int = 3000
    field_action_dims: tuple[int, ...] | None = None
    field_bandwidth: float | str = "likelihood"
    field_threshold_quantile: float = 0.01
    field_alpha: float = -0.1

    @property
    def field_settings(self) -> FieldSettings:
        """What the potential field is fitted with."""
        return FieldSettings(
            n_points=self.n_field_points,
            action_dims=self.field_action_dims,
            bandwidth=self.field_bandwidth,
            threshold_quantile=self.field_threshold_quantile,
            alpha=self.field_alpha,
        )

    def _validate_guidance(self) -> None:
        if not (self.guidance_scale >= 0 and math.isfinite(self.guidance_scale)):
            raise ValueError(f"guidance_scale must be finite and at least 0, got {self.guidance_scale}")
        if self.guidance_integrator not in GUIDANCE_INTEGRATORS:
            raise ValueError(
                f"guidance_integrator must be one of {GUIDANCE_INTEGRATORS}, got {self.guidance_integrator!r}"
            )
        if self.guidance_point is not None and self.guidance_point not in GUIDANCE_POINTS:
            raise ValueError(
                f"guidance_point must be one of {GUIDANCE_POINTS} or null, got {self.guidance_point!r}"
            )
        if self.on_unsupported not in ON_UNSUPPORTED:
            raise ValueError(f"on_unsupported must be one of {ON_UNSUPPORTED}, got {self.on_unsupported!r}")
        _ = self.field_settings  # validates the field's own values

    def _validate_field_dims(self, action_feature: PolicyFeature) -> None:
        action_dim = action_feature.shape[0]
        if self.field_action_dims is not None and max(self.field_action_dims) >= action_dim:
            raise ValueError(
                f"field_action_dims must be below the action dimension {action_dim}, got {self.field_action_dims}"
            )
