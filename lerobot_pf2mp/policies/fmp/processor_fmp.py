# SPDX-License-Identifier: Apache-2.0
"""The processors of the Flow Matching Policy: LeRobot's default ones."""

from typing import Any

from lerobot.processor import PolicyAction, PolicyProcessorPipeline, make_default_pre_post_processors

from lerobot_pf2mp.policies.fmp.configuration_fmp import FMPConfig


def make_fmp_pre_post_processors(
    config: FMPConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """The pipelines before the policy (rename, batch, device, normalise) and after it (unnormalise, to the CPU).

    Args:
        config: The policy's configuration.
        dataset_stats: Statistics that the normalisation uses.

    Returns:
        The preprocessor and the postprocessor.
    """
    return make_default_pre_post_processors(config, dataset_stats)
