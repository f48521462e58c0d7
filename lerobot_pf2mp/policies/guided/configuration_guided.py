# SPDX-License-Identifier: Apache-2.0
"""The options of guidance by a potential field, added to the configuration of a generative policy."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from lerobot.configs import PolicyFeature

from lerobot_pf2mp.guidance import GuidanceSettings
from lerobot_pf2mp.policies.guided.field_settings import INTEGRATED, FieldSettings
from lerobot_pf2mp.policies.obstacles.obstacle_options import ObstacleOptions
from lerobot_pf2mp.policies.plans.plans import ON_UNSUPPORTED

# Policies read their settings for every chunk. The caches create and validate equal settings only once.
_field_settings = lru_cache(maxsize=64)(FieldSettings)
_guidance_settings = lru_cache(maxsize=64)(GuidanceSettings)


@dataclass
class GuidedConfig(ObstacleOptions):
    """The options of guidance (Section IV-B of the paper), to be mixed into the configuration of a policy.

    The field is a density over actions, so the actions it covers must be positions in the space that holds the
    obstacles (ball, gripper or joint positions). A density over displacements says nothing about obstacles: of those, it is
    one over their running sum (`field_over`).

    All values can be changed at evaluation, for example with ``--policy.guidance_scale=0.4``. Only `field_action_dims`,
    `field_over` and what belongs to it then need a new training, or pf2mp-fit-field. The options of obstacles that the
    demonstrations did not know are those of `ObstacleOptions`.

    Args:
        guidance_scale: lambda, the strength of the guidance; 0 with max_plans=1 is exactly the unguided policy.
        guidance_integrator: proximal (solved exactly over a step, insensitive to lambda) or euler (Algorithm 2 as printed).
        guidance_point: The point at which each step evaluates the field: current (A_t), end (the end point that the step
            predicts) or next (after the step). None is the integrator's own: current for euler, end for proximal.
        guidance_region: Where the field pulls: everywhere (the paper); unsupported, where the log density is below that of
            guidance_quantile; or fading, fully outside the safe set and the less the nearer it is to that quantile.
        guidance_quantile: Quantile of the densities of demonstrated actions above which actions are left as they are, for
            guidance_region unsupported and fading.
        max_plans: Largest number of plans that are drawn for one that is executed. A plan whose way leaves the demonstrated
            region is drawn again, and the first one that does not is executed; 1 draws no second plan.
        false_alarm_rate: Largest probability with which a plan as good as a fresh demonstration is flagged, that is, counts
            as leaving the demonstrated region. With n demonstrated plans it is at least 1/(n + 1).
        on_unsupported: What happens if the best of `max_plans` plans is still flagged: ignore, warn (log a line), hold
            (warn, and stay where the way leaves the region) or stop (raise an error), see `react`. All but ignore need the
            field, also with guidance_scale=0.
        n_field_points: Demonstrated actions M kept as anchors of the field.
        field_action_dims: Action dimensions the field covers; None covers all. A gripper's opening is usually left out.
        field_bandwidth: Kernel bandwidth h [normalised action units], or how to choose it: likelihood (maximum likelihood
            of actions that are judged by other episodes), scott or silverman.
        field_threshold_quantile: Quantile of the demonstrated actions' densities above which an action counts as safe.
        field_alpha: Weight of the distance to the safe set, at most 0; 0 leaves that term out.
        field_leave_out: What the density leaves out where it judges the actions it was made from (likelihood, quantile,
            safe anchors): episode (the action's own) or nothing (the frame itself in the likelihood, nothing else).
        field_angle_dims: Action dimensions that are angles: distances in them are the short way round. None finds those in
            which recorded actions jump by a period between two frames.
        field_angle_period: Period of the angles, in the dataset's units [rad; 360 for degrees].
        field_over: What the field is over: actions, which must be positions; or integrated, for actions that are
            displacements of the end effector: the positions to which their running sum leads from the observed state.
        field_displacement_scale: For integrated: what an action of 1 displaces the end effector by, in units of
            observation.state per unit of action.
        field_state_dims: For integrated: the dimensions of observation.state that are the end effector's positions in
            field_action_dims; None for the first ones.
    """

    guidance_scale: float = GuidanceSettings.scale
    guidance_integrator: str = GuidanceSettings.integrator
    guidance_point: str | None = GuidanceSettings.point
    guidance_region: str = FieldSettings.region
    guidance_quantile: float = FieldSettings.quantile
    max_plans: int = 8
    false_alarm_rate: float = 0.01
    on_unsupported: str = "ignore"
    n_field_points: int = FieldSettings.n_points
    field_action_dims: tuple[int, ...] | None = FieldSettings.action_dims
    field_bandwidth: float | str = FieldSettings.bandwidth
    field_threshold_quantile: float = FieldSettings.threshold_quantile
    field_alpha: float = FieldSettings.alpha
    field_leave_out: str = FieldSettings.leave_out
    field_angle_dims: tuple[int, ...] | None = FieldSettings.angle_dims
    field_angle_period: float = FieldSettings.angle_period
    field_over: str = FieldSettings.over
    field_displacement_scale: float = FieldSettings.displacement_scale
    field_state_dims: tuple[int, ...] | None = FieldSettings.state_dims

    @property
    def field_settings(self) -> FieldSettings:
        """The settings with which the potential field is fitted."""
        return _field_settings(*self._field_values)

    @property
    def guidance_settings(self) -> GuidanceSettings:
        """The settings with which the field bends the policy's process."""
        return _guidance_settings(
            self.guidance_scale, self.guidance_integrator, self.guidance_point, self._field_dims
        )

    @property
    def checks_plans(self) -> bool:
        """Whether anything depends on the check of plans."""
        return self.max_plans > 1 or self.on_unsupported != "ignore"

    @property
    def _field_dims(self) -> tuple[int, ...] | None:
        return None if self.field_action_dims is None else tuple(self.field_action_dims)

    @property
    def _field_values(self) -> tuple[Any, ...]:
        """The values of `FieldSettings`, in its order."""
        return (
            self.n_field_points,
            self._field_dims,
            self.field_bandwidth,
            self.field_threshold_quantile,
            self.field_alpha,
            self.field_leave_out,
            None if self.field_angle_dims is None else tuple(self.field_angle_dims),
            self.field_angle_period,
            self.guidance_region,
            self.guidance_quantile,
            self.field_over,
            self.field_displacement_scale,
            None if self.field_state_dims is None else tuple(self.field_state_dims),
        )

    def _validate_guidance(self) -> None:
        if self.on_unsupported not in ON_UNSUPPORTED:
            raise ValueError(f"on_unsupported must be one of {ON_UNSUPPORTED}, got {self.on_unsupported!r}")
        if self.max_plans < 1:
            raise ValueError(f"max_plans must be at least 1, got {self.max_plans}")
        if not 0 < self.false_alarm_rate < 1:
            raise ValueError(f"false_alarm_rate must lie between 0 and 1, got {self.false_alarm_rate}")
        self._validate_obstacles()
        # They validate their own values. Not from the caches, which take hashable values only.
        GuidanceSettings(self.guidance_scale, self.guidance_integrator, self.guidance_point)
        FieldSettings(*self._field_values)

    def _validate_field_dims(self, action_feature: PolicyFeature) -> None:
        action_dim = action_feature.shape[0]
        for name in ("field_action_dims", "field_angle_dims"):
            dims = getattr(self, name)
            if dims and max(dims) >= action_dim:
                raise ValueError(f"{name} must be below the action dimension {action_dim}, got {dims}")
        if self.field_over == INTEGRATED:
            self._validate_field_state(len(self.field_action_dims or range(action_dim)))

    def _validate_field_state(self, n_dims: int) -> None:
        state = getattr(self, "robot_state_feature", None)
        if state is None:
            raise ValueError(
                "field_over=integrated needs observation.state, from which displacements are summed up, got a policy "
                "without it"
            )
        dims = tuple(range(n_dims)) if self.field_state_dims is None else tuple(self.field_state_dims)
        if len(dims) != n_dims or max(dims) >= state.shape[0]:
            raise ValueError(
                f"field_state_dims must be one dimension of observation.state {tuple(state.shape)} for each of the {n_dims} "
                f"dimensions of the field, got {dims}"
            )
