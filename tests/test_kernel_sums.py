# SPDX-License-Identifier: Apache-2.0
"""Kernel sums, each way of computing them against brute force in double precision."""

import subprocess
import sys

import pytest
import torch

from lerobot_pf2mp.kernel_sums import KernelSums

WAYS = {
    "the fastest": lambda sums, q: sums(q),
    "attention": lambda sums, q: sums._by_attention(q - sums._centre, in_double=False),
    "double attention": lambda sums, q: sums._by_attention(q - sums._centre, in_double=True),
    "differences": lambda sums, q: sums._from_differences(q - sums._centre),
    "blocks": lambda sums, q: sums._among_blocks(q - sums._centre),
    "neighbours": lambda sums, q: sums._among_neighbours(q - sums._centre),
}
EVERY_WAY = pytest.mark.parametrize("way", WAYS.values(), ids=WAYS.keys())


@pytest.fixture(autouse=True)
def blocks_however_many_of_them_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lerobot_pf2mp.kernel_sums._SMALL_SHARE", 1.0)


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


@pytest.mark.parametrize("way", ["attention", "neighbours"])
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


@pytest.mark.parametrize("n_many", [0, 2**25], ids=["neighbours", "attention"])
@pytest.mark.parametrize("far", [1e6, 1e20, 3e38])
def test_sums_are_finite_everywhere(far: float, n_many: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lerobot_pf2mp.kernel_sums._MANY_PAIRS", n_many)
    queries = torch.tensor([[far, -far], [far, 0.0], [0.0, 0.0]])
    offsets, log_sums = KernelSums(paths(500, 2), 0.015)(queries)
    assert torch.isfinite(offsets).all()
    assert torch.isfinite(log_sums).all()


def test_float32_is_used_only_where_it_resolves_the_weights() -> None:
    wide, narrow = KernelSums(paths(500, 2), 0.5), KernelSums(paths(500, 2), 0.015)
    queries = paths(50, 2, seed=1)
    assert wide._keys.are_resolved_in_single(queries)
    assert not wide._keys.are_resolved_in_single(queries + 100)
    assert not narrow._keys.are_resolved_in_single(queries)


def test_neighbours_are_a_small_part_of_all_anchors() -> None:
    sums = KernelSums(paths(50_000, 2), 0.005)
    groups = type(sums._groups).of(sums._centred, 128)
    n_pairs = sum(
        len(sums._anchors_of(near)) * len(members)
        for near, members in zip(sums._near(groups), groups.members(), strict=True)
    )
    assert n_pairs < 0.1 * 50_000**2


def test_blocks_are_left_to_attention_where_most_of_them_count(monkeypatch: pytest.MonkeyPatch) -> None:
    anchors = paths(3000, 2)
    sums, scattered = KernelSums(anchors, 0.02), anchors[torch.randperm(len(anchors))]
    plan = torch.linspace(-0.1, 0.1, 80).unsqueeze(1).expand(80, 2)
    monkeypatch.setattr("lerobot_pf2mp.kernel_sums._SMALL_SHARE", 0.5)
    assert sums._among_blocks(plan - sums._centre) is not None
    assert sums._among_blocks(scattered - sums._centre) is None
    check(lambda sums, q: sums(q), scattered[:500], anchors, 0.02)


def test_many_pairs_are_summed_among_neighbours(monkeypatch: pytest.MonkeyPatch) -> None:
    sums = KernelSums(paths(5000, 2), 0.02)
    queries = paths(3000, 2, seed=1)
    dense = sums(queries)
    monkeypatch.setattr("lerobot_pf2mp.kernel_sums._MANY_PAIRS", 1)
    monkeypatch.setattr(KernelSums, "_by_attention", None)
    monkeypatch.setattr(KernelSums, "_among_blocks", None)
    for one, other in zip(sums(queries), dense, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


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
    ["_by_attention(q, in_double=True)", "_from_differences(q)", "_among_blocks(q)", "_among_neighbours(q)"],
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
