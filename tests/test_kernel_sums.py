# SPDX-License-Identifier: Apache-2.0
"""Kernel sums, each way of computing them against brute force in double precision."""

import math
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import torch

from lerobot_pf2mp import _kernel_tree
from lerobot_pf2mp.kernel_sums import KernelSums
from lerobot_pf2mp.kernel_tree import KernelTree

WAYS = {
    "the fastest": lambda sums, q: sums(q),
    "tree": lambda sums, q: sums.tree.sums(q),
    "attention": lambda sums, q: sums._by_attention(q - sums._centre),
    "double attention": lambda sums, q: sums._double_keys.attend(q - sums._centre),
    "differences": lambda sums, q: sums._from_differences(q - sums._centre),
}
EVERY_WAY = pytest.mark.parametrize("way", WAYS.values(), ids=WAYS.keys())


def paths(n: int, dim: int, seed: int = 0, n_paths: int = 20) -> torch.Tensor:
    """Points along smooth paths through the unit cube, as demonstrations are."""
    generator = torch.Generator().manual_seed(seed)
    ends = torch.rand(n_paths, 3, dim, generator=generator) * 2 - 1
    path = torch.randint(n_paths, (n,), generator=generator)
    t = torch.rand(n, 1, generator=generator)
    return (1 - t) ** 2 * ends[path, 0] + 2 * t * (1 - t) * ends[path, 1] + t**2 * ends[path, 2]


