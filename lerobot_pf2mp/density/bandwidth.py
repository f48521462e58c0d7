# SPDX-License-Identifier: Apache-2.0
"""How wide the kernels of a density should be."""

from __future__ import annotations

import math
from numbers import Real

import torch
from torch import Tensor

from lerobot_pf2mp.density.kernels import PAIRS_PER_BLOCK, log_kernels, log_sum_exp, mean

BANDWIDTH_RULES = ("scott", "silverman", "likelihood")
DEFAULT_BANDWIDTH = "likelihood"

# Smallest bandwidth, relative to the spread of the points. Float32 cannot resolve narrower kernels.
_SMALLEST_BANDWIDTH = 1e-3


def check_bandwidth(bandwidth: float, name: str = "bandwidth") -> None:
    """Checks that a bandwidth is finite and positive.

    Args:
        bandwidth: The bandwidth h.
        name: What the user calls it.

    Raises:
        ValueError: If it is not.
    """
    if not (bandwidth > 0 and math.isfinite(bandwidth)):
        raise ValueError(f"{name} must be finite and positive, got {bandwidth}")


def check_bandwidth_rule(rule: float | str, name: str = "bandwidth") -> None:
    """Checks that `select_bandwidth` can follow a rule.

    Args:
        rule: One of `BANDWIDTH_RULES`, or h itself.
        name: What the user calls it.

    Raises:
        ValueError: If it is neither.
    """
    if isinstance(rule, Real) and not isinstance(rule, bool):
        check_bandwidth(float(rule), name)
    elif rule not in BANDWIDTH_RULES:
        raise ValueError(f"{name} must be one of {BANDWIDTH_RULES} or a positive number, got {rule!r}")


def select_bandwidth(points: Tensor, rule: float | str = DEFAULT_BANDWIDTH) -> float:
    """The kernel bandwidth h for a set of points.

    Args:
        points: ``(M, D)`` points [normalised].
        rule: ``scott`` (M^(-1/(D+4)) times the points' standard deviation), ``silverman`` (the same times
            (4/(D+2))^(1/(D+4))), ``likelihood`` (maximises the leave-one-out log likelihood), or h itself. The kernel
            is isotropic, so the standard deviation is the root mean square over the dimensions that vary.

    Returns:
        The bandwidth h > 0 [normalised].

    Raises:
        ValueError: If the rule is unknown, or a number that is not finite and positive.
    """
    check_bandwidth_rule(rule)
    if not isinstance(rule, str):
        return float(rule)
    variance = points.cpu().double().var(dim=0, correction=0)  # (D,)
    varying = variance > 0
    if not bool(varying.any()):
        return _SMALLEST_BANDWIDTH  # all points are equal, so there is no spread to measure
    spread = variance[varying].mean().sqrt().item()
    count, dim = len(points), int(varying.sum())
    scott = spread * count ** (-1 / (dim + 4))
    if rule == "scott":
        return scott
    if rule == "silverman":
        return scott * (4 / (dim + 2)) ** (1 / (dim + 4))
    return _most_likely_bandwidth(
        points.cpu()[:, varying], smallest=_SMALLEST_BANDWIDTH * spread, largest=3 * spread
    )


def leave_one_out_log_likelihood(points: Tensor, bandwidth: float) -> float:
    """The mean of log p_{-i}(x_i) over the points, where p_{-i} is the density fitted without point i.

    Args:
        points: ``(M, D)`` distinct points, M >= 2.
        bandwidth: The kernel bandwidth h > 0.

    Returns:
        The mean leave-one-out log likelihood [nats].
    """
    count, dim = points.shape
    centred = points.float() - mean(points)
    rows_per_block = max(1, PAIRS_PER_BLOCK // count)
    total = 0.0
    for start in range(0, count, rows_per_block):
        exponents = log_kernels(centred[start : start + rows_per_block], centred, bandwidth)
        exponents.diagonal(offset=start).fill_(-math.inf)
        total += log_sum_exp(exponents).cpu().double().sum().item()
    log_normaliser = math.log(count - 1) + dim * (math.log(bandwidth) + 0.5 * math.log(2 * math.pi))
    return total / count - log_normaliser


@torch.no_grad()
def _most_likely_bandwidth(points: Tensor, smallest: float, largest: float, n_points: int = 3000) -> float:
    """The bandwidth with the largest leave-one-out likelihood, to 1 %, by golden-section search on log h.

    Duplicated points are dropped first: with them the likelihood is unbounded as h tends to 0. For more than
    `n_points` points an evenly spaced subset is used. The h found is then corrected for the number of points by
    Scott's rule, h ~ M^(-1/(D+4)).
    """
    distinct = torch.unique(points.float(), dim=0)
    if len(distinct) < 2:
        return smallest
    subset = distinct[torch.linspace(0, len(distinct) - 1, min(n_points, len(distinct))).long()]
    golden = (math.sqrt(5) - 1) / 2
    low, high = math.log(smallest), math.log(largest)
    left, right = high - golden * (high - low), low + golden * (high - low)
    at_left = leave_one_out_log_likelihood(subset, math.exp(left))
    at_right = leave_one_out_log_likelihood(subset, math.exp(right))
    while high - low > 0.01:
        if at_left > at_right:
            high, right, at_right = right, left, at_left
            left = high - golden * (high - low)
            at_left = leave_one_out_log_likelihood(subset, math.exp(left))
        else:
            low, left, at_left = left, right, at_right
            right = low + golden * (high - low)
            at_right = leave_one_out_log_likelihood(subset, math.exp(right))
    return math.exp((low + high) / 2) * (len(subset) / len(distinct)) ** (1 / (points.shape[1] + 4))
