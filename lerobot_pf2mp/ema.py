# SPDX-License-Identifier: Apache-2.0
"""An exponential moving average of a network's weights, kept in the policy's own state."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel

Tensors = tuple[Tensor, ...] | list[Tensor]


def averaged_copy(network: nn.Module, decay: float) -> AveragedModel:
    """A frozen copy of a network whose ``update_parameters(network)`` makes it the moving average.

    The count of updates is a buffer beside the averaged weights, so saving and loading the state resumes the average
    exactly.

    Args:
        network: The network to follow.
        decay: Largest decay for each update; update n uses min(decay, (1 + n) / (10 + n)).

    Returns:
        The averaged model; its ``module`` has the network's own type.
    """
    average = AveragedModel(network, multi_avg_fn=_moving_average(decay))
    return average.requires_grad_(False)


def _moving_average(decay: float) -> Callable[[Tensors, Tensors, Tensor | int], None]:
    @torch.no_grad()
    def update(averaged: Tensors, current: Tensors, n_averaged: Tensor | int) -> None:
        n = int(n_averaged)
        torch._foreach_lerp_(averaged, current, 1 - min(decay, (1 + n) / (10 + n)))

    return update
