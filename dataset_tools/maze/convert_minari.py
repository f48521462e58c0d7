# SPDX-License-Identifier: Apache-2.0
"""Reads PointMaze datasets of Minari (https://minari.farama.org/datasets/D4RL/pointmaze/) from a local folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lerobot_pf2mp.dataset_tools.open_minari import open_minari
from lerobot_pf2mp.dataset_tools.writing.episodes import Trajectory


def read_minari(path: Path) -> tuple[int, Iterator[Trajectory]]:
    """Reads the trajectories of a Minari PointMaze dataset. Its coordinates are those of this package.

    Args:
        path: The dataset's folder, for example ``~/.minari/datasets/D4RL/pointmaze/large-v2``.

    Returns:
        Their number, and the trajectories.

    Raises:
        FileNotFoundError: If there is no such folder.
        ValueError: If it does not hold a Minari dataset of PointMaze.
    """
    dataset = open_minari(path)
    return dataset.total_episodes, _trajectories(dataset, path)


def _trajectories(dataset: object, path: Path) -> Iterator[Trajectory]:
    for episode in dataset.iterate_episodes():  # type: ignore[attr-defined]
        observations = episode.observations
        if not isinstance(observations, dict) or not {"achieved_goal", "desired_goal"} <= set(observations):
            raise ValueError(
                f"{path} must hold PointMaze episodes with achieved_goal and desired_goal, got {observations!r:.80}"
            )
        positions = np.asarray(observations["achieved_goal"], dtype=np.float64)
        goals = np.asarray(observations["desired_goal"], dtype=np.float64)
        if positions.ndim != 2 or positions.shape[1] != 2 or goals.shape != positions.shape:
            raise ValueError(
                f"{path} must hold PointMaze episodes, positions and goals in the plane, got {positions.shape} and "
                f"{goals.shape}"
            )
        # The first desired goal is the previous episode's: PointMaze draws the new one after it is recorded.
        yield Trajectory(positions, goals[min(1, len(goals) - 1)])
