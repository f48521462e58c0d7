# SPDX-License-Identifier: Apache-2.0
"""Converts transitions of gymnasium-robotics' FetchReach and FetchPush that were recorded elsewhere.

The source is the folder of a Minari dataset whose observations hold ``observation``, ``desired_goal`` and
``achieved_goal``, or an npz file without pickles. An npz file holds E whole episodes of equal length, or N rows of all
episodes one after the other:

| array           | episodes               | rows      |                                                                 |
|-----------------|------------------------|-----------|-----------------------------------------------------------------|
| `observation`   | ``(E, T + 1, W)``      | ``(N, W)``| W = 10 for Reach, 25 for Push                                   |
| `desired_goal`  | ``(E, T or T + 1, 3)`` | ``(N, 3)``| [m]; an episode's last is its goal                              |
| `achieved_goal` | ``(E, T + 1, 3)``      | ``(N, 3)``| optional, as a check: position of gripper or block              |
| `episode_ends`  |                        | ``(E,)``  | the row after each episode's last, the last of them N; or       |
| `terminals`     |                        | ``(N,)``  | true in an episode's last row,                                  |
| `timeouts`      |                        | ``(N,)``  | the same; one of the two or both                                |

Columns 0 to 2 of an observation are the gripper's position [m]. For Push, columns 3 to 5 are the block's position [m].
Other columns are not used. In the original environments the gripper starts at y = 0.75 m, inside the default wall of this
package.
"""

from __future__ import annotations

import itertools
import math
import zipfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_pf2mp.dataset_tools.fetch.fetch_dataset import fetch_spec
from lerobot_pf2mp.dataset_tools.npz_file import read_npz
from lerobot_pf2mp.dataset_tools.open_minari import episodes_in, open_minari
from lerobot_pf2mp.dataset_tools.writing.episodes import MIN_STEPS, Trajectory, resample
from lerobot_pf2mp.dataset_tools.writing.write_trajectories import write_trajectories
from lerobot_pf2mp.envs.box import Box
from lerobot_pf2mp.envs.fetch.fetch_scene import BLOCK_SIZE, SUCCESS_RADIUS, WORKSPACE, FetchScene, make_scene

_WIDTHS = {"reach": 10, "push": 25}
_COLUMNS = ("observation", "desired_goal", "achieved_goal")
_FLAGS = ("terminals", "timeouts")
# Wide limits: positions outside them are from another robot or in another unit.
_LIMITS = Box.between(WORKSPACE.low - 0.75, WORKSPACE.high + 0.75)
_SAME_POSITION = 1e-3  # largest distance between equal positions [m]
# A box around the block for every rotation on the table.
_BLOCK = Box((0, 0, 0), (BLOCK_SIZE * math.sqrt(2), BLOCK_SIZE * math.sqrt(2), BLOCK_SIZE))


def convert_fetch(
    path: Path,
    task: str,
    *,
    root: Path,
    repo_id: str,
    n_steps: int,
    scene_changes: dict[str, Any],
    n_episodes: int | None = None,
    overwrite: bool = False,
) -> tuple[int, Counter[str]]:
    """Writes the episodes of a recording that reach their goal without touching the wall as a LeRobotDataset.

    Hand, fingers and block must not touch the wall on the straight lines between resampled positions. The rest of the arm
    is not checked, because recordings do not contain its positions. The block is checked with its width at a rotation of
    45 degrees.

    Args:
        path: An npz file or the folder of a Minari dataset; see the module docstring for the layouts.
        task: reach or push.
        root: The dataset's folder.
        repo_id: Its name, ``user/name``.
        n_steps: Steps T that each episode is resampled to.
        scene_changes: Arguments of `FetchScene` that replace those of the task; None keeps the value of the task.
        n_episodes: Largest number of episodes to write; None writes all.
        overwrite: Whether an existing dataset is replaced.

    Returns:
        The number of episodes written, and the number of those left out, by reason.

    Raises:
        FileNotFoundError: If there is no such file or folder.
        FileExistsError: If `root` exists and `overwrite` is false.
        ValueError: If an argument breaks its rule, the recording has another layout, robot or unit, or holds NaN or
            infinity, or no episode is usable.
    """
    scene = make_scene(task, **scene_changes)
    n_recorded, trajectories = read_fetch(path, task)
    left_out: Counter[str] = Counter()
    n_written, dropped = write_trajectories(
        _usable(trajectories, scene, n_steps, left_out, path),
        root=root,
        spec=fetch_spec(task, repo_id, f"Converted from {Path(path).name} (fetch).", n_steps),
        n_steps=n_steps,
        collides=lambda _: False,  # already checked by _usable, with the block
        n_episodes=n_episodes,
        n_expected=n_recorded,
        overwrite=overwrite,
    )
    return n_written, dropped + left_out


