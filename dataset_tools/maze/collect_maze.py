# SPDX-License-Identifier: Apache-2.0
"""Collects demonstrations in the maze environments."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from lerobot_pf2mp.dataset_tools.maze.maze_dataset import write_maze_dataset
from lerobot_pf2mp.dataset_tools.maze.maze_expert import MazeExpert


def collect_maze(
    maze: str,
    *,
    root: Path,
    repo_id: str,
    n_episodes: int,
    n_steps: int,
    action_noise: float,
    seed: int,
    overwrite: bool,
    image_width: int | None = None,
) -> tuple[int, Counter[str]]:
    """Collects collision-free demonstrations of a scripted expert as a LeRobotDataset.

    Args:
        maze: As for `parse_maze_map`.
        root: The dataset's folder.
        repo_id: Its name, ``user/name``.
        n_episodes: Demonstrations to write.
        n_steps: Steps that each is resampled to.
        action_noise: Standard deviation of noise on the expert's normalised force.
        seed: Seed of all random numbers.
        overwrite: Whether an existing dataset is replaced.
        image_width: Longer side of the images that are recorded instead of the goal's position [pixels]; None records no
            images.

    Returns:
        The number of episodes written, and the number of those left out, by reason.

    Raises:
        ValueError: If an argument breaks its rule.
        FileExistsError: If `root` exists and `overwrite` is false.
    """
    expert = MazeExpert(maze, action_noise, seed)
    n_written, dropped = write_maze_dataset(
        expert.trajectories(),
        root=root,
        repo_id=repo_id,
        maze=maze,
        origin=(
            "A PD controller drove it through MuJoCo from goal to goal, along shortest paths through the centres of the "
            f"cells (maze {maze}, action noise {action_noise}, seed {seed})."
        ),
        n_steps=n_steps,
        n_episodes=n_episodes,
        overwrite=overwrite,
        image_width=image_width,
    )
    dropped["in collision"] += expert.n_collisions
    return n_written, +dropped
