# SPDX-License-Identifier: Apache-2.0
"""LeRobot's own training function, with small datasets in memory.

Reading one sample with an action window costs LeRobot's loader about 14 ms, many times the training step of a small
network, and decoding its images some more. The options, configuration, checkpoints, logs and resumption are those of
``lerobot-train``, and so are the batches and their order.
"""

from __future__ import annotations

import logging
from typing import Any

from lerobot.configs import parser
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.factory import make_train_eval_datasets
from lerobot.scripts import lerobot_train

from lerobot_pf2mp.errors import explained
from lerobot_pf2mp.training.in_memory_dataset import InMemoryDataset, fits_in_memory


def train(limit_gb: float) -> None:
    """Runs lerobot-train, whose options are on the command line.

    Args:
        limit_gb: Largest dataset kept in memory [GB].

    Raises:
        ParsingError: If an option cannot have its value.
    """

    def make_datasets(config: TrainPipelineConfig) -> tuple[Any, Any]:
        _check_episodes(config)
        with explained(f"the dataset {config.dataset.repo_id} cannot be loaded"):
            datasets = make_train_eval_datasets(config)
        return tuple(_in_memory(config, dataset, limit_gb * 1e9) for dataset in datasets)

    # The training function gets its data only from here. LeRobot 0.6 has no plug-in point for it.
    lerobot_train.make_train_eval_datasets = make_datasets
    # LeRobot would print an option that it cannot read in several lines and end. Here it is an error as any other.
    parser.DecodingError = ()
    lerobot_train.main()


def _check_episodes(config: TrainPipelineConfig) -> None:
    """Raises a ValueError if the dataset does not have the episodes that are asked for, or LeRobot would not heed them."""
    episodes = config.dataset.episodes
    if episodes is None:
        return
    if config.dataset.streaming:
        raise ValueError(
            "dataset.episodes must be unset with --dataset.streaming=true, because LeRobot then reads all episodes, got "
            f"{len(episodes)} episodes"
        )
    with explained(f"the dataset {config.dataset.repo_id} cannot be loaded"):
        meta = LeRobotDatasetMetadata(
            config.dataset.repo_id, root=config.dataset.root, revision=config.dataset.revision
        )
    missing = [episode for episode in episodes if not 0 <= episode < meta.total_episodes]
    if missing or not episodes:
        raise ValueError(
            f"dataset.episodes must be numbers of episodes, from 0 to {meta.total_episodes - 1}, got "
            f"{missing or 'none'}"
        )


def _in_memory(config: TrainPipelineConfig, dataset: Any, limit_bytes: float) -> Any:
    if dataset is None or not fits_in_memory(dataset, limit_bytes):
        if dataset is not None:
            logging.info(
                "The dataset is streamed, augmented, has images that are not videos, or is too large for memory: LeRobot's "
                "loader reads it."
            )
        return dataset
    # Worker processes would only copy the data in memory.
    config.num_workers = 0
    logging.info(f"Keeping {dataset.num_frames} frames in memory.")
    return InMemoryDataset(dataset)
