# SPDX-License-Identifier: Apache-2.0
"""The part of a guided policy that uses the potential field.

It adds the actions of training batches to the field, makes the guide from the field, and checks planned actions with it.
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_pf2mp.flow_matching import Guide
from lerobot_pf2mp.guidance import GuidanceSettings, make_guide
from lerobot_pf2mp.policies.batch_keys import ACTION_IS_PAD, POTENTIAL_FIELD
from lerobot_pf2mp.policies.guided.action_kind import warn_unless_positions
from lerobot_pf2mp.policies.guided.action_units import normalised_unit, normaliser_of
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.policies.guided.support_monitor import SupportMonitor
from lerobot_pf2mp.potential_field import PotentialField
from lerobot_pf2mp.training.gathering import gather_rows, is_main_process
from lerobot_pf2mp.training.run_dataset import find_dataset, run_episodes

if TYPE_CHECKING:
    from lerobot_pf2mp.policies.dppf.configuration_dppf import DPPFConfig
    from lerobot_pf2mp.policies.pf2mp.configuration_pf2mp import PF2MPConfig

    type GuidedPolicyConfig = PF2MPConfig | DPPFConfig


class FieldGuidance:
    """Guidance by a potential field, held by one policy.

    The field itself is in the batch. The policy's preprocessor puts it there (see `potential_field_step`).

    Args:
        config: The policy's configuration. Its options may change between two calls.
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
        self._dataset_id = _identify_dataset(dataset_stats, run_episodes(dataset_meta), config)
        self._unit = _unit_of_actions(dataset_stats, config)
        self._unchecked_meta = dataset_meta  # until its dataset's actions have been looked at
        self.demonstrations: DemonstratedActions | None = None  # those of the last training batch
        self._monitor = SupportMonitor(config.on_unsupported, config.field_action_dims)
        self._made: tuple[PotentialField, GuidanceSettings, Guide | None] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """The state for copies and pickles of the policy. A copy makes its own guide."""
        return {**vars(self), "_made": None, "_unchecked_meta": None}

    def reset(self) -> None:
        """Forgets the last chunk. Must be called at the start of an episode."""
        self._monitor.reset()

    @property
    def support(self) -> Tensor | None:
        """``(B, T)`` log density of the last chunk's actions above the field's threshold [nats], negative outside.

        None before the first chunk and with ``on_unsupported=ignore``.
        """
        return self._monitor.support

    def observe(self, batch: dict[str, Any]) -> None:
        """Adds the actions of a training batch to the field in that batch. A batch without a field changes nothing.

        With several processes, the field of each process gets the batches of all, because only the main process saves its
        field. They exchange B x (T x (4 A + 1) + 16) bytes in every step, which is little compared with the gradients.

        Args:
            batch: A training batch that the policy's own preprocessor has made.
        """
        demonstrations = batch.get(POTENTIAL_FIELD)
        if demonstrations is None:
            return
        self.demonstrations = demonstrations
        if self._unchecked_meta is not None:
            self._check_dataset()
        actions, is_pad, frames, episodes = gather_rows(
            batch[ACTION], batch.get(ACTION_IS_PAD), batch.get("index"), batch.get("episode_index")
        )
        demonstrations.observe(
            cast(Tensor, actions),
            is_pad,
            None if frames is None else frames + self.config.action_delta_indices[0],
            episodes,
            settings=self.config.field_settings,
            unit=self._unit,
            dataset_id=self._dataset_id,
        )

    @torch.compiler.disable
    def _check_dataset(self) -> None:
        """Warns if the actions of the run's dataset are no positions. A streaming dataset is not looked at."""
        dataset, self._unchecked_meta = find_dataset(self._unchecked_meta), None
        if isinstance(dataset, LeRobotDataset) and is_main_process():
            warn_unless_positions(dataset, self.config.field_action_dims)

    @torch.compiler.disable  # the field may have to be fitted first
    def guide(self, batch: dict[str, Any], device: torch.device) -> Guide | None:
        """The configured guide over the batch's field; None with a guidance scale of 0.

        A guide is made once for a field and settings. It is kept until one of them changes.

        Args:
            batch: A batch that the policy's own preprocessor has made.
            device: The device of the actions to be guided.

        Raises:
            ValueError: If the batch holds no field, or one over other dimensions.
        """
        settings = self.config.guidance_settings
        if settings.scale == 0:
            return None
        field, made = fitted_field(batch.get(POTENTIAL_FIELD), self.config, device), self._made
        if made is None or made[0] is not field or made[1] != settings:
            made = self._made = field, settings, make_guide(field.prepared, settings)
        return made[2]

    def check(self, batch: dict[str, Any], chunk: Tensor) -> Tensor:
        """The actions ``(B, T, A)`` to execute of a planned chunk, see ``on_unsupported`` in `GuidedConfig`.

        Args:
            batch: A batch that the policy's own preprocessor has made.
            chunk: ``(B, T, A)`` planned actions [normalised].

        Raises:
            ValueError: If actions are checked, and the batch holds no field, or one over other dimensions.
        """
        return chunk if self.config.on_unsupported == "ignore" else self._monitored(batch, chunk)

    @torch.compiler.disable  # the field may have to be fitted first
    def _monitored(self, batch: dict[str, Any], chunk: Tensor) -> Tensor:
        self._monitor.on_unsupported = self.config.on_unsupported
        self._monitor.action_dims = self.config.field_action_dims
        return self._monitor(chunk, fitted_field(batch.get(POTENTIAL_FIELD), self.config, chunk.device))


def fitted_field(
    demonstrations: object, config: GuidedPolicyConfig, device: torch.device | str = "cpu"
) -> PotentialField:
    """The potential field that guides a policy.

    Args:
        demonstrations: The object that the policy's preprocessor puts into a batch under `POTENTIAL_FIELD`.
        config: The policy's configuration.
        device: The device on which the field is used.

    Raises:
        ValueError: If there is no field, it is not fitted, or it covers other dimensions than the policy's.
    """
    if not isinstance(demonstrations, DemonstratedActions):
        raise ValueError(
            f"guidance needs the potential field, which the policy's own preprocessor puts under {POTENTIAL_FIELD!r}; "
            "got a batch without it. Load the preprocessor from the checkpoint, or set guidance_scale=0"
        )
    field = demonstrations.field(config.field_settings, device)
    dims = config.field_action_dims
    n_dims = config.action_feature.shape[0] if dims is None else len(dims)
    if field.dim != n_dims:
        raise ValueError(
            f"the potential field must cover {n_dims} action dimensions, got a field over {field.dim}: it belongs to "
            "another policy"
        )
    return field


def _unit_of_actions(
    dataset_stats: dict[str, dict[str, Any]] | None, config: GuidedPolicyConfig
) -> Tensor | None:
    if not dataset_stats or ACTION not in dataset_stats:
        return None
    return normalised_unit(normaliser_of(config, dataset_stats), config.action_feature.shape[0])


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
    for name, value in sorted(dataset_stats[ACTION].items()):
        digest.update(name.encode())
        digest.update(np.asarray(value, dtype=np.float64).tobytes())
    if episodes is not None:
        digest.update(np.asarray(sorted(episodes), dtype=np.int64).tobytes())
    return digest.digest()
