# SPDX-License-Identifier: Apache-2.0
"""Recordings in a maze as D4RL and Minari leave them, written from demonstrations of ours."""

import itertools
import warnings
from pathlib import Path

import gymnasium as gym
import h5py
import numpy as np
import pytest

from lerobot_pf2mp.dataset_tools.maze.maze_expert import MazeExpert
from lerobot_pf2mp.dataset_tools.writing.episodes import Trajectory
from lerobot_pf2mp.envs.maze.point_maze import parse_maze_map

OPEN = "1111111/1000001/1000001/1000001/1111111"  # D4RL's maze2d-open
FOREIGN_LAYOUT = "observations and infos/goal"


def demonstrations(maze: str, n: int, seed: int = 0) -> list[Trajectory]:
    return list(itertools.islice(MazeExpert(maze, 0.0, seed).trajectories(), n))


def line(start: tuple[float, float], end: tuple[float, float], n_steps: int) -> Trajectory:
    return Trajectory(np.linspace(start, end, n_steps + 1), np.array(end))


def to_d4rl(positions: np.ndarray, maze: str) -> np.ndarray:
    """Joint positions of D4RL's model: i - 0.2 and j - 0.2 at the centre of cell (i, j)."""
    rows = parse_maze_map(maze)
    column = positions[:, 0] + len(rows[0]) / 2 - 0.5
    row = len(rows) / 2 - positions[:, 1] - 0.5
    return np.stack([row - 0.2, column - 0.2], axis=1).astype(np.float32)


def write_d4rl(
    path: Path, trajectories: list[Trajectory], maze: str, with_timeouts: bool, **changes: np.ndarray | None
) -> Path:
    """A file as D4RL's generator leaves it, one step after the other; the released files have timeouts besides."""
    positions = np.concatenate([to_d4rl(t.positions, maze) for t in trajectories])
    goals = np.concatenate([to_d4rl(np.tile(t.goal, (len(t.positions), 1)), maze) for t in trajectories])
    ends = np.cumsum([len(t.positions) for t in trajectories]) - 1
    n = len(positions)
    velocities = np.zeros((n, 2), np.float32)
    columns: dict[str, np.ndarray | None] = {
        "observations": np.hstack([positions, velocities]),
        "actions": np.zeros((n, 2), np.float32),
        "rewards": np.zeros(n, np.float32),
        "terminals": np.zeros(n, bool),
        "infos/goal": goals,
        "infos/qpos": positions,
        "infos/qvel": velocities,
        "timeouts": np.isin(np.arange(n), ends) if with_timeouts else None,
        **{key.replace("__", "/"): value for key, value in changes.items()},
    }
    with h5py.File(path, "w") as file:
        for key, value in columns.items():
            if value is not None:
                file.create_dataset(key, data=value, compression="gzip" if value.ndim else None)
    return path


def write_minari(
    datasets: Path, monkeypatch: pytest.MonkeyPatch, observations: list, space: gym.Space
) -> Path:
    import minari
    from minari.data_collector import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(datasets))
    buffers = []
    for number, observation in enumerate(observations):
        length = len(next(iter(observation.values())) if isinstance(observation, dict) else observation) - 1
        buffers.append(
            EpisodeBuffer(
                id=number,
                observations=observation,
                actions=np.zeros((length, 2), np.float32),
                rewards=np.zeros(length),
                terminations=np.zeros(length, bool),
                truncations=np.arange(length) == length - 1,
            )
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about the author, the code and the requirements
        minari.create_dataset_from_buffers(
            "D4RL/pointmaze/test-v0",
            buffers,
            action_space=gym.spaces.Box(-1, 1, (2,)),
            observation_space=space,
        )
    return datasets / "D4RL" / "pointmaze" / "test-v0"


def write_pointmaze(
    datasets: Path, monkeypatch: pytest.MonkeyPatch, trajectories: list[Trajectory], n_dims: int = 2
) -> Path:
    """Episodes as PointMaze's are: the first desired goal is the one of the episode before."""
    anything = {"low": -np.inf, "high": np.inf, "dtype": np.float64}
    space = gym.spaces.Dict(
        {
            "observation": gym.spaces.Box(shape=(4,), **anything),
            "achieved_goal": gym.spaces.Box(shape=(n_dims,), **anything),
            "desired_goal": gym.spaces.Box(shape=(n_dims,), **anything),
        }
    )
    observations = []
    stale = np.atleast_2d(trajectories[0].goal)[0]
    for trajectory in trajectories:
        # One goal, or one for each position.
        goals = np.array(np.broadcast_to(trajectory.goal, (len(trajectory.positions), n_dims)))
        goals[0] = stale
        stale = goals[-1]
        observations.append(
            {
                "observation": np.zeros((len(goals), 4)),
                "achieved_goal": trajectory.positions,
                "desired_goal": goals,
            }
        )
    return write_minari(datasets, monkeypatch, observations, space)
