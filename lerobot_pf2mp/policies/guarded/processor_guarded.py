# SPDX-License-Identifier: Apache-2.0
"""The processors of a guarded policy: those of its base, and the potential field at the end of the preprocessor."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from lerobot.policies import make_pre_post_processors
from lerobot.processor import PolicyAction, PolicyProcessorPipeline

from lerobot_pf2mp.policies.guarded.configuration_guarded import GuardedConfig
from lerobot_pf2mp.policies.guided.potential_field_step import PotentialFieldProcessorStep


def make_guarded_pre_post_processors(
    config: GuardedConfig, dataset_stats: dict[str, dict[str, Any]] | None = None, dataset_meta: Any = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """The pipelines before and after the policy.

    Args:
        config: The policy's configuration.
        dataset_stats: Statistics that the normalisation uses.
        dataset_meta: The dataset's metadata, which some base policies need.

    Returns:
        The preprocessor and the postprocessor.
    """
    preprocessor, postprocessor = make_pre_post_processors(
        config.base, dataset_stats=dataset_stats, dataset_meta=dataset_meta
    )
    preprocessor.steps.append(PotentialFieldProcessorStep(**asdict(config.field_settings)))
    return preprocessor, postprocessor
