# SPDX-License-Identifier: Apache-2.0
"""What kill -9 at a random moment leaves, and whether the same command then succeeds.

    python tests/benchmarks/kills.py --n_kills=50

Each command runs once to its end, which takes a time T and gives the right output. Then it is killed again and again, after
a time drawn from 0 to T, and checked: at the output's place there is nothing, or what belongs there; its worker processes
have ended too, within 10 s; and the same command, run again, gives the right output and leaves nothing beside it.
"""

from __future__ import annotations

import hashlib
import os
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import draccus
from tqdm import tqdm

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests/fuzzing")]

import environment  # noqa: E402, F401  first
from forked_commands import ForkedCommand  # noqa: E402
from targets import make_seeds  # noqa: E402

MAZE = ["--env.type=pf2mp_maze", "--env.task=MazeUMaze-v0"]
# The last part of an output that differs between two runs, if any: times, or the order of several processes.
COMMANDS: dict[str, tuple[list[str], tuple[str, ...]]] = {
    "pf2mp-collect": (["--task=maze_umaze", "--n_episodes=300", "--root=out"], ()),
    "pf2mp-collect, 2 processes": (
        ["--task=fetch_reach", "--n_episodes=8", "--n_processes=2", "--root=out"],
        (),
    ),
    "pf2mp-convert": (
        ["--source.type=d4rl", "--source.path=SEEDS/d4rl.hdf5", "--task=maze_umaze", "--root=out"],
        (),
    ),
    "pf2mp-collect, overwriting": (
        ["--task=maze_umaze", "--n_episodes=300", "--root=out", "--overwrite=true"],
        (),
    ),
    "pf2mp-fit-field": (
        ["--policy.path=SEEDS/policy", "--dataset.repo_id=local/maze", "--dataset.root=SEEDS/maze", "--output_dir=out"],
        (),
    ),
    "pf2mp-benchmark, 2 processes": (
        ["--policies={a: SEEDS/policy}", *MAZE, "--n_episodes=4", "--batch_size=2", "--n_processes=2", "--output_dir=out"],
        ("episodes.csv", "summary.csv", "table.md", "table.tex"),
    ),
    "pf2mp-plot": (
        ["--figure=flow", "--checkpoint=SEEDS/policy", *MAZE, "--n_episodes=1", "--output=out/flow.gif"],
        (),
    ),
}  # fmt: skip


@dataclass
class KillsConfig:
    """Kills commands at random moments."""

    # Kills of each command.
    n_kills: int = 50
    # Seed of the moments.
    seed: int = 0
    # Only these commands; all by default.
    only: list[str] = field(default_factory=list)
    # Folder for table.md.
    output_dir: Path = Path("results/kills")


def main(config: KillsConfig) -> None:
    """Kills all commands and writes the table."""
    output_dir = config.output_dir.absolute()
    rng = random.Random(config.seed)
    lines = [
        "| command | to the end [s] | kills | whole or nothing | left beside it | workers left | right when run again | "
        "left after that |",
        "|---|---|---|---|---|---|---|---|",
    ]
    output_dir.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="kills-") as folder:
        seeds = Path(folder) / "seeds"
        seeds.mkdir()
        make_seeds(seeds)
        for name, (options, varying) in COMMANDS.items():
            if config.only and name not in config.only:
                continue
            here = Path(folder) / name.replace(", ", "_").replace(" ", "_")
            options = [option.replace("SEEDS", str(seeds)) for option in options]
            lines.append(kill_often(name, options, varying, here, rng, config.n_kills))
            (output_dir / "table.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(*lines, sep="\n")


def kill_often(
    name: str, options: Sequence[str], varying: Sequence[str], here: Path, rng: random.Random, n_kills: int
) -> str:
    """Kills a command and returns its line of the table."""
    here.mkdir()
    command = name.split(",")[0]
    began = time.monotonic()
    assert _run(command, options, here) == 0, f"{name} must succeed"
    seconds = time.monotonic() - began
    right = contents_of(here / "out", varying)
    is_overwriting = "--overwrite=true" in options
    whole = beside = orphans = again = after = 0
    for _ in tqdm(range(n_kills), desc=name, unit="kill"):
        if not is_overwriting:
            shutil.rmtree(here)
            here.mkdir()
        process = ForkedCommand(command, *options, cwd=here, start_new_session=True)
        time.sleep(rng.uniform(0, seconds))
        process.kill()
        process.wait()
        orphans += not has_ended(process.pid)
        found = contents_of(here / "out", varying)
        is_resumed = command in ("pf2mp-benchmark", "pf2mp-plot")  # from its own output, or a folder for it
        whole += found in (None, right) or is_resumed
        beside += bool(hidden_in(here))
        is_done = found is not None and not is_overwriting and not is_resumed
        again += is_done or (
            _run(command, options, here) == 0 and contents_of(here / "out", varying) == right
        )
        after += bool(hidden_in(here)) and not is_done
    return f"| {name} | {seconds:.1f} | {n_kills} | {whole} | {beside} | {orphans} | {again} | {after} |"


def _run(command: str, options: Sequence[str], here: Path) -> int:
    process = ForkedCommand(command, *options, cwd=here)
    return process.wait(600)


def contents_of(folder: Path, varying: Sequence[str]) -> dict[str, str] | None:
    """Digests of a folder's files by name; None if it does not exist. Of files that vary, only whether they are there."""
    if not folder.exists():
        return None
    varying = (*varying, "run.json")
    return {
        str(path.relative_to(folder)): ""
        if path.name in varying
        else hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def hidden_in(folder: Path) -> list[Path]:
    """What an unfinished run has left."""
    return [path for path in folder.rglob(".*") if path.name != ".cache"]


def has_ended(session: int) -> bool:
    """Whether all processes of a session end within 10 s."""
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline:
        if not any(
            _session_of(path.name) == session for path in Path("/proc").iterdir() if path.name.isdigit()
        ):
            return True
        time.sleep(0.1)
    return False


def _session_of(process: str) -> int:
    try:
        return os.getsid(int(process))
    except OSError:
        return -1


if __name__ == "__main__":
    main(draccus.parse(KillsConfig))
