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

from lerobot_pf2mp.density.kernels import checked_periods, mean, without_angles, wrap
from lerobot_pf2mp.density.pull import EVERYWHERE, Pull

# The INTERFACE of the extension that this file calls. In an installation that only links to the source code the built
# extension may be older.
_INTERFACE = 2

try:
    from lerobot_pf2mp.density import _kernel_tree

    if vars(_kernel_tree).get("INTERFACE") != _INTERFACE:
        _kernel_tree = None  # type: ignore[assignment]
except ImportError:  # installed without a C compiler
    _kernel_tree = None  # type: ignore[assignment]

# Upper bound for the total weight of the anchors that are left out, relative to the nearest anchor's weight.
_LEFT_OUT = 1e-7

# Anchor coordinates are clamped to _FARTHEST. _MISSING fills the unused slots of a leaf that is not full.
_FARTHEST, _MISSING = 5e17, 1e19

# Limits of `exponent_per_square`: its product with a squared distance must fit into a float32.
_SMALLEST_EXPONENT_PER_SQUARE, _LARGEST_EXPONENT_PER_SQUARE = 1e-30, 1e30


def is_available() -> bool:
    """Whether the C extension could be built, and is the one that belongs to this version."""
    return _kernel_tree is not None


def check_groups(groups: Tensor, count: int) -> None:
    """Checks the group numbers of points.

    Args:
        groups: The group numbers.
        count: The number of points.

    Raises:
        ValueError: If they are not ``(count,)`` int64, or do not fit into 32 bits.
    """
    if groups.shape != (count,) or groups.dtype != torch.int64:
        raise ValueError(f"groups must be ({count},) int64, got {tuple(groups.shape)} {groups.dtype}")
    # The neighbours of a group number must fit too.
    if count and not (groups.min() > -(2**31) and groups.max() < 2**31 - 1):
        raise ValueError(
            f"group numbers must fit into 32 bits, got {groups.min().item()} to {groups.max().item()}"
        )


