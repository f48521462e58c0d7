# SPDX-License-Identifier: Apache-2.0
"""Collects demonstrations in the Fetch environments, on several processes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from lerobot_pf2mp.dataset_tools.episodes import Trajectory
from lerobot_pf2mp.dataset_tools.fetch_dataset import fetch_spec
from lerobot_pf2mp.dataset_tools.fetch_expert import STYLES, Recording, ScriptedFetchExpert
from lerobot_pf2mp.dataset_tools.write_trajectories import write_trajectories

from lerobot_pf2mp.envs.fetch import FetchEnv
from lerobot_pf2mp.envs.fetch_scene import make_scene
from lerobot_pf2mp.worker_pool import worker_pool

_CHUNK = 16  # demonstrations that a process makes in one go


def collect_fetch(
    task: str,
    *,
    root: Path,
    repo_id: str,
    n_episodes: int,
    n_steps: int,
    style: str,
    scene_changes: dict[str, Any],
    seed: int,
    n_processes: int,
    overwrite: bool,
) -> tuple[int, Counter[str]]:
    """Collects successful, collision-free demonstrations of a scripted expert as a LeRobotDataset.

    The demonstrations do not depend on the number of processes.

    Args:
        task: reach or push.
        root: The dataset's folder.
        repo_id: Its name, ``user/name``.
        n_episodes: Demonstrations to write.
        n_steps: Steps that each is resampled to.
        style: How near the expert comes to the wall, clear or hug.
        scene_changes: Arguments of `FetchScene` that differ from the task's; None for those that do not.
        seed: Seed of everything random.
        n_processes: Processes side by side.
        overwrite: Whether a dataset already there is replaced.

    Returns:
        The number of episodes written, and the number of those left out, by reason.

    Raises:
        ValueError: If an argument breaks its rule.
        FileExistsError: If `root` exists and `overwrite` is false.
    """
    make_scene(task, **scene_changes)
    if style not in STYLES:
        raise ValueError(f"style must be one of {list(STYLES)}, got {style!r}")
    if n_processes < 1:
        raise ValueError(f"n_processes must be at least 1, got {n_processes}")
    failed: Counter[str] = Counter()
    with worker_pool(n_processes, _start_worker, (task, scene_changes, style, seed)) as pool:
        n_written, dropped = write_trajectories(
            _successful(_demonstrations(pool, n_processes), failed),
            root=root,
            spec=fetch_spec(
                task, repo_id, f"A scripted expert moved it (style {style}, seed {seed}).", n_steps
            ),
            n_steps=n_steps,
            collides=lambda way: False,  # contact was looked for in every physics step
            n_episodes=n_episodes,
            overwrite=overwrite,
        )
    return n_written, dropped + failed


def _demonstrations(pool: ProcessPoolExecutor, n_processes: int) -> Iterator[Recording]:
    """All demonstrations in their order, a few chunks ahead of the one that is asked for."""
    ahead = [pool.submit(_work, chunk) for chunk in range(n_processes + 1)]
    for chunk in count(len(ahead)):
        ahead.append(pool.submit(_work, chunk))
        yield from ahead.pop(0).result()


def _successful(recordings: Iterator[Recording], failed: Counter[str]) -> Iterator[Trajectory]:
    for recording in recordings:
        if recording.is_collision:
            failed["in collision"] += 1
        elif not recording.is_success:
            failed["without success"] += 1
        else:
            objects = np.array(recording.blocks) if recording.blocks else None
            yield Trajectory(np.array(recording.grips), recording.goal, objects)


_expert: ScriptedFetchExpert | None = None


def _start_worker(task: str, scene_changes: dict[str, Any], style: str, seed: int) -> None:
    global _expert
    _expert = ScriptedFetchExpert(FetchEnv(task, **scene_changes), style, seed)


def _work(chunk: int) -> list[Recording]:
    assert _expert is not None  # set when the process started
    return [_expert.demonstrate(number) for number in range(chunk * _CHUNK, (chunk + 1) * _CHUNK)]
