# SPDX-License-Identifier: Apache-2.0
"""The command pf2mp-train. It adds one option to those of lerobot-train."""

from __future__ import annotations

import sys

from lerobot_pf2mp.commands.command import answer_version
from lerobot_pf2mp.process.interruption import exit_code, sigterm_like_ctrl_c

MEMORY_LIMIT_OPTION = "--in_memory_limit_gb"
DEFAULT_MEMORY_LIMIT_GB = 4.0

USAGE = f"""\
usage: pf2mp-train [{MEMORY_LIMIT_OPTION}=GB] [options of lerobot-train]

lerobot-train, but datasets without images are kept in memory, which trains small networks many times faster. Options,
configuration, checkpoints, logs, resumption, batches and their order are the same.

  {MEMORY_LIMIT_OPTION}=GB  Largest dataset kept in memory [GB]; beyond it, and with images or streaming, the loader is
                          LeRobot's own. (default: {DEFAULT_MEMORY_LIMIT_GB:g})

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
        limit_gb = _take_memory_limit()
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)
    try:
        with sigterm_like_ctrl_c():
            from lerobot_pf2mp.training.train import train

            train(limit_gb)
    except KeyboardInterrupt as interruption:
        print(
            "\ninterrupted: training continues from the last checkpoint with --resume=true", file=sys.stderr
        )
        sys.exit(exit_code(interruption))


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
