# SPDX-License-Identifier: Apache-2.0
"""How wide the kernels of a density should be."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from numbers import Real

import torch
from torch import Tensor

from lerobot_pf2mp.density.held_out import HeldOut, robust_spread
from lerobot_pf2mp.density.kernels import PAIRS_PER_BLOCK, log_kernels, log_sum_exp, mean

BANDWIDTH_RULES = ("scott", "silverman", "likelihood")
DEFAULT_BANDWIDTH = "likelihood"

# Smallest bandwidth, relative to the spread of the points. Float32 cannot resolve narrower kernels.
_SMALLEST_BANDWIDTH = 1e-3

# Bandwidths whose squares and logarithms are ordinary float32 numbers.
_BANDWIDTH_RANGE = (1e-12, 1e12)

# Number of points that decide on the bandwidth: as many as these products of pairs and dimensions allow, within bounds.
_WORK, _FEWEST_JUDGED, _MOST_JUDGED = 1e8, 500, 2000

# Share of the points that do not count when episodes judge each other: of the least likely ones, which bounds the
# influence of wrong values and of an episode that went where no other did, and of the likeliest ones, which bounds that
# of a place where all episodes rest.
_LEFT_OUT_SHARE = 0.05

# Of one episode's points that are this many bandwidths apart or less, one counts.
_REST = 0.25


def check_bandwidth(bandwidth: float, name: str = "bandwidth") -> None:
    """Checks that a bandwidth is finite and positive, and not so extreme that its square is neither.

    Args:
        bandwidth: The bandwidth h.
        name: What the user calls it.

    Raises:
        ValueError: If it is not.
    """
    if not (bandwidth > 0 and math.isfinite(bandwidth)):
        raise ValueError(f"{name} must be finite and positive, got {bandwidth}")
    smallest, largest = _BANDWIDTH_RANGE
    if not smallest <= bandwidth <= largest:
        raise ValueError(f"{name} must lie between {smallest:g} and {largest:g}, got {bandwidth}")


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


def select_bandwidth(
    points: Tensor,
    rule: float | str = DEFAULT_BANDWIDTH,
    *,
    groups: Tensor | None = None,
    periods: Tensor | None = None,
) -> float:
    """The kernel bandwidth h for a set of points.

    Args:
        points: ``(M, D)`` points [normalised].
        rule: ``scott`` (M^(-1/(D+4)) times the points' standard deviation), ``silverman`` (the same times
            (4/(D+2))^(1/(D+4))), ``likelihood`` (maximises the likelihood of the points, each judged by the others), or
            h itself. The kernel is isotropic, so the standard deviation is the root mean square over the dimensions that
            vary.
        groups: ``(M,)`` int64, see `group_numbers`. With them ``likelihood`` judges each point by other groups, not by
            all other points, see `_most_likely_across_groups`.
        periods: ``(D,)`` periods of angles [normalised], 0 for other dimensions; used with `groups`.

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
    if groups is not None:
        varying_periods = None if periods is None else periods[varying]
        held_out = HeldOut(points.cpu()[:, varying].float(), groups, varying_periods)
        if held_out.can_judge:
            return _most_likely_across_groups(held_out)
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
    h = _maximise(
        lambda bandwidth: leave_one_out_log_likelihood(subset, bandwidth), smallest=smallest, largest=largest
    )
    return h * (len(subset) / len(distinct)) ** (1 / (points.shape[1] + 4))


@torch.no_grad()
def _most_likely_across_groups(held_out: HeldOut) -> float:
    """The bandwidth with the largest mean log density of points, each judged by other episodes.

    The least likely and the likeliest `_LEFT_OUT_SHARE` of the points do not count. Points of an episode within a cell of
    `_REST` h count once: a robot that stands still says nothing new, however long it does so and however its sensors
    tremble. The cells need h, so h is found by iteration, from above.
    """
    spread = robust_spread(held_out.points, held_out.periods)
    smallest, largest = _SMALLEST_BANDWIDTH * spread, 3 * spread
    h, low, high, n_before = spread / 4, smallest, largest, 0
    likelihood = None
    for _ in range(4):
        thinned, before = _one_of_each_cell(held_out, _REST * h), h
        if len(thinned.points) == n_before:
            break
        n_before = len(thinned.points)
        likelihood = partial(_trimmed_log_likelihood, thinned, _evenly_chosen(thinned.points))
        h = _maximise(likelihood, low, high, tolerance=0.05)
        if abs(math.log(h / before)) < 0.02:
            break
        low, high = max(h / 4, smallest), 1.3 * h
    assert likelihood is not None
    return _maximise(likelihood, 0.9 * h, 1.1 * h, tolerance=0.005)


def _evenly_chosen(points: Tensor) -> Tensor:
    """``(N,)`` rows of points ``(P, D)``, evenly spaced, as many as the time allows."""
    n_points, dim = points.shape
    n_most = int(min(max(_WORK / (n_points * dim), _FEWEST_JUDGED), _MOST_JUDGED, n_points))
    return torch.linspace(0, n_points - 1, n_most).long()


def _trimmed_log_likelihood(held_out: HeldOut, rows: Tensor, bandwidth: float) -> float:
    """The mean log density of some rows, each judged by other groups, without the extreme ones [nats]."""
    log_density = held_out.judge(bandwidth, held_out.points[rows], held_out.groups[rows]).log_density
    known = log_density[log_density > -math.inf].double().sort().values
    n_left_out = min(math.ceil(_LEFT_OUT_SHARE * len(known)), (len(known) - 1) // 2)
    return known[n_left_out : len(known) - n_left_out].mean().item()


def _one_of_each_cell(held_out: HeldOut, side: float) -> HeldOut:
    """The points without those that share a cube of this side with an earlier point of their episode.

    Blocks of one recording count as one episode. The order is that of the first coordinate, so it does not depend on the
    order of the points.
    """
    groups = held_out.groups
    order = held_out.points[:, 0].argsort(stable=True)
    # Off centre, so that a rest at 0 does not lie on the border of cells.
    cells = torch.floor(held_out.points[order].double() / side + 0.3)
    key = torch.zeros_like(order) if held_out.is_one_recording else groups[order].clone()
    for coordinate in cells.unbind(1):
        key = key * 0x5851F42D4C957F2D + coordinate.clamp(-(2.0**62), 2.0**62).long()
        key = key ^ ((key >> 29) & 0x7FFFFFFFF)
    key, position = key.sort(stable=True)
    is_first = torch.ones_like(key, dtype=torch.bool)
    is_first[1:] = key[1:] != key[:-1]
    kept = order[position[is_first].sort().values]
    return HeldOut(held_out.points[kept], groups[kept], held_out.periods)


def _maximise(
    function: Callable[[float], float], smallest: float, largest: float, tolerance: float = 0.01
) -> float:
    """The argument between two positive bounds with the largest value, by golden-section search on its logarithm."""
    golden = (math.sqrt(5) - 1) / 2
    low, high = math.log(smallest), math.log(largest)
    left, right = high - golden * (high - low), low + golden * (high - low)
    at_left, at_right = function(math.exp(left)), function(math.exp(right))
    while high - low > tolerance:
        if at_left > at_right:
            high, right, at_right = right, left, at_left
            left = high - golden * (high - low)
            at_left = function(math.exp(left))
        else:
            low, left, at_left = left, right, at_right
            right = low + golden * (high - low)
            at_right = function(math.exp(right))
    return math.exp((low + high) / 2)
