# SPDX-License-Identifier: Apache-2.0
"""Recorded actions and states of whole episodes, to tell what kind of actions they are."""

from __future__ import annotations

from typing import Any

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, OBS_STATE

_N_FRAMES = 20_000


def read_whole_episodes(dataset: LeRobotDataset) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Up to 20 000 frames of whole episodes spread over a dataset.

    Returns:
        Actions ``(N, A)``, states ``(N, S)`` and episode numbers ``(N,)``; None if action or ``observation.state`` are no
        vectors, or there are no frames.
    """
    shapes: list[Any] = [
        tuple(dataset.meta.features.get(key, {}).get("shape", ())) for key in (ACTION, OBS_STATE)
    ]
    if any(len(shape) != 1 for shape in shapes) or not len(dataset.hf_dataset):
        return None
    table = dataset.hf_dataset.with_format("numpy", columns=[ACTION, OBS_STATE, "episode_index"])
    episodes = np.asarray(table.with_format("numpy", columns=["episode_index"])[:]["episode_index"]).reshape(
        -1
    )
    bounds = np.flatnonzero(np.diff(episodes, prepend=-1, append=-1))
    n_episodes = len(bounds) - 1
    n_chosen = max(1, min(n_episodes, n_episodes * _N_FRAMES // len(episodes)))
    chosen = np.unique(np.linspace(0, n_episodes - 1, n_chosen).round().astype(int))
    parts = [table[bounds[i] : min(bounds[i + 1], bounds[i] + _N_FRAMES)] for i in chosen.tolist()]
    actions, states = (
        np.concatenate([np.asarray(part[key], dtype=np.float64).reshape(-1, *shape) for part in parts])
        for key, shape in zip((ACTION, OBS_STATE), shapes, strict=True)
    )
    return actions, states, np.concatenate([part["episode_index"].reshape(-1) for part in parts])
