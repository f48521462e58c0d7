# SPDX-License-Identifier: Apache-2.0
"""Whether recorded actions are positions, which a potential field needs, or displacements, velocities or torques.

Positions go along with the state of the robot, displacements and velocities with its change to the next frame, and torques
with neither.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import OBS_STATE

from lerobot_pf2mp.policies.guided.displacement_scale import warn_unless_displacements
from lerobot_pf2mp.policies.guided.field_settings import INTEGRATED, FieldSettings
from lerobot_pf2mp.policies.guided.whole_episodes import read_whole_episodes

logger = logging.getLogger(__name__)

# Rank correlation with the state below which actions are no positions. Noise as large as the motion leaves positions 0.7.
_LEAST_CORRELATION = 0.5

# Actions may precede the state by at most this many frames.
_LARGEST_LEAD = 5

# A dimension is constant if this share of its values is the same.
_CONSTANT_SHARE = 0.99

_FEWEST_FRAMES = 10


@dataclass(frozen=True)
class ActionKind:
    """How actions go along with the state, as rank correlations, averaged over the dimensions that vary.

    Args:
        with_states: Correlation with the state, in [-1, 1].
        with_changes: Correlation with the state's change to the next frame, in [-1, 1].
    """

    with_states: float
    with_changes: float

    @property
    def are_positions(self) -> bool:
        """Whether the actions look like positions."""
        return self.with_states >= max(_LEAST_CORRELATION, self.with_changes)


def check_positions(actions: np.ndarray, states: np.ndarray, episodes: np.ndarray) -> ActionKind | None:
    """Compares actions with states.

    Ranks make single wrong values, units and offsets irrelevant. Commands precede the motion, so a dimension's correlations
    are the largest ones over leads of 0 to 5 frames. Each dimension counts as much as its larger correlation, so that the
    noise of a joint at rest does not count.

    Args:
        actions: ``(N, A)`` actions in any units, in the order of their frames.
        states: ``(N, A)`` states in any units, of the same dimensions.
        episodes: ``(N,)`` episode numbers.

    Returns:
        The correlations; None if they cannot be told, because too few frames follow each other or no dimension varies.
    """
    varying = [d for d in range(actions.shape[1]) if _varies(actions[:, d]) and _varies(states[:, d])]
    actions, states = actions[:, varying], states[:, varying]
    found = [_correlations(actions, states, episodes, lead) for lead in range(_LARGEST_LEAD + 1)]
    by_lead = [correlations for correlations in found if correlations is not None]
    if not varying or not by_lead:
        return None
    correlations = np.max(by_lead, axis=0)  # (V, 2)
    weights = np.maximum(np.abs(correlations).max(axis=1), 1e-6)
    with_states, with_changes = np.average(correlations, axis=0, weights=weights)
    return ActionKind(float(with_states), float(with_changes))


def action_kind_of(dataset: LeRobotDataset, dims: Sequence[int] | None) -> ActionKind | None:
    """`check_positions` for a dataset, on up to 20 000 frames of whole episodes spread over it.

    Args:
        dataset: The dataset, with the episodes that a field is fitted to.
        dims: Action dimensions that the field covers; None for all.

    Returns:
        The correlations; None if they cannot be told, or ``observation.state`` has other dimensions than the action.
    """
    columns = read_whole_episodes(dataset)
    if columns is None or columns[0].shape[1] != columns[1].shape[1]:
        return None
    actions, states, episodes = columns
    chosen = list(range(actions.shape[1]) if dims is None else dims)
    return check_positions(actions[:, chosen], states[:, chosen], episodes)


def warn_about_actions(dataset: LeRobotDataset, settings: FieldSettings) -> None:
    """Warns in one line if a dataset's actions are not what a field is over.

    Args:
        dataset: The dataset, with the episodes that the field is fitted to.
        settings: The settings of the field.
    """
    if settings.over == INTEGRATED:
        warn_unless_displacements(dataset, settings)
    else:
        warn_unless_positions(dataset, settings.action_dims)


def warn_unless_positions(dataset: LeRobotDataset, dims: Sequence[int] | None) -> None:
    """Warns in one line if a dataset's actions do not look like positions. A field over them says nothing about obstacles.

    Arguments as for `action_kind_of`.
    """
    kind = action_kind_of(dataset, dims)
    if kind is not None and not kind.are_positions:
        logger.warning(
            "The dataset's actions do not look like absolute positions: their rank correlation is %.2f with %s, and %.2f "
            "with its change to the next frame. Displacements, velocities and torques are the same everywhere, so a "
            "potential field over them says nothing about obstacles. Record the positions to which the robot is sent as "
            "actions, or, if they are displacements of the end effector, train with --policy.field_over=integrated.",
            kind.with_states,
            OBS_STATE,
            kind.with_changes,
        )


def _correlations(
    actions: np.ndarray, states: np.ndarray, episodes: np.ndarray, lead: int
) -> np.ndarray | None:
    """``(A, 2)`` correlations with the state `lead` frames later, and with its change from there to the next frame."""
    n_pairs = len(actions) - lead - 1
    follow = episodes[: max(n_pairs, 0)] == episodes[lead + 1 :]
    if follow.sum() < _FEWEST_FRAMES:
        return None
    actions, now, later = actions[:n_pairs][follow], states[lead:-1][follow], states[lead + 1 :][follow]
    rows = []
    for action, state, change in zip(actions.T, now.T, (later - now).T, strict=True):
        ranks = _ranks(action)
        rows.append([_cosine(ranks, _ranks(state)), _cosine(ranks, _ranks(change))])
    return np.array(rows)


def _varies(values: np.ndarray) -> bool:
    """Whether values are more than one constant and single wrong values."""
    _, counts = np.unique(values, return_counts=True)
    return bool(counts.max(initial=0) < _CONSTANT_SHARE * len(values))


def _ranks(values: np.ndarray) -> np.ndarray:
    """Centred ranks; equal values share their mean rank."""
    _, number, counts = np.unique(values, return_inverse=True, return_counts=True)
    ranks = (np.cumsum(counts) - 0.5 * counts)[number]
    return ranks - ranks.mean()


def _cosine(first: np.ndarray, second: np.ndarray) -> float:
    norms = float(np.linalg.norm(first) * np.linalg.norm(second))
    return float(first @ second) / norms if norms > 0 else 0.0
