# SPDX-License-Identifier: Apache-2.0
"""Trains experts for the Fetch tasks by reinforcement learning. The paper makes its demonstrations with such experts."""

from __future__ import annotations

import math
import sys
import warnings
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tqdm import tqdm

from lerobot_pf2mp.dataset_tools.experts.expert_checkpoint import EXPERT_FILE, ExpertCheckpoint
from lerobot_pf2mp.dataset_tools.experts.expert_settings import ExpertSettings
from lerobot_pf2mp.process.claims import claimed

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm


def train_expert(
    task: str,
    algo: str | None,
    total_steps: int,
    output_dir: Path,
    *,
    save_freq: int = 50_000,
    device: str = "cpu",
    **settings: Any,
) -> ExpertCheckpoint:
    """Trains an expert, or continues the training of one with fewer steps.

    After an interruption, the same call continues from the last checkpoint. It then begins a new episode, and its random
    numbers differ from those of a training without the interruption.

    Args:
        task: reach or push.
        algo: ppo or sac_her; None means ppo for reach, sac_her for push.
        total_steps: Environment steps in total, rounded up to whole rollouts of the algorithm.
        output_dir: The expert's folder, see `expert_checkpoint`.
        save_freq: Environment steps between checkpoints, rounded up in the same way.
        device: Device on which the networks are trained, cpu or cuda.
        **settings: Arguments of `ExpertSettings.of`: reward, collision_penalty, seed, scene_changes, options.

    Returns:
        The expert that was written.

    Raises:
        ImportError: If Stable-Baselines3 is missing.
        ValueError: If an argument breaks its rule, or the folder's expert cannot be read or has other settings.
        OSError: If the folder cannot be written, or holds something else.
    """
    for name, value in (("total_steps", total_steps), ("save_freq", save_freq)):
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")
    if device != "cpu" and not (device.startswith("cuda") and torch.cuda.is_available()):
        raise ValueError(f"device must be cpu, or cuda where there is such a GPU, got {device!r}")
    wanted = ExpertSettings.of(task, algo, **settings)
    with claimed(output_dir):
        try:
            return _continue(wanted, total_steps, output_dir, save_freq, device)
        finally:
            with suppress(OSError):  # not empty, or never made
                output_dir.rmdir()


def _continue(
    wanted: ExpertSettings, total_steps: int, output_dir: Path, save_freq: int, device: str
) -> ExpertCheckpoint:
    checkpoint = _found(output_dir, wanted)
    if checkpoint is not None and checkpoint.n_steps >= total_steps:
        return checkpoint
    from lerobot_pf2mp.dataset_tools.experts.expert_algorithms import make_algorithm

    algorithm = make_algorithm(wanted, device)
    try:
        output_dir.mkdir(parents=True, exist_ok=True)  # fails before the training, not after it
        if checkpoint is not None:
            checkpoint.load_into(algorithm)
        return _train(algorithm, wanted, total_steps, output_dir, save_freq)
    finally:
        algorithm.get_env().close()


def _found(folder: Path, wanted: ExpertSettings) -> ExpertCheckpoint | None:
    if not (folder / EXPERT_FILE).exists():
        # A call that was killed during its first checkpoint leaves only the arrays. They may be complete, as the settings
        # are written last. But without settings the training cannot continue from them.
        if folder.exists() and any(not path.name.startswith((".", "steps_")) for path in folder.iterdir()):
            raise FileExistsError(
                f"{folder} is no expert's folder, it holds no {EXPERT_FILE}: choose another --output_dir"
            )
        return None
    checkpoint = ExpertCheckpoint.read(folder)
    name = checkpoint.settings.difference(wanted)
    if name is not None:
        raise ValueError(
            f"{folder} holds an expert with another {name}, {checkpoint.settings.plain[name]} instead of "
            f"{wanted.plain[name]}: choose another --output_dir, or the same settings to continue its training"
        )
    return checkpoint


def _train(
    algorithm: BaseAlgorithm, settings: ExpertSettings, total_steps: int, folder: Path, save_freq: int
) -> ExpertCheckpoint:
    from lerobot_pf2mp.dataset_tools.experts.expert_progress import ExpertProgress

    _begin_new_episode(algorithm, settings.seed)
    total = math.ceil(total_steps / settings.rollout_steps) * settings.rollout_steps
    with tqdm(
        initial=algorithm.num_timesteps, total=total, desc="Training", unit="step", mininterval=1.0
    ) as bar:
        while True:
            algorithm.learn(
                min(save_freq, total - algorithm.num_timesteps),
                callback=ExpertProgress(bar),
                log_interval=sys.maxsize,
                reset_num_timesteps=False,
            )
            checkpoint = ExpertCheckpoint(folder, settings, algorithm.num_timesteps)
            checkpoint.write(algorithm)
            if checkpoint.n_steps >= total:
                return checkpoint


def _begin_new_episode(algorithm: BaseAlgorithm, seed: int) -> None:
    """Sets a new seed for the random numbers, and ends the current episode."""
    algorithm.set_random_seed(
        int(np.random.SeedSequence([seed, algorithm.num_timesteps]).generate_state(1)[0])
    )
    buffer = getattr(algorithm, "replay_buffer", None)
    if buffer is not None:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="The last trajectory")  # as intended
            buffer.truncate_last_trajectory()
