# SPDX-License-Identifier: Apache-2.0
"""Sums of Gaussian kernels over anchors: their logarithm, and the kernel-weighted mean of the anchors.

Both come from one attention call, with queries q / h, keys x / h, biases -|x|^2 / 2h^2 and values x: its output is the
mean, and the normaliser of its softmax is the sum, up to exp(-|q|^2 / 2h^2). Where queries and anchors are many, each
group of neighbouring queries attends only to the anchors that are near enough to count.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from lerobot_pf2mp.kernel_density import PAIRS_PER_BLOCK, log_kernels, log_sum_exp, mean

# Queries and anchors further from the origin than this (many bandwidths) count as this far, or squares would overflow.
_FARTHEST = 5e17

# Exponents |q|^2 / 2h^2 up to which float32 resolves their differences to some 1e-5.
_LARGEST_SINGLE_EXPONENT = 256.0

# Pairs (query, anchor) from which on neighbours are looked for, and how many make a group.
_MANY_PAIRS = 2**25
_ANCHORS_PER_GROUP, _QUERIES_PER_GROUP = 128, 128

# The weight of all anchors that are left out for being far, relative to the nearest one's.
_LEFT_OUT = 1e-7


@dataclass(frozen=True, eq=False)
class KernelSums:
    """Sums of Gaussian kernels over given anchors.

    Args:
        anchors: ``(M, D)`` float32 places of the kernels, M >= 1.
        bandwidth: Standard deviation h > 0 of the kernels.
    """

    anchors: Tensor
    bandwidth: float

    def __call__(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        """The local means and the log sums at queries; finite everywhere, in O(M + Q) memory.

        Args:
            queries: ``(Q, D)`` float32 on the anchors' device.

        Returns:
            ``(Q, D)`` the offsets m(q) - q to m(q) = sum_i w_i x_i with w = softmax_i(-|q - x_i|^2 / 2h^2), and ``(Q,)``
            log sum_i exp(-|q - x_i|^2 / 2h^2).
        """
        if not len(queries):
            return queries, queries.new_empty(0)  # on which attention would crash
        with torch.autocast(device_type=queries.device.type, enabled=False):  # it would multiply in bfloat16
            centred = queries - self._centre
            if queries.device.type != "cpu":
                return self._from_differences(centred)
            is_compiling = torch.compiler.is_compiling()
            if is_compiling or len(queries) * len(self.anchors) < _MANY_PAIRS:
                return self._by_attention(centred, in_double=is_compiling)
            return self._among_neighbours(centred)

    def _from_differences(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        offsets, log_sums = torch.empty_like(queries), torch.empty_like(queries[:, 0])
        n_at_once = max(1, PAIRS_PER_BLOCK // len(self.anchors))
        for some, offset, log_sum in zip(
            *(x.split(n_at_once) for x in (queries, offsets, log_sums)), strict=True
        ):
            exponents = log_kernels(some, self._centred, self.bandwidth)  # (Q, M)
            offset.copy_(torch.softmax(exponents, dim=-1) @ self._centred - some)
            log_sum.copy_(log_sum_exp(exponents))
        return offsets, log_sums

    def _by_attention(self, queries: Tensor, in_double: bool) -> tuple[Tensor, Tensor]:
        if in_double or not self._keys.are_resolved_in_single(queries):
            return self._double_keys.attend(queries)
        return self._keys.attend(queries)

    def _among_neighbours(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        queries = queries.clamp(-_FARTHEST, _FARTHEST)
        offsets, log_sums = torch.empty_like(queries), torch.empty(len(queries))
        groups = _Groups.of(queries, _QUERIES_PER_GROUP)
        for group, near in zip(groups.members(), self._near(groups), strict=True):
            # Seen from the group's middle all of them are close, and float32 mostly does.
            middle = queries[group].mean(dim=0)
            keys = _Keys.of(self._anchors_of(near) - middle, self.bandwidth)
            around = queries[group] - middle
            if not keys.are_resolved_in_single(around):
                keys = keys.double()
            offsets[group], log_sums[group] = keys.attend(around)
        return offsets, log_sums

    def _near(self, queries: _Groups) -> Iterator[Tensor]:
        """For each group of queries the groups of anchors that count, as indices in ascending order.

        A group counts unless it is so far from the queries' box that its weights vanish beside those of anchors that are
        known to be nearer to each of the queries.
        """
        anchors = self._groups
        reach = 2 * self.bandwidth**2 * math.log(len(self.anchors) / _LEFT_OUT)
        n_at_once = max(1, PAIRS_PER_BLOCK // len(anchors.low))
        for low, high in zip(queries.low.split(n_at_once), queries.high.split(n_at_once), strict=True):
            nearest = torch.zeros(len(low), len(anchors.low))  # squared distances
            farthest = torch.zeros_like(nearest)
            for d in range(low.shape[1]):
                below = anchors.low[:, d] - high[:, d, None]
                above = low[:, d, None] - anchors.high[:, d]
                nearest += torch.maximum(below, above).clamp_min(0).square()
                to_member = torch.maximum(
                    (anchors.member[:, d] - low[:, d, None]).abs(),
                    (anchors.member[:, d] - high[:, d, None]).abs(),
                )
                farthest += to_member.square()
            is_near = nearest <= farthest.amin(dim=1, keepdim=True) + reach
            yield from (row.nonzero().squeeze(1) for row in is_near)

    def _anchors_of(self, groups: Tensor) -> Tensor:
        ends = self._groups.ends
        starts = torch.cat([ends.new_zeros(1), ends[:-1]])[groups]
        counts = ends[groups] - starts
        firsts = counts.cumsum(0) - counts
        rows = torch.arange(int(counts.sum())) + (starts - firsts).repeat_interleave(counts)
        return self._grouped[rows]

    # Distances are taken after centring: float32 resolves differences between points, not their common offset.

    @cached_property
    def _centre(self) -> Tensor:
        return mean(self.anchors)  # (D,)

    @cached_property
    def _centred(self) -> Tensor:
        return self.anchors - self._centre  # (M, D)

    @cached_property
    def _keys(self) -> _Keys:
        return _Keys.of(self._centred, self.bandwidth)

    @cached_property
    def _double_keys(self) -> _Keys:
        return _Keys.of(self._centred.double(), self.bandwidth)

    @cached_property
    def _groups(self) -> _Groups:
        return _Groups.of(self._centred, _ANCHORS_PER_GROUP)

    @cached_property
    def _grouped(self) -> Tensor:
        return self._centred[self._groups.order]  # (M, D)


@dataclass(frozen=True, eq=False)
class _Keys:
    """Anchors as an attention call needs them, in float32 or float64.

    Args:
        anchors: ``(M, D)``.
        keys: ``(1, 1, M, D + 1)``, x / h and the bias.
        values: ``(1, 1, M, D + 1)``, x and a zero, as values must have the keys' size.
        bandwidth: h.
    """

    anchors: Tensor
    keys: Tensor
    values: Tensor
    bandwidth: float

    @classmethod
    def of(cls, anchors: Tensor, bandwidth: float) -> _Keys:
        scaled = (anchors / bandwidth).clamp(-_FARTHEST, _FARTHEST)
        bias = -0.5 * scaled.square().sum(dim=1, keepdim=True)
        keys = torch.cat([scaled, bias], dim=1)
        values = torch.cat([anchors, torch.zeros_like(bias)], dim=1)
        return cls(anchors, keys[None, None], values[None, None], bandwidth)

    def double(self) -> _Keys:
        return self.of(self.anchors.double(), self.bandwidth)

    def are_resolved_in_single(self, queries: Tensor) -> bool:
        """Whether rounding the exponents to float32 changes the weights by some 1e-5, relatively."""
        largest = 2 * _LARGEST_SINGLE_EXPONENT * self.bandwidth**2
        return self._largest_square <= largest and bool((queries.square().sum(dim=1) <= largest).all())

    @cached_property
    def _largest_square(self) -> float:
        return self.anchors.square().sum(dim=1).max().item()

    def attend(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        """What `KernelSums` returns, for float32 queries ``(Q, D)``."""
        precise = queries.to(self.keys.dtype)
        scaled = (precise / self.bandwidth).clamp_(-_FARTHEST, _FARTHEST)
        means, normalisers = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu(
            F.pad(scaled, (0, 1), value=1.0)[None, None], self.keys, self.values, scale=1.0
        )
        log_sums = normalisers[0, 0] - 0.5 * scaled.square().sum(dim=1)
        return (means[0, 0, :, :-1] - precise).float(), log_sums.float()


@dataclass(frozen=True, eq=False)
class _Groups:
    """Points sorted into groups of neighbours.

    Args:
        order: ``(N,)`` the points' indices, group after group.
        ends: ``(G,)`` where each group ends in this order.
        low: ``(G, D)`` the lower corner of the box around each group.
        high: ``(G, D)`` its upper corner.
        member: ``(G, D)`` one of the points of each group, near its middle.
    """

    order: Tensor
    ends: Tensor
    low: Tensor
    high: Tensor
    member: Tensor

    @classmethod
    def of(cls, points: Tensor, size: int) -> _Groups:
        """Groups of up to `size` points, the leaves of a k-d tree."""
        from scipy.spatial import cKDTree

        tree = cKDTree(points.numpy(), leafsize=size)
        todo, ends = [tree.tree], []
        while todo:
            node = todo.pop()
            if node.lesser is None:
                ends.append(node.end_idx)
            else:
                todo += [node.greater, node.lesser]
        order = torch.from_numpy(tree.indices)
        groups = cls(order, torch.tensor(ends), *(points[:0] for _ in range(3)))
        boxes = [(points[group].amin(dim=0), points[group].amax(dim=0)) for group in groups.members()]
        low, high = (torch.stack(corners) for corners in zip(*boxes, strict=True))
        middles = [
            points[group][(points[group] - (a + b) / 2).square().sum(dim=1).argmin()]
            for group, (a, b) in zip(groups.members(), boxes, strict=True)
        ]
        return cls(order, groups.ends, low, high, torch.stack(middles))

    def members(self) -> Iterator[Tensor]:
        """The indices of each group's points."""
        start = 0
        for end in self.ends.tolist():
            yield self.order[start:end]
            start = end
