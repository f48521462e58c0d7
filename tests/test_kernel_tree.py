# SPDX-License-Identifier: Apache-2.0
"""The tree of anchors, and the C extension that walks down it."""

import math
import shutil
import sysconfig
from pathlib import Path

import numpy as np
import pytest
import torch
from demonstrated_paths import brute_force, paths
from harness import threads

from lerobot_pf2mp.density import kernel_tree
from lerobot_pf2mp.density.kernel_sums import KernelSums
from lerobot_pf2mp.density.kernel_tree import KernelTree

CAN_BE_BUILT = shutil.which("cc") and Path(sysconfig.get_path("include"), "Python.h").exists()

pytestmark = pytest.mark.skipif(
    not (kernel_tree.is_available() or CAN_BE_BUILT), reason="there is no C compiler, or no Python.h"
)


@pytest.mark.parametrize("n_anchors", [63, 64, 65, 128, 129, 190, 200, 321, 700, 5000])
def test_a_tree_holds_every_anchor_once_in_boxes_that_hold_it(n_anchors: int) -> None:
    anchors = paths(n_anchors, 3)
    tree = KernelTree.of(anchors, 0.1)
    found = tree.leaves.transpose(1, 2).reshape(-1, 3)
    found = found[found[:, 0] < 1e18]
    assert torch.equal(torch.unique(found, dim=0), torch.unique(anchors - tree.centre, dim=0))
    assert len(found) == n_anchors
    n_leaves = len(tree.leaves)
    low, high = tree.boxes.unbind(1)
    leaves = tree.leaves.transpose(1, 2)
    is_anchor = leaves < 1e18
    assert ((leaves >= low[n_leaves - 1 :, None]) | ~is_anchor).all()
    assert ((leaves <= high[n_leaves - 1 :, None]) | ~is_anchor).all()
    for node in range(1, len(tree.boxes)):
        parent = (node - 1) // 2
        assert (low[parent] <= low[node]).all()
        assert (high[parent] >= high[node]).all()


