# SPDX-License-Identifier: Apache-2.0
"""PF2MP: the Flow Matching Policy, guided at inference by a potential field (Section IV-B of the paper)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from lerobot_pf2mp.flow_matching import Guide
from lerobot_pf2mp.policies.fmp.modeling_fmp import FMPPolicy
from lerobot_pf2mp.policies.guided.modeling_guided import PotentialFieldGuidance
from lerobot_pf2mp.policies.pf2mp.configuration_pf2mp import PF2MPConfig


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
        self._guidance = PotentialFieldGuidance(config, dataset_stats)  # first, as FMPPolicy resets itself
        super().__init__(config, dataset_stats, dataset_meta, **kwargs)

    def reset(self) -> None:
        """Forgets past observations and planned actions; to be called when an episode begins."""
        super().reset()
        self._guidance.monitor.reset()

    @property
    def support(self) -> Tensor | None:
        """``(B, T)`` how far the last chunk's actions are inside the demonstrated region [nats], negative outside.

        The log density above the field's threshold; None before the first chunk and with ``on_unsupported=ignore``.
        """
        return self._guidance.monitor.support

    def forward(self, batch: dict[str, Any], reduction: str = "mean") -> tuple[Tensor, None]:
        """The loss of `FMPPolicy.forward`; in training, the batch's actions also go to the potential field."""
        if self.training and torch.is_grad_enabled():
            self._guidance.observe(batch)
        return super().forward(batch, reduction)

    def make_guide(self, batch: dict[str, Any]) -> Guide | None:
        """The configured guide over the field in the batch; None with ``guidance_scale=0``.

        Raises:
            ValueError: If the batch holds no field, or one over other dimensions.
        """
        return self._guidance.make_guide(batch, next(self.parameters()).device)

    def check_chunk(self, batch: dict[str, Any], chunk: Tensor) -> Tensor:
        """The actions ``(B, T, A)`` to execute of a planned chunk, see `on_unsupported`."""
        return self._guidance.check_chunk(batch, chunk)
