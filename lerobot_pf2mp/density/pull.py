# SPDX-License-Identifier: Apache-2.0
"""Where a density pulls: fully where it is low, not at all where it is high.

With l = log p and two log densities full <= none:

    weight     w(l)   = clamp((none - l) / (none - full), 0, 1); if both are equal, 1 for l < none and else 0
    integral   psi(l) = l up to full, rising ever less from there on, and (full + none) / 2 from none on

w is the slope of psi, so that w(log p) grad log p is the gradient of psi(log p). With one log density tau for both, psi(l)
is min(l, tau).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

_TINY = torch.finfo(torch.float32).tiny

# Differences of such log densities, and of those that are computed, fit into a float32.
_LARGEST = 1e30


@dataclass(frozen=True)
class Pull:
    """The weight w(l) with which a density pulls where its logarithm is l.

    Args:
        log_full: Log density up to which it pulls fully [nats].
        log_none: Log density from which on it does not pull [nats]. Both infinite: it pulls fully everywhere.

    Raises:
        ValueError: If they are neither both infinite nor finite, at most 1e30 in size and in this order.
    """

    log_full: float = math.inf
    log_none: float = math.inf

    def __post_init__(self) -> None:
        is_ordered = -_LARGEST <= self.log_full <= self.log_none <= _LARGEST
        if not (is_ordered or self.is_everywhere):
            raise ValueError(
                "log_full_pull and log_no_pull must both be inf, or finite with log_full_pull <= log_no_pull, got "
                f"{self.log_full} and {self.log_none}"
            )

    @property
    def is_everywhere(self) -> bool:
        """Whether the weight is 1 everywhere."""
        return self.log_full == self.log_none == math.inf

    @property
    def width(self) -> float:
        """The divisor none - full of the weight, positive and finite also where the weight is a step or 1 everywhere."""
        return 1.0 if self.is_everywhere else max(self.log_none - self.log_full, _TINY)

    def weight(self, log_density: Tensor) -> Tensor:
        """The weights w, ``(...)`` in [0, 1], of log densities ``(...)`` [nats]."""
        return ((self.log_none - log_density) / self.width).clamp(0, 1)

    def integral(self, log_density: Tensor) -> Tensor:
        """The integrals psi, ``(...)`` [nats], of log densities ``(...)`` [nats]."""
        if self.is_everywhere:
            return log_density
        above = (log_density - self.log_full).clamp(0, self.log_none - self.log_full)
        return log_density.clamp(max=self.log_full) + above * (1 - above / (2 * self.width))

    def weighted(self, vectors: Tensor, log_density: Tensor) -> Tensor:
        """Vectors ``(..., D)``, each times the weight at its log density ``(...)`` [nats]."""
        return vectors if self.is_everywhere else vectors * self.weight(log_density).unsqueeze(-1)


EVERYWHERE = Pull()
