# SPDX-License-Identifier: Apache-2.0
"""The command pf2mp-train. It adds two options to those of lerobot-train."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

from lerobot_pf2mp.commands.command import answer_version, errors_in_one_line, trust_steps
from lerobot_pf2mp.commands.options import quoted_texts, read_config_file
from lerobot_pf2mp.process.interruption import exit_code, sigterm_like_ctrl_c

MEMORY_LIMIT_OPTION = "--in_memory_limit_gb"
TRUST_OPTION = "--trust"
DEFAULT_MEMORY_LIMIT_GB = 4.0

USAGE = f"""\
usage: pf2mp-train [{MEMORY_LIMIT_OPTION}=GB] [{TRUST_OPTION}=CLASS,...] [options of lerobot-train]

lerobot-train, but small datasets are kept in memory, their videos decoded, which trains small networks many times faster.
Options, configuration, checkpoints, logs, resumption, batches and their order are the same.

  {TRUST_OPTION}=CLASS,...       Processor steps of a checkpoint that may be imported although they are not registered.
  {MEMORY_LIMIT_OPTION}=GB  Largest dataset kept in memory [GB]; beyond it, and with streaming or image transforms, the
                          loader is LeRobot's own. (default: {DEFAULT_MEMORY_LIMIT_GB:g})

Examples:
  pf2mp-train --config_path=eval_configs/train_maze_large_small.yaml --dataset.root=data/maze_large \\
      --output_dir=outputs/pf2mp
  pf2mp-train --config_path=outputs/pf2mp/checkpoints/last/pretrained_model/train_config.json --resume=true

The options of lerobot-train follow.
"""


def main() -> None:
    """Runs the command."""
    answer_version()
    if {"-h", "--help"} & set(sys.argv[1:]):
        print(USAGE)
    try:
        with errors_in_one_line(), sigterm_like_ctrl_c():
            limit_gb = _take_memory_limit()
            from lerobot.configs.parser import parse_arg
            from lerobot.configs.train import TrainPipelineConfig

            from lerobot_pf2mp.process.claims import claimed
            from lerobot_pf2mp.training.train import train

            trust_steps(_take_option(TRUST_OPTION).strip("[]").split(","))
            _check_checkpoint(sys.argv[1:])
            output_dir = parse_arg("output_dir", sys.argv[1:])
            sys.argv[1:] = quoted_texts(TrainPipelineConfig, sys.argv[1:])
            is_first = os.environ.get("RANK", "0") == os.environ.get("LOCAL_RANK", "0") == "0"
            with claimed(Path(output_dir)) if output_dir and is_first else nullcontext():
                train(limit_gb)
    except KeyboardInterrupt as interruption:
        print(
            "\ninterrupted: training continues from the last checkpoint with --resume=true", file=sys.stderr
        )
        sys.exit(exit_code(interruption))


def _take_memory_limit() -> float:
    """The value of the option of that name [GB]."""
    value = _take_option(MEMORY_LIMIT_OPTION) or str(DEFAULT_MEMORY_LIMIT_GB)
    try:
        limit = float(value)
    except ValueError:
        raise ValueError(f"{MEMORY_LIMIT_OPTION} must be a number [GB], got {value!r}") from None
    if not limit >= 0:
        raise ValueError(f"{MEMORY_LIMIT_OPTION} must be at least 0 [GB], got {limit:g}")
    return limit


def _take_option(option: str) -> str:
    """Removes an option that is not LeRobot's from the command line and returns its last value; empty without it."""
    value = ""
    for argument in [a for a in sys.argv[1:] if a.startswith(f"{option}=")]:
        sys.argv.remove(argument)
        value = argument.partition("=")[2]
    return value


def _check_checkpoint(args: Sequence[str]) -> None:
    """Checks the processors of the checkpoint from which training goes on, before LeRobot loads them."""
    from lerobot.configs.parser import parse_arg

    from lerobot_pf2mp.policies.processor_files import check_processors

    path, config_path = parse_arg("policy.path", args), parse_arg("config_path", args)
    if path:
        check_processors(path)
    if config_path and Path(config_path).is_file():
        check_processors(Path(config_path).parent)
        in_file = read_config_file(config_path, object).get("policy")
        if isinstance(in_file, dict) and isinstance(in_file.get("path"), str):
            check_processors(in_file["path"])


if __name__ == "__main__":
    main()
