# SPDX-License-Identifier: Apache-2.0
"""An exponential moving average of a network's weights, kept in the policy's own state."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn


class MovingAverage(nn.Module):
    """A frozen copy of a network. Its weights are the moving average of the network's, and it stays in evaluation mode.

    The count of updates is a buffer beside the averaged weights, so saving and loading the state resumes the average
    exactly. The state has the keys of PyTorch's ``AveragedModel``, whose update takes many times longer.

    Args:
        network: The network whose weights are averaged.
        decay: Largest decay for each update; update n uses min(decay, (1 + n) / (10 + n)), and the first one takes the
            weights as they are.
    """

    n_averaged: Tensor

    def __init__(self, network: nn.Module, decay: float) -> None:
        super().__init__()
        self.module = copy.deepcopy(network).requires_grad_(False).eval()
        self.register_buffer("n_averaged", torch.tensor(0))
        self._decay = decay
        # Lists of the weights, because collecting them from the modules takes longer than averaging.
        self._averaged: list[Tensor] = []
        self._followed: list[Tensor] = []
        self._has_buffers = next(network.buffers(), None) is not None

    @torch.no_grad()
    def update_parameters(self, network: nn.Module) -> None:
        """Moves the average towards the weights of the network. Buffers are copied."""
        if not self._followed or next(network.parameters()) is not self._followed[0]:
            self._averaged = list(self.module.parameters())
            self._followed = list(network.parameters())
        n = int(self.n_averaged)
        if n == 0:
            torch._foreach_copy_(self._averaged, self._followed)
        else:
            decay = min(self._decay, (1 + n) / (10 + n))
            torch._foreach_lerp_(self._averaged, self._followed, 1 - decay)
        if self._has_buffers:
            for buffer, followed in zip(self.module.buffers(), network.buffers(), strict=True):
                buffer.copy_(followed)
        self.n_averaged += 1

    def train(self, mode: bool = True) -> MovingAverage:
        """Changes nothing: the average is only for evaluation."""
        return self