@contextmanager
def torch_threads(n_threads: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(n_threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def brute_force(queries: torch.Tensor, anchors: torch.Tensor, h: float) -> tuple[torch.Tensor, torch.Tensor]:
    queries, anchors = queries.double(), anchors.double()
    exponents = -(queries[:, None] - anchors).square().sum(dim=-1) / (2 * h**2)
    return torch.softmax(exponents, dim=1) @ anchors - queries, exponents.logsumexp(dim=1)


def check(way, queries: torch.Tensor, anchors: torch.Tensor, h: float, rtol: float = 1e-4) -> None:
    """Offsets are right up to `rtol` of their usual length, log sums up to `rtol`."""
    offsets, log_sums = way(KernelSums(anchors, h), queries)
    wanted, wanted_sums = brute_force(queries, anchors, h)
    assert offsets.dtype == log_sums.dtype == torch.float32
    scale = wanted.square().sum(dim=1).mean().sqrt()
    assert (offsets - wanted).norm(dim=1).max() <= rtol * scale
    torch.testing.assert_close(log_sums.double(), wanted_sums, rtol=1e-6, atol=rtol)


@EVERY_WAY
@pytest.mark.parametrize("dim", [1, 2, 3, 9, 32])
@pytest.mark.parametrize("h", [0.015, 0.3])
def test_sums_at_demonstrated_places_are_those_of_brute_force(way, dim: int, h: float) -> None:
    anchors = paths(3000, dim)
    queries = anchors[::7] + h * torch.randn(
        len(anchors[::7]), dim, generator=torch.Generator().manual_seed(1)
    )
    check(way, queries, anchors, h)


@pytest.mark.parametrize("way", ["attention", "tree"])
def test_many_anchors_around_a_query_cost_no_digits(way: str) -> None:
    # So wide a spread, in bandwidths, that float32 alone would be wrong by more than 1e-4.
    anchors = paths(100_000, 3, n_paths=1000)
    check(WAYS[way], anchors[:100] + 0.08 * torch.randn(100, 3), anchors, 0.0885)


@EVERY_WAY
@pytest.mark.parametrize("distance", [1.0, 10.0, 1000.0])
def test_sums_far_from_all_anchors_are_those_of_brute_force(way, distance: float) -> None:
    anchors = paths(2000, 2)
    angles = torch.linspace(0, 6, 300)
    queries = distance * torch.stack([angles.cos(), angles.sin()], dim=1)
    check(way, queries, anchors, 0.05, rtol=1e-3)


@EVERY_WAY
def test_an_offset_from_the_origin_costs_no_digits(way) -> None:
    # In steps of 2^-10, so that the shifted points are exact too.
    anchors = (paths(2000, 2) * 1024).round() / 1024
    queries = ((anchors[::5] + 0.03 * torch.randn(400, 2)) * 1024).round() / 1024
    for shift in (0.0, 4096.0):
        check(way, queries + shift, anchors + shift, 0.03)


@EVERY_WAY
@pytest.mark.parametrize("n_anchors", [1, 2, 129, 1000])
@pytest.mark.parametrize("n_queries", [1, 130])
def test_few_and_equal_points(way, n_anchors: int, n_queries: int) -> None:
    anchors = torch.full((n_anchors, 2), 0.25)
    anchors[: n_anchors // 2] = torch.tensor([0.5, -0.5])
    queries = paths(n_queries, 2)
    check(way, queries, anchors, 0.1)
    check(way, queries[:1].expand(n_queries, 2), anchors, 0.1)


@pytest.mark.parametrize("way", ["tree", "attention", "differences"])
@pytest.mark.parametrize("far", [1e6, 1e20, 3e38])
def test_sums_are_finite_everywhere(far: float, way: str) -> None:
    queries = torch.tensor([[far, -far], [far, 0.0], [0.0, 0.0]])
    offsets, log_sums = WAYS[way](KernelSums(paths(500, 2), 0.015), queries)
    assert torch.isfinite(offsets).all()
    assert torch.isfinite(log_sums).all()


def test_float32_is_used_only_where_it_resolves_the_weights() -> None:
    wide, narrow = KernelSums(paths(500, 2), 0.5), KernelSums(paths(500, 2), 0.015)
    queries = paths(50, 2, seed=1)
    assert wide._keys.are_resolved_in_single(queries)
    assert not wide._keys.are_resolved_in_single(queries + 100)
    assert not narrow._keys.are_resolved_in_single(queries)


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
def test_threads_change_nothing(n_threads: int) -> None:
    tree = KernelTree.of(paths(3000, 3), 0.05)
    queries = paths(2500, 3, seed=1)
    one_by_one = [torch.cat(x) for x in zip(*(tree.sums(q) for q in queries.split(1)), strict=True)]
    with torch_threads(n_threads):
        for found, wanted in zip(tree.sums(queries), one_by_one, strict=True):
            torch.testing.assert_close(found, wanted, rtol=1e-5, atol=1e-5)


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
def test_the_way_to_the_nearest_target_is_that_of_all_distances(dim: int, n_threads: int) -> None:
    sums = KernelSums(paths(3000, dim) + 100, 0.05)
    queries = sums.anchors[::2] + 0.1 * torch.randn(1500, dim)
    targets = sums.anchors[:300]
    log_sums = brute_force(queries, sums.anchors, 0.05)[1]
    log_sum = log_sums.median().item()
    distances = torch.cdist(queries.double(), targets.double(), compute_mode="donot_use_mm_for_euclid_dist")
    wanted = (targets[distances.argmin(dim=1)] - queries) * (log_sums <= log_sum).unsqueeze(1)
    with torch_threads(n_threads):
        for at_least in (None, log_sums.float() - 1e-3 - torch.rand(1500)):
            found = sums.tree.offsets_to(KernelTree.of(targets, 0.05), queries, log_sum, at_least)
            is_clear = (log_sums - log_sum).abs() > 1e-4
            torch.testing.assert_close(found[is_clear], wanted[is_clear], rtol=1e-5, atol=1e-4)
            assert (found != 0).any()


def test_what_is_known_to_be_dense_is_not_looked_at() -> None:
    sums = KernelSums(paths(500, 2), 0.05)
    queries = torch.full((10, 2), 5.0)
    at_least = torch.tensor([0.0, 2.0]).repeat(5)
    found = sums.tree.offsets_to(sums.tree, queries, 1.0, at_least)
    assert torch.equal((found != 0).any(dim=1), at_least == 0)


@pytest.mark.parametrize("far", [1e6, 3e38, torch.nan])
def test_ways_end_somewhere(far: float) -> None:
    queries = torch.tensor([[far, 0.0], [0.0, -far], [5.0, 5.0]])
    anchors = paths(300, 2)
    sums = KernelSums(anchors, 0.05)
    found = sums.tree.offsets_to(sums.tree, queries, 0.0)
    assert torch.isfinite(found[:2]).all() or not math.isfinite(far)
    nearest = (queries[2] - anchors).square().sum(dim=1).argmin()
    torch.testing.assert_close(queries[2] + found[2], anchors[nearest])


def test_the_extension_refuses_arrays_that_do_not_fit() -> None:
    leaves, boxes, centre, scale, reach = held = KernelTree.of(paths(300, 2), 0.05)._held
    queries, log_sums = np.zeros((5, 2), np.float32), np.zeros(5, np.float32)
    bad_trees = [
        (leaves[1:], boxes, centre, scale, reach),
        (leaves, boxes[:-1], centre, scale, reach),
        (leaves, boxes[:-2], centre, scale, reach),
        (leaves, boxes, centre[1:], scale, reach),
        (leaves, boxes, centre[:0], scale, reach),
    ]
    for tree in bad_trees:
        with pytest.raises(ValueError, match="do not fit"):
            _kernel_tree.sum_kernels(tree, queries, queries.copy(), log_sums)
        with pytest.raises(ValueError, match="do not fit"):
            _kernel_tree.lead_to_targets(held, tree, queries, None, 0.0, queries.copy())
    for offsets, sums in (
        (queries[1:], log_sums),
        (queries, log_sums[1:]),
        (np.zeros((5, 3), "f"), log_sums),
    ):
        with pytest.raises(ValueError, match="do not fit"):
            _kernel_tree.sum_kernels(held, queries, offsets.copy(), sums.copy())
    with pytest.raises(ValueError, match="do not fit"):
        _kernel_tree.lead_to_targets(held, held, queries, log_sums[1:], 0.0, queries.copy())
    with pytest.raises(ValueError, match="do not fit"):
        _kernel_tree.order_points(queries, np.zeros(3, np.int64))
    with pytest.raises(TypeError, match="bytes-like"):  # not contiguous
        _kernel_tree.sum_kernels(held, queries, queries.copy().T, log_sums)


def test_without_the_extension_attention_gives_the_same_sums(monkeypatch: pytest.MonkeyPatch) -> None:
    sums, queries = KernelSums(paths(1000, 2), 0.02), paths(100, 2, seed=1)
    wanted = sums(queries)
    monkeypatch.setattr("lerobot_pf2mp.kernel_tree._kernel_tree", None)
    without = KernelSums(sums.anchors, sums.bandwidth)
    for one, other in zip(without(queries), wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)
    assert "tree" not in vars(without)


def test_autocast_and_inference_mode_change_nothing() -> None:
    sums = KernelSums(paths(1000, 2), 0.02)
    queries = paths(100, 2, seed=1)
    plain = sums(queries)
    with torch.inference_mode(), torch.autocast("cpu", dtype=torch.bfloat16):
        for one, other in zip(sums(queries), plain, strict=True):
            assert torch.equal(one, other)


def test_compiled_sums_are_the_same() -> None:
    sums = KernelSums(paths(1000, 2), 0.02)
    queries = paths(100, 2, seed=1)
    compiled = torch.compile(sums.__call__, backend="eager", fullgraph=True)
    for one, other in zip(compiled(queries), sums(queries), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    "way",
    ["_double_keys.attend(q)", "_from_differences(q)", "tree.sums(q)"],
)
def test_memory_does_not_grow_with_the_pairs(way: str) -> None:
    code = f"""
import resource, torch
from lerobot_pf2mp.kernel_sums import KernelSums
def peak(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # [MB]
q, sums = torch.rand(20_000, 2), KernelSums(torch.rand(20_000, 2), 0.01)
sums.{way.replace("(q", "(q[:300]")}
before = peak()
sums.{way}
print(peak() - before)
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert float(result.stdout) < 100  # all pairs in float32 would be 1600 MB
