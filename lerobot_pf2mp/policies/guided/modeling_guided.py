# SPDX-License-Identifier: Apache-2.0
"""How a policy learns which actions were demonstrated, and gets a guide from their potential field."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_pf2mp.flow_matching import Guide
from lerobot_pf2mp.guidance import make_guide
from lerobot_pf2mp.policies.guided.potential_field_step import POTENTIAL_FIELD, DemonstratedActions
from lerobot_pf2mp.policies.guided.support_monitor import SupportMonitor
from lerobot_pf2mp.potential_field import PotentialField
from lerobot_pf2mp.training.gathering import gather_rows

if TYPE_CHECKING:
    from lerobot_pf2mp.policies.dppf.configuration_dppf import DPPFConfig
    from lerobot_pf2mp.policies.pf2mp.configuration_pf2mp import PF2MPConfig

    type GuidedPolicyConfig = PF2MPConfig | DPPFConfig


class PotentialFieldGuidance:
    """The potential field as one policy uses it.

    Args:
        config: The policy's configuration.
        dataset_stats: Statistics of the training dataset; None at evaluation.
    """

    def __init__(
        self, config: GuidedPolicyConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
    ) -> None:
        self.config = config
        self._dataset_id = _identify_dataset(dataset_stats, config)
        self.demonstrations: DemonstratedActions | None = None  # those of the last training batch
        self.monitor = SupportMonitor(config.on_unsupported, config.field_action_dims)

    def observe(self, batch: dict[str, Any]) -> None:
        """Shows a training batch's actions to the field that the preprocessor put into it; without one, does nothing.

        With several processes each is shown the batches of all of them: only the main one saves its field. For that they
        exchange B x T x (4 A + 1) bytes in every step, little beside the gradients.
        """
        demonstrations = batch.get(POTENTIAL_FIELD)
        if demonstrations is None:
            return
        self.demonstrations = demonstrations
        actions, is_pad, frames = gather_rows(
            batch[ACTION], batch.get(f"{ACTION}_is_pad"), batch.get("index")
        )
        demonstrations.observe(
            cast(Tensor, actions),
            is_pad,
            None if frames is None else frames + (1 - self.config.n_obs_steps),
            settings=self.config.field_settings,
            dataset_id=self._dataset_id,
        )

    @torch.compiler.disable  # the field may have to be fitted first
    def make_guide(self, batch: dict[str, Any], device: torch.device) -> Guide | None:
        """The configured guide over the batch's field; None with a guidance scale of 0.

        Args:
            batch: A batch that the policy's own preprocessor has made.
            device: Where the guide is used.

        Raises:
            ValueError: If the batch holds no field, or one over other dimensions.
        """
        config = self.config
        if config.guidance_scale == 0:
            return None
        field = fitted_field(batch.get(POTENTIAL_FIELD), config, device)
        return make_guide(
            field.prepared,
            config.guidance_scale,
            config.guidance_integrator,
            config.field_action_dims,
            config.guidance_point,
        )

    def check_chunk(self, batch: dict[str, Any], chunk: Tensor) -> Tensor:
        """The actions ``(B, T, A)`` to execute, after `SupportMonitor` has looked at them.

        Args:
            batch: A batch that the policy's own preprocessor has made.
            chunk: ``(B, T, A)`` planned actions [normalised].

        Raises:
            ValueError: If the batch holds no field, or one over other dimensions.
        """
        if self.config.on_unsupported == "ignore":
            return chunk
        return self.monitor(chunk, fitted_field(batch.get(POTENTIAL_FIELD), self.config, chunk.device))


class GuidedPolicy:
    """A policy guided by a potential field; to be mixed into the unguided one before its own class.

    The weights are those of the unguided policy, and with ``guidance_scale=0`` so are its actions.

    Args:
        config: The policy's configuration.
        dataset_stats: Statistics of the training dataset; None at evaluation.
        dataset_meta: Its metadata (not used).
    """

    def __init__(
        self,
        config: GuidedPolicyConfig,
        dataset_stats: dict[str, dict[str, Any]] | None = None,
        dataset_meta: Any = None,
        **kwargs: Any,
    ) -> None:
        # Before the policy's own set-up, which ends in `reset`.
        self._guidance = PotentialFieldGuidance(config, dataset_stats)
        super().__init__(config, **kwargs)  # type: ignore[call-arg]

    def reset(self) -> None:
        """Forgets past observations and planned actions; to be called when an episode begins."""
        super().reset()  # type: ignore[misc]
        self._guidance.monitor.reset()

    @property
    def support(self) -> Tensor | None:
        """``(B, T)`` how far the last chunk's actions are inside the demonstrated region [nats], negative outside.

        The log density above the field's threshold; None before the first chunk and with ``on_unsupported=ignore``.
        """
        return self._guidance.monitor.support

    def forward(self, batch: dict[str, Any], *args: Any, **kwargs: Any) -> tuple[Tensor, None]:
        """The loss of the unguided policy; in training, the batch's actions also go to the potential field."""
        if self.training and torch.is_grad_enabled():  # type: ignore[attr-defined]
            self._guidance.observe(batch)
        return super().forward(batch, *args, **kwargs)  # type: ignore[misc]

    def make_guide(self, batch: dict[str, Any]) -> Guide | None:
        """The configured guide over the field in the batch; None with ``guidance_scale=0``.

        Raises:
            ValueError: If the batch holds no field, or one over other dimensions.
        """
        return self._guidance.make_guide(batch, next(self.parameters()).device)  # type: ignore[attr-defined]

    def check_chunk(self, batch: dict[str, Any], chunk: Tensor) -> Tensor:
        """The actions ``(B, T, A)`` to execute of a planned chunk, see `on_unsupported`.

        Raises:
            ValueError: If they are looked at, and the batch holds no field, or one over other dimensions.
        """
        return self._guidance.check_chunk(batch, chunk)


def fitted_field(
    demonstrations: object, config: GuidedPolicyConfig, device: torch.device | str = "cpu"
) -> PotentialField:
    """The potential field that a policy is guided by.

    Args:
        demonstrations: What the policy's preprocessor puts into a batch.
        config: The policy's configuration.
        device: Where the field is used.

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


def _identify_dataset(dataset_stats: dict[str, dict[str, Any]] | None, config: GuidedPolicyConfig) -> bytes:
    """A digest of the action statistics and their normalisation, by which resuming and fine-tuning differ.

    LeRobot reloads the saved preprocessor in both cases. With the same digest the sample goes on where it was; with
    another one its points belong to other data, or to other units, and the sample starts afresh.
    """
    if not dataset_stats or ACTION not in dataset_stats:
        return b""
    digest = hashlib.sha256(str(config.normalization_mapping.get("ACTION")).encode())
    for name, value in sorted(dataset_stats[ACTION].items()):
        digest.update(name.encode())
        digest.update(np.asarray(value, dtype=np.float64).tobytes())
    return digest.digest()
