# SPDX-License-Identifier: Apache-2.0
"""Collects demonstrations of the SO-101 arm, as LeRobot's recorder writes them."""

from __future__ import annotations

from collections import Counter
from contextlib import closing
from itertools import count
from pathlib import Path

import numpy as np

from lerobot_pf2mp.dataset_tools.so101.fence_dataset import IMAGE_KEY, fence_spec
from lerobot_pf2mp.dataset_tools.so101.fence_expert import STYLES, FenceRecording, ScriptedFenceExpert
from lerobot_pf2mp.dataset_tools.writing.attempts import successful
from lerobot_pf2mp.dataset_tools.writing.write_trajectories import write_episodes
from lerobot_pf2mp.envs.so101.fence_env import SO101FenceEnv
from lerobot_pf2mp.envs.tasks import SO101_STEPS


def collect_so101(
    *,
    root: Path,
    repo_id: str,
    n_episodes: int,
    n_steps: int,
    style: str,
    seed: int,
    overwrite: bool,
    image_width: int | None = None,
) -> tuple[int, Counter[str]]:
    """Collects successful, collision-free demonstrations of the scripted expert as a LeRobotDataset.

    Args:
        root: The dataset's folder.
        repo_id: Its name, ``user/name``.
        n_episodes: Demonstrations to write.
        n_steps: Steps of each, always `SO101_STEPS`: joint targets are recorded as they were sent, not resampled.
        style: How high the cube passes above the wall, see `STYLES`.
        seed: Seed of all random numbers.
        overwrite: Whether an existing dataset is replaced.
        image_width: Height and width of the camera's images, recorded instead of the positions of cube and goal [pixels];
            None for no camera.

    Returns:
        The number of episodes written, and the number of those left out, by reason.

    Raises:
        ValueError: If an argument breaks its rule.
        FileExistsError: If `root` exists and `overwrite` is false.
        ImportError: If so101-nexus is missing.
    """
    if style not in STYLES:
        raise ValueError(f"style must be one of {list(STYLES)}, got {style!r}")
    if n_steps != SO101_STEPS:
        raise ValueError(
            f"n_steps must be {SO101_STEPS} for so101_fence, which is not resampled, got {n_steps}"
        )
    failed: Counter[str] = Counter()
    obs_type = "state" if image_width is None else "pixels_agent_pos"
    with closing(SO101FenceEnv(obs_type, image_size=image_width or 96)) as env:
        expert = ScriptedFenceExpert(env, style, seed)
        attempts = (_frames_of(expert.demonstrate(number)) for number in count())
        n_written = write_episodes(
            successful(attempts, failed),
            root=root,
            spec=fence_spec(repo_id, style, seed, image_width),
            n_episodes=n_episodes,
            overwrite=overwrite,
        )
    return n_written, failed


def _frames_of(recording: FenceRecording) -> dict[str, np.ndarray] | str:
    """The frames of an episode, or why it is no demonstration."""
    if recording.info["is_collision"] or recording.info["is_table_contact"]:
        return "in collision"
    if not recording.info["is_success"]:
        return "without success"
    frames = {"observation.state": recording.states, "action": recording.actions}
    if recording.images:
        frames[IMAGE_KEY] = recording.images
    else:
        frames["observation.environment_state"] = recording.environment_states
    return {key: np.array(values) for key, values in frames.items()}
