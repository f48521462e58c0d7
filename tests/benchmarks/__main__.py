# SPDX-License-Identifier: Apache-2.0
"""The command of the benchmark suite, ``make bench``."""

from __future__ import annotations

import importlib
import logging
import sys
import warnings
from dataclasses import dataclass, field
from pathlib import Path

import draccus
from figure import plot_density
from report import make_table, write_report
from tqdm import tqdm

from lerobot_pf2mp.figures.theme import THEMES

PARTS = (
    "guidance",
    "density",
    "chunk",
    "training",
    "time_to_policy",
    "conversion",
    "evaluation",
    "startup",
)


@dataclass
class BenchConfig:
    """Measures how fast everything is, beside what else does the same.

    Examples:
        make bench
        python tests/benchmarks --only=[density,guidance] --output_dir=bench
    """

    # Which parts: guidance, density, chunk, training, time_to_policy, conversion, evaluation, startup. All of them take an
    # hour and a half on two cores.
    only: list[str] = field(default_factory=lambda: list(PARTS))
    # Folder of bench.csv, table.md and run.json; by default results/bench. Parts measured there before stay, unless they are
    # measured again.
    output_dir: Path = Path(__file__).parents[2] / "results" / "bench"


def main() -> None:
    """Runs the command."""
    config = draccus.parse(BenchConfig)
    unknown = [part for part in config.only if part not in PARTS]
    if unknown:
        sys.exit(f"error: only must be of {list(PARTS)}, got {unknown}")
    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore")
    for part in tqdm(config.only, unit="part"):
        rows = list(importlib.import_module(part).measure())
        every = write_report(config.output_dir, rows)
        tqdm.write(make_table(rows))
        if part == "density":
            for background in THEMES:
                plot_density(config.output_dir / f"density_{background}.png", every, background)


if __name__ == "__main__":
    main()
