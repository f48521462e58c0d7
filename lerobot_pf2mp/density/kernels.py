# SPDX-License-Identifier: Apache-2.0
"""Gaussian kernels: their exponents and their sums.

A dimension may be an angle: with a period P > 0, x and x + P are the same there. Of the images of a point only the one
nearest to the query counts.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor

# Pairs (query, anchor) in memory at once: 2^20 float32 numbers, 4 MB, stay in a core's cache.
PAIRS_PER_BLOCK = 2**20

# Scaled coordinates are clamped to this. A sum of a thousand of its squares still fits into a float32.
_LARGEST = 5e17


def log_kernels(queries: Tensor, anchors: Tensor, bandwidth: float, periods: Tensor | None = None) -> Tensor:
    """The exponents -|q - x|^2 / 2h^2 for all pairs, ``(Q, M)``.

    `periods` ``(D,)`` holds the periods of angles, and 0 for other dimensions; None stands for zeros.

    Differences are taken before squares. For queries many bandwidths from the origin, the expansion
    |q|^2 - 2 q.x + |x|^2 would lose the digits on which the softmax depends. Autocast is off: bfloat16 would lose them
    too.
    """
    with torch.autocast(device_type=queries.device.type, enabled=False):
        factor = 1 / (math.sqrt(2) * bandwidth)
        squares = torch.zeros(len(queries), len(anchors), dtype=torch.float32, device=queries.device)
        if periods is not None:
            for difference in differences(queries, anchors, periods):
                # The differences are scaled, not the coordinates: this costs no digits of close ones.
                scaled = (difference * factor).clamp_(-_LARGEST, _LARGEST)
                squares.addcmul_(scaled, scaled)
            return squares.neg_()
        # Beyond the limit the squares would overflow, and the softmax with them. There the nearest anchor is unknown.
        scaled_queries = (queries * factor).clamp(-_LARGEST, _LARGEST)
        scaled_anchors = (anchors * factor).clamp(-_LARGEST, _LARGEST)
        for q, x in zip(scaled_queries.unbind(-1), scaled_anchors.unbind(-1), strict=True):
            difference = q.unsqueeze(1) - x.unsqueeze(0)  # (Q, M)
            squares.addcmul_(difference, difference)
        return squares.neg_()


def offsets_to_nearest(
    queries: Tensor, anchors: Tensor, bandwidth: float, periods: Tensor | None = None
) -> Tensor:
    """The offsets ``(Q, D)`` from queries ``(Q, D)`` to the nearest of anchors ``(M, D)``, in blocks of pairs.

    `periods` are those of `log_kernels`.
    """
    # Centred first: float32 resolves differences between points, but not a large common offset.
    centre = without_angles(anchors[0], periods)
    centred = anchors - centre
    return torch.cat(
        [
            offsets_between(
                block, centred[log_kernels(block, centred, bandwidth, periods).argmax(dim=-1)], periods
            )
            for block in (queries - centre).split(max(1, PAIRS_PER_BLOCK // len(anchors)))
        ]
    )


def checked_periods(periods: Tensor | None, dim: int) -> Tensor | None:
    """The periods ``(D,)`` as float32, or None if no dimension is an angle.

    Raises:
        ValueError: If they are not `dim` finite numbers of at least 0.
    """
    if periods is None or torch.compiler.is_compiling():  # to read values would break a compiled graph
        return periods
    if periods.shape != (dim,):
        raise ValueError(f"periods must have shape ({dim},), got {tuple(periods.shape)}")
    if not bool(((periods >= 0) & periods.isfinite()).all()):
        raise ValueError(f"periods must be finite and at least 0, got {periods.tolist()}")
    return periods.detach().float().contiguous() if bool((periods > 0).any()) else None


def without_angles(centre: Tensor, periods: Tensor | None) -> Tensor:
    """The centre ``(D,)`` to subtract from points: zero for angles, which `wrap` keeps small already."""
    return centre if periods is None else torch.where(periods > 0, 0.0, centre)


def wrap(points: Tensor, periods: Tensor) -> Tensor:
    """Points ``(..., D)`` with each angle brought into [-P/2, P/2]. It costs no digits."""
    moduli = torch.where(periods > 0, periods, torch.inf)  # (D,)
    largest = torch.finfo(points.dtype).max
    rest = torch.fmod(points.clamp(-largest, largest), moduli)
    wrapped = rest - torch.copysign(moduli, rest).masked_fill_(rest.abs() <= moduli / 2, 0.0)
    return torch.where(periods > 0, wrapped, points)


def differences(queries: Tensor, anchors: Tensor, periods: Tensor) -> Iterator[Tensor]:
    """The differences x - q of all pairs, ``(Q, M)`` for each dimension; those of angles lie in [-P/2, P/2]."""
    for q, x, period in zip(
        wrap(queries, periods).unbind(-1), wrap(anchors, periods).unbind(-1), periods.unbind(), strict=True
    ):
        yield _difference(q.unsqueeze(1), x.unsqueeze(0), period)


def offsets_between(queries: Tensor, points: Tensor, periods: Tensor | None) -> Tensor:
    """The offsets x - q ``(Q, D)`` from queries ``(Q, D)`` to points ``(Q, D)``; those of angles lie in [-P/2, P/2]."""
    if periods is None:
        return points - queries
    return _difference(wrap(queries, periods), wrap(points, periods), periods)


def _difference(q: Tensor, x: Tensor, period: Tensor) -> Tensor:
    """The difference x - q, for angles in [-P/2, P/2] to the nearest image of x.

    Half a period is taken from each of x and q: their difference is close to a whole period where the images are close
    to each other, so it would lose their digits.
    """
    half = torch.where(period > 0, period / 2, torch.inf)
    difference = x - q
    shift = torch.copysign(half, difference).masked_fill_(difference.abs() <= half, 0.0)
    return (x - shift) - (q + shift)


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
