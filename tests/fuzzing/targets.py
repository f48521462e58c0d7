# SPDX-License-Identifier: Apache-2.0
"""What is fuzzed: every file and command line that users give, from small real ones."""

from __future__ import annotations

import csv
import json
import random
import shutil
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from foreign_recordings import demonstrations, write_d4rl, write_pointmaze
from forked_commands import run_well
from mutations import (
    VALUES,
    mutate_bytes,
    mutate_hdf5,
    mutate_json,
    mutate_npz,
    mutate_safetensors,
    mutate_text,
    mutate_value,
    yaml_of,
)
from runner import Make
from untrained_policies import write_checkpoint

from lerobot_pf2mp import load_policy
from lerobot_pf2mp.commands import cli
from lerobot_pf2mp.commands.command import errors_in_one_line

COMMANDS: dict[str, Callable[[], None]] = {
    "pf2mp-collect": cli.collect,
    "pf2mp-convert": cli.convert,
    "pf2mp-benchmark": cli.benchmark,
    "pf2mp-fit-field": cli.fit_field,
    "pf2mp-plot": cli.plot,
    "pf2mp-push": cli.push,
    "pf2mp-train-expert": cli.train_expert,
}


def call(command: str, *options: str) -> Callable[[], None]:
    """A call of a command."""

    def run() -> None:
        with patch.object(sys, "argv", [command, *options]):
            COMMANDS[command]()

    return run


# Options of a command that ends at once, in a folder with the seeds (see `make_seeds`) beside it.
OPTIONS: dict[str, dict[str, Any]] = {
    "pf2mp-collect": {
        "task": "maze_umaze", "n_episodes": 1, "n_steps": 8, "seed": 0, "root": "out", "action_noise": 0.0,
        "overwrite": False, "repo_id": "local/x", "maze_map": "11111/10001/11111",
    },
    "pf2mp-collect pen": {
        "task": "handwriting_pen", "n_episodes": 1, "n_steps": 8, "letter": "S", "letter_height": 0.12, "n_regions": 2,
        "region_gap": 0.012, "root": "out", "scene_file": None,
    },
    "pf2mp-convert": {
        "source": {"type": "handwriting", "path": "SEEDS/pen.csv", "joint_offsets": []}, "task": "handwriting_pen",
        "n_steps": 8, "n_regions": 0, "root": "out", "overwrite": False,
    },
    "pf2mp-benchmark": {
        "policies": {"a": "SEEDS/policy"}, "env": {"type": "pf2mp_maze", "task": "MazeUMaze-v0", "episode_length": 4},
        "guidance": ["none"], "variants": {"": {}}, "seeds": [0], "n_repeats": 1, "n_episodes": 1, "batch_size": 1,
        "n_processes": 1, "output_dir": "out",
    },
    "pf2mp-fit-field": {
        "policy": {
            "path": "SEEDS/policy", "n_field_points": 30, "field_action_dims": [0, 1], "field_bandwidth": "likelihood",
        },
        "dataset": {"repo_id": "local/maze", "root": "SEEDS/maze", "episodes": [0, 1]}, "output_dir": "out",
    },
    "pf2mp-plot": {
        "figure": "lambda", "results": ["SEEDS/results"], "task": "MazeLarge-v0", "output": "q.png", "n_episodes": 1,
        "episodes": [0], "background": "light",
    },
    "pf2mp-train-expert": {"task": "fetch_reach", "algo": "nothing", "total_steps": 1, "output_dir": "out", "seed": 0},
}  # fmt: skip


def placed(value: Any, seeds: Path) -> Any:
    """Options with the folder of the seeds."""
    return json.loads(json.dumps(value).replace("SEEDS", str(seeds)))


def fuzz_file(name: str, seeds: Path) -> Make:
    """A configuration file with changed values."""

    def make(rng: random.Random, folder: Path) -> Callable[[], None]:
        options = mutate_value(placed(OPTIONS[name], seeds), rng)
        text = yaml_of(options, rng)
        (folder / "options.yaml").write_bytes(
            mutate_bytes(text.encode(), rng) if rng.random() < 0.1 else text.encode("utf-8", "replace")
        )
        return call(name.split()[0], f"--config_path={folder / 'options.yaml'}")

    return make


def fuzz_line(name: str, seeds: Path) -> Make:
    """A command line with changed values, and with options that do not exist."""

    def make(rng: random.Random, folder: Path) -> Callable[[], None]:
        flat = flatten(placed(OPTIONS[name], seeds))
        for _ in range(rng.choice([1, 1, 2])):
            key = rng.choice([*flat, "nothing"])
            flat[key] = rng.choice(
                [*VALUES, "!x", "!!python/object/apply:foreign_marker.touch []", "include x", "x #1"]
            )
        texts = {key: value if isinstance(value, str) else json.dumps(value) for key, value in flat.items()}
        return call(
            name.split()[0], *(f"--{key}={text}" for key, text in texts.items() if "\x00" not in text)
        )

    return make


