# SPDX-License-Identifier: Apache-2.0
"""Anchors along smooth paths, and the sums of kernels over them in their most obvious form."""

import math

import torch

TURN = 2 * math.pi


def paths(n: int, dim: int, seed: int = 0, n_paths: int = 20) -> torch.Tensor:
    """Points along smooth paths through the unit cube, as demonstrations are."""
    generator = torch.Generator().manual_seed(seed)
    ends = torch.rand(n_paths, 3, dim, generator=generator) * 2 - 1
    path = torch.randint(n_paths, (n,), generator=generator)
    t = torch.rand(n, 1, generator=generator)
    return (1 - t) ** 2 * ends[path, 0] + 2 * t * (1 - t) * ends[path, 1] + t**2 * ends[path, 2]


def turning_paths(n: int, periods: torch.Tensor, seed: int = 0) -> torch.Tensor:
    """Such points, whose angles lie around half a period, on both sides and up to three periods away."""
    generator = torch.Generator().manual_seed(100 + seed)
    turns = torch.randint(-3, 4, (n, len(periods)), generator=generator) + 0.5
    return paths(n, len(periods), seed) + turns * periods


def differences(queries: torch.Tensor, anchors: torch.Tensor, periods: torch.Tensor | None) -> torch.Tensor:
    """The differences x - q ``(Q, M, D)`` of all pairs in double precision, to the nearest images for angles."""
    offsets = anchors.double() - queries.double()[:, None]
    if periods is None:
        return offsets
    p = periods.double()
    return torch.where(p > 0, offsets - p * (offsets / p).round(), offsets)


def brute_force(
    queries: torch.Tensor, anchors: torch.Tensor, h: float, periods: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    offsets = differences(queries, anchors, periods)
    exponents = -offsets.square().sum(dim=-1) / (2 * h**2)
    return torch.einsum("qm,qmd->qd", torch.softmax(exponents, dim=1), offsets), exponents.logsumexp(dim=1)


def brute_force_without_own_group(
    queries: torch.Tensor,
    anchors: torch.Tensor,
    h: float,
    groups_of_queries: torch.Tensor,
    groups_of_anchors: torch.Tensor,
    periods: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    squares = differences(queries, anchors, periods).square().sum(dim=-1)
    squares[(groups_of_queries[:, None] - groups_of_anchors).abs() <= 1] = torch.inf
    return (-squares / (2 * h**2)).logsumexp(dim=1), squares.amin(dim=1).sqrt()


def some_periods(dim: int, n_angles: int) -> torch.Tensor:
    """The periods of `dim` dimensions, the last `n_angles` of which are angles."""
    periods = torch.zeros(dim)
    periods[dim - n_angles :] = torch.tensor([TURN, 3.0, 2 * TURN, 2.5, TURN, 4.0, TURN])[:n_angles]
    return periods
