# SPDX-License-Identifier: Apache-2.0
"""Reads maze2d recordings of D4RL (Fu et al., 2020): one HDF5 file of consecutive steps."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
from lerobot_pf2mp.dataset_tools.episodes import Trajectory

from lerobot_pf2mp.envs.point_maze import parse_maze_map

# In D4RL's model the walls of cell (i, j) are centred at (i + 1, j + 1) and the ball's joints start at (1.2, 1.2).
_CELL_OFFSET = 1.2 - 1.0
# Same goal: its noise is drawn once, so that only rounding separates two records of it.
_SAME_GOAL = 1e-5  # [m]


def read_d4rl(path: Path, maze: str) -> list[Trajectory]:
    """The start-goal trajectories of a D4RL maze2d file, in the coordinates of this package's environment.

    A trajectory ends where ``timeouts`` says so or the recorded goal changes. Files with and without ``timeouts`` occur.

    Args:
        path: The HDF5 file.
        maze: The maze it was recorded in, as for `parse_maze_map`.

    Returns:
        The trajectories.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not a whole HDF5 file of D4RL's layout, or holds NaN or infinity.
    """
    observations, goals, timeouts = _read(Path(path).expanduser())
    rows = parse_maze_map(maze)
    new_goal = np.abs(np.diff(goals, axis=0)).max(axis=1, initial=0) > _SAME_GOAL
    ends = np.flatnonzero(new_goal | timeouts[:-1]) + 1
    return [
        Trajectory(_to_environment(positions, rows), _to_environment(goal[:1], rows)[0])
        for positions, goal in zip(np.split(observations[:, :2], ends), np.split(goals, ends), strict=True)
    ]


def _read(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    if not path.is_file():
        raise FileNotFoundError(f"source.path must be an HDF5 file, got {path}, which does not exist")
    try:
        with h5py.File(path) as file:
            missing = [key for key in ("observations", "infos/goal") if not _is_column(file.get(key))]
            if missing:
                raise ValueError(
                    f"a D4RL maze2d file must hold observations and infos/goal, got {sorted(file)} in {path}; "
                    f"missing: {', '.join(missing)}"
                )
            observations = np.asarray(file["observations"][:], dtype=np.float64)
            goals = np.asarray(file["infos/goal"][:], dtype=np.float64)
            timeouts = np.asarray(file["timeouts"][:] if "timeouts" in file else np.zeros(len(goals)), bool)
    except OSError as error:
        raise ValueError(f"{path} must be a whole HDF5 file, got one that cannot be read: {error}") from error
    if observations.ndim != 2 or observations.shape[1] != 4 or goals.shape != (len(observations), 2):
        raise ValueError(
            f"observations must have shape (N, 4) and infos/goal (N, 2), got {observations.shape} and {goals.shape} "
            f"in {path}"
        )
    if timeouts.shape != (len(observations),) or len(observations) < 1:
        raise ValueError(
            f"timeouts must have one entry for each of N >= 1 observations, got {timeouts.shape} for "
            f"{len(observations)} in {path}"
        )
    for name, values in (("observations", observations), ("infos/goal", goals)):
        bad = ~np.isfinite(values).all(axis=1)
        if bad.any():
            raise ValueError(f"{name} must be finite, got NaN or infinity in row {bad.argmax()} of {path}")
    return observations, goals, timeouts


def _is_column(entry: object) -> bool:
    return isinstance(entry, h5py.Dataset) and entry.ndim > 0


def _to_environment(positions: np.ndarray, rows: list[list[int]]) -> np.ndarray:
    """From D4RL's joint positions, first axis along rows and second along columns, to x east and y north [m]."""
    row, column = (positions + _CELL_OFFSET).T
    return np.stack([column + 0.5 - len(rows[0]) / 2, len(rows) / 2 - (row + 0.5)], axis=1)
