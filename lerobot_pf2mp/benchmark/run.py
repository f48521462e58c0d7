# SPDX-License-Identifier: Apache-2.0
"""Compares policies on the same episodes: tasks x policies x guidance x training seeds x repeats, one row per episode.

Every policy gets the same start-goal pairs and, in each repeat, the same prior noise, so that policies can be compared
pair by pair. The evaluation is LeRobot's own, on vectorised environments.
"""

from __future__ import annotations

import csv
import json
import os
import platform
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from lerobot.envs.configs import EnvConfig
from tqdm import tqdm

from lerobot_pf2mp.benchmark.evaluation import evaluate_all
from lerobot_pf2mp.benchmark.spec import NONE, BenchmarkSpec, Job
from lerobot_pf2mp.loading import load_config
from lerobot_pf2mp.policies.guided.configuration_guided import GuidedConfig
from lerobot_pf2mp.process.atomic_files import file_written_beside
from lerobot_pf2mp.process.claims import claimed
from lerobot_pf2mp.results.rows import EpisodeRow, SummaryRow, format_row, read_rows, write_rows
from lerobot_pf2mp.results.summary import group_cells, summarise
from lerobot_pf2mp.results.tables import make_latex, make_markdown

# Names of guided policies when guidance is off.
UNGUIDED_NAMES = {"pf2mp": "fmp", "dppf": "dp"}
GUARDED = "guarded "


def run_benchmark(spec: BenchmarkSpec, output_dir: Path, *, n_processes: int = 1) -> list[SummaryRow]:
    """Evaluates all policies and writes ``episodes.csv``, ``summary.csv``, ``table.md``, ``table.tex`` and ``run.json``.

    An interrupted benchmark continues where it stopped. More policies, guidance, variants, seeds or repeats are added to the
    existing results.

    Args:
        spec: The benchmark.
        output_dir: Folder of the results.
        n_processes: Number of parallel processes. With more than one, each uses one thread.

    Returns:
        One row for each policy, kind of guidance and repeat.

    Raises:
        ValueError: If `output_dir` holds a benchmark with other episodes, or of other policies with the same names.
        FileNotFoundError: If a checkpoint does not exist.
        FileExistsError: If another process is writing there.
    """
    if n_processes < 1:
        raise ValueError(f"n_processes must be at least 1, got {n_processes}")
    with claimed(output_dir):
        return _run(spec, output_dir, n_processes)


def _run(spec: BenchmarkSpec, output_dir: Path, n_processes: int) -> list[SummaryRow]:
    jobs = _make_jobs(spec)
    output_dir.mkdir(parents=True, exist_ok=True)
    episodes = output_dir / "episodes.csv"
    rows = read_rows(episodes, EpisodeRow) if episodes.exists() else []
    _refuse_other_checkpoints(rows, jobs, output_dir)
    _mark_episodes(output_dir, spec)
    # Repeats that were cut short by a kill are run again.
    counts = Counter(map(_identify, rows))
    done = {key for key, count in counts.items() if count == spec.n_episodes}
    write_rows(episodes, [row for row in rows if _identify(row) in done], EpisodeRow)
    missing = [job for job in jobs if _identify(job) not in done]
    with (
        episodes.open("a", newline="", encoding="utf-8") as file,
        tqdm(total=len(jobs), initial=len(jobs) - len(missing), desc="Benchmark", unit="repeat") as bar,
    ):
        for rows in evaluate_all(spec, missing, n_processes):
            csv.writer(file, lineterminator="\n").writerows(map(format_row, rows))
            file.flush()
            bar.update()
    summary = summarise(read_rows(episodes, EpisodeRow))
    write_rows(output_dir / "summary.csv", summary, SummaryRow)
    cells = group_cells(summary)
    for name, make_table in (("table.md", make_markdown), ("table.tex", make_latex)):
        with file_written_beside(output_dir / name) as partial:
            partial.write_text(make_table(cells), encoding="utf-8")
    return summary


def _make_jobs(spec: BenchmarkSpec) -> list[Job]:
    jobs = []
    for task in spec.tasks:
        replace(spec.env, task=task)  # raises an error for an unknown task now, not later
        for name, template in spec.policies.items():
            for seed in spec.seeds:
                checkpoint = template.replace("{task}", task).replace("{seed}", str(seed))
                # This raises an error for unknown options now, not later.
                configs = [load_config(checkpoint, **options) for options in spec.variants.values()]
                is_guided = isinstance(configs[0], GuidedConfig)
                guidances = spec.guidances if is_guided else (NONE,)
                jobs += [
                    Job(
                        task=task,
                        policy=name if guidance.scale or not is_guided else unguided_name(name),
                        checkpoint=checkpoint,
                        guidance=guidance,
                        variant=variant,
                        seed=seed,
                        repeat=repeat,
                    )
                    for variant in spec.variants
                    for guidance in guidances
                    for repeat in range(spec.n_repeats)
                ]
    names = Counter(replace(job, checkpoint="") for job in jobs)
    for job, count in names.items():
        if count > 1:
            raise ValueError(
                f"every policy must have its own name, got {job.policy!r} twice (guidance {job.guidance.integrator})"
            )
    return jobs


