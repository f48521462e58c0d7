# SPDX-License-Identifier: Apache-2.0
"""Fuzzes every file and command line that users give.

    make fuzz
    python tests/fuzzing --n_inputs=5000 --seed=0 --output_dir=results/fuzz

An input is right if it is accepted, or refused in one line with exit code 1 or 2. Tracebacks, hangs (20 s), crashes, more
than 4 GB, files left half-written and foreign code that runs are faults; inputs that end so are kept in outputs/fuzz.
"""

from __future__ import annotations

import csv
import sys
import tempfile
import time
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path

import draccus
import environment  # noqa: F401  first
import forked_commands
from runner import MARKER, VERDICTS, Outcome, run_inputs
from targets import TARGETS, make_seeds
from tqdm import tqdm

FOREIGN = f"""
import os
from pathlib import Path

def touch(*args, **kwargs):
    Path(os.environ[{MARKER!r}]).touch()

class Step:
    def __init__(self, *args, **kwargs):
        touch()

touch()
"""


@dataclass
class FuzzConfig:
    """Fuzzes every file and command line that users give."""

    # Inputs of all targets together.
    n_inputs: int = 5000
    # Seed of all inputs.
    seed: int = 0
    # After this time no new target begins, and none goes on [s].
    time_limit: float = 7200.0
    # Folder for table.md.
    output_dir: Path = Path("results/fuzz")
    # Folder for faults.csv and the inputs that end wrongly.
    keep: Path = Path("outputs/fuzz")
    # Only targets whose names hold this text.
    only: str = ""


def main(config: FuzzConfig) -> None:
    """Runs all targets, writes the table, and ends with code 1 if there is a fault."""
    began = time.monotonic()
    output_dir, keep = config.output_dir.absolute(), config.keep.absolute()
    targets = {name: target for name, target in TARGETS.items() if config.only in name}
    total_weight = sum(weight for _, weight in targets.values())
    found: dict[str, list[Outcome]] = defaultdict(list)
    with tempfile.TemporaryDirectory(prefix="fuzz-seeds-") as folder:
        modules = Path(folder) / "modules"
        modules.mkdir()
        (modules / "foreign_marker.py").write_text(FOREIGN)
        sys.path.insert(0, str(modules))
        make_seeds(Path(folder))
        for module in forked_commands._IMPORTED_BEFORE:
            __import__(module)  # once, not in every process
        with tqdm(total=config.n_inputs, desc="Inputs", unit="input") as bar:
            for name, (of_seeds, weight) in targets.items():
                # In the order in which they come, however many there are altogether.
                n_inputs = round(config.n_inputs * weight / total_weight)
                for outcome in run_inputs(name, of_seeds(Path(folder)), n_inputs, config.seed, keep):
                    found[name].append(outcome)
                    bar.update()
                    if time.monotonic() - began > config.time_limit:
                        break
                if time.monotonic() - began > config.time_limit:
                    break
    table = make_table(found)
    faults = [one for outcomes in found.values() for one in outcomes if one.verdict not in VERDICTS[:3]]
    output_dir.mkdir(parents=True, exist_ok=True)
    (output_dir / "table.md").write_text(table, encoding="utf-8")
    keep.mkdir(parents=True, exist_ok=True)
    with (keep / "faults.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["target", "number", "verdict", "said"])
        writer.writerows([one.target, one.number, one.verdict, one.said] for one in faults)
    # A seed that is never right would test nothing.
    never = [
        name
        for name, ones in found.items()
        if len(ones) > 60 and all(one.verdict != "accepted" for one in ones)
    ]
    assert not never, f"nothing of {never} was accepted"
    print(table)
    print(f"{len(faults)} faults in {(time.monotonic() - began) / 60:.1f} minutes, seed {config.seed}.")
    sys.exit(1 if faults else 0)


def make_table(found: dict[str, list[Outcome]]) -> str:
    """How many inputs of each target ended in each way, as Markdown."""
    lines = [
        f"| input | inputs | {' | '.join(VERDICTS)} | longest [s] |",
        f"|---|---|{'---|' * len(VERDICTS)}---|",
    ]
    everything = [one for outcomes in found.values() for one in outcomes]
    for name, outcomes in [*found.items(), ("all", everything)]:
        counts = Counter(one.verdict for one in outcomes)
        longest = max((one.seconds for one in outcomes), default=0.0)
        cells = " | ".join(str(counts[verdict]) for verdict in VERDICTS)
        lines.append(f"| {name} | {len(outcomes)} | {cells} | {longest:.1f} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main(draccus.parse(FuzzConfig))
