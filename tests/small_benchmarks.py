# SPDX-License-Identifier: Apache-2.0
"""Benchmarks of a few short episodes in a maze, and what they leave behind."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from lerobot_pf2mp import PF2MPMazeEnv
from lerobot_pf2mp.benchmark.run import run_benchmark
from lerobot_pf2mp.benchmark.spec import BenchmarkSpec, Guidance
from lerobot_pf2mp.results.rows import EpisodeRow, read_rows

UMAZE = "MazeUMaze-v0"
EPISODE_LENGTH, N_EPISODES, EPISODE_SEED = 6, 3, 7


def spec_of(policies: dict[str, str], *guidances: str, **options: Any) -> BenchmarkSpec:
    defaults: dict[str, Any] = {
        "env": PF2MPMazeEnv(task=UMAZE, episode_length=EPISODE_LENGTH),
        "tasks": (UMAZE,),
        "guidances": tuple(guidance for text in guidances or ("none",) for guidance in Guidance.parse(text)),
        "variants": {"": {}},
        "n_repeats": 1,
        "n_episodes": N_EPISODES,
        "episode_seed": EPISODE_SEED,
        "batch_size": 2,  # the last rollout has an episode too many
    }
    return BenchmarkSpec(policies=policies, **{**defaults, **options})


def rows_of(folder: Path) -> list[EpisodeRow]:
    return read_rows(folder / "episodes.csv", EpisodeRow)


def timeless(rows: list[EpisodeRow]) -> list[EpisodeRow]:
    """Everything but the time, which no two runs share, and the commit, which may change between them."""
    return [replace(row, chunk_latency_ms=None, commit="") for row in rows]


def run(spec: BenchmarkSpec, folder: Path) -> list[EpisodeRow]:
    run_benchmark(spec, folder)
    return timeless(rows_of(folder))


def outcomes(rows: list[EpisodeRow], policy: str, **where: Any) -> list[tuple]:
    """What happened in a policy's episodes."""
    return [
        (
            row.task,
            row.seed,
            row.repeat,
            row.episode,
            row.success,
            row.collision,
            row.min_clearance_m,
            row.path_length_m,
        )
        for row in rows
        if row.policy == policy and all(getattr(row, name) == value for name, value in where.items())
    ]
