# SPDX-License-Identifier: Apache-2.0
"""The processors of guided policies: LeRobot's default ones, and the potential field at the end of the preprocessor."""

from dataclasses import asdict
from typing import Any

from lerobot.configs import PreTrainedConfig
from lerobot.processor import PolicyAction, PolicyProcessorPipeline, make_default_pre_post_processors

from lerobot_pf2mp.policies.guided.potential_field_step import PotentialFieldProcessorStep


def make_guided_pre_post_processors(
    config: PreTrainedConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """The pipelines before the policy (rename, batch, device, normalise, potential field) and after it.

    Args:
        config: The policy's configuration.
        dataset_stats: Statistics that the normalisation uses.

    Returns:
        The preprocessor and the postprocessor.
    """
    preprocessor, postprocessor = make_default_pre_post_processors(config, dataset_stats)
    preprocessor.steps.append(PotentialFieldProcessorStep(**asdict(config.field_settings)))
    return preprocessor, postprocessor
