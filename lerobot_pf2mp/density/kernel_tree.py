# SPDX-License-Identifier: Apache-2.0
"""Sums of Gaussian kernels over a k-d tree of anchors, on a CPU: the results of `KernelSums`, from a small C extension.

It leaves out the anchors that are too far away to count. `is_available` is false if the extension could not be built.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from numpy.typing import NDArray
from torch import Tensor

from lerobot_pf2mp.density.kernels import mean, wrap

try:
    from lerobot_pf2mp.density import _kernel_tree
except ImportError:  # installed without a C compiler
    _kernel_tree = None  # type: ignore[assignment]

# Upper bound for the total weight of the anchors that are left out, relative to the nearest anchor's weight.
_LEFT_OUT = 1e-7

# Anchor coordinates are clamped to _FARTHEST. _MISSING fills the unused slots of a leaf that is not full.
_FARTHEST, _MISSING = 5e17, 1e19

# Limits of `exponent_per_square`: its product with a squared distance must fit into a float32.
_SMALLEST_EXPONENT_PER_SQUARE, _LARGEST_EXPONENT_PER_SQUARE = 1e-30, 1e30


def is_available() -> bool:
    """Whether the C extension could be built."""
    return _kernel_tree is not None


@dataclass(frozen=True, eq=False)
class KernelTree:
    """A binary tree of L leaves that is full except for its last level.

    Leaf i is node L - 1 + i. Node k has the children 2k + 1 and 2k + 2.

    Args:
        leaves: ``(L, D, S)`` the anchors of each leaf, relative to the centre.
        boxes: ``(2 L - 1, 2, D)`` the lower and upper corner of each node's bounding box, relative to the centre.
        centre: ``(D,)`` the mean of the anchors. Subtracting it keeps float32 precise for points far from the origin.
        periods: ``(D,)`` the periods of angles, 0 for other dimensions; ``(0,)`` if there are no angles. Positions in an
            angle lie within half a period of the centre.
        exponent_per_square: log2(e) / 2h^2. Times a squared distance it is the exponent e of a kernel 2^-e.
        exponent_range: A kernel is left out if it is smaller than 2^-exponent_range times that of the nearest anchor.
    """

    leaves: Tensor
    boxes: Tensor
    centre: Tensor
    periods: Tensor
    exponent_per_square: float
    exponent_range: float

    @classmethod
    def of(cls, anchors: Tensor, bandwidth: float, periods: Tensor | None = None) -> KernelTree:
        """Builds the tree of anchors ``(M, D)``, float32 on the CPU, M >= 1.

        Args:
            anchors: The anchors.
            bandwidth: The kernel bandwidth h > 0.
            periods: ``(D,)`` periods of angles, 0 for other dimensions; None if there are no angles.
        """
        centre = mean(anchors)
        positions = wrap(anchors - centre, periods).clamp(-_FARTHEST, _FARTHEST)
        leaves = _in_leaves(positions[_order_of(anchors, periods)], _MISSING)
        return cls(
            leaves.transpose(1, 2).contiguous(),
            _boxes_around(leaves),
            centre,
            torch.empty(0) if periods is None else periods.float().contiguous(),
            exponent_per_square=min(
                max(math.log2(math.e) / 2 / bandwidth / bandwidth, _SMALLEST_EXPONENT_PER_SQUARE),
                _LARGEST_EXPONENT_PER_SQUARE,
            ),
            exponent_range=math.log2(len(anchors) / _LEFT_OUT),
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

    def sums_of_others(self, labels: Tensor, queries: Tensor, query_labels: Tensor) -> tuple[Tensor, Tensor]:
        """The log sums, and the distances to the nearest anchor, over the anchors with other labels.

        Args:
            labels: ``(L, S)`` int32 labels of the anchors, see `labels_in_leaves`.
            queries: ``(Q, D)`` float32.
            query_labels: ``(Q,)`` int32. The anchors whose label differs from the query's by at most 1 are left out.

        Returns:
            ``(Q,)`` log sums and ``(Q,)`` distances; -inf and inf where no anchor remains.
        """
        queries = queries.contiguous()
        log_sums, squares = torch.empty(len(queries)), torch.empty(len(queries))
        _kernel_tree.sum_other_kernels(
            self._held,
            labels.numpy(),
            queries.numpy(),
            query_labels.contiguous().numpy(),
            log_sums.numpy(),
            squares.numpy(),
            torch.get_num_threads(),
        )
        return log_sums, squares.sqrt()

    def offsets_to(self, targets: KernelTree, queries: Tensor, log_sum_threshold: float) -> Tensor:
        """The offsets to the nearest target, for queries with a small kernel sum.

        Args:
            targets: The tree of the target points.
            queries: ``(Q, D)`` float32.
            log_sum_threshold: Log sum above which the offset is zero.

        Returns:
            ``(Q, D)`` offsets to the nearest target; zero where the log sum is above the threshold.
        """
        if torch.compiler.is_compiling():
            return self.steps_to(targets, queries, log_sum_threshold, share=0.0, max_distance=math.inf)
        queries = queries.contiguous()
        offsets = torch.empty_like(queries)
        _kernel_tree.lead_to_targets(
            self._held,
            targets._held,
            queries.numpy(),
            log_sum_threshold,
            offsets.numpy(),
            torch.get_num_threads(),
        )
        return offsets

    def steps_to(
        self,
        targets: KernelTree,
        queries: Tensor,
        log_sum_threshold: float,
        share: float,
        max_distance: float,
    ) -> Tensor:
        """Steps towards the local mean, and from there towards the nearest target if the kernel sum there is small.

        Args:
            targets: The tree of the target points.
            queries: ``(Q, D)`` float32.
            log_sum_threshold: Log sum at the end of the first part above which there is no part towards a target.
            share: Fraction in [0, 1] of the offset to the local mean that a step covers.
            max_distance: Largest length of the part of a step towards the nearest target.

        Returns:
            ``(Q, D)`` the steps from the queries.
        """
        if torch.compiler.is_compiling():
            return _steps_operator(
                *self._parts, *targets._parts, queries, log_sum_threshold, share, max_distance
            )
        queries = queries.contiguous()
        steps = torch.empty_like(queries)
        _kernel_tree.step_to_targets(
            self._held,
            targets._held,
            queries.numpy(),
            log_sum_threshold,
            share,
            max_distance,
            steps.numpy(),
            torch.get_num_threads(),
        )
        return steps

    @property
    def _parts(self) -> tuple[Tensor, Tensor, Tensor, Tensor, float, float]:
        numbers = self.exponent_per_square, self.exponent_range
        return self.leaves, self.boxes, self.centre, self.periods, *numbers

    @cached_property
    def _held(self) -> tuple[NDArray, NDArray, NDArray, NDArray, float, float]:
        leaves, boxes, centre, periods = (
            x.numpy() for x in (self.leaves, self.boxes, self.centre, self.periods)
        )
        return leaves, boxes, centre, periods, self.exponent_per_square, self.exponent_range


# The methods of a tree as custom operators, which compiled graphs can call. Below each: the shapes of its results.


@torch.library.custom_op("lerobot_pf2mp::kernel_sums", mutates_args=(), device_types="cpu")
def _sums_operator(
    leaves: Tensor,
    boxes: Tensor,
    centre: Tensor,
    periods: Tensor,
    exponent_per_square: float,
    exponent_range: float,
    queries: Tensor,
) -> tuple[Tensor, Tensor]:
    return KernelTree(leaves, boxes, centre, periods, exponent_per_square, exponent_range).sums(queries)


@_sums_operator.register_fake
def _(
    leaves: Tensor,
    boxes: Tensor,
    centre: Tensor,
    periods: Tensor,
    exponent_per_square: float,
    exponent_range: float,
    queries: Tensor,
) -> tuple[Tensor, Tensor]:
    return queries.new_empty(queries.shape), queries.new_empty(len(queries))


@torch.library.custom_op("lerobot_pf2mp::steps_to_targets", mutates_args=(), device_types="cpu")
def _steps_operator(
    leaves: Tensor,
    boxes: Tensor,
    centre: Tensor,
    periods: Tensor,
    exponent_per_square: float,
    exponent_range: float,
    target_leaves: Tensor,
    target_boxes: Tensor,
    target_centre: Tensor,
    target_periods: Tensor,
    target_exponent_per_square: float,
    target_exponent_range: float,
    queries: Tensor,
    log_sum_threshold: float,
    share: float,
    max_distance: float,
) -> Tensor:
    targets = KernelTree(
        target_leaves,
        target_boxes,
        target_centre,
        target_periods,
        target_exponent_per_square,
        target_exponent_range,
    )
    tree = KernelTree(leaves, boxes, centre, periods, exponent_per_square, exponent_range)
    return tree.steps_to(targets, queries, log_sum_threshold, share, max_distance)


@_steps_operator.register_fake
def _(*arguments: Tensor | float) -> Tensor:
    queries = arguments[12]
    assert isinstance(queries, Tensor)
    return queries.new_empty(queries.shape)


def labels_in_leaves(labels: Tensor, anchors: Tensor, periods: Tensor | None = None) -> Tensor:
    """The labels ``(M,)`` of anchors ``(M, D)`` in the order of the leaves of their tree, ``(L, S)`` int32."""
    return _in_leaves(labels.int()[_order_of(anchors, periods)].unsqueeze(1), 0).squeeze(2).contiguous()


def _order_of(anchors: Tensor, periods: Tensor | None) -> Tensor:
    """The order ``(M,)`` of anchors in the leaves of their tree, from left to right."""
    points = anchors if periods is None else wrap(anchors - mean(anchors), periods)
    order = torch.empty(len(anchors), dtype=torch.int64)
    _kernel_tree.order_points(points.contiguous().numpy(), order.numpy())
    return order


def _in_leaves(rows: Tensor, missing: float) -> Tensor:
    """Rows ``(M, D)``, in the order of the leaves from left to right, as leaves ``(L, S, D)`` in the numbering of nodes."""
    n_rows, dim = rows.shape
    size = _kernel_tree.LEAF_SIZE
    filled = torch.full((-(-n_rows // size) * size, dim), missing, dtype=rows.dtype)
    filled[:n_rows] = rows
    leaves = filled.view(-1, size, dim)
    # From left to right the leaves of the last level come first. In the numbering of nodes they come last.
    full_level = 2 ** (len(leaves).bit_length() - 1)
    return leaves.roll(-2 * (len(leaves) - full_level), dims=0)


def _boxes_around(leaves: Tensor) -> Tensor:
    """The bounding boxes ``(2 L - 1, 2, D)`` of all nodes of the tree with leaves ``(L, S, D)``."""
    n_leaves, _, dim = leaves.shape
    boxes = torch.empty(2 * n_leaves - 1, 2, dim)
    boxes[n_leaves - 1 :, 0] = leaves.amin(dim=1)
    boxes[n_leaves - 1 :, 1] = leaves.masked_fill(leaves == _MISSING, -_MISSING).amax(dim=1)
    end = n_leaves - 1  # the boxes of nodes end, end + 1, ... are known
    while end > 0:
        start = end // 2
        children = boxes[2 * start + 1 : 2 * end + 1].view(-1, 2, 2, dim)
        boxes[start:end, 0] = children[:, :, 0].amin(dim=1)
        boxes[start:end, 1] = children[:, :, 1].amax(dim=1)
        end = start
    return boxes