def read_fetch(path: Path, task: str) -> tuple[int, Iterator[Trajectory]]:
    """Reads the episodes of a recording. The goal of each is its last desired goal.

    Args:
        path: An npz file or the folder of a Minari dataset; see the module docstring for the layouts.
        task: reach or push.

    Returns:
        Their number, and the episodes.

    Raises:
        FileNotFoundError: If there is no such file or folder.
        ValueError: If it has another layout. When an episode is read: if that has another layout, robot or unit, or holds
            NaN or infinity.
    """
    source = Path(path).expanduser()
    n_episodes, episodes = _read_minari(source) if source.is_dir() else _read_npz(source)
    return n_episodes, (
        _trajectory(episode, task, f"episode {number} of {path}") for number, episode in enumerate(episodes)
    )


def _usable(
    trajectories: Iterator[Trajectory], scene: FetchScene, n_steps: int, left_out: Counter[str], path: Path
) -> Iterator[Trajectory]:
    n_usable = 0
    for trajectory in trajectories:
        fault = _fault(trajectory, scene, n_steps)
        if fault is None:
            n_usable += 1
            yield trajectory
        else:
            left_out[fault] += 1
    if not n_usable:
        counts = ", ".join(f"{count} {fault}" for fault, count in left_out.items()) or "none"
        raise ValueError(
            f"at least one episode must reach its goal without touching the wall, got none that is usable in {path} "
            f"(left out: {counts}); the wall is at {scene.wall_position} m and {scene.wall_size} m in size"
        )


def _fault(trajectory: Trajectory, scene: FetchScene, n_steps: int) -> str | None:
    """The reason why an episode is left out; None if it is usable."""
    if trajectory.n_steps < MIN_STEPS:
        return f"shorter than {MIN_STEPS} steps"
    positions = resample(trajectory.positions, n_steps)
    if any(scene.hits_wall(a, b) for a, b in itertools.pairwise(positions)):
        return "in collision"
    if trajectory.objects is not None:
        wall = scene.wall.grown_by(_BLOCK)
        if any(wall.blocks(a, b) for a, b in itertools.pairwise(resample(trajectory.objects, n_steps))):
            return "in collision"
    moved = trajectory.positions if trajectory.objects is None else trajectory.objects
    return None if math.dist(moved[-1], trajectory.goal) < SUCCESS_RADIUS else "without success"


def _read_npz(path: Path) -> tuple[int, Iterator[dict[str, np.ndarray]]]:
    arrays = _load(path)
    columns = {name: arrays[name] for name in _COLUMNS if name in arrays}
    shapes = {name: values.shape for name, values in columns.items()}
    n_dims, n = columns["observation"].ndim, len(np.atleast_1d(columns["observation"]))
    if n_dims not in (2, 3) or n < 1 or any((len(s), *s[:1]) != (n_dims, n) for s in shapes.values()):
        raise ValueError(
            "observation must have shape (E, T + 1, W) and the goals (E, T + 1, 3), or (N, W) and (N, 3), with at least "
            f"one episode or row, got {shapes} in {path}"
        )
    if n_dims == 3:
        parts = {name: list(values) for name, values in columns.items()}
    else:
        ends = _ends(arrays, n, path)
        parts = {name: np.split(values, ends[:-1]) for name, values in columns.items()}
    n_episodes = len(parts["observation"])
    return n_episodes, ({name: parts[name][i] for name in parts} for i in range(n_episodes))


def _load(path: Path) -> dict[str, np.ndarray]:
    if not path.is_file():
        raise FileNotFoundError(
            f"source.path must be an npz file or the folder of a Minari dataset, got {path}, which does not exist"
        )
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{path} must be a whole npz file or the folder of a Minari dataset, got neither")
    found, arrays = read_npz(path, (*_COLUMNS, "episode_ends", *_FLAGS))
    missing = [name for name in _COLUMNS[:2] if name not in arrays]
    if missing:
        raise ValueError(
            f"an npz file of Fetch transitions must hold observation and desired_goal, got {sorted(found)} in {path}; "
            f"missing: {', '.join(missing)}"
        )
    for name, values in arrays.items():
        if values.dtype.kind not in "biuf":
            raise ValueError(f"{name} must hold real numbers, got {values.dtype} in {path}")
    return arrays


