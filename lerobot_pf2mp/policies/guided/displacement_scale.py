# SPDX-License-Identifier: Apache-2.0
"""Whether recorded actions are displacements of the observed state, and how far one of them moves it."""

from __future__ import annotations

import logging

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import OBS_STATE

from lerobot_pf2mp.policies.guided.field_settings import FieldSettings
from lerobot_pf2mp.policies.guided.whole_episodes import read_whole_episodes

logger = logging.getLogger(__name__)

# Beyond this factor, a scale is not that of the recorded displacements. A controller that lags changes it less.
_LARGEST_FACTOR = 2.0
_LEAST_CORRELATION = 0.5


def measured_scale(actions: np.ndarray, states: np.ndarray, episodes: np.ndarray) -> tuple[float, float]:
    """How far displacements move the state, by least squares over the way from the start of each episode.

    Args:
        actions: ``(N, D)`` displacements in the order of their frames.
        states: ``(N, D)`` states of the same dimensions.
        episodes: ``(N,)`` episode numbers.

    Returns:
        The scale [units of state per unit of action] and the correlation of running sums and ways; zeros if nothing moves.
    """
    sums, ways = [], []
    starts = np.flatnonzero(np.diff(episodes, prepend=episodes[0] - 1))
    for start, end in zip(starts, [*starts[1:], len(episodes)], strict=True):
        sums.append(actions[start : end - 1].cumsum(axis=0))
        ways.append(states[start + 1 : end] - states[start])
    x, y = (np.concatenate(parts).ravel() for parts in (sums, ways))
    size = float(x @ x), float(y @ y)
    if min(size) == 0:
        return 0.0, 0.0
    return float(x @ y) / size[0], float(x @ y) / (size[0] * size[1]) ** 0.5


def warn_unless_displacements(dataset: LeRobotDataset, settings: FieldSettings) -> None:
    """Warns in one line if a dataset's actions do not displace its state as the settings of an integrated field say.

    Args:
        dataset: The dataset.
        settings: The settings, whose dimensions the dataset has.
    """
    columns = read_whole_episodes(dataset)
    if columns is None:
        return
    actions, states, episodes = columns
    dims = list(settings.action_dims or range(actions.shape[1]))
    state_dims = list(settings.state_dims or range(len(dims)))
    if max(dims) >= actions.shape[1] or max(state_dims) >= states.shape[1]:
        return  # an error of its own, where the field is made
    scale, correlation = measured_scale(actions[:, dims], states[:, state_dims], episodes)
    factor = scale / settings.displacement_scale
    if correlation < _LEAST_CORRELATION:
        logger.warning(
            "field_over=integrated is for actions that displace %s, but the correlation of their running sums with its way "
            "is %.2f: are field_action_dims and field_state_dims right?",
            OBS_STATE,
            correlation,
        )
    elif not 1 / _LARGEST_FACTOR <= factor <= _LARGEST_FACTOR:
        logger.warning(
            "An action of 1 moves %s by about %.3g in this dataset, but field_displacement_scale is %.3g: set "
            "--policy.field_displacement_scale to what the robot's controller does with an action of 1.",
            OBS_STATE,
            scale,
            settings.displacement_scale,
        )