def flatten(options: dict[str, Any], below: str = "") -> dict[str, Any]:
    """Options by their names on a command line."""
    flat: dict[str, Any] = {}
    for key, value in options.items():
        is_group = isinstance(value, dict) and key in ("source", "policy", "dataset", "env")
        flat |= flatten(value, f"{below}{key}.") if is_group else {f"{below}{key}": value}
    return flat


def fuzz_source(
    kind: str, seed: str, task: str, change: Callable[[Path, random.Random], None]
) -> Callable[[Path], Make]:
    """A recording that is converted."""

    def of_seeds(seeds: Path) -> Make:
        def make(rng: random.Random, folder: Path) -> Callable[[], None]:
            source = copied(seeds / seed, folder)
            files = [path for path in source.rglob("*") if path.is_file()] if source.is_dir() else [source]
            change(rng.choice(sorted(files)), rng)
            options = [
                f"--source.type={kind}",
                f"--source.path={source}",
                f"--task={task}",
                "--n_steps=8",
                "--n_regions=0",
                "--root=out",
            ]
            return call("pf2mp-convert", *options)

        return make

    return of_seeds


def copied(path: Path, folder: Path) -> Path:
    """A copy of a file or folder."""
    target = folder / path.name
    if path.is_dir():
        shutil.copytree(path, target)
    else:
        shutil.copy(path, target)
    return target


def change_by_suffix(path: Path, rng: random.Random) -> None:
    """Changes a file in the way of its kind."""
    if path.suffix == ".json":
        mutate_json(path, rng)
    elif path.suffix in (".hdf5", ".h5"):
        mutate_hdf5(path, rng)
    elif path.suffix == ".npz":
        mutate_npz(path, rng)
    elif path.suffix == ".safetensors":
        mutate_safetensors(path, rng)
    elif path.suffix in (".csv", ".tsv", ".md"):
        path.write_bytes(mutate_text(path.read_text(), rng))
    else:
        path.write_bytes(mutate_bytes(path.read_bytes(), rng))


def fuzz_checkpoint(pattern: str) -> Callable[[Path], Make]:
    """A checkpoint with a changed file, which is loaded and plans."""

    def of_seeds(seeds: Path) -> Make:
        def make(rng: random.Random, folder: Path) -> Callable[[], None]:
            checkpoint = copied(seeds / rng.choice(["policy", "dppf"]), folder)
            change_by_suffix(rng.choice(sorted(checkpoint.glob(pattern))), rng)

            def load() -> None:
                with errors_in_one_line():
                    import torch

                    policy, preprocess, _ = load_policy(checkpoint, device="cpu")
                    keys = ("observation.state", "observation.environment_state")
                    policy.select_action(preprocess({key: torch.zeros(2) for key in keys}))

            return load

        return make

    return of_seeds


def fuzz_dataset(seeds: Path) -> Make:
    """A LeRobotDataset with a changed file, to which a field is fitted."""

    def make(rng: random.Random, folder: Path) -> Callable[[], None]:
        data = copied(seeds / "maze", folder)
        change_by_suffix(rng.choice(sorted(path for path in data.rglob("*") if path.is_file())), rng)
        options = [
            f"--policy.path={seeds / 'policy'}",
            "--dataset.repo_id=local/maze",
            f"--dataset.root={data}",
        ]
        return call("pf2mp-fit-field", *options, "--output_dir=out")

    return make


def fuzz_results(seeds: Path) -> Make:
    """Results with changed rows, which are drawn."""

    def make(rng: random.Random, folder: Path) -> Callable[[], None]:
        results = copied(seeds / "results", folder)
        change_by_suffix(results / "summary.csv", rng)
        return call("pf2mp-plot", "--figure=lambda", f"--results=[{results}]", "--output=q.png")

    return make


def fuzz_run(seeds: Path) -> Make:
    """A benchmark that goes on from changed files."""

    def make(rng: random.Random, folder: Path) -> Callable[[], None]:
        shutil.copytree(seeds / "benchmark", folder / "out")
        change_by_suffix(folder / "out" / rng.choice(["run.json", "episodes.csv"]), rng)
        options = flatten(placed(OPTIONS["pf2mp-benchmark"], seeds))
        texts = {
            key: value if isinstance(value, str) else json.dumps(value) for key, value in options.items()
        }
        return call("pf2mp-benchmark", *(f"--{key}={text}" for key, text in texts.items()))

    return make


def fuzz_scene(seeds: Path) -> Make:
    """A stroke of one's own with changed values."""

    def make(rng: random.Random, folder: Path) -> Callable[[], None]:
        mutate_json(copied(seeds / "scene.json", folder), rng)
        options = ["--task=handwriting_pen", "--n_episodes=1", "--n_steps=8", "--root=out"]
        return call("pf2mp-collect", *options, f"--scene_file={folder / 'scene.json'}")

    return make


