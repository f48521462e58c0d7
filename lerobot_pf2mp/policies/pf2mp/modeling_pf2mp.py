# SPDX-License-Identifier: Apache-2.0
"""PF2MP: the Flow Matching Policy, guided at inference by a potential field (Section IV-B of the paper)."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_pf2mp.flow_matching import Guide
from lerobot_pf2mp.guidance import make_guide
from lerobot_pf2mp.policies.fmp.modeling_fmp import ACTION_IS_PAD, FMPPolicy
from lerobot_pf2mp.policies.pf2mp.configuration_pf2mp import PF2MPConfig
from lerobot_pf2mp.potential_field_processor import POTENTIAL_FIELD, DemonstratedActions


class PF2MPPolicy(FMPPolicy):
    """Differs from `FMPPolicy` by a guide in the integration, and by showing the field what it learns from.

    Args:
        config: The policy's configuration.
        dataset_stats: Statistics of the training dataset; None at evaluation.
        dataset_meta: Its metadata (not used).
    """

    config_class = PF2MPConfig
    name = "pf2mp"
    config: PF2MPConfig

    def __init__(
        self,
        config: PF2MPConfig,
        dataset_stats: dict[str, dict[str, Any]] | None = None,
        dataset_meta: Any = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(config, dataset_stats, dataset_meta, **kwargs)
        self._dataset_id = _identify_dataset(dataset_stats, config)

    def forward(self, batch: dict[str, Any], reduction: str = "mean") -> tuple[Tensor, None]:
        """The loss of `FMPPolicy.forward`; in training, the batch's actions also go to the potential field."""
        demonstrations = batch.get(POTENTIAL_FIELD)
        if demonstrations is not None and self.training and torch.is_grad_enabled():
            frames = batch.get("index")
            demonstrations.observe(
                batch[ACTION],
                batch.get(ACTION_IS_PAD),
                None if frames is None else frames + (1 - self.config.n_obs_steps),
                settings=self.config.field_settings,
                dataset_id=self._dataset_id,
            )
        return super().forward(batch, reduction)

    def _make_guide(self, batch: dict[str, Any]) -> Guide | None:
        if self.config.guidance_scale == 0:
            return None
        demonstrations = batch.get(POTENTIAL_FIELD)
        if not isinstance(demonstrations, DemonstratedActions):
            raise ValueError(
                f"guidance needs the potential field, which the policy's own preprocessor puts under {POTENTIAL_FIELD!r}; "
                "got a batch without it. Load the preprocessor from the checkpoint, or set guidance_scale=0"
            )
        field = demonstrations.field(self.config.field_settings, next(self.parameters()).device)
        dims = self.config.field_action_dims
        n_dims = self.config.action_feature.shape[0] if dims is None else len(dims)
        if field.dim != n_dims:
            raise ValueError(
                f"the potential field must cover {n_dims} action dimensions, got a field over {field.dim}: it belongs to "
                "another policy"
            )
        return make_guide(field, self.config.guidance_scale, self.config.guidance_integrator, dims)


def _identify_dataset(dataset_stats: dict[str, dict[str, Any]] | None, config: PF2MPConfig) -> bytes:
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