@dataclass(frozen=True, eq=False)
class KernelTree:
    """A binary tree of L leaves that is full except for its last level.

    Leaf i is node L - 1 + i. Node k has the children 2k + 1 and 2k + 2.

    Args:
        leaves: ``(L, D, S)`` the anchors of each leaf, relative to the centre.
        boxes: ``(2 L - 1, 2, D)`` the lower and upper corner of each node's bounding box, relative to the centre.
        centre: ``(D,)`` the mean of the anchors, zero for angles. Subtracting it keeps float32 precise for points far from
            the origin.
        periods: ``(D,)`` the periods of angles, 0 for other dimensions; ``(0,)`` if there are no angles.
        exponent_per_square: log2(e) / 2h^2. Times a squared distance it is the exponent e of a kernel 2^-e.
        exponent_range: A kernel is left out if it is smaller than 2^-exponent_range times that of the nearest anchor.
        labels: ``(L, S)`` int32 group numbers of the anchors in the leaves, for `sums_without_own_group`.
    """

    leaves: Tensor
    boxes: Tensor
    centre: Tensor
    periods: Tensor
    exponent_per_square: float
    exponent_range: float
    labels: Tensor | None = None

    @classmethod
    def of(
        cls,
        anchors: Tensor,
        bandwidth: float,
        periods: Tensor | None = None,
        groups: Tensor | None = None,
    ) -> KernelTree:
        """Builds the tree of anchors.

        Args:
            anchors: ``(M, D)`` float32 on the CPU, M >= 1.
            bandwidth: Standard deviation h > 0 of the kernels.
            periods: ``(D,)`` the periods of angles, 0 for other dimensions; None stands for zeros.
            groups: ``(M,)`` int64 group numbers, for `sums_without_own_group`.

        Raises:
            ValueError: If the periods or the groups are not those that `KernelSums` accepts.
        """
        n_anchors, dim = anchors.shape
        size = _kernel_tree.LEAF_SIZE
        periods = checked_periods(periods, dim)
        centre = without_angles(mean(anchors), periods)
        if periods is not None:
            anchors = wrap(anchors, periods)
        order = torch.empty(n_anchors, dtype=torch.int64)
        _kernel_tree.order_points(anchors.contiguous().numpy(), order.numpy())
        positions = torch.full((-(-n_anchors // size) * size, dim), _MISSING)
        positions[:n_anchors] = (anchors - centre)[order].clamp(-_FARTHEST, _FARTHEST)
        leaves = positions.view(-1, size, dim)
        # From left to right the leaves of the last level come first. In the numbering of nodes they come last.
        full_level = 2 ** (len(leaves).bit_length() - 1)
        n_rolled = 2 * (len(leaves) - full_level)
        leaves = leaves.roll(-n_rolled, dims=0)
        labels = None
        if groups is not None:
            check_groups(groups, n_anchors)
            labels = torch.zeros(len(positions), dtype=torch.int32)
            labels[:n_anchors] = groups[order].int()
            labels = labels.view(-1, size).roll(-n_rolled, dims=0)
        return cls(
            leaves.transpose(1, 2).contiguous(),
            _boxes_around(leaves),
            centre,
            centre.new_empty(0) if periods is None else periods,
            exponent_per_square=min(
                max(math.log2(math.e) / 2 / bandwidth / bandwidth, _SMALLEST_EXPONENT_PER_SQUARE),
                _LARGEST_EXPONENT_PER_SQUARE,
            ),
            exponent_range=math.log2(n_anchors / _LEFT_OUT),
            labels=labels,
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

    def sums_without_own_group(self, queries: Tensor, groups: Tensor) -> tuple[Tensor, Tensor]:
        """The log sums and distances of `KernelSums.sums_without_own_group`, for a tree with labels."""
        if self.labels is None:
            raise ValueError("the anchors must have groups, got None")
        check_groups(groups, len(queries))
        log_sums, distances = torch.empty(len(queries)), torch.empty(len(queries))
        _kernel_tree.sum_other_kernels(
            self._held,
            self.labels.numpy(),
            queries.contiguous().numpy(),
            groups.int().contiguous().numpy(),
            log_sums.numpy(),
            distances.numpy(),
            torch.get_num_threads(),
        )
        return log_sums, distances

    def offsets_to(self, targets: KernelTree, queries: Tensor, log_sum_threshold: float) -> Tensor:
        """The offsets to the nearest target, for queries with a small kernel sum.

        Args:
            targets: The tree of the target points, with the same periods.
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
        pull: Pull = EVERYWHERE,
        log_normaliser: float = 0.0,
    ) -> Tensor:
        """Steps towards the local mean, and from there towards the nearest target if the kernel sum there is small.

        Args:
            targets: The tree of the target points, with the same periods.
            queries: ``(Q, D)`` float32.
            log_sum_threshold: Log sum at the end of the first part above which there is no part towards a target.
            share: Fraction in [0, 1] of the offset to the local mean that a step covers where the pull is full.
            max_distance: Largest length of the part of a step towards the nearest target. 0: there is no such part, and
                the targets do not matter.
            pull: Its weight multiplies the share. It depends on the log density at the query.
            log_normaliser: The log sum less the log density [nats].

        Returns:
            ``(Q, D)`` the steps from the queries.
        """
        if torch.compiler.is_compiling():
            return _steps_operator(
                *self._parts,
                *targets._parts,
                queries,
                log_sum_threshold,
                share,
                max_distance,
                pull.log_full,
                pull.log_none,
                log_normaliser,
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
            (log_normaliser, pull.log_none, pull.width),
            steps.numpy(),
            torch.get_num_threads(),
        )
        return steps

    @property
    def _parts(self) -> tuple[Tensor, Tensor, Tensor, Tensor, float, float]:
        arrays = self.leaves, self.boxes, self.centre, self.periods
        return *arrays, self.exponent_per_square, self.exponent_range

    @cached_property
    def _held(self) -> tuple[NDArray, NDArray, NDArray, NDArray, float, float]:
        leaves, boxes, centre, periods, exponent_per_square, exponent_range = self._parts
        arrays = leaves.numpy(), boxes.numpy(), centre.numpy(), periods.numpy()
        return *arrays, exponent_per_square, exponent_range


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
    log_full: float,
    log_none: float,
    log_normaliser: float,
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
    pull = Pull(log_full, log_none)
    return tree.steps_to(targets, queries, log_sum_threshold, share, max_distance, pull, log_normaliser)


@_steps_operator.register_fake
def _(*arguments: Tensor | float) -> Tensor:
    queries = arguments[12]
    assert isinstance(queries, Tensor)
    return queries.new_empty(queries.shape)


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
