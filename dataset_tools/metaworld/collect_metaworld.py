# SPDX-License-Identifier: Apache-2.0
"""Collects demonstrations of Meta-World's shipped experts."""

from __future__ import annotations

from collections import Counter
from contextlib import closing
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_pf2mp.dataset_tools.metaworld.metaworld_dataset import metaworld_spec
from lerobot_pf2mp.dataset_tools.writing.attempts import successful
from lerobot_pf2mp.dataset_tools.writing.episodes import IMAGE_KEY, check_n_steps
from lerobot_pf2mp.dataset_tools.writing.write_trajectories import write_episodes
from lerobot_pf2mp.envs.image_size import image_size_of
from lerobot_pf2mp.envs.metaworld.metaworld_env import MetaWorldEnv
from lerobot_pf2mp.envs.tasks import METAWORLD_MOST_STEPS

# After the import of the environment, which says what is missing.
from lerobot_pf2mp.dataset_tools.metaworld.metaworld_expert import Attempt, MetaWorldExpert  # isort: skip


def collect_metaworld(
    task: str,
    *,
    root: Path,
    repo_id: str,
    n_episodes: int,
    n_steps: int,
    seed: int,
    overwrite: bool,
    image_width: int | None = None,
) -> tuple[int, Counter[str]]:
    """Collects successful, collision-free demonstrations as a LeRobotDataset.

    They are recorded step by step, not resampled, because their actions are displacements.

    Args:
        task: The task's name in Meta-World, for example reach-wall-v3.
        root: The dataset's folder.
        repo_id: Its name, ``user/name``.
        n_episodes: Demonstrations to write.
        n_steps: Steps of each of them.
        seed: Seed of all random numbers.
        overwrite: Whether an existing dataset is replaced.
        image_width: Width of a camera's images [pixels]; their height is three quarters of it. The images are recorded
            instead of the positions of object and goal. None for no camera.

    Returns:
        The number of episodes written, and the number of those left out, by reason.

    Raises:
        ValueError: If an argument breaks its rule, or the expert almost never succeeds.
        FileExistsError: If `root` exists and `overwrite` is false.
        ImportError: If Meta-World is not installed.
    """
    check_n_steps(n_steps)
    if n_steps > METAWORLD_MOST_STEPS:
        raise ValueError(f"n_steps must be at most {METAWORLD_MOST_STEPS} in Meta-World, got {n_steps}")
    options: dict[str, Any] = {}
    image_size = None
    if image_width is not None:
        options = {"render_mode": "rgb_array", "render_size": image_width}
        image_size = image_size_of(image_width)
    failed: Counter[str] = Counter()
    with closing(MetaWorldEnv(task, **options)) as env:
        expert = MetaWorldExpert(env, task, seed)
        attempts = (_frames_of(expert.demonstrate(number, n_steps)) for number in count())
        n_written = write_episodes(
            successful(attempts, failed),
            root=root,
            spec=metaworld_spec(task, repo_id, seed, n_steps, image_size),
            n_episodes=n_episodes,
            overwrite=overwrite,
        )
    return n_written, failed


def _frames_of(attempt: Attempt) -> dict[str, np.ndarray] | str:
    if attempt.is_collision:
        return "in collision"
    if not attempt.is_success:
        return "without success"
    frames = {
        "observation.state": np.array([seen["agent_pos"] for seen in attempt.observations]),
        "observation.environment_state": np.array(
            [seen["environment_state"] for seen in attempt.observations]
        ),
        "action": np.array(attempt.actions),
    }
    return frames | ({IMAGE_KEY: np.array(attempt.images)} if attempt.images else {})
