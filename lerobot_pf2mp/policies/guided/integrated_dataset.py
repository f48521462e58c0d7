# SPDX-License-Identifier: Apache-2.0
"""The positions to which the displacements of a whole dataset lead, for a field that is fitted without training."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.processor import NormalizerProcessorStep
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor
from tqdm import tqdm

from lerobot_pf2mp.policies.guided.configuration_guided import GuidedConfig
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.policies.guided.integrated_actions import Integration, observe_integrated

_FRAMES_AT_ONCE = 65536
_ACTIONS_AT_ONCE = 2**20


def observe_integrated_dataset(
    demonstrations: DemonstratedActions,
    dataset: LeRobotDataset,
    config: PreTrainedConfig,
    normaliser: NormalizerProcessorStep,
    normalise: Callable[[Tensor, str], Tensor],
) -> None:
    """Shows the chunks of a dataset to the sample of a field, as training on all of them would.

    Args:
        demonstrations: The sample.
        dataset: The dataset, whose actions have the policy's shape.
        config: The guided policy's configuration.
        normaliser: The step that normalises actions and states.
        normalise: Normalises actions or, by their key, observations ``(..., D)``.

    Raises:
        ValueError: If the dataset has no ``observation.state`` of the policy's dimensions.
    """
    settings = cast(GuidedConfig, config).field_settings
    action_dim = config.action_feature.shape[0]
    stats = (dataset.meta.stats or {}).get(ACTION, {})
    integration = Integration.of(normaliser, settings, action_dim, stats)
    wanted = tuple(normaliser.features[OBS_STATE].shape)
    shape = tuple(dataset.meta.features.get(OBS_STATE, {}).get("shape", ()))
    if shape != wanted:
        raise ValueError(f"the dataset's {OBS_STATE} must have the policy's shape {wanted}, got {shape}")
    columns = _read(dataset)
    actions, states = normalise(columns[ACTION], ACTION), normalise(columns[OBS_STATE], OBS_STATE)
    steps = torch.tensor([delta for delta in config.action_delta_indices if delta >= 0])
    n_dropped = min(getattr(config, "drop_n_last_frames", 0) or 0, len(steps) - 1)
    episodes = columns["episode_index"]
    _, number, counts = torch.unique_consecutive(episodes, return_inverse=True, return_counts=True)
    ends = counts.cumsum(0)[number]  # of each frame's episode
    starts = (ends - torch.arange(len(episodes)) > n_dropped).nonzero().squeeze(1)
    blocks = starts.split(max(1, _ACTIONS_AT_ONCE // len(steps)))
    for block in tqdm(blocks, desc="Adding up actions", unit="block", disable=len(blocks) < 2):
        rows = block.unsqueeze(1) + steps  # (B, T)
        is_pad = rows >= ends[block].unsqueeze(1)
        # Without a dataset_id, training that continues from this checkpoint fits a new field, to its own data.
        observe_integrated(
            demonstrations,
            integration,
            actions[rows.minimum(ends[block].unsqueeze(1) - 1)],
            is_pad,
            columns["index"][block],
            episodes[block],
            states[block],
            settings=settings,
            n_executed=cast(Any, config).n_action_steps,
            drop_n_last_frames=n_dropped,
        )


def _read(dataset: LeRobotDataset) -> dict[str, Tensor]:
    """Actions, states, indices and episode numbers of all frames."""
    kinds = {ACTION: np.float32, OBS_STATE: np.float32, "index": np.int64, "episode_index": np.int64}
    table = dataset.hf_dataset.with_format("numpy", columns=list(kinds))
    starts = range(0, len(table), _FRAMES_AT_ONCE)
    blocks = [table[start : start + _FRAMES_AT_ONCE] for start in starts]
    return {
        key: torch.from_numpy(np.concatenate([np.array(block[key], dtype=kind) for block in blocks]))
        for key, kind in kinds.items()
    }