def test_leaves_are_small_parts_of_space() -> None:
    low, high = KernelTree.of(paths(50_000, 2), 0.005).boxes[-(50_000 // 64) :].unbind(1)
    assert (high - low).prod(dim=1).mean() < 0.01  # of 4


@pytest.mark.parametrize("n_threads", [1, 2, 3])
@pytest.mark.parametrize(("n_queries", "dim"), [(2500, 3), (90, 20), (33, 20), (5, 20)])
def test_threads_change_nothing(n_threads: int, n_queries: int, dim: int) -> None:
    tree = KernelTree.of(paths(3000, dim), 0.05)
    queries = paths(n_queries, dim, seed=1)
    one_by_one = [torch.cat(x) for x in zip(*(tree.sums(q) for q in queries.split(1)), strict=True)]
    with threads(n_threads):
        for found, wanted in zip(tree.sums(queries), one_by_one, strict=True):
            torch.testing.assert_close(found, wanted, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("h", [1e-30, 1e-10, 1e10, 1e30])
def test_extreme_bandwidths_end_in_numbers(h: float) -> None:
    anchors = paths(500, 2)
    offsets, log_sums = KernelSums(anchors, h).tree.sums(anchors[:50])
    wanted = 0.0 * offsets if h < 1 else anchors.mean(dim=0) - anchors[:50]
    torch.testing.assert_close(offsets, wanted, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(log_sums, torch.full((50,), 0.0 if h < 1 else math.log(500)))


def test_a_query_that_is_not_a_number_spoils_no_other() -> None:
    sums = KernelSums(paths(1000, 2), 0.05)
    queries = paths(100, 2, seed=1)
    wanted = sums(queries)
    spoiled = queries.clone()
    spoiled[17, 0] = torch.nan
    rest = torch.arange(100) != 17
    for found, other in zip(sums(spoiled), wanted, strict=True):
        assert torch.isnan(found[17]).any()
        torch.testing.assert_close(found[rest], other[rest], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("n_threads", [1, 2])
@pytest.mark.parametrize("dim", [1, 2, 3, 9])
def test_the_offset_to_the_nearest_target_is_that_of_all_distances(dim: int, n_threads: int) -> None:
    sums = KernelSums(paths(3000, dim) + 100, 0.05)
    queries = sums.anchors[::2] + 0.1 * torch.randn(1500, dim)
    targets = sums.anchors[:300]
    log_sums = brute_force(queries, sums.anchors, 0.05)[1]
    log_sum = log_sums.median().item()
    distances = torch.cdist(queries.double(), targets.double(), compute_mode="donot_use_mm_for_euclid_dist")
    wanted = (targets[distances.argmin(dim=1)] - queries) * (log_sums <= log_sum).unsqueeze(1)
    with threads(n_threads):
        found = sums.tree.offsets_to(KernelTree.of(targets, 0.05), queries, log_sum)
    is_clear = (log_sums - log_sum).abs() > 1e-4
    torch.testing.assert_close(found[is_clear], wanted[is_clear], rtol=1e-5, atol=1e-4)
    assert (found != 0).any()


@pytest.mark.parametrize("n_threads", [1, 2])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("max_distance", [0.0, 0.01, 10.0])
def test_a_step_is_a_share_of_the_offset_to_the_mean_and_a_limited_one_to_a_target(
    max_distance: float, share: float, n_threads: int
) -> None:
    sums = KernelSums(paths(3000, 3), 0.05)
    queries = sums.anchors[::2] + 0.1 * torch.randn(1500, 3)
    targets = KernelTree.of(sums.anchors[:300], 0.05)
    shifts = share * sums(queries)[0]
    log_sums = sums(queries + shifts)[1]
    log_sum = log_sums.median().item()
    ways = sums.tree.offsets_to(targets, queries + shifts, log_sum)
    lengths = ways.norm(dim=1, keepdim=True)
    wanted = shifts + ways * (max_distance / lengths.clamp_min(max(max_distance, 1e-9)))
    with threads(n_threads):
        found = sums.tree.steps_to(targets, queries, log_sum, share, max_distance)
    is_clear = (log_sums - log_sum).abs() > 1e-4
    torch.testing.assert_close(found[is_clear], wanted[is_clear], rtol=1e-4, atol=1e-5)
    assert 300 < (lengths > 0).sum() < 1200


@pytest.mark.parametrize("far", [1e6, 3e38, torch.nan])
def test_steps_from_far_away_are_finite(far: float) -> None:
    queries = torch.tensor([[far, 0.0], [0.0, -far], [5.0, 5.0]])
    anchors = paths(300, 2)
    sums = KernelSums(anchors, 0.05)
    nearest = anchors[(queries[2] - anchors).square().sum(dim=1).argmin()]
    for found in (
        sums.tree.offsets_to(sums.tree, queries, 0.0),
        sums.tree.steps_to(sums.tree, queries, 0.0, 0.5, 10.0),
    ):
        assert torch.isfinite(found[:2]).all() or not math.isfinite(far)
        torch.testing.assert_close(queries[2] + found[2], nearest, rtol=1e-3, atol=1e-3)


def test_the_extension_refuses_arrays_that_do_not_fit() -> None:
    held = KernelTree.of(paths(300, 2), 0.05)._held
    leaves, boxes, centre, periods, *numbers = held
    queries, log_sums = np.zeros((5, 2), np.float32), np.zeros(5, np.float32)
    bad_trees = [
        (leaves[1:], boxes, centre, periods, *numbers),
        (leaves, boxes[:-1], centre, periods, *numbers),
        (leaves, boxes[:-2], centre, periods, *numbers),
        (leaves, boxes, centre[1:], periods, *numbers),
        (leaves, boxes, centre[:0], periods, *numbers),
        (leaves, boxes, centre, centre[1:], *numbers),
    ]
    for tree in bad_trees:
        with pytest.raises(ValueError, match="do not fit"):
            kernel_tree._kernel_tree.sum_kernels(tree, queries, queries.copy(), log_sums, 1)
        with pytest.raises(ValueError, match="do not fit"):
            kernel_tree._kernel_tree.lead_to_targets(held, tree, queries, 0.0, queries.copy(), 1)
        with pytest.raises(ValueError, match="do not fit"):
            kernel_tree._kernel_tree.step_to_targets(tree, held, queries, 0.0, 0.5, 0.1, queries.copy(), 1)
    for offsets, sums in (
        (queries[1:], log_sums),
        (queries, log_sums[1:]),
        (np.zeros((5, 3), "f"), log_sums),
    ):
        with pytest.raises(ValueError, match="do not fit"):
            kernel_tree._kernel_tree.sum_kernels(held, queries, offsets.copy(), sums.copy(), 1)
    with pytest.raises(ValueError, match="do not fit"):
        kernel_tree._kernel_tree.lead_to_targets(held, held, queries, 0.0, queries[1:].copy(), 1)
    with pytest.raises(ValueError, match="do not fit"):
        kernel_tree._kernel_tree.order_points(queries, np.zeros(3, np.int64))
    with pytest.raises(TypeError, match="bytes-like"):  # not contiguous
        kernel_tree._kernel_tree.sum_kernels(held, queries, queries.copy().T, log_sums, 1)
