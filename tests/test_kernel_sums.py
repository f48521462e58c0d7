# SPDX-License-Identifier: Apache-2.0
"""Kernel sums: each implementation against brute force in double precision."""

import math
import subprocess
import sys

import pytest
import torch
from demonstrated_paths import (
    TURN,
    brute_force,
    brute_force_without_own_group,
    differences,
    paths,
    some_periods,
    turning_paths,
)

from lerobot_pf2mp.density import kernel_tree
from lerobot_pf2mp.density.kernel_sums import KernelSums
from lerobot_pf2mp.density.kernels import log_kernels, offsets_to_nearest

WAYS = {
    "the fastest": lambda sums, q: sums(q),
    "attention": lambda sums, q: sums._by_attention(q - sums._centre),
    "double attention": lambda sums, q: sums._double_keys.attend(q - sums._centre),
    "differences": lambda sums, q: sums._from_differences(q - sums._centre),
}
if kernel_tree.is_available():
    WAYS["tree"] = lambda sums, q: sums.tree.sums(q)
EVERY_WAY = pytest.mark.parametrize("way", WAYS.values(), ids=WAYS.keys())


ANGULAR_WAYS = {name: WAYS[name] for name in ("the fastest", "differences", "tree") if name in WAYS}
EVERY_ANGULAR_WAY = pytest.mark.parametrize("way", ANGULAR_WAYS.values(), ids=ANGULAR_WAYS.keys())