def _ends(arrays: dict[str, np.ndarray], n: int, path: Path) -> np.ndarray:
    """The row after each episode's last row. Rows after the last mark are an episode too."""
    if "episode_ends" in arrays:
        ends = arrays["episode_ends"]
        is_right = ends.ndim == 1 and ends.dtype.kind in "iu" and len(ends) > 0
        ends = ends.astype(np.int64) if is_right else ends
        if not is_right or np.any(np.diff(ends, prepend=0) < 1) or ends[-1] != n:
            raise ValueError(
                f"episode_ends must be whole numbers that increase from at least 1 to the number of rows, {n}, got "
                f"{ends!r:.80} in {path}"
            )
        return ends
    flags = {name: arrays[name] for name in _FLAGS if name in arrays}
    if not flags:
        raise ValueError(
            f"rows of transitions must come with episode_ends, terminals or timeouts, got none of them in {path}"
        )
    for name, flag in flags.items():
        if flag.shape != (n,):
            raise ValueError(f"{name} must have one entry for each of {n} rows, got {flag.shape} in {path}")
    is_last = np.any([flag != 0 for flag in flags.values()], axis=0)
    if not is_last.any():
        raise ValueError(f"{' or '.join(flags)} must mark where episodes end, got no mark in {path}")
    is_last[-1] = True
    return np.flatnonzero(is_last) + 1


def _read_minari(path: Path) -> tuple[int, Iterator[dict[str, np.ndarray]]]:
    dataset = open_minari(path)
    return dataset.total_episodes, _observations(dataset, path)


def _observations(dataset: Any, path: Path) -> Iterator[dict[str, np.ndarray]]:
    for episode in episodes_in(dataset, path):
        observations = episode.observations
        if not isinstance(observations, dict) or not set(_COLUMNS) <= set(observations):
            raise ValueError(
                f"{path} must hold episodes with {', '.join(_COLUMNS)}, got {observations!r:.80}"
            )
        yield {name: np.asarray(observations[name]) for name in _COLUMNS}


def _trajectory(episode: dict[str, np.ndarray], task: str, what: str) -> Trajectory:
    observations, goals = episode["observation"], episode["desired_goal"]
    shape, n_rows = observations.shape, len(observations)
    if observations.ndim != 2 or shape[1] != _WIDTHS[task] or n_rows < 1:
        raise ValueError(
            f"observation must have {_WIDTHS[task]} columns for fetch_{task}, those of gymnasium-robotics, got shape "
            f"{shape} in {what}"
        )
    if goals.shape not in ((n_rows, 3), (n_rows - 1, 3)) or not len(goals):
        raise ValueError(
            f"desired_goal must have 3 columns and as many rows as observation, {n_rows}, or one less but at least one, "
            f"got shape {goals.shape} in {what}"
        )
    grips, blocks = observations[:, :3].astype(float), observations[:, 3:6].astype(float)
    goals = goals.astype(float)
    moved = blocks if task == "push" else grips
    for name, values in (("observation", grips), ("observation", moved), ("desired_goal", goals)):
        if not np.isfinite(values).all():
            raise ValueError(f"positions and goals must be finite, got NaN or infinity in {name} of {what}")
    _check_limits(np.concatenate([grips, goals, moved[:1]]), what)
    if "achieved_goal" in episode:
        _check_achieved(episode["achieved_goal"], moved, task, what)
    return Trajectory(grips, goals[-1], blocks if task == "push" else None)


def _check_limits(positions: np.ndarray, what: str) -> None:
    low, high = positions.min(axis=0), positions.max(axis=0)
    if np.any(low < _LIMITS.low) or np.any(high > _LIMITS.high):
        found, expected = (
            f"{np.round(ends[0], 3).tolist()} to {np.round(ends[1], 3).tolist()}"
            for ends in ((low, high), (_LIMITS.low, _LIMITS.high))
        )
        raise ValueError(
            f"gripper, block and goal must be about where Fetch can reach, x, y, z from {expected} m, got {found} in "
            f"{what}: is it from another robot, or not in metres?"
        )


def _check_achieved(achieved: np.ndarray, moved: np.ndarray, task: str, what: str) -> None:
    if achieved.shape != moved.shape:
        raise ValueError(f"achieved_goal must have shape {moved.shape}, got {achieved.shape} in {what}")
    # Also false if a distance is not a number.
    if not np.all(np.abs(achieved - moved) < _SAME_POSITION):
        columns, mover = ("3 to 5", "block") if task == "push" else ("0 to 2", "gripper")
        raise ValueError(
            f"achieved_goal must be the {mover}'s position, columns {columns} of observation, got another in {what}"
        )
