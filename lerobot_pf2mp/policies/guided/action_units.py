# SPDX-License-Identifier: Apache-2.0
"""How large a unit of the recorded actions is in the actions that a policy generates."""

from __future__ import annotations

from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.lerobot_types import TransitionKey
from lerobot.processor import NormalizerProcessorStep
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor


def affine_of(normaliser: NormalizerProcessorStep, key: str, dim: int | None = None) -> Tensor:
    """How a step normalises an action or an observation: LeRobot's normalisations are affine in each dimension.

    Args:
        normaliser: The normalising step of a preprocessor.
        key: ``action``, or the name of an observation.
        dim: The number of its dimensions D; None for that of its feature.

    Returns:
        ``(2, D)`` float64 factors and offsets, on the CPU.
    """
    size = normaliser.features[key].shape[0] if dim is None else dim
    ends = torch.stack([torch.zeros(size), torch.ones(size)])
    transition: Any = (
        {TransitionKey.ACTION: ends} if key == ACTION else {TransitionKey.OBSERVATION: {key: ends}}
    )
    done = normaliser(transition)
    zero, one = (
        (done[TransitionKey.ACTION] if key == ACTION else done[TransitionKey.OBSERVATION][key]).cpu().double()
    )
    return torch.stack([one - zero, zero])


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


def places_of_states(normaliser: NormalizerProcessorStep, action_dim: int) -> Tensor:
    """How a normalised state becomes a normalised action, if both are the same positions.

    Args:
        normaliser: The normalising step of a preprocessor.
        action_dim: The number of action dimensions A.

    Returns:
        ``(2, A)`` float32 factors and offsets, on the CPU; ``(0, 0)`` if ``observation.state`` is unknown to the step or
        has other dimensions.
    """
    feature = (normaliser.features or {}).get(OBS_STATE)
    if feature is None or tuple(feature.shape) != (action_dim,):
        return torch.empty(0, 0)
    both = torch.stack([torch.zeros(action_dim), torch.ones(action_dim)])
    transition: Any = {TransitionKey.OBSERVATION: {OBS_STATE: both}, TransitionKey.ACTION: both}
    normalised = normaliser(transition)
    state = normalised[TransitionKey.OBSERVATION][OBS_STATE].double().cpu()
    action = normalised[TransitionKey.ACTION].double().cpu()
    factors = (action[1] - action[0]) / (state[1] - state[0])
    places = torch.stack([factors, action[0] - factors * state[0]]).float()
    return places if bool(places.isfinite().all()) else torch.empty(0, 0)


def normaliser_of(config: Any, dataset_stats: dict[str, dict[str, Any]]) -> NormalizerProcessorStep:
    """The step that normalises actions and states for a policy, from its configuration and its dataset's statistics."""
    shape = tuple(config.action_feature.shape)
    features = {ACTION: PolicyFeature(type=FeatureType.ACTION, shape=shape)}
    if config.robot_state_feature is not None and OBS_STATE in dataset_stats:
        features[OBS_STATE] = config.robot_state_feature
    return NormalizerProcessorStep(
        features=features,
        norm_map=config.normalization_mapping,
        stats=dataset_stats,
        device="cpu",
    )
