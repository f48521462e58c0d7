# SPDX-License-Identifier: Apache-2.0
"""Sums of Gaussian kernels over anchors: their logarithm, and the kernel-weighted mean of the anchors.

Both come from one attention call, with queries q / h, keys x / h, biases -|x|^2 / 2h^2 and values x: its output is the
mean, and the normaliser of its softmax is the sum, up to exp(-|q|^2 / 2h^2). What is too far away to count is left out:
the queries of a plan attend, a few at a time, to the blocks of anchors near them, all in one call; where queries and anchors
are many, each group of neighbouring queries attends to the anchors near the group.
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
_LARGEST_SINGLE_EXPONENT = 64.0
_LARGEST_BLOCK_EXPONENT = 1024.0  # of which the parts of one block differ less

# Pairs (query, anchor) from which on blocks are worth their while, and from which on groups are; how many make one.
_SOME_PAIRS, _MANY_PAIRS = 2**16, 2**25
_ANCHORS_PER_BLOCK, _QUERIES_PER_BLOCK = 48, 4
_ANCHORS_PER_GROUP, _QUERIES_PER_GROUP = 128, 128

# The share of pairs that count up to which blocks are faster than all pairs, and how many blocks attend in one call.
_SMALL_SHARE = 0.5
_PAIRS_OF_BLOCKS_AT_ONCE = 2**13

# The weight of all anchors that are left out for being far, relative to the nearest one's.
_LEFT_OUT = 1e-7
_NO_WEIGHT = -1e30  # as an exponent


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
            if torch.compiler.is_compiling():
                return self._by_attention(centred, in_double=True)
            n_pairs = len(queries) * len(self.anchors)
            if n_pairs >= _MANY_PAIRS:
                return self._among_neighbours(centred)
            sums = self._among_blocks(centred) if n_pairs >= _SOME_PAIRS else None
            return self._by_attention(centred, in_double=False) if sums is None else sums

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

    def _among_blocks(self, queries: Tensor) -> tuple[Tensor, Tensor] | None:
        """Small blocks of queries in the order given, in which those of a plan are neighbours; None if most pairs count."""
        n_queries, dim = queries.shape
        padding = -n_queries % _QUERIES_PER_BLOCK
        padded = torch.cat([queries, queries[-1:].expand(padding, dim)]) if padding else queries
        blocks = padded.clamp(-_FARTHEST, _FARTHEST).view(-1, _QUERIES_PER_BLOCK, dim)  # (B, q, D)
        anchors = self._blocks
        is_near = _are_near(blocks.amin(dim=1), blocks.amax(dim=1), anchors.groups, self._reach)
        of_query, of_anchor = is_near.nonzero().unbind(1)  # (P,) each
        if len(of_query) > _SMALL_SHARE * is_near.numel():
            return None
        parts = []
        for q, x in zip(
            *(pairs.split(_PAIRS_OF_BLOCKS_AT_ONCE) for pairs in (of_query, of_anchor)), strict=True
        ):
            # Seen from the anchors' middle all of them are close, and float32 mostly does.
            middle = anchors.middle[x].unsqueeze(1)
            scaled = (blocks[q] - middle).to(anchors.keys.dtype) / self.bandwidth
            means, sums = _attend(scaled, anchors.keys[x], anchors.values[x])
            parts.append((means.float() + middle, sums))
        # The means of all pairs of blocks, weighted by their sums.
        means, sums = (torch.cat(part) for part in zip(*parts, strict=True))  # (P, q, D), (P, q)
        rows = of_query.unsqueeze(1).expand_as(sums)
        largest = sums.new_full(blocks.shape[:2], -math.inf).scatter_reduce_(0, rows, sums, "amax")
        weights = (sums - largest[of_query]).exp()
        total = torch.zeros_like(largest).index_add_(0, of_query, weights)
        shares = (weights / total[of_query]).float().unsqueeze(-1)
        local_means = torch.zeros_like(blocks).index_add_(0, of_query, shares * means)
        log_sums = (largest + total.log()).float()
        return local_means.view(-1, dim)[:n_queries] - queries, log_sums.view(-1)[:n_queries]

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
        """For each group of queries the groups of anchors that count, as indices in ascending order."""
        n_at_once = max(1, PAIRS_PER_BLOCK // len(self._groups.low))
        for low, high in zip(queries.low.split(n_at_once), queries.high.split(n_at_once), strict=True):
            is_near = _are_near(low, high, self._groups, self._reach)
            yield from (row.nonzero().squeeze(1) for row in is_near)

    def _anchors_of(self, groups: Tensor) -> Tensor:
        ends = self._groups.ends
        starts = torch.cat([ends.new_zeros(1), ends[:-1]])[groups]
        counts = ends[groups] - starts
        firsts = counts.cumsum(0) - counts
        rows = torch.arange(int(counts.sum())) + (starts - firsts).repeat_interleave(counts)
        return self._grouped[rows]

    @cached_property
    def _reach(self) -> float:
        return 2 * self.bandwidth**2 * math.log(len(self.anchors) / _LEFT_OUT)

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
    def _blocks(self) -> _Blocks:
        return _Blocks.of(self._centred, self.bandwidth)

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
        keys: ``(1, M, D + 1)``, x / h and the bias.
        values: ``(1, M, D + 1)``, x and a zero, as values must have the keys' size.
        bandwidth: h.
    """

    anchors: Tensor
    keys: Tensor
    values: Tensor
    bandwidth: float

    @classmethod
    def of(cls, anchors: Tensor, bandwidth: float) -> _Keys:
        keys, values = _keys_and_values(anchors, bandwidth)
        return cls(anchors, keys[None], values[None], bandwidth)

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
        means, log_sums = _attend(scaled[None], self.keys, self.values)
        return (means[0] - precise).float(), log_sums[0].float()


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Anchors in G groups of neighbours, all filled up to S with anchors that weigh nothing.

    Args:
        groups: The groups.
        keys: ``(G, S, D + 1)`` x / h seen from the group's middle, and the bias; in float64 if need be.
        values: ``(G, S, D + 1)`` x seen from there, and a zero.
        middle: ``(G, D)`` the mean of each group.
    """

    groups: _Groups
    keys: Tensor
    values: Tensor
    middle: Tensor

    @classmethod
    def of(cls, anchors: Tensor, bandwidth: float) -> _Blocks:
        groups = _Groups.of(anchors, _ANCHORS_PER_BLOCK)
        ends = groups.ends.unsqueeze(1)
        starts = F.pad(ends[:-1], (0, 0, 1, 0))
        places = starts + torch.arange(int((ends - starts).max()))  # (G, S)
        blocks = anchors[groups.order[places.minimum(ends - 1)]]  # (G, S, D)
        middle = blocks.mean(dim=1)
        around = blocks - middle.unsqueeze(1)
        largest = around.square().sum(dim=-1).max().item()
        is_single = largest <= 2 * _LARGEST_BLOCK_EXPONENT * bandwidth**2
        keys, values = _keys_and_values(around if is_single else around.double(), bandwidth)
        keys[..., -1].masked_fill_(places >= ends, _NO_WEIGHT)
        return cls(groups, keys, values, middle)


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


def _are_near(low: Tensor, high: Tensor, anchors: _Groups, reach: float) -> Tensor:
    """Which groups of anchors count for queries in boxes with these corners (B, D), as (B, G).

    A group counts unless it is so far from the box that its weights vanish beside that of an anchor that is known to be
    nearer to every query in it.
    """
    nearest = torch.zeros(len(low), len(anchors.low))  # squared distances
    farthest = torch.zeros_like(nearest)
    for d in range(low.shape[1]):
        low_d, high_d = low[:, d, None], high[:, d, None]
        gap = torch.maximum(anchors.low[:, d] - high_d, low_d - anchors.high[:, d]).clamp_min_(0)
        member = anchors.member[:, d]
        span = torch.maximum((member - low_d).abs_(), (member - high_d).abs_())
        nearest.addcmul_(gap, gap)
        farthest.addcmul_(span, span)
    return nearest <= farthest.amin(dim=1, keepdim=True) + reach


def _keys_and_values(anchors: Tensor, bandwidth: float) -> tuple[Tensor, Tensor]:
    scaled = (anchors / bandwidth).clamp(-_FARTHEST, _FARTHEST)
    bias = -0.5 * scaled.square().sum(dim=-1, keepdim=True)
    return torch.cat([scaled, bias], dim=-1), torch.cat([anchors, torch.zeros_like(bias)], dim=-1)


def _attend(queries: Tensor, keys: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """The means (B, Q, D) of the values, and the log sums of the kernels (B, Q) in float64, of queries (B, Q, D) / h."""
    means, normalisers = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu(
        F.pad(queries, (0, 1), value=1.0)[:, None], keys[:, None], values[:, None], scale=1.0
    )
    return means[:, 0, :, :-1], normalisers[:, 0] - 0.5 * queries.double().square().sum(dim=-1)
