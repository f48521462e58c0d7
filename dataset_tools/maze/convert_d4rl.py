# SPDX-License-Identifier: Apache-2.0
"""Reads maze2d recordings of D4RL (Fu et al., 2020): one HDF5 file of consecutive steps."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import h5py
import numpy as np

from lerobot_pf2mp.dataset_tools.hdf5_file import array_in, holds, opened_hdf5
from lerobot_pf2mp.dataset_tools.maze.maze_dataset import GOAL_RADIUS
from lerobot_pf2mp.dataset_tools.maze.maze_recognition import check_maze
from lerobot_pf2mp.dataset_tools.writing.episodes import Trajectory
from lerobot_pf2mp.envs.maze.point_maze import parse_maze_map

# In D4RL's model the walls of cell (i, j) are centred at (i + 1, j + 1) and the ball's joints start at (1.2, 1.2).
_CELL_OFFSET = 1.2 - 1.0
# Two recorded goals within this distance are the same goal: they differ only by rounding, as its noise is drawn once.
_SAME_GOAL = 1e-5  # [m]
_COLUMNS = ("observations", "infos/goal")
_ANT_WIDTH = 29  # of the observations of D4RL's antmaze
_ENDS = ("timeouts", "terminals")  # columns that are true in the last row of a trajectory
_SLICE_ROWS = 2**16  # rows that are read at a time


def read_d4rl(path: Path, maze: str) -> tuple[int, Iterator[Trajectory]]:
    """Reads the start-goal trajectories of a D4RL maze2d file, in the coordinates of this package's environment.

    A trajectory ends where ``timeouts`` or ``terminals`` is true, and where the recorded goal changes. Either column may be
    missing, or false everywhere. If there is one goal in the whole file, it says nothing about a trajectory that ends
    elsewhere: then the goal is where that trajectory ends. The file is read in slices: apart from a few numbers per
    trajectory, memory does not grow with its length.

    Args:
        path: The HDF5 file.
        maze: The maze it was recorded in, as for `parse_maze_map`.

    Returns:
        Their number, and the trajectories, which are read lazily. The last one may be cut off, far from its goal.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not a whole HDF5 file of D4RL's layout, was recorded in another maze, or holds NaN or infinity.
    """
    path = Path(path).expanduser()
    if not path.is_file():
        raise FileNotFoundError(f"source.path must be an HDF5 file, got {path}, which does not exist")
    rows = parse_maze_map(maze)
    with opened_hdf5(path) as file:
        columns = _columns(file, path)
        check_maze(partial(_positions, columns["observations"], path), maze, path)
        starts, goals = _find_starts(columns, path)
        n_rows = len(columns["observations"])
        is_cut_off = not _is_last(columns, n_rows - 1, n_rows)[0]
    keeps_goal = np.full(len(starts), np.ptp(goals, axis=0).max() > _SAME_GOAL)
    keeps_goal[-1] |= is_cut_off
    return len(starts), _trajectories(path, starts, _to_environment(goals, rows), keeps_goal, rows)


def _trajectories(
    path: Path, starts: np.ndarray, goals: np.ndarray, keeps_goal: np.ndarray, rows: list[list[int]]
) -> Iterator[Trajectory]:
    """The trajectories that begin at the rows ``(E,)``. The goals ``(E, 2)`` of those marked ``(E,)`` are theirs."""
    for number, positions in enumerate(_parts(path, starts, rows)):
        goal = goals[number]
        if not keeps_goal[number] and np.linalg.norm(positions[-1] - goal) > GOAL_RADIUS:
            goal = positions[-1]
        yield Trajectory(positions, goal)


def _parts(path: Path, starts: np.ndarray, rows: list[list[int]]) -> Iterator[np.ndarray]:
    """The positions ``(N, 2)`` of each trajectory [m], which begin at the rows ``(E,)``."""
    with opened_hdf5(path) as file:
        pending: list[np.ndarray] = []  # the parts read so far of the current trajectory
        first = 0
        for positions in _positions(array_in(file, "observations", path), path, rows):
            ends = starts[(starts > first) & (starts <= first + len(positions))] - first
            *whole, rest = np.split(positions, ends)
            for part in whole:
                yield np.concatenate([*pending, part])
                pending = []
            pending.append(rest)
            first += len(positions)
        yield np.concatenate(pending)


def _positions(observations: h5py.Dataset, path: Path, rows: list[list[int]]) -> Iterator[np.ndarray]:
    """All positions ``(N, 2)`` in slices [m], in the frame of the environment with this map."""
    for _, values in _slices(observations, path):
        yield _to_environment(values[:, :2], rows)


def _find_starts(columns: dict[str, h5py.Dataset], path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The first row ``(E,)`` of each trajectory, and its goal ``(E, 2)`` in D4RL's coordinates [m]."""
    starts, start_goals = [], []
    last_goal, is_over = columns["infos/goal"][:1], True  # values of the previous row
    for first, goals in _slices(columns["infos/goal"], path):
        is_last = _is_last(columns, first, first + len(goals))
        change = np.abs(np.diff(goals, axis=0, prepend=last_goal)).max(axis=1)
        begins = np.flatnonzero((change > _SAME_GOAL) | np.r_[is_over, is_last[:-1]])
        starts.append(first + begins)
        start_goals.append(goals[begins])
        last_goal, is_over = goals[-1:], is_last[-1]
    return np.concatenate(starts), np.concatenate(start_goals)


