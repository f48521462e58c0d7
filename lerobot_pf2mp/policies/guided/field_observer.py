# SPDX-License-Identifier: Apache-2.0
"""The part of a guided policy that adds the actions of training batches to the potential field."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from lerobot_pf2mp.policies.batch_keys import ACTION_IS_PAD, POTENTIAL_FIELD
from lerobot_pf2mp.policies.guided.action_kind import warn_about_actions
from lerobot_pf2mp.policies.guided.action_units import normalised_unit, normaliser_of, places_of_states
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.policies.guided.field_settings import INTEGRATED
from lerobot_pf2mp.policies.guided.integrated_actions import Integration, observe_integrated
from lerobot_pf2mp.training.gathering import gather_rows, is_main_process
from lerobot_pf2mp.training.run_dataset import find_dataset, run_episodes

if TYPE_CHECKING:
    from lerobot_pf2mp.policies.guided.fitted_field import GuidedPolicyConfig


class FieldObserver:
    """Adds the actions of training batches to the field in them, for one policy.

    Args:
        config: The policy's configuration.
        dataset_stats: Statistics of the training dataset; None at evaluation.
        dataset_meta: Its metadata; None at evaluation.
    """

    def __init__(
        self,
        config: GuidedPolicyConfig,
        dataset_stats: dict[str, dict[str, Any]] | None = None,
        dataset_meta: Any = None,
    ) -> None:
        self.config = config
        self.demonstrations: DemonstratedActions | None = None  # those of the last training batch
        self._dataset_id = _identify_dataset(dataset_stats, run_episodes(dataset_meta), config)
        self._unit, self._places = _units_of(dataset_stats, config)
        self._integration = _integration_of(dataset_stats, config)
        self._unchecked_meta = dataset_meta  # until its dataset's actions have been looked at

    def __getstate__(self) -> dict[str, Any]:
        """The state for copies and pickles of the policy: without the dataset."""
        return {**vars(self), "_unchecked_meta": None}

    def observe(self, batch: dict[str, Any]) -> None:
        """Adds the actions of a training batch to the field in that batch. A batch without a field changes nothing.

        With several processes, the field of each process gets the batches of all, because only the main process saves its
        field. They exchange B x (T x (4 A + 1) + 4 A + 16) bytes in every step, which is little compared with the gradients.

        Args:
            batch: A training batch that the policy's own preprocessor has made.
        """
        demonstrations = batch.get(POTENTIAL_FIELD)
        if demonstrations is None:
            return
        self.demonstrations = demonstrations
        if self._unchecked_meta is not None:
            self._check_dataset()
        is_integrated = self.config.field_over == INTEGRATED
        states = batch.get(OBS_STATE)
        if states is not None and states.ndim == 3:
            states = states[:, -1]
        has_places = self._places is not None and bool(self._places.numel())
        actions, is_pad, frames, episodes, states = gather_rows(
            batch[ACTION],
            batch.get(ACTION_IS_PAD),
            batch.get("index"),
            batch.get("episode_index"),
            states if is_integrated or has_places else None,
        )
        first = self.config.action_delta_indices[0]
        if is_integrated:
            self._observe_integrated(demonstrations, cast(Tensor, actions), is_pad, frames, episodes, states)
            return
        demonstrations.observe(
            cast(Tensor, actions),
            is_pad,
            None if frames is None else frames + first,
            episodes,
            settings=self.config.field_settings,
            unit=self._unit,
            dataset_id=self._dataset_id,
            n_past=-first,
            n_executed=self.config.n_action_steps,
            drop_n_last_frames=getattr(self.config, "drop_n_last_frames", 0) or 0,
            states=states,
            places=self._places,
        )

    def _observe_integrated(
        self,
        demonstrations: DemonstratedActions,
        actions: Tensor,
        is_pad: Tensor | None,
        frames: Tensor | None,
        episodes: Tensor | None,
        states: Tensor | None,
    ) -> None:
        """Adds the positions to which the displacements of a training batch lead. Arguments as gathered by `observe`."""
        if self._integration is None or states is None:
            raise ValueError(
                "field_over=integrated needs observation.state and the dataset's statistics in training, got a batch or a "
                "policy without them"
            )
        observe_integrated(
            demonstrations,
            self._integration,
            actions[:, -self.config.action_delta_indices[0] :],
            None if is_pad is None else is_pad[:, -self.config.action_delta_indices[0] :],
            frames,
            episodes,
            states,
            settings=self.config.field_settings,
            dataset_id=self._dataset_id,
            n_executed=self.config.n_action_steps,
            drop_n_last_frames=getattr(self.config, "drop_n_last_frames", 0) or 0,
        )

    @torch.compiler.disable
    def _check_dataset(self) -> None:
        """Warns if the field is over what the actions of the run's dataset are not. A streaming dataset is not looked at."""
        dataset, self._unchecked_meta = find_dataset(self._unchecked_meta), None
        if isinstance(dataset, LeRobotDataset) and is_main_process():
            warn_about_actions(dataset, self.config.field_settings)


def _units_of(
    dataset_stats: dict[str, dict[str, Any]] | None, config: GuidedPolicyConfig
) -> tuple[Tensor | None, Tensor | None]:
    """The `normalised_unit` and `places_of_states` of a dataset; None at evaluation."""
    if not dataset_stats or ACTION not in dataset_stats:
        return None, None
    normaliser, action_dim = normaliser_of(config, dataset_stats), config.action_feature.shape[0]
    return normalised_unit(normaliser, action_dim), places_of_states(normaliser, action_dim)


def _integration_of(
    dataset_stats: dict[str, dict[str, Any]] | None, config: GuidedPolicyConfig
) -> Integration | None:
    """How displacements of a dataset become positions; None at evaluation, or for a field over actions."""
    if config.field_over != INTEGRATED or not dataset_stats or ACTION not in dataset_stats:
        return None
    return Integration.of(
        normaliser_of(config, dataset_stats),
        config.field_settings,
        config.action_feature.shape[0],
        dataset_stats[ACTION],
    )


def _identify_dataset(
    dataset_stats: dict[str, dict[str, Any]] | None, episodes: list[int] | None, config: GuidedPolicyConfig
) -> bytes:
    """A digest of the action statistics, their normalisation and the run's episodes.

    LeRobot reloads the saved preprocessor both when a run resumes and when another run starts from a checkpoint. With the
    same digest, the saved sample continues. With another digest, its points belong to other data or have other units, so a
    new sample starts.
    """
    if not dataset_stats or ACTION not in dataset_stats:
        return b""
    digest = hashlib.sha256(str(config.normalization_mapping.get("ACTION")).encode())
    keys = (ACTION, OBS_STATE) if config.field_over == INTEGRATED else (ACTION,)
    for name, value in [item for key in keys for item in sorted(dataset_stats.get(key, {}).items())]:
        digest.update(name.encode())
        digest.update(np.asarray(value, dtype=np.float64).tobytes())
    if episodes is not None:
        digest.update(np.asarray(sorted(episodes), dtype=np.int64).tobytes())
    return digest.digest()
