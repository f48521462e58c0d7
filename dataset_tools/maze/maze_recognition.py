# SPDX-License-Identifier: Apache-2.0
"""Recognises the maze in which positions were recorded."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from lerobot_pf2mp.envs.maze.point_maze import parse_maze_map
from lerobot_pf2mp.envs.tasks import MAZE_OF_TASK

_OPEN = "1111111/1000001/1000001/1000001/1111111"  # D4RL's maze2d-open
_KNOWN = {**{f"--task={task}": maze for task, maze in MAZE_OF_TASK.items()}, f"--maze_map={_OPEN}": _OPEN}
# Largest shares of the positions that may lie inside walls. A ball never does, but a few positions may come from elsewhere.
_FITS = 0.001  # of a maze that fits
_MAY_FIT = 0.01  # of the chosen maze
_FITS_IN_PARTS = 0.3  # of the chosen maze, if no other fits

_Rows = list[list[int]]


def check_maze(positions_in: Callable[[_Rows], Iterable[np.ndarray]], maze: str, path: Path) -> None:
    """Checks that positions were recorded in a maze.

    Args:
        positions_in: The recorded positions in the frame of the environment with a map, in parts ``(N, 2)`` [m].
        maze: The maze, as for `parse_maze_map`.
        path: The recording, for the error message.

    Raises:
        ValueError: If too many positions lie inside walls of the maze or outside of it. The message names the maze that
            fits, if it is known.
    """
    rows = parse_maze_map(maze)
    share = _share_in_walls(positions_in(rows), rows)
    if share <= _MAY_FIT:
        return
    known = {option: parse_maze_map(other) for option, other in _KNOWN.items()}
    fitting = [
        option for option, other in known.items() if _share_in_walls(positions_in(other), other) <= _FITS
    ]
    if not fitting and share <= _FITS_IN_PARTS:
        return
    # A smaller maze fits into the open one.
    advice = min(fitting, key=lambda option: _n_free(known[option])) if fitting else "none that is known"
    raise ValueError(
        f"a recording must come from the maze that is chosen, {maze}, got positions in {path} of which {share:.0%} lie in "
        f"its walls or outside; the maze that fits: {advice} (choose one with --task or --maze_map)"
    )


def maze_of_recording(recorded: str, chosen: str, is_own: bool, path: Path) -> str:
    """The maze of a recording that says in which maze it was made.

    Args:
        recorded: That maze, as for `parse_maze_map`.
        chosen: The maze that the user chose.
        is_own: Whether it is a map of the user's own, and not that of a task.
        path: The recording, for the error message.

    Raises:
        ValueError: If the recording was made in another maze. A task's maze gives way to one that no task has.
    """
    if _walls(recorded) == _walls(chosen):
        return chosen
    task = next((task for task, maze in MAZE_OF_TASK.items() if _walls(maze) == _walls(recorded)), None)
    if task is None and not is_own:
        return recorded
    option = f"--maze_map={recorded}" if task is None else f"--task={task}"
    raise ValueError(
        f"a recording must come from the maze that is chosen, {chosen}, got {path}, which was made in that of {option}"
    )


def _share_in_walls(parts: Iterable[np.ndarray], rows: _Rows) -> float:
    """The share of positions [m], in parts ``(N, 2)``, that lie in walls of a map or outside of it."""
    is_free = np.array([[cell != 1 for cell in row] for row in rows])
    height, width = is_free.shape
    n_free, n = 0, 0
    for positions in parts:
        column = np.floor(positions[:, 0] + width / 2)
        row = np.floor(height / 2 - positions[:, 1])
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        n_free += is_free[row[inside].astype(int), column[inside].astype(int)].sum()
        n += len(positions)
    return 1 - n_free / n if n else 0.0


def _walls(maze: str) -> list[list[bool]]:
    return [[cell == 1 for cell in row] for row in parse_maze_map(maze)]


def _n_free(rows: _Rows) -> int:
    return sum(cell != 1 for row in rows for cell in row)