def unguided_name(name: str) -> str:
    """The name of a policy, which has another one with guidance, without it."""
    if name.startswith(GUARDED):
        return name.removeprefix(GUARDED)
    return UNGUIDED_NAMES.get(name, f"{name} unguided")


def _identify(row: Job | EpisodeRow) -> tuple[object, ...]:
    if isinstance(row, Job):
        guidance = row.guidance.integrator, row.guidance.scale
    else:
        guidance = row.guidance_integrator, row.guidance_scale
    return row.task, row.policy, row.checkpoint, *guidance, row.variant, row.seed, row.repeat


def _refuse_other_checkpoints(rows: Sequence[EpisodeRow], jobs: Sequence[Job], output_dir: Path) -> None:
    """Checks that each name has one checkpoint, because rows of two checkpoints with one name would be counted together."""
    found = {(row.task, row.policy, row.seed): row.checkpoint for row in rows}
    for job in jobs:
        checkpoint = found.get((job.task, job.policy, job.seed), job.checkpoint)
        if checkpoint != job.checkpoint:
            raise ValueError(
                f"{output_dir} holds results of {job.policy!r} from {checkpoint}, got {job.checkpoint}: choose another "
                "name or another --output_dir"
            )


def _settings_of(env: EnvConfig) -> dict[str, Any]:
    """The settings of an environment on which episodes depend, without its task."""
    settings = {k: v for k, v in asdict(env).items() if not k.startswith("features") and k != "task"}
    return {"type": env.type, **settings}


def _mark_episodes(output_dir: Path, spec: BenchmarkSpec) -> None:
    """Marks the folder as a benchmark over these episodes, so that a later call can only continue with the same ones."""
    mark = output_dir / "run.json"
    episodes = {
        "env": _settings_of(spec.env),
        **{name: getattr(spec, name) for name in ("n_episodes", "episode_seed", "batch_size", "device")},
    }
    variants = spec.variants
    if mark.exists():
        found = _read_mark(mark)
        # Settings that environments got later had their defaults.
        if isinstance(found["episodes"].get("env"), dict):
            found["episodes"]["env"] = {**_settings_of(type(spec.env)()), **found["episodes"]["env"]}
        if json.loads(json.dumps(found["episodes"])) != json.loads(json.dumps(episodes)):
            raise ValueError(
                f"{output_dir} holds a benchmark over other episodes ({found['episodes']}), got {episodes}: choose another "
                "--output_dir"
            )
        for name, changes in json.loads(json.dumps(variants)).items():
            if found["variants"].get(name, changes) != changes:
                raise ValueError(
                    f"{output_dir} holds results of a variant {name!r} with {found['variants'][name]}, got {changes}: "
                    "choose another name or another --output_dir"
                )
        variants = {**found["variants"], **variants}
    made_with = {
        name: version(name) for name in ("lerobot", "torch", "mujoco", "gymnasium-robotics", "diffusers")
    }
    content = {
        "episodes": episodes,
        "variants": variants,
        "made_with": {
            **made_with,
            "python": platform.python_version(),
            "machine": _describe_machine(spec.device),
        },
    }
    with file_written_beside(mark) as partial:
        partial.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _read_mark(mark: Path) -> dict[str, dict[str, Any]]:
    """What another call has written into ``run.json``.

    Raises:
        ValueError: If no call of `run_benchmark` has written it.
    """
    try:
        found = json.loads(mark.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{mark} must be one that pf2mp-benchmark has written: {error}") from error
    parts = [found.get(name) for name in ("episodes", "variants")] if isinstance(found, dict) else [None]
    if not all(isinstance(part, dict) for part in parts):
        raise ValueError(
            f"{mark} must be one that pf2mp-benchmark has written, with episodes and variants, got another one: choose "
            "another --output_dir"
        )
    return found


def _describe_machine(device: str) -> str:
    cpu = f"{platform.machine()}, {os.cpu_count()} cores"
    return f"{cpu}, {torch.cuda.get_device_name(device)}" if device.startswith("cuda") else cpu
