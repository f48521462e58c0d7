# SPDX-License-Identifier: Apache-2.0
"""A density never judges what it was made from, and few wrong values cannot fool it."""

import math

import pytest
import torch
from torch import Tensor

from lerobot_pf2mp.density import kernel_tree
from lerobot_pf2mp.density.bandwidth import select_bandwidth
from lerobot_pf2mp.density.held_out import N_BLOCKS, HeldOut, group_numbers
from lerobot_pf2mp.potential_field import PotentialField, fit, fit_judged


def strokes(
    n_episodes: int, n_frames: int = 100, dim: int = 2, spread: float = 0.05
) -> tuple[Tensor, Tensor]:
    """Episodes along one curve, each with its own smooth deviation. Successive frames are nearer than episodes."""
    t = torch.linspace(0, 1, n_frames)
    phases = torch.linspace(0, 3, dim)
    curve = torch.sin(2 * math.pi * t.unsqueeze(1) + phases)  # (T, D)
    waves = torch.stack([torch.ones(n_frames), torch.sin(math.pi * t), torch.cos(3 * t)])  # (3, T)
    deviation = spread * torch.einsum("ekd,kt->etd", torch.randn(n_episodes, 3, dim), waves)
    points = (curve + deviation).reshape(-1, dim)
    return points, torch.arange(n_episodes).repeat_interleave(n_frames)


def brute_force_log_density(points: Tensor, is_other: Tensor, a: Tensor, h: float) -> float:
    squares = (points[is_other].double() - a.double()).square().sum(dim=1)
    log_normaliser = math.log(int(is_other.sum())) + points.shape[1] * math.log(h * math.sqrt(2 * math.pi))
    return (torch.logsumexp(-squares / (2 * h * h), dim=0) - log_normaliser).item()


@pytest.fixture(params=["tree", "torch"])
def engine(request, monkeypatch):
    if request.param == "torch":
        monkeypatch.setattr(kernel_tree, "_kernel_tree", None)
    return request.param


def outside_of_held_out_episodes(points: Tensor, episodes: Tensor, **options) -> float:
    shares = []
    for episode in episodes.unique()[::3]:
        is_held_out = episodes == episode
        field = fit(points[~is_held_out], episodes=episodes[~is_held_out], **options)
        shares.append((~field.is_safe(points[is_held_out])).double().mean().item())
    return sum(shares) / len(shares)


@pytest.mark.parametrize("dim", [1, 2, 5])
def test_a_point_is_judged_by_the_other_episodes_alone(engine, dim):
    points, episodes = strokes(6, 20, dim)
    judged = HeldOut(points, group_numbers(len(points), episodes)).judge(0.1)
    for i in range(0, len(points), 7):
        is_other = episodes != episodes[i]
        expected = brute_force_log_density(points, is_other, points[i], 0.1)
        assert judged.log_density[i].item() == pytest.approx(expected, rel=1e-5, abs=1e-4)
        nearest = (points[is_other] - points[i]).norm(dim=1).min().item()
        assert judged.distance[i].item() == pytest.approx(nearest, rel=1e-4, abs=1e-6)


