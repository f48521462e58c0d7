# SPDX-License-Identifier: Apache-2.0
"""Gaussian kernels: their exponents and their sums."""

from __future__ import annotations

import math

import torch
from torch import Tensor

# Pairs (query, anchor) in memory at once: 2^20 float32 numbers, 4 MB, stay in a core's cache.
PAIRS_PER_BLOCK = 2**20

# Scaled coordinates are clamped to this. A sum of a thousand of its squares still fits into a float32.
_LARGEST = 5e17


def log_kernels(
    queries: Tensor, anchors: Tensor, bandwidth: float, periods: Tensor | None = None
) -> Tensor:
    """The exponents -|q - x|^2 / 2h^2 for all pairs, ``(Q, M)``.

    In dimensions with a period in `periods` ``(D,)``, differences are the short way round; 0 means no period.

    Differences are taken before squares. For queries many bandwidths from the origin, the expansion
    |q|^2 - 2 q.x + |x|^2 would lose the digits on which the softmax depends. Autocast is off: bfloat16 would lose them
    too.
    """
    with torch.autocast(device_type=queries.device.type, enabled=False):
        factor = 1 / (math.sqrt(2) * bandwidth)
        # Beyond the limit the squares would overflow, and the softmax with them. There the nearest anchor is unknown.
        scaled_queries = (queries * factor).clamp(-_LARGEST, _LARGEST)
        scaled_anchors = (anchors * factor).clamp(-_LARGEST, _LARGEST)
        squares = torch.zeros(len(queries), len(anchors), dtype=torch.float32, device=queries.device)
        scaled_periods = [0.0] * anchors.shape[1] if periods is None else (periods.double() * factor).tolist()
        for q, x, period in zip(
            scaled_queries.unbind(-1), scaled_anchors.unbind(-1), scaled_periods, strict=True
        ):
            difference = q.unsqueeze(1) - x.unsqueeze(0)  # (Q, M)
            if period > 0:
                difference = difference - period * torch.round(difference / period)
            squares.addcmul_(difference, difference)
        return squares.neg_()


def wrap(differences: Tensor, periods: Tensor | None) -> Tensor:
    """Differences ``(..., D)``, the short way round in dimensions with a period in `periods` ``(D,)``; 0 means none."""
    if periods is None:
        return differences
    turns = torch.round(differences / torch.where(periods > 0, periods, math.inf))
    return differences - periods * turns


def offsets_to_nearest(
    queries: Tensor, anchors: Tensor, bandwidth: float, periods: Tensor | None = None
) -> Tensor:
    """The offsets ``(Q, D)`` from queries ``(Q, D)`` to the nearest of anchors ``(M, D)``, in blocks of pairs."""
    # Centred first: float32 resolves differences between points, but not a large common offset.
    centre = anchors[0]
    centred = anchors - centre
    return torch.cat(
        [
            wrap(centred[log_kernels(block, centred, bandwidth, periods).argmax(dim=-1)] - block, periods)
            for block in (queries - centre).split(max(1, PAIRS_PER_BLOCK // len(anchors)))
        ]
    )


def mean(points: Tensor) -> Tensor:
    """The mean ``(D,)`` of points ``(M, D)`` as float32.

    It is computed in double precision on the CPU, because not every device has double precision.
    """
    return points.cpu().double().mean(dim=0).float().to(points.device)


def log_sum_exp(exponents: Tensor) -> Tensor:
    """The log-sum-exp over the last dimension, ``(Q, M)`` to ``(Q,)``.

    It is computed from the largest softmax weight, exp(max - lse). On a CPU torch.logsumexp is several times slower
    where exponents underflow (denormal numbers); torch.softmax is not.
    """
    largest_weight = torch.softmax(exponents, dim=-1).amax(dim=-1)
    return exponents.amax(dim=-1) - largest_weight.log()
