# SPDX-License-Identifier: Apache-2.0
"""Reads maze2d recordings of D4RL (Fu et al., 2020): one HDF5 file of consecutive steps."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np

from lerobot_pf2mp.dataset_tools.writing.episodes import Trajectory
from lerobot_pf2mp.envs.maze.point_maze import parse_maze_map

# In D4RL's model the walls of cell (i, j) are centred at (i + 1, j + 1) and the ball's joints start at (1.2, 1.2).
_CELL_OFFSET = 1.2 - 1.0
# Two recorded goals within this distance are the same goal: they differ only by rounding, as its noise is drawn once.
_SAME_GOAL = 1e-5  # [m]
_SLICE_ROWS = 2**16  # rows that are read at a time


def read_d4rl(path: Path, maze: str) -> tuple[int, Iterator[Trajectory]]:
    """Reads the start-goal trajectories of a D4RL maze2d file, in the coordinates of this package's environment.

    A trajectory ends where ``timeouts`` is true or the recorded goal changes. Some files have no ``timeouts``. The file is
    read in slices: apart from a few numbers per trajectory, memory does not grow with its length.

    Args:
        path: The HDF5 file.
        maze: The maze it was recorded in, as for `parse_maze_map`.

    Returns:
        Their number, and the trajectories, which are read lazily.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not a whole HDF5 file of D4RL's layout, or holds NaN or infinity; for the observations, when
            the trajectories are read.
    """
    path = Path(path).expanduser()
    if not path.is_file():
        raise FileNotFoundError(f"source.path must be an HDF5 file, got {path}, which does not exist")
    rows = parse_maze_map(maze)
    with _opened(path) as file:
        _check_layout(file, path)
        starts, goals = _find_starts(file, path)
    return len(starts), _trajectories(path, starts, _to_environment(goals, rows), rows)


def _trajectories(
    path: Path, starts: np.ndarray, goals: np.ndarray, rows: list[list[int]]
) -> Iterator[Trajectory]:
    """The trajectories that begin at the rows ``(E,)`` and lead to the goals ``(E, 2)``."""
    with _opened(path) as file:
        pending: list[np.ndarray] = []  # the parts read so far of the current trajectory
        number = 0
        for first, observations in _slices(file, "observations", path):
            ends = starts[(starts > first) & (starts <= first + len(observations))] - first
            *whole, rest = np.split(_to_environment(observations[:, :2], rows), ends)
            for part in whole:
                yield Trajectory(np.concatenate([*pending, part]), goals[number])
                pending, number = [], number + 1
            pending.append(rest)
        yield Trajectory(np.concatenate(pending), goals[number])


def _find_starts(file: h5py.File, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The first row ``(E,)`` of each trajectory, and its goal ``(E, 2)`` in D4RL's coordinates [m]."""
    starts, start_goals = [], []
    last_goal, is_over = file["infos/goal"][:1], True  # values of the previous row
    for first, goals in _slices(file, "infos/goal", path):
        is_last = np.zeros(len(goals), bool)
        if "timeouts" in file:
            is_last |= np.asarray(file["timeouts"][first : first + len(goals)], bool)
        change = np.abs(np.diff(goals, axis=0, prepend=last_goal)).max(axis=1)
        begins = np.flatnonzero((change > _SAME_GOAL) | np.r_[is_over, is_last[:-1]])
        starts.append(first + begins)
        start_goals.append(goals[begins])
        last_goal, is_over = goals[-1:], is_last[-1]
    return np.concatenate(starts), np.concatenate(start_goals)


def _slices(file: h5py.File, name: str, path: Path) -> Iterator[tuple[int, np.ndarray]]:
    """The rows of a column in slices, each with the number of its first row."""
    for first in range(0, len(file[name]), _SLICE_ROWS):
        values = np.asarray(file[name][first : first + _SLICE_ROWS], dtype=np.float64)
        bad = ~np.isfinite(values).all(axis=1)
        if bad.any():
            raise ValueError(
                f"{name} must be finite, got NaN or infinity in row {first + bad.argmax()} of {path}"
            )
        yield first, values


@contextmanager
def _opened(path: Path) -> Iterator[h5py.File]:
    try:
        with h5py.File(path) as file:
            yield file
    except OSError as error:
        raise ValueError(f"{path} must be a whole HDF5 file, got one that cannot be read: {error}") from error


def _check_layout(file: h5py.File, path: Path) -> None:
    missing = [key for key in ("observations", "infos/goal") if not _is_column(file.get(key))]
    if missing:
        raise ValueError(
            f"a D4RL maze2d file must hold observations and infos/goal, got {sorted(file)} in {path}; "
            f"missing: {', '.join(missing)}"
        )
    observations, goals = file["observations"].shape, file["infos/goal"].shape
    n_rows = observations[0]
    if observations != (n_rows, 4) or goals != (n_rows, 2):
        raise ValueError(
            f"observations must have shape (N, 4) and infos/goal (N, 2), got {observations} and {goals} in {path}"
        )
    timeouts = getattr(file["timeouts"], "shape", None) if "timeouts" in file else (n_rows,)
    if timeouts != (n_rows,) or n_rows < 1:
        raise ValueError(
            f"timeouts must have one entry for each of N >= 1 observations, got {timeouts} for {n_rows} in {path}"
        )


def _is_column(entry: object) -> bool:
    return isinstance(entry, h5py.Dataset) and entry.ndim > 0


def _to_environment(positions: np.ndarray, rows: list[list[int]]) -> np.ndarray:
    """Converts D4RL's joint positions (first axis along rows, second along columns) to x east and y north [m]."""
    row, column = (positions + _CELL_OFFSET).T
    return np.stack([column + 0.5 - len(rows[0]) / 2, len(rows) / 2 - (row + 0.5)], axis=1)