@pytest.fixture(params=["extension", "torch"])
def _implementation(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param == "torch":
        monkeypatch.setattr("lerobot_pf2mp.density.kernel_tree._kernel_tree", None)
    elif not kernel_tree.is_available():
        pytest.skip("the C extension could not be built")


def check(
    way,
    queries: torch.Tensor,
    anchors: torch.Tensor,
    h: float,
    rtol: float = 1e-4,
    periods: torch.Tensor | None = None,
) -> None:
    """Offsets are right up to `rtol` of their usual length, log sums up to `rtol`."""
    offsets, log_sums = way(KernelSums(anchors, h, periods), queries)
    wanted, wanted_sums = brute_force(queries, anchors, h, periods)
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


@EVERY_ANGULAR_WAY
@pytest.mark.parametrize("n_anchors", [1, 65, 3000])
@pytest.mark.parametrize(("dim", "n_angles"), [(1, 0), (1, 1), (2, 1), (2, 2), (7, 1), (7, 7)])
@pytest.mark.parametrize("h", [0.015, 0.3])
def test_sums_over_angles_are_those_of_brute_force(
    way, h: float, dim: int, n_angles: int, n_anchors: int
) -> None:
    periods = some_periods(dim, n_angles)
    anchors = turning_paths(n_anchors, periods)
    near = anchors[:: max(1, n_anchors // 300)]
    near = near + h * torch.randn(near.shape)
    anywhere = turning_paths(300, periods, seed=1) + torch.randn(300, dim) * periods
    for queries in (near, near + 4 * periods, anywhere):
        check(way, queries, anchors, h, periods=periods)


@EVERY_ANGULAR_WAY
def test_sums_over_angles_are_finite_and_right_far_away(way) -> None:
    periods = some_periods(2, 1)
    anchors = turning_paths(500, periods)
    queries = torch.tensor([[0.0, 1e4], [1e3, -1e5], [0.0, 0.0]])
    check(way, queries, anchors, 0.05, rtol=1e-3, periods=periods)
    queries = torch.tensor([[0.0, 1e20], [0.0, -3e38], [1e6, 1e6]])
    for found in way(KernelSums(anchors, 0.05, periods), queries):
        assert torch.isfinite(found).all()


@EVERY_WAY
def test_periods_of_zero_are_none(way) -> None:
    anchors, queries = paths(1000, 3), paths(100, 3, seed=1)
    without, zeros = KernelSums(anchors, 0.05), KernelSums(anchors, 0.05, torch.zeros(3))
    assert zeros.periods is None
    for one, other in zip(way(without, queries), way(zeros, queries), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize(
    ("periods", "message"), [([1.0], "shape"), ([1.0, -1.0], "0"), ([0.0, torch.nan], "0")]
)
def test_periods_are_one_number_for_each_dimension(periods: list[float], message: str) -> None:
    with pytest.raises(ValueError, match=rf"periods must .*{message}"):
        KernelSums(paths(10, 2), 0.1, torch.tensor(periods))


@pytest.mark.parametrize("n_anchors", [1, 3000])
@pytest.mark.parametrize(("dim", "n_angles"), [(1, 1), (2, 1), (7, 7)])
def test_the_nearest_anchor_is_nearest_on_the_circle(dim: int, n_angles: int, n_anchors: int) -> None:
    periods = some_periods(dim, n_angles)
    anchors, queries = turning_paths(n_anchors, periods), turning_paths(400, periods, seed=1)
    offsets = differences(queries, anchors, periods)
    squares = offsets.square().sum(dim=-1)
    wanted = offsets[torch.arange(400), squares.argmin(dim=1)]
    found = offsets_to_nearest(queries, anchors, 0.1, periods)
    torch.testing.assert_close(found.double(), wanted, rtol=1e-4, atol=1e-5)
    exponents = log_kernels(queries, anchors, 0.1, periods).double()
    torch.testing.assert_close(exponents, -squares / 0.02, rtol=1e-4, atol=1e-4)


@pytest.mark.usefixtures("_implementation")
@pytest.mark.parametrize("n_anchors", [1, 65, 3000])
@pytest.mark.parametrize(("dim", "n_angles"), [(1, 0), (1, 1), (2, 0), (2, 1), (7, 0), (7, 1), (7, 7)])
@pytest.mark.parametrize("h", [0.015, 0.3])
def test_sums_without_the_own_group_are_those_of_brute_force(
    h: float, dim: int, n_angles: int, n_anchors: int
) -> None:
    periods = some_periods(dim, n_angles)
    anchors = turning_paths(n_anchors, periods)
    groups = torch.arange(n_anchors) // 9
    queries = torch.cat([anchors[:300], turning_paths(300, periods, seed=1) + torch.randn(300, dim)])
    own = torch.cat([groups[:300], torch.randint(-2, n_anchors // 9 + 3, (300,))])
    found, distances = KernelSums(anchors, h, periods, groups).sums_without_own_group(queries, own)
    wanted, wanted_distances = brute_force_without_own_group(queries, anchors, h, own, groups, periods)
    torch.testing.assert_close(found.double(), wanted, rtol=1e-6, atol=1e-4)
    torch.testing.assert_close(distances.double(), wanted_distances, rtol=1e-5, atol=1e-6)
    assert found.isfinite().any() or n_anchors == 1


@pytest.mark.usefixtures("_implementation")
def test_adjacent_groups_are_left_out_and_the_next_but_one_are_not() -> None:
    groups = torch.tensor([4, 5, 6, 7, 3, 50])
    anchors = torch.tensor([[0.0], [0.1], [0.2], [0.3], [0.5], [9.0]])
    sums = KernelSums(anchors, 1.0, groups=groups)
    log_sums, distances = sums.sums_without_own_group(torch.zeros(4, 1), torch.tensor([5, 4, 2, 8]))
    wanted = torch.tensor([0.3, 0.2, 0.0, 0.0])
    torch.testing.assert_close(distances, wanted)
    kept = ([3, 4, 5], [2, 3, 5], [0, 1, 2, 3, 5], [0, 1, 2, 4, 5])
    for log_sum, i in zip(log_sums, kept, strict=True):
        torch.testing.assert_close(log_sum, (-anchors[i, 0].square() / 2).logsumexp(dim=0))


@pytest.mark.usefixtures("_implementation")
def test_where_no_other_group_remains_nothing_is_near() -> None:
    anchors, groups = paths(1000, 2), torch.full((1000,), 7)
    sums = KernelSums(anchors, 0.02, groups=groups)
    own = torch.tensor([7, 8, 9, 6, 7])
    log_sums, distances = sums.sums_without_own_group(anchors[:5], own)
    is_alone = torch.tensor([True, True, False, True, True])
    assert torch.equal(log_sums == -math.inf, is_alone)
    assert torch.equal(distances == math.inf, is_alone)
    assert distances[2] == 0


@pytest.mark.usefixtures("_implementation")
def test_the_own_group_is_left_out_and_not_subtracted() -> None:
    # The own anchors are millions of times nearer than the others.
    generator = torch.Generator().manual_seed(0)
    own = 1e-6 * torch.randn(500, 2, generator=generator)
    others = torch.tensor([3.0, 4.0]) + 0.1 * torch.randn(500, 2, generator=generator)
    anchors, groups = torch.cat([own, others]), torch.arange(1000) // 500 * 5
    for h in (0.01, 1.0):
        sums = KernelSums(anchors, h, groups=groups)
        found, distances = sums.sums_without_own_group(own, groups[:500])
        wanted, wanted_distances = brute_force_without_own_group(own, anchors, h, groups[:500], groups)
        torch.testing.assert_close(found.double(), wanted, rtol=1e-6, atol=1e-5)
        torch.testing.assert_close(distances.double(), wanted_distances, rtol=1e-6, atol=0.0)


@pytest.mark.usefixtures("_implementation")
def test_a_query_that_is_not_a_number_has_no_judgement() -> None:
    sums = KernelSums(paths(300, 2), 0.05, groups=torch.arange(300))
    queries = torch.cat([paths(20, 2, seed=1), torch.full((1, 2), torch.nan)])
    for found in sums.sums_without_own_group(queries, torch.arange(21)):
        assert torch.equal(found.isnan(), torch.arange(21) == 20)
    for found in sums.sums_without_own_group(queries[:0], torch.arange(0)):
        assert found.shape == (0,)


@pytest.mark.usefixtures("_implementation")
def test_the_blocks_do_not_change_the_sums_without_the_own_group(monkeypatch: pytest.MonkeyPatch) -> None:
    sums = KernelSums(paths(300, 2), 0.05, torch.tensor([TURN, 0.0]), torch.arange(300) // 7)
    wanted = sums.sums_without_own_group(sums.anchors, sums.groups)
    monkeypatch.setattr("lerobot_pf2mp.density.kernel_sums.PAIRS_PER_BLOCK", 1000)
    for one, other in zip(sums.sums_without_own_group(sums.anchors, sums.groups), wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5)


def test_groups_are_numbers_of_32_bits_for_each_point() -> None:
    anchors, groups = paths(10, 2), torch.arange(10)
    with pytest.raises(ValueError, match="must have groups"):
        KernelSums(anchors, 0.1).sums_without_own_group(anchors, groups)
    with pytest.raises(ValueError, match=r"groups must be \(10,\)"):
        KernelSums(anchors, 0.1, groups=groups[1:])
    with pytest.raises(ValueError, match="32 bits"):
        KernelSums(anchors, 0.1, groups=groups + 2**31 - 10)
    sums = KernelSums(anchors, 0.1, groups=groups + 2**31 - 12)
    with pytest.raises(ValueError, match="32 bits"):
        sums.sums_without_own_group(anchors, groups - 2**31)
    log_sums, _ = sums.sums_without_own_group(anchors, groups - 2**31 + 1)
    assert log_sums.isfinite().all()


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
