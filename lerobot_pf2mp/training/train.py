# SPDX-License-Identifier: Apache-2.0
"""pf2mp-train: LeRobot's own training function, with low-dimensional datasets held in memory.

Reading one sample with an action window costs LeRobot's loader about 14 ms, many times the training step of a small
network. The options, configuration, checkpoints, logs and resumption are those of ``lerobot-train``, and so are the
batches and their order.
"""

from __future__ import annotations

import logging
import sys
from typing import Any

from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.factory import make_train_eval_datasets
from lerobot.scripts import lerobot_train

from lerobot_pf2mp.process.interruption import exit_code, sigterm_like_ctrl_c
from lerobot_pf2mp.training.in_memory_dataset import InMemoryDataset, fits_in_memory

MEMORY_LIMIT_OPTION = "--in_memory_limit_gb"
DEFAULT_MEMORY_LIMIT_GB = 4.0

USAGE = f"""\
usage: pf2mp-train [{MEMORY_LIMIT_OPTION}=GB] [options of lerobot-train]

lerobot-train with datasets that hold no images kept in memory, which trains small networks many times faster. Same
options, configuration, checkpoints, logs, resumption, batches and order.

  {MEMORY_LIMIT_OPTION}=GB  Largest dataset kept in memory [GB]; beyond it, and with images or streaming, the loader is
                          LeRobot's own. (default: {DEFAULT_MEMORY_LIMIT_GB:g})

Examples:
  pf2mp-train --config_path=eval_configs/train_maze_large_small.yaml --dataset.root=data/maze_large \\
      --output_dir=outputs/pf2mp
  pf2mp-train --config_path=outputs/pf2mp/checkpoints/last/pretrained_model/train_config.json --resume=true

The options of lerobot-train follow.
"""


def main() -> None:
    """The command pf2mp-train."""
    if {"-h", "--help"} & set(sys.argv[1:]):
        print(USAGE)
    try:
        limit_gb = _take_memory_limit()
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)

    def make_datasets(config: TrainPipelineConfig) -> tuple[Any, Any]:
        return tuple(
            _in_memory(config, dataset, limit_gb * 1e9) for dataset in make_train_eval_datasets(config)
        )

    # The one place where the training function gets its data; there is no plug-in point for it in LeRobot 0.6.
    lerobot_train.make_train_eval_datasets = make_datasets
    try:
        with sigterm_like_ctrl_c():
            lerobot_train.main()
    except KeyboardInterrupt as interruption:
        print("\ninterrupted: training goes on from the last checkpoint with --resume=true", file=sys.stderr)
        sys.exit(exit_code(interruption))


def _in_memory(config: TrainPipelineConfig, dataset: Any, limit_bytes: float) -> Any:
    if dataset is None or not fits_in_memory(dataset, limit_bytes):
        if dataset is not None:
            logging.info(
                "The dataset has images, is streamed or is too large for memory: LeRobot's loader reads it."
            )
        return dataset
    # Worker processes would only copy what is already there.
    config.num_workers = 0
    logging.info(f"Keeping {dataset.num_frames} frames in memory.")
    return InMemoryDataset(dataset)


def _take_memory_limit() -> float:
    """Removes the one option that is not LeRobot's from the command line and returns its value [GB]."""
    limit = DEFAULT_MEMORY_LIMIT_GB
    for argument in [a for a in sys.argv[1:] if a.startswith(f"{MEMORY_LIMIT_OPTION}=")]:
        sys.argv.remove(argument)
        value = argument.partition("=")[2]
        try:
            limit = float(value)
        except ValueError:
            raise ValueError(f"{MEMORY_LIMIT_OPTION} must be a number [GB], got {value!r}") from None
        if not limit >= 0:
            raise ValueError(f"{MEMORY_LIMIT_OPTION} must be at least 0 [GB], got {limit:g}")
    return limit


if __name__ == "__main__":
    main()
