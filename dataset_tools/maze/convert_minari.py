# SPDX-License-Identifier: Apache-2.0
"""Reads PointMaze datasets of Minari (https://minari.farama.org/datasets/D4RL/pointmaze/) from a local folder."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lerobot_pf2mp.dataset_tools.maze.maze_recognition import check_maze
from lerobot_pf2mp.dataset_tools.open_minari import env_spec_of, episodes_in, open_minari
from lerobot_pf2mp.dataset_tools.writing.episodes import Trajectory
from lerobot_pf2mp.envs.maze.point_maze import parse_maze_map
from lerobot_pf2mp.errors import explained

if TYPE_CHECKING:
    from minari import MinariDataset

_SAME_GOAL = 1e-5  # largest difference of coordinates between equal goals [m]
_WIDTH = 4  # of an observation: position and velocity
_N_COMPARED = 50  # episodes by which another maze is recognised


def read_minari(path: Path, maze: str | None = None) -> tuple[int, Iterator[Trajectory]]:
    """Reads the trajectories of a Minari PointMaze dataset. Its coordinates are those of this package.

    An episode in which the goal changes, as in continuing tasks, is one trajectory for each goal. The last of them may be
    cut off, far from its goal.

    Args:
        path: The dataset's folder, for example ``~/.minari/datasets/D4RL/pointmaze/large-v2``.
        maze: The maze in which it must have been recorded, as for `parse_maze_map`; None accepts any.

    Returns:
        The number of episodes, and the trajectories.

    Raises:
        FileNotFoundError: If there is no such folder.
        ValueError: If it does not hold a Minari dataset of PointMaze, or one of another maze.
    """
    _check_no_ant(path)
    dataset = open_minari(path)
    if maze is not None:
        compared = [positions for positions, _ in islice(_episodes(dataset, path), _N_COMPARED)]
        check_maze(lambda _: compared, maze, path)
    return dataset.total_episodes, _trajectories(dataset, path)


def recorded_maze(path: Path) -> str | None:
    """The maze in which a Minari dataset says that it was recorded, as for `parse_maze_map`; None if it says nothing.

    Raises:
        ValueError: If it is that of an ant, or no maze.
    """
    _check_no_ant(path)
    kwargs = env_spec_of(path).get("kwargs")
    rows = kwargs.get("maze_map") if isinstance(kwargs, dict) else None
    if not isinstance(rows, list) or not all(isinstance(row, list) for row in rows):
        return None
    # Free cells may hold letters, for the starts and the goals.
    maze = "/".join("".join("1" if cell == 1 else "0" for cell in row) for row in rows)
    with explained(f"{path} names a maze that cannot be used"):
        parse_maze_map(maze)
    return maze


def _check_no_ant(path: Path) -> None:
    spec = env_spec_of(path)
    name = str(spec.get("id"))
    if name.lower().startswith("antmaze") or "ant_maze" in str(spec.get("entry_point")):
        raise ValueError(f"{path} must hold PointMaze episodes, got AntMaze ({name}), whose ant is no ball")


def _trajectories(dataset: MinariDataset, path: Path) -> Iterator[Trajectory]:
    for positions, goals in _episodes(dataset, path):
        # The first desired goal is the previous episode's: PointMaze draws the new one after it is recorded.
        goals[0] = goals[min(1, len(goals) - 1)]
        changes = np.flatnonzero((np.abs(np.diff(goals, axis=0)) > _SAME_GOAL).any(axis=1)) + 1
        for part, part_goals in zip(np.split(positions, changes), np.split(goals, changes), strict=True):
            yield Trajectory(part, part_goals[0])


def _episodes(dataset: MinariDataset, path: Path) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Positions and goals ``(N, 2)`` of each episode [m]."""
    for episode in episodes_in(dataset, path):
        observations = episode.observations
        if not isinstance(observations, dict) or not {"achieved_goal", "desired_goal"} <= set(observations):
            raise ValueError(
                f"{path} must hold PointMaze episodes with achieved_goal and desired_goal, got {observations!r:.80}"
            )
        positions = np.asarray(observations["achieved_goal"], dtype=np.float64)
        goals = np.array(observations["desired_goal"], dtype=np.float64)
        if positions.ndim != 2 or positions.shape[1] != 2 or goals.shape != positions.shape or not len(goals):
            raise ValueError(
                f"{path} must hold PointMaze episodes, positions and goals in the plane, got {positions.shape} and "
                f"{goals.shape}"
            )
        width = np.shape(observations.get("observation", np.empty((0, _WIDTH))))[-1]
        if width != _WIDTH:
            raise ValueError(
                f"{path} must hold PointMaze episodes with {_WIDTH} numbers in observation, got {width}: those of AntMaze?"
            )
        yield positions, goals
