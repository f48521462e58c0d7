# SPDX-License-Identifier: Apache-2.0
"""Collects demonstrations in the Fetch environments, on one process or several."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing, contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_pf2mp.dataset_tools.experts.expert_checkpoint import ExpertCheckpoint
from lerobot_pf2mp.dataset_tools.experts.learned_expert import LearnedFetchExpert, check_scene
from lerobot_pf2mp.dataset_tools.experts.recording import Recording
from lerobot_pf2mp.dataset_tools.fetch.fetch_dataset import fetch_spec
from lerobot_pf2mp.dataset_tools.fetch.fetch_expert import STYLES, ScriptedFetchExpert
from lerobot_pf2mp.dataset_tools.writing.attempts import successful
from lerobot_pf2mp.dataset_tools.writing.episodes import Trajectory, resample
from lerobot_pf2mp.dataset_tools.writing.write_trajectories import write_trajectories
from lerobot_pf2mp.envs.fetch.fetch_env import MAX_STEP, FetchEnv
from lerobot_pf2mp.envs.fetch.fetch_scene import make_scene
from lerobot_pf2mp.envs.image_size import image_size_of
from lerobot_pf2mp.process.worker_pool import worker_pool

_CHUNK = 16  # demonstrations that a process makes in one call


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
    expert: Path | None = None,
    image_width: int | None = None,
) -> tuple[int, Counter[str]]:
    """Collects successful, collision-free demonstrations of an expert as a LeRobotDataset.

    The demonstrations do not depend on the number of processes.

    Args:
        task: reach or push.
        root: The dataset's folder.
        repo_id: Its name, ``user/name``.
        n_episodes: Demonstrations to write.
        n_steps: Steps that each is resampled to.
        style: Distance of the scripted expert to the wall: ``clear`` (2 to 5 cm) or ``hug`` (2 to 10 mm).
        scene_changes: Arguments of `FetchScene` that replace those of the task; None keeps the value of the task.
        seed: Seed of all random numbers.
        n_processes: Number of parallel processes; with 1 the demonstrations are made in this process.
        overwrite: Whether an existing dataset is replaced.
        expert: Folder of an expert that `train_expert` wrote; None uses the scripted expert.
        image_width: Width of a camera's images [pixels]; their height is three quarters of it. The images are recorded
            instead of the positions of block and goal. None for no camera.

    Returns:
        The number of episodes written, and the number of those left out, by reason.

    Raises:
        ValueError: If an argument breaks its rule, or the expert almost never succeeds.
        FileExistsError: If `root` exists and `overwrite` is false.
        ImportError: If the expert needs Stable-Baselines3 and it is missing.
        OSError: If the expert's folder lacks a file.
    """
    scene = make_scene(task, **scene_changes)
    if style not in STYLES:
        raise ValueError(f"style must be one of {list(STYLES)}, got {style!r}")
    if n_processes < 1:
        raise ValueError(f"n_processes must be at least 1, got {n_processes}")
    if expert is None:
        origin = f"A scripted expert moved it (style {style}, seed {seed})."
    elif style != "clear":
        raise ValueError(f"style is for the scripted expert only, got {style!r}")
    else:
        checkpoint = ExpertCheckpoint.read(expert)
        check_scene(checkpoint, scene)
        checkpoint.load_policy()  # an error is clearer here than in a process
        origin = f"{checkpoint.description} moved it (seed {seed})."
    failed: Counter[str] = Counter()
    options: dict[str, Any] = dict(scene_changes)
    image_size = None
    if image_width is not None:
        options |= {"render_mode": "rgb_array", "render_size": image_width}
        image_size = image_size_of(image_width)
    with _demonstrations(n_processes, task, options, style, seed, expert) as recordings:
        attempts = (_attempt(recording, n_steps) for recording in recordings)
        n_written, dropped = write_trajectories(
            successful(attempts, failed),
            root=root,
            spec=fetch_spec(task, repo_id, origin, n_steps, image_size),
            n_steps=n_steps,
            collides=lambda _: False,  # the environment checks contact in every physics step
            n_episodes=n_episodes,
            overwrite=overwrite,
        )
    return n_written, dropped + failed


@contextmanager
def _demonstrations(
    n_processes: int, task: str, options: dict[str, Any], style: str, seed: int, expert: Path | None
) -> Iterator[Iterator[Recording]]:
    """All demonstrations in their order."""
    if n_processes == 1:
        with closing(FetchEnv(task, **options)) as env:
            yield map(_make_expert(env, style, seed, expert).demonstrate, count())
    else:
        with worker_pool(n_processes, _start_worker, (task, options, style, seed, expert)) as pool:
            yield _side_by_side(pool, n_processes)


def _side_by_side(pool: ProcessPoolExecutor, n_processes: int) -> Iterator[Recording]:
    """All demonstrations in their order. A few chunks are computed ahead."""
    ahead = [pool.submit(_work, chunk) for chunk in range(n_processes + 1)]
    for chunk in count(len(ahead)):
        ahead.append(pool.submit(_work, chunk))
        yield from ahead.pop(0).result()


def _attempt(recording: Recording, n_steps: int) -> Trajectory | str:
    if recording.is_collision:
        return "in collision"
    if not recording.is_success:
        return "without success"
    if _largest_step(recording, n_steps) > MAX_STEP:
        return f"too long to be repeated in {n_steps} steps"
    objects = np.array(recording.blocks) if recording.blocks else None
    images = np.array(recording.images) if recording.images else None
    return Trajectory(np.array(recording.grips), recording.goal, objects, images)


def _largest_step(recording: Recording, n_steps: int) -> float:
    steps = np.diff(resample(np.array(recording.grips), n_steps), axis=0)
    return float(np.linalg.norm(steps, axis=1).max())


def _make_expert(
    env: FetchEnv, style: str, seed: int, expert: Path | None
) -> ScriptedFetchExpert | LearnedFetchExpert:
    return ScriptedFetchExpert(env, style, seed) if expert is None else LearnedFetchExpert(env, expert, seed)


_expert: ScriptedFetchExpert | LearnedFetchExpert | None = None


def _start_worker(task: str, options: dict[str, Any], style: str, seed: int, expert: Path | None) -> None:
    global _expert
    _expert = _make_expert(FetchEnv(task, **options), style, seed, expert)


def _work(chunk: int) -> list[Recording]:
    assert _expert is not None  # set when the process started
    return [_expert.demonstrate(number) for number in range(chunk * _CHUNK, (chunk + 1) * _CHUNK)]