def _is_last(columns: dict[str, h5py.Dataset], first: int, end: int) -> np.ndarray:
    """Whether each row from `first` to before `end` is marked as the last of its trajectory."""
    marks = [np.asarray(columns[name][first:end], bool) for name in _ENDS if name in columns]
    return np.any([np.zeros(end - first, bool), *marks], axis=0)


def _slices(column: h5py.Dataset, path: Path) -> Iterator[tuple[int, np.ndarray]]:
    """The rows of a column in slices, each with the number of its first row."""
    for first in range(0, len(column), _SLICE_ROWS):
        values = np.asarray(column[first : first + _SLICE_ROWS], dtype=np.float64)
        bad = ~np.isfinite(values).all(axis=1)
        if bad.any():
            raise ValueError(
                f"{column.name[1:]} must be finite, got NaN or infinity in row {first + bad.argmax()} of {path}"
            )
        yield first, values


def _columns(file: h5py.File, path: Path) -> dict[str, h5py.Dataset]:
    """The columns that are used, of which nothing is read yet."""
    missing = [name for name in _COLUMNS if not holds(file, name)]
    if missing:
        raise ValueError(
            f"a D4RL maze2d file must hold observations and infos/goal, got {sorted(file)} in {path}; "
            f"missing: {', '.join(missing)}"
        )
    columns = {name: array_in(file, name, path) for name in (*_COLUMNS, *_ENDS) if holds(file, name)}
    n_rows = len(columns["observations"])
    observations, goals = (columns[name].shape for name in _COLUMNS)
    if observations != (n_rows, 4) or goals != (n_rows, 2):
        hint = ", which is of AntMaze" if observations[1:] == (_ANT_WIDTH,) else ""
        raise ValueError(
            f"observations must have shape (N, 4) and infos/goal (N, 2), got {observations} and {goals} in {path}{hint}"
        )
    for name in _ENDS:
        if name in columns and columns[name].shape != (n_rows,):
            raise ValueError(
                f"{name} must have one entry for each of N observations, got {columns[name].shape} for {n_rows} in {path}"
            )
    if n_rows < 1:
        raise ValueError(f"a D4RL maze2d file must hold at least one row, got none in {path}")
    return columns


def _to_environment(positions: np.ndarray, rows: list[list[int]]) -> np.ndarray:
    """Converts D4RL's joint positions (first axis along rows, second along columns) to x east and y north [m]."""
    row, column = (positions + _CELL_OFFSET).T
    return np.stack([column + 0.5 - len(rows[0]) / 2, len(rows) / 2 - (row + 0.5)], axis=1)
