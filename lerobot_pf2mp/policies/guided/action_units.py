# SPDX-License-Identifier: Apache-2.0
"""How large a unit of the recorded actions is in the actions that a policy generates."""

from __future__ import annotations

from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.lerobot_types import TransitionKey
from lerobot.processor import NormalizerProcessorStep
from lerobot.utils.constants import ACTION
from torch import Tensor


def normalised_unit(normaliser: NormalizerProcessorStep, action_dim: int) -> Tensor:
    """What a change of the recorded actions by 1 is in normalised actions, for each dimension.

    LeRobot's normalisations are affine in each dimension, so two actions tell.

    Args:
        normaliser: The normalising step of a preprocessor.
        action_dim: The number of action dimensions A.

    Returns:
        ``(A,)`` float32, on the CPU.
    """
    actions = torch.stack([torch.zeros(action_dim), torch.ones(action_dim)])
    transition: Any = {TransitionKey.ACTION: actions}
    zero, one = normaliser(transition)[TransitionKey.ACTION].cpu()
    return one - zero


def normaliser_of(config: Any, dataset_stats: dict[str, dict[str, Any]]) -> NormalizerProcessorStep:
    """The step that normalises actions for a policy, from its configuration and the statistics of its dataset."""
    shape = tuple(config.action_feature.shape)
    return NormalizerProcessorStep(
        features={ACTION: PolicyFeature(type=FeatureType.ACTION, shape=shape)},
        norm_map=config.normalization_mapping,
        stats=dataset_stats,
        device="cpu",
    )
