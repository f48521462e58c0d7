# SPDX-License-Identifier: Apache-2.0
"""The dataset of a training run, found by its metadata.

LeRobot gives a policy the metadata of the whole dataset. Which of its episodes the run learns from (``--dataset.episodes``,
``--dataset.eval_split``) only the dataset object knows, and LeRobot 0.6 has no way from the metadata to it.
"""

from __future__ import annotations

import gc
from typing import Any

from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.streaming_dataset import StreamingLeRobotDataset

from lerobot_pf2mp.errors import ConfigError


def find_dataset(dataset_meta: Any) -> LeRobotDataset | StreamingLeRobotDataset | None:
    """The dataset whose metadata is this very object; None if there is none.

    Args:
        dataset_meta: The metadata that LeRobot gave to the policy; None at evaluation.
    """
    if dataset_meta is None:
        return None
    for candidate in gc.get_objects():
        # By type: isinstance would ask proxies for their class.
        is_dataset = issubclass(type(candidate), LeRobotDataset | StreamingLeRobotDataset)
        if is_dataset and vars(candidate).get("meta") is dataset_meta:
            return candidate
    return None


def run_episodes(dataset_meta: Any) -> list[int] | None:
    """The numbers of the episodes that a run learns from; None for all of them, or if they are unknown.

    Args:
        dataset_meta: The metadata that LeRobot gave to the policy; None at evaluation.

    Raises:
        ConfigError: If the dataset is streamed and only some episodes are asked for. LeRobot 0.6 streams all of them.
    """
    dataset = find_dataset(dataset_meta)
    if isinstance(dataset, StreamingLeRobotDataset) and dataset.episodes is not None:
        raise ConfigError(
            "dataset.episodes must be unset with --dataset.streaming=true, because LeRobot then reads all episodes, got "
            f"{len(dataset.episodes)} of {dataset_meta.total_episodes}: the potential field would cover the others too"
        )
    if dataset is None or dataset.episodes is None or len(dataset.episodes) == dataset_meta.total_episodes:
        return None
    return [int(episode) for episode in dataset.episodes]
