# SPDX-License-Identifier: Apache-2.0
"""What a model card is written from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

POLICY_NAMES = {
    "fmp": "Flow Matching Policy (FMP)",
    "pf2mp": "Potential Field-Guided Flow Matching Policy (PF2MP)",
    "dppf": "Diffusion Policy with Potential Field Guidance (DPPF)",
    "guarded": "policy, guarded by a potential field",
}


@dataclass(frozen=True)
class PlanFacts:
    """The facts about the check of plans.

    Args:
        log_threshold: Smallest log density that the way of a plan may have [nats].
        false_alarm_rate: Largest probability with which a plan as good as a fresh demonstration is flagged.
        n_plans: Number of demonstrated plans from which that follows.
    """

    log_threshold: float
    false_alarm_rate: float
    n_plans: int


@dataclass(frozen=True)
class GuidanceFacts:
    """The facts about a policy's guidance for its card.

    Args:
        scale: lambda.
        integrator: proximal or euler.
        point: The point at which the field is evaluated; None for the integrator's own.
        action_dims: The action dimensions that the field covers.
        alpha: Weight of the distance term [1/normalised].
        bandwidth_rule: The rule by which the bandwidth was chosen; None for a given number.
        bandwidth: The bandwidth h [normalised action units]; None if the field is not fitted.
        n_anchors: The number M of anchors; None if the field is not fitted.
        region: Where the field pulls: everywhere, unsupported or fading.
        quantile: The quantile of demonstrated actions' densities above which it does not; of no meaning for everywhere.
        max_plans: Largest number of plans that are drawn for one that is executed.
        on_unsupported: What happens if the best of them leaves the demonstrated region.
        plans: How plans are calibrated; None if they are not.
        displacement_scale: Of a field over integrated displacements, units of state per unit of action; None for a field
            over actions.
    """

    scale: float
    integrator: str
    point: str | None
    action_dims: Sequence[int]
    alpha: float
    bandwidth_rule: str | None
    bandwidth: float | None = None
    n_anchors: int | None = None
    region: str = "everywhere"
    quantile: float = 0.5
    max_plans: int = 1
    on_unsupported: str = "ignore"
    plans: PlanFacts | None = None
    displacement_scale: float | None = None


@dataclass(frozen=True)
class PolicyFacts:
    """The facts about a policy for its card.

    Args:
        type: Its registered name, one of `POLICY_NAMES`.
        inputs: Shapes of the input features by name.
        outputs: Shapes of the output features by name.
        horizon: Actions predicted at once.
        n_action_steps: Number of these actions that are executed.
        num_inference_steps: Integration or denoising steps N; None for a policy without steps.
        base: The type of the policy that a guarded one guards; None for others.
        guidance: Its guidance; None for an unguided policy.
        license: Name of the licence; None for the default.
        tags: More tags.
    """

    type: str
    inputs: Mapping[str, Sequence[int]]
    outputs: Mapping[str, Sequence[int]]
    horizon: int
    n_action_steps: int
    num_inference_steps: int | None
    guidance: GuidanceFacts | None = None
    base: str | None = None
    license: str | None = None
    tags: Sequence[str] = ()


@dataclass(frozen=True)
class CardFacts:
    """All facts that a card is written from.

    Args:
        policy: The policy.
        repo_id: The repository in which it is published, ``user/name``.
        dataset: Name of the dataset it was trained on; None if unknown.
        dataset_size: Its number of episodes and of frames; None if unknown.
        training: LeRobot's training configuration, as in ``train_config.json``; empty if unknown.
        env_options: Options of lerobot-eval for the environment, as `env_options` gives them; empty if unknown.
        table: A table of results in Markdown; None without one.
        made_with: Versions and hardware of the results.
        figures: Images and videos, by their paths in the repository.
    """

    policy: PolicyFacts
    repo_id: str
    dataset: str | None = None
    dataset_size: tuple[int, int] | None = None
    training: Mapping[str, Any] = field(default_factory=dict)
    env_options: Sequence[str] = ()
    table: str | None = None
    made_with: Mapping[str, str] = field(default_factory=dict)
    figures: Sequence[str] = ()