def test_a_recording_without_episodes_is_judged_without_the_blocks_of_time_around_a_frame(engine):
    points, _ = strokes(1, 1000)
    groups = group_numbers(1000, None)
    assert torch.equal(groups, torch.arange(1000) // (1000 // N_BLOCKS))
    judged = HeldOut(points, groups).judge(0.1)
    is_other = (groups - groups[500]).abs() > 1
    assert is_other.sum() == 970
    expected = brute_force_log_density(points, is_other, points[500], 0.1)
    assert judged.log_density[500].item() == pytest.approx(expected, abs=1e-4)


def test_a_single_episode_is_cut_into_blocks_of_equal_time_wherever_its_frames_lie():
    times = torch.tensor([5000, 5001, 5500, 5999])
    assert group_numbers(4, torch.tensor([7, 7, 7, 7]), times).tolist() == [0, 0, 50, 99]
    assert group_numbers(4, None, times).tolist() == [0, 0, 50, 99]


def test_episodes_have_even_numbers_so_that_successive_ones_judge_each_other():
    assert group_numbers(5, torch.tensor([9, 3, 3, 4, 9])).tolist() == [4, 0, 0, 2, 4]


def test_the_bandwidth_is_that_of_the_distance_between_episodes_not_between_frames():
    points, episodes = strokes(12, 300)
    by_frame = select_bandwidth(points, "likelihood")
    by_episode = fit(points, episodes=episodes).bandwidth
    assert by_episode > 1.5 * by_frame
    # Recorded at a tenth of the rate, the episodes are as far apart as before.
    slow = fit(points[::10], episodes=episodes[::10]).bandwidth
    assert by_episode == pytest.approx(slow, rel=0.35)


@pytest.mark.parametrize("quantile", [0.01, 0.05])
def test_held_out_episodes_lie_outside_as_often_as_the_quantile_says(quantile):
    points, episodes = strokes(30, 60)
    outside = outside_of_held_out_episodes(points, episodes, threshold_quantile=quantile)
    assert 0.2 * quantile <= outside <= 2 * quantile


def test_judged_by_itself_a_fast_recording_looks_far_safer_than_it_is():
    points, episodes = strokes(12, 400)
    outside = outside_of_held_out_episodes(points, episodes)
    assert outside <= 0.1
    assert outside_of_held_out_episodes(points, episodes, leave_out="nothing") > 2 * outside


@pytest.mark.parametrize("size", [0.0, 2.0, 1e8])
@pytest.mark.parametrize("dim", [2, 6])
def test_one_percent_of_wrong_values_of_any_size_change_neither_bandwidth_nor_threshold(engine, size, dim):
    points, episodes = strokes(20, 60, dim)
    clean = fit(points, episodes=episodes)
    bad = torch.randperm(len(points))[: len(points) // 100]
    spoilt = points.clone()
    spoilt[bad] = (
        size
        * torch.nn.functional.normalize(torch.randn(len(bad), dim), dim=1)
        * (1 + torch.rand(len(bad), 1))
    )
    judged = fit_judged(spoilt, episodes=episodes)
    assert judged.field.bandwidth == pytest.approx(clean.bandwidth, rel=0.1)
    good = torch.ones(len(points), dtype=torch.bool)
    good[bad] = False
    assert (~judged.field.is_safe(points)).double().mean() <= 0.02
    if size >= 2:
        assert torch.equal(judged.is_outlying, ~good)
        assert not judged.field.is_safe(spoilt[bad]).any()
        assert len(judged.field.anchors) == len(points) - len(bad)


def test_a_saturated_sensor_is_found_though_its_wrong_values_are_near_one_another():
    points, episodes = strokes(20, 60)
    spoilt = points.clone()
    spoilt[7::120, 0] = 5.0
    judged = fit_judged(spoilt, episodes=episodes)
    assert judged.is_outlying.nonzero().flatten().tolist() == list(range(7, 1200, 120))
    assert not judged.field.is_safe(spoilt[7::120]).any()


def test_a_way_that_only_one_episode_went_is_kept_but_not_safe():
    points, episodes = strokes(20, 100, spread=0.01)
    detour = points.clone()
    alone = episodes == 3
    bump = 2.5 * torch.sin(math.pi * torch.linspace(0, 1, 100)).square()
    detour[alone, 1] += bump
    judged = fit_judged(detour, episodes=episodes)
    assert not judged.is_outlying.any()
    far = alone & (detour[:, 1] > 1.3)
    assert far.sum() > 10
    assert not judged.field.safe_anchors[far].any()
    assert judged.field.bandwidth == pytest.approx(fit(points, episodes=episodes).bandwidth, rel=0.3)


@pytest.mark.parametrize("noise", [0.0, 1e-6, 1e-4, 1e-3])
def test_standing_still_does_not_change_the_bandwidth(noise):
    points, episodes = strokes(20, 100)
    h = fit(points, episodes=episodes).bandwidth
    still = points[::100].repeat_interleave(60, dim=0)
    still = still + noise * torch.randn_like(still)
    with_rests = torch.cat([points, still]), torch.cat([episodes, torch.arange(20).repeat_interleave(60)])
    assert fit(with_rests[0], episodes=with_rests[1]).bandwidth == pytest.approx(h, rel=0.1)
    # Also where all of them rest at the same place.
    home = torch.zeros(1200, 2) + noise * torch.randn(1200, 2)
    at_home = torch.cat([points, home]), torch.cat([episodes, torch.arange(20).repeat_interleave(60)])
    assert fit(at_home[0], episodes=at_home[1]).bandwidth == pytest.approx(h, rel=0.1)


def test_the_order_of_the_points_changes_nothing():
    points, episodes = strokes(10, 50)
    order = torch.randperm(500)
    field, permuted = fit(points, episodes=episodes), fit(points[order], episodes=3 * episodes[order] + 5)
    assert permuted.bandwidth == pytest.approx(field.bandwidth, rel=1e-5)
    assert permuted.log_threshold == pytest.approx(field.log_threshold, abs=1e-3)
    assert torch.equal(permuted.anchor_is_safe, field.anchor_is_safe[order])


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize(("dim", "h"), [(2, 0.002), (9, 0.02)])
def test_points_that_stand_alone_tie_at_the_threshold_and_lie_in_the_safe_set(engine, dim, h, compiled):
    points = torch.rand(200, dim) * 2 - 1
    field = fit(points, bandwidth=h, threshold_quantile=0.2, leave_out="nothing", alpha=-1.0)
    exact = torch.cdist(points.double(), points.double()).square().neg() / (2 * h * h)
    log_density = torch.logsumexp(exact, dim=1) - field._log_normaliser
    expected = log_density > field.log_threshold
    assert expected.double().mean() > 0.75
    offset_to_safe_set = field.prepared.offset_to_safe_set
    if compiled:
        offset_to_safe_set = torch.compile(offset_to_safe_set, backend="eager", fullgraph=True)
    is_outside = offset_to_safe_set(points).norm(dim=1) > 0
    assert torch.equal(field.is_safe(points), expected)
    assert torch.equal(field.safe_anchors, expected)
    assert not is_outside[expected].any()


@pytest.mark.parametrize("n_points", [1, 2, 3, 5])
def test_a_handful_of_points_still_gives_a_field(n_points):
    points = torch.randn(n_points, 3)
    for episodes in (None, torch.zeros(n_points, dtype=torch.int64), torch.arange(n_points)):
        field = fit(points, episodes=episodes, alpha=-1.0)
        assert math.isfinite(field.log_threshold)
        assert field.potential_gradient(torch.randn(4, 3)).isfinite().all()


def angles(points: Tensor, periods: Tensor) -> Tensor:
    """The same directions, within half a period of zero in the dimensions with a period."""
    around = torch.where(periods > 0, periods, math.inf)
    return points - torch.where(periods > 0, periods * torch.round(points / around), 0.0)


@pytest.mark.parametrize("alpha", [0.0, -1.0])
def test_a_field_over_an_angle_is_the_same_wherever_the_angle_is_cut(engine, alpha):
    periods = torch.tensor([2.0, 0.0])
    points, episodes = strokes(10, 60)
    points = 0.2 * points  # within a fifth of the period
    turned = points.clone()
    turned[:, 0] += 0.97
    plain = fit(points, episodes=episodes, alpha=alpha)
    field = fit(angles(turned, periods), episodes=episodes, periods=periods, alpha=alpha)
    assert field.bandwidth == pytest.approx(plain.bandwidth, rel=0.02)
    a = 0.3 * torch.randn(50, 2)
    b = a + torch.tensor([0.97, 0.0]) + torch.tensor([2.0, 0.0]) * torch.randint(-3, 4, (50, 1))
    plain = PotentialField(
        plain.anchors, field.bandwidth, field.log_threshold, alpha, None, plain.anchor_is_safe
    )
    field = PotentialField(
        field.anchors, field.bandwidth, field.log_threshold, alpha, periods, plain.anchor_is_safe
    )
    torch.testing.assert_close(field.log_density(b), plain.log_density(a), rtol=1e-4, atol=1e-3)
    for method in ("score", "mean_shift", "potential_gradient", "offset_to_safe_set"):
        actual, expected = getattr(field, method)(b), getattr(plain, method)(a)
        torch.testing.assert_close(actual, expected, rtol=1e-3, atol=1e-3, msg=method)
    steps = field.step_to_safety(b, 0.7, 0.1)
    torch.testing.assert_close(steps, plain.step_to_safety(a, 0.7, 0.1), rtol=1e-3, atol=1e-4)


def test_the_score_is_small_at_the_cut_of_an_angle():
    points = torch.cat([torch.linspace(3.0, 3.14, 20), torch.linspace(-3.14, -3.0, 20)]).unsqueeze(1)
    period = torch.tensor([2 * math.pi])
    field = PotentialField(points, 0.05, periods=period)
    assert field.score(torch.tensor([[3.141]])).abs().item() < 1
    assert PotentialField(points, 0.05).score(torch.tensor([[3.141]])).abs().item() > 10


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"episodes": torch.zeros(3, dtype=torch.int64)},
            r"episodes must be whole numbers of shape \(10,\), got \(3,\)",
        ),
        ({"episodes": torch.zeros(10)}, "episodes must be whole numbers"),
        ({"times": torch.zeros(10, 1, dtype=torch.int64)}, "times must be whole numbers"),
        ({"periods": torch.zeros(3)}, "periods must be 2 finite numbers of at least 0"),
        ({"periods": torch.tensor([1.0, -1.0])}, "periods must be 2 finite numbers of at least 0"),
        ({"leave_out": "frame"}, r"leave_out must be one of \('episode', 'nothing'\), got 'frame'"),
    ],
)
def test_a_bad_argument_is_an_error(arguments, message):
    with pytest.raises(ValueError, match=message):
        fit(torch.randn(10, 2), **arguments)