def fuzz_expert(seeds: Path) -> Make:
    """An expert's folder with a changed file, which is to make demonstrations."""

    def make(rng: random.Random, folder: Path) -> Callable[[], None]:
        expert = copied(seeds / "expert", folder)
        change_by_suffix(rng.choice(sorted(path for path in expert.rglob("*") if path.is_file())), rng)

        def read() -> None:
            from lerobot_pf2mp.dataset_tools.experts.expert_checkpoint import ExpertCheckpoint

            with errors_in_one_line():
                ExpertCheckpoint.read(expert)

        return read

    return make


# The shares of inputs of a command's configuration file and of its command line.
SHARES = {
    "pf2mp-collect": (1, 1),
    "pf2mp-collect pen": (0.5, 0.5),
    "pf2mp-convert": (1, 1),
    "pf2mp-benchmark": (0.5, 0.5),
    "pf2mp-fit-field": (1, 1),
    "pf2mp-plot": (0.5, 0.5),
    "pf2mp-train-expert": (0.5, 0.0),
}

# Each with the share of inputs that it gets.
TARGETS: dict[str, tuple[Callable[[Path], Make], float]] = {
    **{f"YAML, {name}": (partial(fuzz_file, name), share) for name, (share, _) in SHARES.items()},
    **{
        f"command line, {name}": (partial(fuzz_line, name), share)
        for name, (_, share) in SHARES.items()
        if share
    },
    "D4RL": (fuzz_source("d4rl", "d4rl.hdf5", "maze_umaze", change_by_suffix), 1.5),
    "Minari": (fuzz_source("minari", "minari", "maze_umaze", change_by_suffix), 1.5),
    "Fetch, npz": (fuzz_source("fetch", "reach.npz", "fetch_reach", change_by_suffix), 1),
    "handwriting, CSV": (fuzz_source("handwriting", "pen.csv", "handwriting_pen", change_by_suffix), 1.5),
    "handwriting, JSON": (fuzz_source("handwriting", "pen.json", "handwriting_pen", change_by_suffix), 1.5),
    "LeRobot dataset": (fuzz_dataset, 1.5),
    "config.json": (fuzz_checkpoint("config.json"), 2),
    "processors' JSON": (fuzz_checkpoint("policy_*processor.json"), 2),
    "field": (fuzz_checkpoint("*potential_field.safetensors"), 2),
    "weights and statistics": (fuzz_checkpoint("*[lr].safetensors"), 0.5),
    "result CSV": (fuzz_results, 1),
    "run.json, episodes.csv": (fuzz_run, 0.5),
    "scene file": (fuzz_scene, 1),
    "expert's folder": (fuzz_expert, 1),
}


def make_seeds(folder: Path) -> None:
    """Small inputs that are right."""
    write_checkpoint(folder / "policy", "pf2mp")
    write_checkpoint(folder / "dppf", "dppf")
    run_well(
        "pf2mp-collect", "--task=maze_umaze", "--n_episodes=3", "--n_steps=12", f"--root={folder / 'maze'}"
    )
    trajectories = demonstrations("umaze", 2)
    write_d4rl(folder / "d4rl.hdf5", trajectories, "umaze", with_timeouts=True)
    with pytest.MonkeyPatch.context() as patched:
        shutil.move(write_pointmaze(folder / "datasets", patched, trajectories), folder / "minari")
    ways = np.linspace([1.25, 0.6, 0.5], [1.35, 0.65, 0.6], 10)
    observation = np.zeros((2, 10, 10))
    observation[:, :, :3] = ways
    np.savez(folder / "reach.npz", observation=observation, desired_goal=np.tile(ways[-1], (2, 10, 1)))
    times = np.arange(20) * 0.05
    stroke = np.stack([0.5 + 0.04 * np.sin(3 * times), 0.05 * times], axis=1)  # on the sheet
    with (folder / "pen.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["episode", "time", "x", "y"])
        writer.writerows(
            [n, *row] for n in range(2) for row in np.column_stack([times, stroke]).round(4).tolist()
        )
    episode = {"time": times.tolist(), "pen": stroke.round(4).tolist()}
    (folder / "pen.json").write_text(json.dumps({"episodes": [episode, episode]}))
    (folder / "scene.json").write_text(
        json.dumps(
            {"stroke": stroke[:10].round(3).tolist(), "regions": [{"centre": [0.6, 0.1], "radius": 0.01}]}
        )
    )
    (folder / "results").mkdir()
    root = Path(__file__).parents[2]
    shutil.copy(root / "results/maze_lambda/summary.csv", folder / "results")
    options = flatten(placed(OPTIONS["pf2mp-benchmark"], folder)) | {"output_dir": str(folder / "benchmark")}
    texts = {key: value if isinstance(value, str) else json.dumps(value) for key, value in options.items()}
    run_well("pf2mp-benchmark", *(f"--{key}={text}" for key, text in texts.items()))
    run_well(
        "pf2mp-train-expert", "--task=fetch_reach", "--total_steps=64", f"--output_dir={folder / 'expert'}",
        "--options={n_steps: 64, batch_size: 32, n_epochs: 1, net_arch: [4]}",
    )  # fmt: skip
