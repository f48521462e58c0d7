# SPDX-License-Identifier: Apache-2.0
"""Sums of Gaussian kernels over a k-d tree of anchors, on a CPU: what `KernelSums` returns, by a small C extension.

It leaves out the anchors that are too far away to count. Where it could not be built, `is_available` is false.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from numpy.typing import NDArray
from torch import Tensor

from lerobot_pf2mp.density.kernels import mean

try:
    from lerobot_pf2mp.density import _kernel_tree
except ImportError:  # installed without a C compiler
    _kernel_tree = None  # type: ignore[assignment]

# The weight of all anchors that are left out for being far, relative to the nearest one's.
_LEFT_OUT = 1e-7

# Anchors further from the origin than this count as this far; the missing ones of a leaf that is not full are further.
_FARTHEST, _MISSING = 5e17, 1e19
_SMALLEST_SCALE, _LARGEST_SCALE = 1e-30, 1e30  # that leave room for squared distances


def is_available() -> bool:
    """Whether the C extension could be built."""
    return _kernel_tree is not None


@dataclass(frozen=True, eq=False)
class KernelTree:
    """A binary tree of L leaves, full but for its last level: leaf i is node L - 1 + i, node k has children 2k + 1, 2k + 2.

    Args:
        leaves: ``(L, D, S)`` the anchors of each leaf, seen from the centre.
        boxes: ``(2 L - 1, 2, D)`` the lower and the upper corner of the box around each node's anchors, seen from there.
        centre: ``(D,)``. Float32 resolves differences between points, not their common offset.
        scale: What turns squared distances into exponents of 2.
        reach: How many powers of 2 below the nearest anchor's kernel others still count.
    """

    leaves: Tensor
    boxes: Tensor
    centre: Tensor
    scale: float
    reach: float

    @classmethod
    def of(cls, anchors: Tensor, bandwidth: float) -> KernelTree:
        """The tree of anchors ``(M, D)``, float32 on the CPU, M >= 1."""
        n_anchors, dim = anchors.shape
        size = _kernel_tree.LEAF_SIZE
        centre = mean(anchors)
        order = torch.empty(n_anchors, dtype=torch.int64)
        _kernel_tree.order_points(anchors.contiguous().numpy(), order.numpy())
        places = torch.full((-(-n_anchors // size) * size, dim), _MISSING)
        places[:n_anchors] = (anchors - centre)[order].clamp(-_FARTHEST, _FARTHEST)
        leaves = places.view(-1, size, dim)
        # From left to right the leaves of the last level come first, but they have the last numbers.
        full_level = 2 ** (len(leaves).bit_length() - 1)
        leaves = leaves.roll(-2 * (len(leaves) - full_level), dims=0)
        return cls(
            leaves.transpose(1, 2).contiguous(),
            _boxes_around(leaves),
            centre,
            scale=min(max(math.log2(math.e) / 2 / bandwidth / bandwidth, _SMALLEST_SCALE), _LARGEST_SCALE),
            reach=math.log2(n_anchors / _LEFT_OUT),
        )

    def sums(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        """The offsets ``(Q, D)`` to the local means and the log sums ``(Q,)`` at float32 queries ``(Q, D)``."""
        if torch.compiler.is_compiling():
            return _sums_operator(*self._parts, queries)
        queries = queries.contiguous()
        offsets, log_sums = torch.empty_like(queries), torch.empty(len(queries))
        _kernel_tree.sum_kernels(
            self._held, queries.numpy(), offsets.numpy(), log_sums.numpy(), torch.get_num_threads()
        )
        return offsets, log_sums

    def offsets_to(self, targets: KernelTree, queries: Tensor, log_sum: float) -> Tensor:
        """The way from where the kernels add up to little.

        Args:
            targets: Where to.
            queries: ``(Q, D)`` float32.
            log_sum: What counts as little.

        Returns:
            ``(Q, D)`` offsets to the nearest target; zero where the log sum is above `log_sum`.
        """
        if torch.compiler.is_compiling():
            return self.steps_to(targets, queries, log_sum, share=0.0, reach=math.inf)
        queries = queries.contiguous()
        offsets = torch.empty_like(queries)
        _kernel_tree.lead_to_targets(
            self._held, targets._held, queries.numpy(), log_sum, offsets.numpy(), torch.get_num_threads()
        )
        return offsets

    def steps_to(
        self, targets: KernelTree, queries: Tensor, log_sum: float, share: float, reach: float
    ) -> Tensor:
        """Steps towards the local mean, and on to a target from where the kernels add up to little.

        Args:
            targets: Where to.
            queries: ``(Q, D)`` float32.
            log_sum: What counts as little.
            share: In [0, 1], how much of the way to the local mean.
            reach: How far at most towards the nearest target.

        Returns:
            ``(Q, D)`` the steps from the queries.
        """
        if torch.compiler.is_compiling():
            return _steps_operator(*self._parts, *targets._parts, queries, log_sum, share, reach)
        queries = queries.contiguous()
        steps = torch.empty_like(queries)
        _kernel_tree.step_to_targets(
            self._held,
            targets._held,
            queries.numpy(),
            log_sum,
            share,
            reach,
            steps.numpy(),
            torch.get_num_threads(),
        )
        return steps

    @property
    def _parts(self) -> tuple[Tensor, Tensor, Tensor, float, float]:
        return self.leaves, self.boxes, self.centre, self.scale, self.reach

    @cached_property
    def _held(self) -> tuple[NDArray, NDArray, NDArray, float, float]:
        return self.leaves.numpy(), self.boxes.numpy(), self.centre.numpy(), self.scale, self.reach


# A tree's methods as operators, as which compiled graphs call them. Each is followed by the shapes of what it returns.


@torch.library.custom_op("lerobot_pf2mp::kernel_sums", mutates_args=(), device_types="cpu")
def _sums_operator(
    leaves: Tensor, boxes: Tensor, centre: Tensor, scale: float, reach: float, queries: Tensor
) -> tuple[Tensor, Tensor]:
    return KernelTree(leaves, boxes, centre, scale, reach).sums(queries)


@_sums_operator.register_fake
def _(
    leaves: Tensor, boxes: Tensor, centre: Tensor, scale: float, reach: float, queries: Tensor
) -> tuple[Tensor, Tensor]:
    return queries.new_empty(queries.shape), queries.new_empty(len(queries))


@torch.library.custom_op("lerobot_pf2mp::steps_to_targets", mutates_args=(), device_types="cpu")
def _steps_operator(
    leaves: Tensor,
    boxes: Tensor,
    centre: Tensor,
    scale: float,
    reach: float,
    target_leaves: Tensor,
    target_boxes: Tensor,
    target_centre: Tensor,
    target_scale: float,
    target_reach: float,
    queries: Tensor,
    log_sum: float,
    share: float,
    step_reach: float,
) -> Tensor:
    targets = KernelTree(target_leaves, target_boxes, target_centre, target_scale, target_reach)
    tree = KernelTree(leaves, boxes, centre, scale, reach)
    return tree.steps_to(targets, queries, log_sum, share, step_reach)


@_steps_operator.register_fake
def _(*arguments: Tensor | float) -> Tensor:
    queries = arguments[10]
    assert isinstance(queries, Tensor)
    return queries.new_empty(queries.shape)


def _boxes_around(leaves: Tensor) -> Tensor:
    """The boxes ``(2 L - 1, 2, D)`` of all nodes above leaves ``(L, S, D)``, and of these."""
    n_leaves, _, dim = leaves.shape
    boxes = torch.empty(2 * n_leaves - 1, 2, dim)
    boxes[n_leaves - 1 :, 0] = leaves.amin(dim=1)
    boxes[n_leaves - 1 :, 1] = leaves.masked_fill(leaves == _MISSING, -_MISSING).amax(dim=1)
    end = n_leaves - 1  # from here on boxes are known
    while end > 0:
        start = end // 2
        children = boxes[2 * start + 1 : 2 * end + 1].view(-1, 2, 2, dim)
        boxes[start:end, 0] = children[:, :, 0].amin(dim=1)
        boxes[start:end, 1] = children[:, :, 1].amax(dim=1)
        end = start
    return boxes
