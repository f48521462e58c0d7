# SPDX-License-Identifier: Apache-2.0
"""The tree of anchors, and the C extension that walks down it."""

import math
import shutil
import sysconfig
from pathlib import Path

import numpy as np
import pytest
import torch
from demonstrated_paths import brute_force, differences, paths, some_periods, turning_paths
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


@pytest.mark.parametrize("n_anchors", [1, 64, 200, 3000])
@pytest.mark.parametrize(("dim", "n_angles"), [(1, 0), (1, 1), (2, 1), (2, 2), (7, 1), (7, 7)])
def test_the_offset_to_the_nearest_target_goes_the_short_way_round(
    dim: int, n_angles: int, n_anchors: int
) -> None:
    periods = some_periods(dim, n_angles)
    targets = turning_paths(n_anchors, periods)
    queries = turning_paths(500, periods, seed=1) + 0.1 * torch.randn(500, dim)
    offsets = differences(queries, targets, periods)
    nearest = offsets.norm(dim=-1).argmin(dim=1)
    tree = KernelTree.of(targets, 0.05, periods)
    found = tree.offsets_to(tree, queries, math.inf)
    torch.testing.assert_close(found.double(), offsets[torch.arange(500), nearest], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_step_goes_the_short_way_round(share: float) -> None:
    periods = some_periods(3, 2)
    sums = KernelSums(turning_paths(3000, periods), 0.05, periods)
    queries = turning_paths(1500, periods, seed=1) + 0.1 * torch.randn(1500, 3)
    targets = KernelTree.of(sums.anchors[:300], 0.05, periods)
    shifts = share * brute_force(queries, sums.anchors, 0.05, periods)[0].float()
    log_sums = brute_force(queries + shifts, sums.anchors, 0.05, periods)[1]
    log_sum = log_sums.median().item()
    offsets = differences(queries + shifts, sums.anchors[:300], periods)
    ways = offsets[torch.arange(1500), offsets.norm(dim=-1).argmin(dim=1)].float()
    ways[log_sums > log_sum] = 0.0
    wanted = shifts + ways * (0.1 / ways.norm(dim=1, keepdim=True).clamp_min(0.1))
    found = sums.tree.steps_to(targets, queries, log_sum, share, 0.1)
    is_clear = (log_sums - log_sum).abs() > 1e-3
    torch.testing.assert_close(found[is_clear], wanted[is_clear], rtol=1e-4, atol=1e-4)


def test_a_turn_costs_no_digits() -> None:
    # Anchors a millionth apart on both sides of half a turn: the difference of a whole turn would lose 2e-7 of it.
    half = torch.tensor(math.pi)
    steps = torch.arange(-20, 20) * 1e-6
    anchors = torch.where(steps < 0, half + steps, steps - half)[:, None]
    tree = KernelTree.of(anchors, 1e-6, periods=2 * half[None])
    found, found_sums = tree.sums(anchors)
    wanted, wanted_sums = brute_force(anchors, anchors, 1e-6, 2 * half[None])
    torch.testing.assert_close(found.double(), wanted, rtol=1e-4, atol=1e-11)
    torch.testing.assert_close(found_sums.double(), wanted_sums, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("n_threads", [1, 2, 3])
def test_threads_change_nothing_for_angles_and_groups(n_threads: int) -> None:
    periods = some_periods(3, 1)
    tree = KernelTree.of(turning_paths(3000, periods), 0.05, periods, torch.arange(3000) // 10)
    queries, groups = turning_paths(2500, periods, seed=1), torch.arange(2500) // 10
    one_by_one = zip(queries.split(100), groups.split(100), strict=True)
    wanted = [torch.cat(x) for x in zip(*(tree.sums_without_own_group(*x) for x in one_by_one), strict=True)]
    with threads(n_threads):
        found = [*tree.sums(queries), *tree.sums_without_own_group(queries, groups)]
    wanted = [*(torch.cat(x) for x in zip(*map(tree.sums, queries.split(100)), strict=True)), *wanted]
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5)


def test_a_tree_without_groups_leaves_none_out() -> None:
    tree = KernelTree.of(paths(10, 2), 0.1)
    with pytest.raises(ValueError, match="must have groups"):
        tree.sums_without_own_group(paths(5, 2), torch.zeros(5, dtype=torch.int64))


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
    leaves, boxes, centre, periods, *exponents = held
    queries, log_sums = np.zeros((5, 2), np.float32), np.zeros(5, np.float32)
    bad_trees = [
        (leaves[1:], boxes, centre, periods, *exponents),
        (leaves, boxes[:-1], centre, periods, *exponents),
        (leaves, boxes[:-2], centre, periods, *exponents),
        (leaves, boxes, centre[1:], periods, *exponents),
        (leaves, boxes, centre[:0], periods, *exponents),
        (leaves, boxes, centre, centre[1:], *exponents),
    ]
    labels, groups = np.zeros((len(leaves), leaves.shape[2]), np.int32), np.zeros(5, np.int32)
    for tree in bad_trees:
        with pytest.raises(ValueError, match="do not fit"):
            kernel_tree._kernel_tree.sum_kernels(tree, queries, queries.copy(), log_sums, 1)
        with pytest.raises(ValueError, match="do not fit"):
            kernel_tree._kernel_tree.sum_other_kernels(
                tree, labels, queries, groups, log_sums, log_sums.copy(), 1
            )
        with pytest.raises(ValueError, match="do not fit"):
            kernel_tree._kernel_tree.lead_to_targets(held, tree, queries, 0.0, queries.copy(), 1)
        with pytest.raises(ValueError, match="do not fit"):
            kernel_tree._kernel_tree.step_to_targets(
                tree, held, queries, 0.0, 0.5, 0.1, (0.0, math.inf, 1.0), queries.copy(), 1
            )
    for offsets, sums in (
        (queries[1:], log_sums),
        (queries, log_sums[1:]),
        (np.zeros((5, 3), "f"), log_sums),
    ):
        with pytest.raises(ValueError, match="do not fit"):
            kernel_tree._kernel_tree.sum_kernels(held, queries, offsets.copy(), sums.copy(), 1)
    for arrays in (
        (labels[1:], queries, groups, log_sums, log_sums.copy()),
        (labels, queries[1:], groups, log_sums, log_sums.copy()),
        (labels, queries, groups[1:], log_sums, log_sums.copy()),
        (labels, queries, groups, log_sums, log_sums[1:].copy()),
    ):
        with pytest.raises(ValueError, match="do not fit"):
            kernel_tree._kernel_tree.sum_other_kernels(held, *arrays, 1)
    with pytest.raises(ValueError, match="do not fit"):
        kernel_tree._kernel_tree.lead_to_targets(held, held, queries, 0.0, queries[1:].copy(), 1)
    with pytest.raises(ValueError, match="do not fit"):
        kernel_tree._kernel_tree.order_points(queries, np.zeros(3, np.int64))
    pull = 0.0, math.inf, 1.0
    for trees in ((held, held[:-1]), (held[:-1], held), (held, [*held]), ((*held[:2], 1, *held[3:]), held)):
        with pytest.raises(TypeError):
            kernel_tree._kernel_tree.step_to_targets(*trees, queries, 0.0, 0.5, 0.1, pull, queries.copy(), 1)
        with pytest.raises(TypeError):
            kernel_tree._kernel_tree.lead_to_targets(*trees, queries, 0.0, queries.copy(), 1)
    with pytest.raises(TypeError):
        kernel_tree._kernel_tree.sum_kernels(held[:-1], queries, queries.copy(), log_sums, 1)
    with pytest.raises(TypeError, match="bytes-like"):  # not contiguous
        kernel_tree._kernel_tree.sum_kernels(held, queries, queries.copy().T, log_sums, 1)
