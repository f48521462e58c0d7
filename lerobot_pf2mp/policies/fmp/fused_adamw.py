# SPDX-License-Identifier: Apache-2.0
"""AdamW in PyTorch's fused form."""

from dataclasses import asdict, dataclass

import torch
from lerobot.optim import AdamWConfig, OptimizerConfig
from lerobot.optim.optimizers import OptimizerParams


@OptimizerConfig.register_subclass("fused_adamw")
@dataclass
class FusedAdamWConfig(AdamWConfig):
    """LeRobot's ``adamw``, but each weight is updated in one pass instead of a dozen operations. Equal up to rounding."""

    def build(self, params: OptimizerParams) -> torch.optim.Optimizer:
        """The optimiser of these weights."""
        options = asdict(self)
        del options["grad_clip_norm"]  # LeRobot applies it itself
        return torch.optim.AdamW(params, **options, fused=True)
