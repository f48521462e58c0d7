# SPDX-License-Identifier: Apache-2.0
"""Kernel sums: each implementation against brute force in double precision."""

import subprocess
import sys

import pytest
import torch
from demonstrated_paths import brute_force, paths

from lerobot_pf2mp.density import kernel_tree
from lerobot_pf2mp.density.kernel_sums import KernelSums

WAYS = {
    "the fastest": lambda sums, q: sums(q),
    "attention": lambda sums, q: sums._by_attention(q - sums._centre),
    "double attention": lambda sums, q: sums._double_keys.attend(q - sums._centre),
    "differences": lambda sums, q: sums._from_differences(q - sums._centre),
}
if kernel_tree.is_available():
    WAYS["tree"] = lambda sums, q: sums.tree.sums(q)
EVERY_WAY = pytest.mark.parametrize("way", WAYS.values(), ids=WAYS.keys())


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
def test_sums_at_demonstrated_positions_are_those_of_brute_force(way, dim: int, h: float) -> None:
    anchors = paths(3000, dim)
    queries = anchors[::7] + h * torch.randn(
        len(anchors[::7]), dim, generator=torch.Generator().manual_seed(1)
    )
    check(way, queries, anchors, h)


@pytest.mark.slow
@pytest.mark.parametrize("way", ["attention", "the fastest"])
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


@EVERY_WAY
@pytest.mark.parametrize("far", [1e6, 1e20, 3e38])
def test_sums_are_finite_everywhere(far: float, way) -> None:
    queries = torch.tensor([[far, -far], [far, 0.0], [0.0, 0.0]])
    offsets, log_sums = way(KernelSums(paths(500, 2), 0.015), queries)
    assert torch.isfinite(offsets).all()
    assert torch.isfinite(log_sums).all()


def test_float32_is_used_only_where_it_resolves_the_weights() -> None:
    wide, narrow = KernelSums(paths(500, 2), 0.5), KernelSums(paths(500, 2), 0.015)
    queries = paths(50, 2, seed=1)
    assert wide._keys.are_resolved_in_single(queries)
    assert not wide._keys.are_resolved_in_single(queries + 100)
    assert not narrow._keys.are_resolved_in_single(queries)


def test_without_the_extension_attention_gives_the_same_sums(monkeypatch: pytest.MonkeyPatch) -> None:
    sums, queries = KernelSums(paths(1000, 2), 0.02), paths(100, 2, seed=1)
    wanted = sums(queries)
    monkeypatch.setattr("lerobot_pf2mp.density.kernel_tree._kernel_tree", None)
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


@pytest.mark.slow
@pytest.mark.parametrize(
    "way",
    ["_double_keys.attend(q)", "_from_differences(q)", "__call__(q)"],
)
def test_memory_does_not_grow_with_the_pairs(way: str) -> None:
    code = f"""
import resource, torch
from lerobot_pf2mp.density.kernel_sums import KernelSums
def peak(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # [MB]
q, sums = torch.rand(20_000, 2), KernelSums(torch.rand(20_000, 2), 0.01)
sums.{way.replace("(q", "(q[:300]")}
before = peak()
sums.{way}
print(peak() - before)
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert float(result.stdout) < 100  # all pairs in float32 would be 1600 MB
