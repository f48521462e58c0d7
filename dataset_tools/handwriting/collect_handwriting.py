# SPDX-License-Identifier: Apache-2.0
"""Collects demonstrations in the handwriting environments."""

from __future__ import annotations

from collections import Counter
from itertools import count
from pathlib import Path
from typing import Any

from lerobot_pf2mp.dataset_tools.handwriting.handwriting_dataset import handwriting_spec
from lerobot_pf2mp.dataset_tools.handwriting.handwriting_expert import ScriptedHandwritingExpert
from lerobot_pf2mp.dataset_tools.writing.attempts import successful
from lerobot_pf2mp.dataset_tools.writing.episodes import check_n_steps
from lerobot_pf2mp.dataset_tools.writing.write_trajectories import write_trajectories
from lerobot_pf2mp.envs.handwriting.handwriting_env import HandwritingEnv
from lerobot_pf2mp.envs.image_size import image_size_of


def collect_handwriting(
    space: str,
    *,
    root: Path,
    repo_id: str,
    n_episodes: int,
    n_steps: int,
    scene_options: dict[str, Any],
    seed: int,
    overwrite: bool,
    image_width: int | None = None,
    robot: str = "panda",
) -> tuple[int, Counter[str]]:
    """Collects successful, collision-free demonstrations of a scripted expert as a LeRobotDataset.

    Args:
        space: ``joint`` or ``pen``: states and actions are joint positions or positions of the pen's tip.
        root: The dataset's folder.
        repo_id: Its name, ``user/name``.
        n_episodes: Demonstrations to write.
        n_steps: Steps of each demonstration.
        scene_options: Arguments of `make_writing_scene`.
        seed: Seed of all random numbers.
        overwrite: Whether an existing dataset is replaced.
        image_width: Width of a camera's images [pixels]; their height is three quarters of it. None for no camera.
        robot: The arm, one of `tasks.ROBOTS`.

    Returns:
        The number of episodes written, and the number of those left out, by reason.

    Raises:
        ValueError: If an argument breaks its rule, or the expert almost never succeeds.
        ImportError: If the package with the arm's model is missing.
        FileExistsError: If `root` exists and `overwrite` is false.
    """
    check_n_steps(n_steps)
    options, image_size = {**scene_options, "robot": robot}, None
    if image_width is not None:
        options |= {"render_mode": "rgb_array", "render_size": image_width}
        image_size = image_size_of(image_width)
    env = HandwritingEnv(space, **options)
    writer = ScriptedHandwritingExpert(env, n_steps, seed)
    failed: Counter[str] = Counter()
    origin = f"A scripted expert wrote it (seed {seed})."
    n_written, dropped = write_trajectories(
        successful((writer.demonstrate(number) for number in count()), failed),
        root=root,
        spec=handwriting_spec(space, env.arm, env.scene.name, repo_id, origin, n_steps, image_size),
        n_steps=n_steps,
        collides=lambda _: False,  # checked when the environment drew it
        n_episodes=n_episodes,
        overwrite=overwrite,
    )
    return n_written, dropped + failed
