# SPDX-License-Identifier: Apache-2.0
"""What all maze datasets have in common: features, card, collision test."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_pf2mp.dataset_tools.writing.episodes import PICTURES, Trajectory, resample
from lerobot_pf2mp.dataset_tools.writing.lerobot_writer import DatasetSpec, picture_feature
from lerobot_pf2mp.dataset_tools.writing.write_trajectories import write_trajectories
from lerobot_pf2mp.envs.maze.maze_image import MazePicture
from lerobot_pf2mp.envs.maze.point_maze import BALL_RADIUS, make_point_maze
from lerobot_pf2mp.envs.maze.swept_ball import SweptBall
from lerobot_pf2mp.envs.tasks import MAZE_OF_TASK

FPS = 10
TASK_DESCRIPTION = "Move the ball to the red goal without touching a wall."

_FEATURES = {
    "observation.state": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
    "observation.environment_state": {"dtype": "float32", "shape": (2,), "names": ["goal_x", "goal_y"]},
    "action": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
}

_GOAL = "| `observation.environment_state` | position x, y of the goal | m |"
_PICTURES = "| `observation.image` | the maze from above | |"
_CARD = """\
---
license: apache-2.0
task_categories: [robotics]
tags: [LeRobot, pf2mp, maze]
---
# {title}

Start-goal trajectories of a ball in a maze, none of which touches a wall. {origin}

Every trajectory is resampled to {n_steps} steps by linear interpolation in time; {fps} fps is nominal.

| feature | meaning | unit |
|---|---|---|
| `observation.state` | position x, y of the ball | m |
{surroundings}
| `action` | next position x, y of the ball | m |

The origin is the centre of the map, x points east and y north; cells have sides of 1 m, the ball a radius of 0.1 m.
Made with lerobot_policy_pf2mp.
"""


def maze_of(task: str, maze_map: str | None) -> str:
    """The maze of a task, or a map given instead of it.

    Raises:
        ValueError: If there is no such task.
    """
    if maze_map is not None:
        return maze_map
    if task not in MAZE_OF_TASK:
        raise ValueError(f"task must be one of {list(MAZE_OF_TASK)}, got {task!r}")
    return MAZE_OF_TASK[task]


def write_maze_dataset(
    trajectories: Iterable[Trajectory],
    *,
    root: Path,
    repo_id: str,
    maze: str,
    origin: str,
    n_steps: int,
    n_episodes: int | None = None,
    n_expected: int | None = None,
    overwrite: bool = False,
    picture_width: int | None = None,
) -> tuple[int, Counter[str]]:
    """Writes the usable ones of some trajectories in a maze as a LeRobotDataset.

    As `write_trajectories`, with the same arguments, result and errors; `trajectories` are in the coordinates of the
    environment [m]. Besides, there is `repo_id`, the dataset's name ``user/name``; `maze`, as for `parse_maze_map`, whose
    walls a trajectory must not touch; and `origin`, a sentence for the card: where the trajectories come from.
    """
    point_maze, model = make_point_maze(maze)
    features: dict[str, Any] = dict(_FEATURES)
    if picture_width is not None:
        picture = MazePicture(point_maze.maze.maze_map, picture_width)
        trajectories = _with_pictures(trajectories, picture, n_steps)
        del features["observation.environment_state"]
        features[PICTURES] = picture_feature(picture.size)
    card = _CARD.format(
        title=repo_id,
        origin=origin,
        n_steps=n_steps,
        fps=FPS,
        surroundings=_PICTURES if picture_width else _GOAL,
    )
    return write_trajectories(
        trajectories,
        root=root,
        spec=DatasetSpec(repo_id, FPS, features, TASK_DESCRIPTION, card),
        n_steps=n_steps,
        collides=SweptBall(model, BALL_RADIUS).collides,
        n_episodes=n_episodes,
        n_expected=n_expected,
        overwrite=overwrite,
    )


def _with_pictures(
    trajectories: Iterable[Trajectory], picture: MazePicture, n_steps: int
) -> Iterator[Trajectory]:
    """The trajectories, resampled, with what the environment would show on the way."""
    for trajectory in trajectories:
        assert trajectory.goal is not None  # there is one in every maze
        way = resample(trajectory.positions, n_steps)
        pictures = [
            picture.draw(ball=way[i], goal=trajectory.goal, path=way[: i + 1], collisions=())
            for i in range(len(way))
        ]
        yield Trajectory(way, trajectory.goal, pictures=np.array(pictures))
