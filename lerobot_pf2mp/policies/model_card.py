# SPDX-License-Identifier: Apache-2.0
"""The model card with which LeRobot publishes a checkpoint of a policy of this package."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from huggingface_hub import ModelCard

from lerobot_pf2mp.hub.card_facts import CardFacts, GuidanceFacts, PlanFacts, PolicyFacts
from lerobot_pf2mp.hub.model_card import env_options, make_model_card
from lerobot_pf2mp.policies.guided.configuration_guided import GuidedConfig
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.policies.guided.field_guidance import FieldGuidance
from lerobot_pf2mp.policies.guided.field_settings import INTEGRATED


class WithModelCard:
    """A mixin for policies that are published with a card of this package. It must come before LeRobot's policy class.

    LeRobot 0.6 calls `generate_model_card`. If a later version does not call it, LeRobot's own card is published.
    """

    config: Any

    def generate_model_card(
        self,
        dataset_repo_id: str | None,
        model_type: str,
        license: str | None = None,
        tags: Sequence[str] | None = None,
        cfg: Any = None,
        dataset_meta: Any = None,
        **_: Any,
    ) -> ModelCard:
        """The card. The arguments are those of LeRobot's `PreTrainedPolicy.generate_model_card`."""
        training = {} if cfg is None else cfg.to_dict()
        facts = CardFacts(
            policy=policy_facts(self.config, self._trained_demonstrations(), license, tags),
            repo_id=self.config.repo_id or f"you/your_{model_type}",
            dataset=dataset_repo_id,
            dataset_size=dataset_meta and (dataset_meta.total_episodes, dataset_meta.total_frames),
            training=training,
            env_options=env_options(training.get("env")),
        )
        return make_model_card(facts)

    def _trained_demonstrations(self) -> DemonstratedActions | None:
        """The actions on which the policy was just trained; None if it has not been, or has no field."""
        guidance: FieldGuidance | None = getattr(self, "guidance", None)
        return None if guidance is None else guidance.demonstrations


def policy_facts(
    config: Any,
    demonstrations: DemonstratedActions | None,
    license: str | None = None,
    tags: Sequence[str] | None = None,
) -> PolicyFacts:
    """The facts about a policy of this package for its card.

    Args:
        config: Its configuration.
        demonstrations: What its potential field is fitted to; None without a field.
        license: Name of the licence; None for that of the configuration.
        tags: More tags; None for those of the configuration.
    """
    inputs, outputs = (
        {name: tuple(feature.shape) for name, feature in (features or {}).items()}
        for features in (config.input_features, config.output_features)
    )
    return PolicyFacts(
        type=config.type,
        inputs=inputs,
        outputs=outputs,
        horizon=len(config.action_delta_indices),
        n_action_steps=config.n_action_steps,
        num_inference_steps=_n_steps(config),
        guidance=_guidance_facts(config, demonstrations, outputs["action"][0])
        if isinstance(config, GuidedConfig)
        else None,
        base=config.base.type if hasattr(config, "base") else None,
        license=license or config.license,
        tags=tuple(tags or config.tags or ()),
    )


def _n_steps(config: Any) -> int | None:
    """The integration or denoising steps of a policy; None if it has none."""
    if getattr(config, "objective", None) == "flow_matching":
        return config.num_integration_steps
    for name in ("num_inference_steps", "num_steps", "num_train_timesteps"):
        if getattr(config, name, None) is not None:
            return getattr(config, name)
    return None


def _guidance_facts(
    config: Any, demonstrations: DemonstratedActions | None, action_dim: int
) -> GuidanceFacts:
    field, plans, region = None, None, config.guidance_region
    if demonstrations is not None:
        with suppress(ValueError):  # not fitted, for example after a training of 0 steps
            field = demonstrations.field(config.field_settings)
            region = demonstrations.region(config.field_settings)
    if demonstrations is not None and field is not None and config.checks_plans:
        with suppress(ValueError):  # a field of before has no demonstrated plans
            threshold = demonstrations.plan_threshold(
                config.field_settings, config.n_action_steps, config.false_alarm_rate
            )
            plans = PlanFacts(threshold.log_density, threshold.false_alarm_rate, threshold.n_plans)
    return GuidanceFacts(
        scale=config.guidance_scale,
        integrator=config.guidance_integrator,
        point=config.guidance_point,
        action_dims=range(action_dim) if config.field_action_dims is None else config.field_action_dims,
        alpha=config.field_alpha,
        bandwidth_rule=config.field_bandwidth if isinstance(config.field_bandwidth, str) else None,
        bandwidth=None if field is None else field.bandwidth,
        n_anchors=None if field is None else len(field.anchors),
        region=region,
        quantile=config.guidance_quantile,
        max_plans=config.max_plans,
        on_unsupported=config.on_unsupported,
        plans=plans,
        displacement_scale=config.field_displacement_scale if config.field_over == INTEGRATED else None,
    )
