# SPDX-License-Identifier: Apache-2.0
"""The report on a field and the dataset that it is fitted to."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION
from torch import Tensor
from tqdm import tqdm

from lerobot_pf2mp.field_report.examination import Frames, make_field_report
from lerobot_pf2mp.field_report.report import FieldReport
from lerobot_pf2mp.policies.guided.action_kind import action_kind_of
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.policies.guided.field_settings import INTEGRATED

_MOST_FRAMES = 200_000  # that are looked at; of a larger dataset, every second, third, ... frame
_FRAMES_AT_ONCE = 65536


def report_on_dataset(
    demonstrations: DemonstratedActions, dataset: LeRobotDataset, normalise: Callable[[Tensor], Tensor]
) -> FieldReport:
    """The report on a field, for which all frames of its dataset are looked at, up to 200 000 evenly spaced ones.

    Args:
        demonstrations: A sample of the dataset's actions.
        dataset: The dataset.
        normalise: Normalises actions ``(N, A)`` as those of the sample.
    """
    dims = demonstrations.settings.action_dims
    source, names = f"dataset {dataset.repo_id}", _names_of(dataset.meta.features[ACTION].get("names"))
    if demonstrations.settings.over == INTEGRATED:  # positions of the sample: the dataset holds displacements
        return make_field_report(demonstrations, source=source, names=names)
    frames = _read(dataset, normalise)
    actions = frames.actions if dims is None else frames.actions[:, list(dims)]
    return make_field_report(
        demonstrations,
        source=source,
        frames=frames._replace(actions=actions),
        names=names,
        action_kind=action_kind_of(dataset, dims),
    )


def _read(dataset: LeRobotDataset, normalise: Callable[[Tensor], Tensor]) -> Frames:
    table = dataset.hf_dataset.with_format("numpy", columns=[ACTION, "index", "episode_index"])
    stride = -(-len(table) // _MOST_FRAMES)
    starts = range(0, len(table), _FRAMES_AT_ONCE)
    parts = []
    for start in tqdm(starts, desc="Judging actions", unit="block", disable=len(starts) < 2):
        block = table[start : start + _FRAMES_AT_ONCE]
        n_rows = len(block["index"])
        actions, episodes, numbers = (
            torch.from_numpy(np.array(block[key], dtype=dtype)).reshape(n_rows, -1)[-start % stride :: stride]
            for key, dtype in ((ACTION, np.float32), ("episode_index", np.int64), ("index", np.int64))
        )
        parts.append((normalise(actions), episodes.flatten(), numbers.flatten()))
    actions, episodes, numbers = (torch.cat(columns) for columns in zip(*parts, strict=True))
    return Frames(actions, episodes, numbers)


def _names_of(names: Any) -> list[str] | None:
    """The names of action dimensions, which datasets hold as a list, as a number of each, or as a list of each group."""
    if isinstance(names, dict):
        if all(isinstance(value, int) for value in names.values()):
            return sorted(names, key=lambda name: names[name])
        names = [name for group in names.values() for name in (group if isinstance(group, list) else [])]
    return [str(name) for name in names] if isinstance(names, (list, tuple)) and names else None
