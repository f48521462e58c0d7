# SPDX-License-Identifier: Apache-2.0
"""Anchors along smooth paths, and the sums of kernels over them in their most obvious form."""

import torch


def paths(n: int, dim: int, seed: int = 0, n_paths: int = 20) -> torch.Tensor:
    """Points along smooth paths through the unit cube, as demonstrations are."""
    generator = torch.Generator().manual_seed(seed)
    ends = torch.rand(n_paths, 3, dim, generator=generator) * 2 - 1
    path = torch.randint(n_paths, (n,), generator=generator)
    t = torch.rand(n, 1, generator=generator)
    return (1 - t) ** 2 * ends[path, 0] + 2 * t * (1 - t) * ends[path, 1] + t**2 * ends[path, 2]


def brute_force(queries: torch.Tensor, anchors: torch.Tensor, h: float) -> tuple[torch.Tensor, torch.Tensor]:
    queries, anchors = queries.double(), anchors.double()
    exponents = -(queries[:, None] - anchors).square().sum(dim=-1) / (2 * h**2)
    return torch.softmax(exponents, dim=1) @ anchors - queries, exponents.logsumexp(dim=1)
