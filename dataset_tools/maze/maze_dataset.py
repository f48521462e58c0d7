# SPDX-License-Identifier: Apache-2.0
"""The common parts of all maze datasets: features, card and collision test."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_pf2mp.dataset_tools.writing.card import card_header
from lerobot_pf2mp.dataset_tools.writing.episodes import IMAGE_KEY, Trajectory, resample
from lerobot_pf2mp.dataset_tools.writing.lerobot_writer import DatasetSpec, image_feature
from lerobot_pf2mp.dataset_tools.writing.write_trajectories import write_trajectories
from lerobot_pf2mp.envs.maze.maze_image import MazeImage
from lerobot_pf2mp.envs.maze.point_maze import BALL_RADIUS, make_point_maze
from lerobot_pf2mp.envs.maze.swept_ball import SweptBall
from lerobot_pf2mp.envs.tasks import MAZE_OF_TASK

ROBOT = "point_maze"
FPS = 10
GOAL_RADIUS = 0.5  # largest distance from its goal at which a demonstration may end [m]
_LONGEST_STEP = 1.0  # a longer step is no motion, but where two recordings meet [m]
TASK_DESCRIPTION = "Move the ball to the red goal without touching a wall."

_FEATURES = {
    "observation.state": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
    "observation.environment_state": {"dtype": "float32", "shape": (2,), "names": ["goal_x", "goal_y"]},
    "action": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
}

_GOAL = "| `observation.environment_state` | position x, y of the goal | m |"
_IMAGES = "| `observation.image` | the maze from above | |"
_CARD = """\
{header}# {title}

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
    """The maze of a task, or the given map instead.

    Args:
        task: A key of `MAZE_OF_TASK`.
        maze_map: As for `parse_maze_map`; None uses the maze of the task.

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
    image_width: int | None = None,
) -> tuple[int, Counter[str]]:
    """Writes the usable trajectories in a maze as a LeRobotDataset.

    Errors are those of `write_trajectories`.

    Args:
        trajectories: Trajectories in the coordinates of the environment [m].
        root: The dataset's folder.
        repo_id: The dataset's name, ``user/name``.
        maze: As for `parse_maze_map`; a trajectory must not touch its walls.
        origin: A sentence for the card about the source of the trajectories.
        n_steps: Steps T that each trajectory is resampled to.
        n_episodes: Largest number of episodes to write; None writes all.
        n_expected: Number of trajectories, for the progress bar, if it is known.
        overwrite: Whether an existing dataset is replaced.
        image_width: Longer side of the images that are recorded instead of the goal's position [pixels]; None records no
            images.

    Returns:
        The number of episodes written, and the number of those left out, by reason.
    """
    point_maze, model = make_point_maze(maze)
    left_out: Counter[str] = Counter()
    trajectories = _whole(trajectories, left_out)
    features: dict[str, Any] = dict(_FEATURES)
    if image_width is not None:
        image = MazeImage(point_maze.maze.maze_map, image_width)
        trajectories = _with_images(trajectories, image, n_steps)
        del features["observation.environment_state"]
        features[IMAGE_KEY] = image_feature(image.size)
    card = _CARD.format(
        header=card_header("maze"),
        title=repo_id,
        origin=origin,
        n_steps=n_steps,
        fps=FPS,
        surroundings=_IMAGES if image_width else _GOAL,
    )
    n_written, dropped = write_trajectories(
        trajectories,
        root=root,
        spec=DatasetSpec(repo_id, FPS, features, TASK_DESCRIPTION, card, ROBOT),
        n_steps=n_steps,
        collides=SweptBall(model, BALL_RADIUS).collides,
        n_episodes=n_episodes,
        n_expected=n_expected,
        overwrite=overwrite,
    )
    return n_written, dropped + left_out


def _whole(trajectories: Iterable[Trajectory], left_out: Counter[str]) -> Iterator[Trajectory]:
    """The trajectories that lead to their goal in one piece; counts the others."""
    for trajectory in trajectories:
        assert trajectory.goal is not None  # there is one in every maze
        steps = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1)
        if (steps > _LONGEST_STEP).any():
            left_out["with a jump"] += 1
        elif np.linalg.norm(trajectory.positions[-1] - trajectory.goal) > GOAL_RADIUS:
            left_out["far from their goal"] += 1
        else:
            yield trajectory


def _with_images(trajectories: Iterable[Trajectory], image: MazeImage, n_steps: int) -> Iterator[Trajectory]:
    """The resampled trajectories, with the images that the environment would render at each step."""
    for trajectory in trajectories:
        assert trajectory.goal is not None  # there is one in every maze
        positions = resample(trajectory.positions, n_steps)
        images = [
            image.draw(ball=positions[i], goal=trajectory.goal, path=positions[: i + 1], collisions=())
            for i in range(len(positions))
        ]
        yield Trajectory(positions, trajectory.goal, images=np.array(images))
