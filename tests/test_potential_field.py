# SPDX-License-Identifier: Apache-2.0
import math

import pytest
import torch
from torch import Tensor

from lerobot_pf2mp.density import bandwidth as bandwidths
from lerobot_pf2mp.density import kernel_sums, kernels
from lerobot_pf2mp.density.bandwidth import BANDWIDTH_RULES, leave_one_out_log_likelihood, select_bandwidth
from lerobot_pf2mp.density.kernel_sums import KernelSums
from lerobot_pf2mp.density.kernels import offsets_to_nearest
from lerobot_pf2mp.potential_field import PotentialField, fit, fit_judged

# What follows is the specification in its most obvious form: all pairs at once, float64, autograd.


def log_density_float64(anchors: Tensor, h: float, a: Tensor) -> Tensor:
    squares = (a.double().unsqueeze(-2) - anchors.double()).square().sum(dim=-1)  # (..., M)
    log_normaliser = math.log(len(anchors)) + anchors.shape[1] * (math.log(h) + 0.5 * math.log(2 * math.pi))
    return torch.logsumexp(-squares / (2 * h**2), dim=-1) - log_normaliser


def score_float64(anchors: Tensor, h: float, a: Tensor) -> Tensor:
    a = a.double().requires_grad_()
    return torch.autograd.grad(log_density_float64(anchors, h, a).sum(), a)[0]


def potential_float64(field: PotentialField, a: Tensor) -> Tensor:
    h, anchors = field.bandwidth, field.anchors.double()
    distance = torch.cdist(a.double(), anchors[field.safe_anchors]).amin(dim=-1)
    log_p = log_density_float64(anchors, h, a)
    return log_p + field.alpha * distance * (log_p <= field.log_threshold)


def leave_one_out_float64(points: Tensor, h: float) -> float:
    others = [torch.cat([points[:i], points[i + 1 :]]) for i in range(len(points))]
    return sum(
        log_density_float64(rest, h, point).item() for rest, point in zip(others, points, strict=True)
    ) / len(points)


def assert_rows_agree(actual: Tensor, expected: Tensor, rtol: float, atol: float = 1e-5) -> None:
    """The error of each vector is small against its own length."""
    assert actual.isfinite().all()
    error = (actual.double() - expected).norm(dim=-1)
    assert (error <= atol + rtol * expected.norm(dim=-1)).all(), f"largest error {error.max()}"


def clusters(n_points: int, dim: int) -> Tensor:
    centres = torch.randn(5, dim)
    return centres[torch.arange(n_points) % 5] + 0.2 * torch.randn(n_points, dim)


def with_duplicates(dim: int) -> Tensor:
    return clusters(50, dim).repeat(4, 1)


def with_a_constant_dimension(dim: int) -> Tensor:
    points = clusters(200, dim)
    points[:, -1] = 0.1
    return points


def one_anchor(dim: int) -> Tensor:
    return torch.randn(1, dim)


def spread_of_a_million(dim: int) -> Tensor:
    return 1e6 * clusters(200, dim)


def all_kinds_of_queries(anchors: Tensor, h: float) -> Tensor:
    """Near the anchors, 10 to 50 bandwidths away, and prior samples, in units of the anchors' spread."""
    n, dim = 40, anchors.shape[1]
    unit = max(anchors.std().item(), h) if len(anchors) > 1 else 1.0
    start = anchors[torch.arange(n) % len(anchors)]
    direction = torch.nn.functional.normalize(torch.randn(n, dim), dim=-1)
    far = start + torch.linspace(10, 50, n).unsqueeze(-1) * h * direction
    return torch.cat([start + h * torch.randn(n, dim), far, 5 * unit * torch.randn(n, dim)])


@pytest.mark.parametrize("dim", [2, 3, 9])
@pytest.mark.parametrize(
    "make_anchors",
    [clusters, with_duplicates, with_a_constant_dimension, one_anchor, spread_of_a_million],
    ids=lambda make: make.__name__,
)
def test_log_density_and_score_equal_a_float64_brute_force_also_in_the_far_tails(make_anchors, dim):
    anchors = make_anchors(200, dim) if make_anchors is clusters else make_anchors(dim)
    h = 1e5 if make_anchors is spread_of_a_million else 0.1
    a = all_kinds_of_queries(anchors, h)
    field = PotentialField(anchors, h)
    expected = log_density_float64(anchors, h, a)
    torch.testing.assert_close(field.log_density(a).double(), expected, rtol=1e-5, atol=1e-4)
    assert_rows_agree(h * field.score(a), h * score_float64(anchors, h, a), rtol=1e-3, atol=1e-3)


def test_a_common_offset_of_a_million_costs_no_accuracy():
    anchors, a, h = clusters(200, 3) + 1e6, clusters(60, 3) + 1e6, 0.3
    field = PotentialField(anchors, h)
    torch.testing.assert_close(
        field.log_density(a).double(), log_density_float64(anchors, h, a), rtol=1e-4, atol=1e-4
    )
    assert_rows_agree(field.score(a), score_float64(anchors, h, a), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("distance", [0.0, 1.0, 1e3, 1e9, 1e18, 1e30])
def test_everything_is_finite_however_far_away(distance):
    field = fit(clusters(100, 3), bandwidth=0.3, threshold_quantile=0.1, alpha=-2.0)
    a = distance * torch.nn.functional.normalize(torch.randn(10, 3), dim=-1)
    for method in ("local_mean", "score", "log_density", "offset_to_safe_set", "potential_gradient"):
        assert getattr(field, method)(a).isfinite().all(), method


@pytest.mark.parametrize("method", ["log_density", "score", "local_mean", "offset_to_safe_set", "potential"])
@pytest.mark.parametrize("batch_shape", [(), (1,), (7,), (2, 3, 4), (0,), (2, 0)])
def test_any_batch_shape_gives_the_same_numbers_as_one_by_one(method, batch_shape):
    field = fit(clusters(50, 3), bandwidth=0.3, threshold_quantile=0.2, alpha=-1.0)
    a = torch.randn(*batch_shape, 3)
    result = getattr(field, method)(a)
    assert result.shape == (a.shape if result.ndim == a.ndim else batch_shape)
    one_by_one = [getattr(field, method)(row) for row in a.reshape(-1, 3)]
    expected = torch.stack(one_by_one).reshape(result.shape) if one_by_one else torch.empty_like(result)
    torch.testing.assert_close(result, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("method", ["log_density", "score", "offset_to_safe_set", "potential_gradient"])
@pytest.mark.parametrize(
    "mode",
    [torch.inference_mode, lambda: torch.autocast("cpu", torch.bfloat16)],
    ids=["inference_mode", "bfloat16_autocast"],
)
def test_inference_mode_and_autocast_do_not_change_the_result(method, mode):
    points, a = clusters(200, 3), 2 * torch.randn(30, 3)
    expected = getattr(fit(points, bandwidth=0.3, threshold_quantile=0.2, alpha=-1.0), method)(a)
    with mode():
        field = fit(points, bandwidth=0.3, threshold_quantile=0.2, alpha=-1.0)
        result = getattr(field, method)(a)
    assert result.dtype == torch.float32
    assert torch.equal(result, expected)
    assert torch.equal(getattr(field, method)(a), expected)


def test_a_field_used_first_in_inference_mode_serves_queries_that_require_a_gradient():
    field = fit(clusters(50, 2), bandwidth=0.3, threshold_quantile=0.2, alpha=-1.0)
    a = torch.randn(5, 2)
    with torch.inference_mode():
        expected = field.potential_gradient(a)
    assert torch.equal(field.potential_gradient(a.requires_grad_()), expected)


def test_queries_may_come_in_other_floating_point_types():
    field = PotentialField(clusters(50, 2), 0.3)
    a = torch.randn(5, 2).bfloat16()
    assert torch.equal(field.score(a.double()), field.score(a))
    assert field.score(a).dtype == torch.float32


def test_permuting_the_anchors_changes_nothing():
    points, a = clusters(300, 3), 2 * torch.randn(50, 3)
    field = fit(points, bandwidth=0.3, threshold_quantile=0.1, alpha=-1.0)
    order = torch.randperm(300)
    permuted = fit(points[order], times=order, bandwidth=0.3, threshold_quantile=0.1, alpha=-1.0)
    assert permuted.log_threshold == pytest.approx(field.log_threshold, abs=1e-5)
    torch.testing.assert_close(permuted.log_density(a), field.log_density(a), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(permuted.potential_gradient(a), field.potential_gradient(a))
    for rule in BANDWIDTH_RULES:
        assert select_bandwidth(points[torch.randperm(300)], rule) == pytest.approx(
            select_bandwidth(points, rule), rel=1e-6
        )


def test_translating_anchors_and_actions_together_leaves_score_and_density():
    anchors, a, shift = clusters(100, 3), torch.randn(50, 3), torch.tensor([4.0, -2.0, 0.5])
    field, shifted = PotentialField(anchors, 0.3), PotentialField(anchors + shift, 0.3)
    torch.testing.assert_close(shifted.score(a + shift), field.score(a), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(shifted.log_density(a + shift), field.log_density(a), rtol=1e-4, atol=1e-4)


def test_rotating_anchors_and_actions_together_rotates_the_score():
    anchors, a = clusters(100, 3), torch.randn(50, 3)
    rotation = torch.linalg.qr(torch.randn(3, 3)).Q
    field, rotated = PotentialField(anchors, 0.3), PotentialField(anchors @ rotation, 0.3)
    torch.testing.assert_close(rotated.score(a @ rotation), field.score(a) @ rotation, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(rotated.log_density(a @ rotation), field.log_density(a), rtol=1e-4, atol=1e-4)


def test_the_density_integrates_to_one():
    anchors = 0.5 * torch.randn(40, 2)
    axis = torch.linspace(-5, 5, 201)
    density = PotentialField(anchors, 0.2).log_density(torch.cartesian_prod(axis, axis)).double().exp()
    assert density.sum().item() * (axis[1] - axis[0]).item() ** 2 == pytest.approx(1, abs=1e-4)


def test_the_local_mean_is_the_only_anchor_if_there_is_one():
    anchor = torch.tensor([[1.0, 2.0]])
    torch.testing.assert_close(
        PotentialField(anchor, 0.1).local_mean(3 * torch.randn(9, 2)), anchor.expand(9, 2)
    )


def test_the_potential_gradient_equals_finite_differences_inside_the_safe_set_and_far_outside():
    field = fit(clusters(200, 3), bandwidth=0.3, threshold_quantile=0.2, alpha=-3.0)
    inside = field.anchors[field.log_density(field.anchors) > field.log_threshold + 0.1][:30]
    far = 10 * torch.nn.functional.normalize(torch.randn(30, 3), dim=-1)
    assert (field.offset_to_safe_set(inside) == 0).all()
    assert (field.offset_to_safe_set(far) != 0).any(dim=-1).all()
    step = 1e-5 * torch.eye(3, dtype=torch.float64)
    for a in (inside, far):
        torch.testing.assert_close(
            field.potential(a).double(), potential_float64(field, a), rtol=1e-5, atol=1e-4
        )
        ahead = potential_float64(field, a.double().unsqueeze(1) + step)  # (Q, 3)
        behind = potential_float64(field, a.double().unsqueeze(1) - step)
        assert_rows_agree(field.potential_gradient(a), (ahead - behind) / 2e-5, rtol=1e-4, atol=1e-3)


def test_alpha_makes_a_difference_outside_the_safe_set_only():
    points = clusters(200, 2)
    plain = fit(points, bandwidth=0.2, threshold_quantile=0.3)
    distant = fit(points, bandwidth=0.2, threshold_quantile=0.3, alpha=-2.0)
    a = 3 * torch.randn(100, 2)
    is_safe = plain.log_density(a) > plain.log_threshold
    difference = distant.potential_gradient(a) - plain.potential_gradient(a)
    assert 0 < is_safe.sum() < 100
    assert (difference[is_safe] == 0).all()
    torch.testing.assert_close(difference[~is_safe].norm(dim=-1), torch.full([int((~is_safe).sum())], 2.0))


@pytest.mark.parametrize("alpha", [0.0, -2.0])
def test_a_small_step_along_the_gradient_raises_the_log_density(alpha):
    field = fit(clusters(200, 2), bandwidth=0.2, threshold_quantile=0.1, alpha=alpha)
    a = torch.cat([2 * torch.randn(100, 2), 20 * torch.randn(100, 2)])
    moved = a + 0.05 * field.bandwidth**2 * field.potential_gradient(a)
    outside = field.offset_to_safe_set(a).norm(dim=-1) > 0.1
    raised = potential_float64(field, moved) > potential_float64(field, a)
    assert raised[outside].all()
    assert outside.sum() > 100


@pytest.mark.parametrize("quantile", [0.0, 0.01, 0.25, 0.5, 0.999, 1.0])
def test_the_threshold_quantile_is_the_share_of_anchors_outside_the_safe_set(quantile):
    points = torch.randn(1000, 2)
    field = fit(points, bandwidth=0.3, threshold_quantile=quantile, leave_out="nothing")
    share = (~field.is_safe(field.anchors)).double().mean().item()
    assert share == pytest.approx(quantile, abs=2.1e-3)
    judged = fit_judged(points, bandwidth=0.3, threshold_quantile=quantile)
    share = (judged.log_density <= judged.field.log_threshold).double().mean().item()
    assert share == pytest.approx(quantile, abs=2.1e-3)


@pytest.mark.parametrize("quantile", [0.0, 0.1, 0.5, 1.0])
def test_the_offset_is_zero_in_the_safe_set_and_ends_at_its_nearest_anchor_outside(quantile):
    field = fit(clusters(300, 3), bandwidth=0.3, threshold_quantile=quantile, alpha=-1.0)
    a = 2 * torch.randn(100, 3)
    offset = field.offset_to_safe_set(a)
    is_safe = field.log_density(a) > field.log_threshold
    assert (offset[is_safe] == 0).all()
    safe_anchors = field.anchors[field.safe_anchors]
    distance = torch.cdist((a + offset)[~is_safe].double(), safe_anchors.double()).amin(dim=-1)
    assert len(distance) > 0
    assert (distance < 1e-5).all()
    nearest = torch.cdist(a[~is_safe].double(), safe_anchors.double()).amin(dim=-1)
    torch.testing.assert_close(offset[~is_safe].norm(dim=-1).double(), nearest, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("count", "dim"), [(100, 1), (500, 2), (77, 9)])
def test_scott_and_silverman_follow_their_formulas(count, dim):
    points = torch.randn(count, dim) * torch.linspace(0.5, 2, dim) + 3
    spread = points.double().var(dim=0, correction=0).mean().sqrt().item()
    scott = spread * count ** (-1 / (dim + 4))
    assert select_bandwidth(points, "scott") == pytest.approx(scott, rel=1e-9)
    silverman = spread * (count * (dim + 2) / 4) ** (-1 / (dim + 4))
    assert select_bandwidth(points, "silverman") == pytest.approx(silverman, rel=1e-9)


@pytest.mark.parametrize("rule", BANDWIDTH_RULES)
def test_a_constant_dimension_does_not_change_the_bandwidth(rule):
    points = clusters(500, 2)
    padded = torch.cat([points, torch.full((500, 1), 0.1)], dim=1)
    assert select_bandwidth(padded, rule) == pytest.approx(select_bandwidth(points, rule), rel=0.02)


@pytest.mark.parametrize("rule", BANDWIDTH_RULES)
def test_the_bandwidth_scales_with_the_points_and_ignores_where_they_are(rule):
    points = clusters(300, 2)
    h = select_bandwidth(points, rule)
    assert select_bandwidth(100 * points, rule) == pytest.approx(100 * h, rel=0.02)
    assert select_bandwidth(points + 50, rule) == pytest.approx(h, rel=0.02)


def test_the_leave_one_out_likelihood_equals_a_float64_brute_force():
    points = clusters(150, 3)
    for h in (0.05, 0.3, 3.0):
        expected = leave_one_out_float64(points, h)
        assert leave_one_out_log_likelihood(points, h) == pytest.approx(expected, rel=1e-5, abs=1e-5)


def test_the_leave_one_out_likelihood_does_not_depend_on_the_blocks(monkeypatch):
    points = clusters(150, 3)
    expected = leave_one_out_log_likelihood(points, 0.3)
    monkeypatch.setattr(bandwidths, "PAIRS_PER_BLOCK", 1000)
    assert leave_one_out_log_likelihood(points, 0.3) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("dim", [1, 2, 6])
def test_the_likelihood_rule_maximises_the_leave_one_out_likelihood(dim):
    points = clusters(200, dim)
    h = select_bandwidth(points, "likelihood")
    best = leave_one_out_float64(points, h)
    for other in (0.8 * h, 1.25 * h, 0.3 * h, 3 * h):
        assert leave_one_out_float64(points, other) < best
        assert leave_one_out_log_likelihood(points, other) < leave_one_out_log_likelihood(points, h)


def test_the_likelihood_rule_recovers_the_scale_of_clusters_that_scott_smooths_over():
    centres = 10 * torch.randn(20, 2)
    points = (centres.unsqueeze(1) + 0.1 * torch.randn(20, 100, 2)).reshape(-1, 2)
    of_one_cluster = 0.1 * 100 ** (-1 / 6)
    assert of_one_cluster / 1.5 < select_bandwidth(points, "likelihood") < 1.5 * of_one_cluster
    assert select_bandwidth(points, "scott") > 10 * of_one_cluster


def test_the_likelihood_rule_on_a_subset_is_carried_over_to_all_points():
    points = torch.randn(2000, 2)
    of_a_subset = bandwidths._most_likely_bandwidth(points, 0.01, 3.0, n_points=300)
    assert of_a_subset == pytest.approx(select_bandwidth(points, "likelihood"), rel=0.2)


def test_duplicated_points_do_not_collapse_the_likelihood_bandwidth():
    points = clusters(200, 2)
    h = select_bandwidth(points, "likelihood")
    assert select_bandwidth(points.repeat(20, 1), "likelihood") == pytest.approx(h, rel=0.4)
    assert select_bandwidth(torch.cat([points, points[:1].repeat(500, 1)]), "likelihood") == pytest.approx(
        h, rel=0.2
    )


@pytest.mark.parametrize("rule", BANDWIDTH_RULES)
@pytest.mark.parametrize("points", [torch.full((50, 3), 0.1), torch.zeros(1, 2)], ids=["identical", "single"])
def test_points_without_any_spread_still_give_a_field(rule, points):
    field = fit(points, bandwidth=rule, alpha=-1.0)
    assert 0 < field.bandwidth < 0.01
    assert field.potential_gradient(torch.randn(20, points.shape[1])).isfinite().all()
    assert (field.potential_gradient(points) == 0).all()


@pytest.mark.parametrize("number", [0.05, 3])
def test_a_number_as_bandwidth_passes_through(number):
    assert select_bandwidth(torch.randn(10, 2), number) == number
    assert fit(torch.randn(10, 2), bandwidth=number).bandwidth == number


@pytest.mark.parametrize("bandwidth", [0, -0.1, math.nan, math.inf])
def test_a_bandwidth_that_is_not_finite_and_positive_is_an_error(bandwidth):
    for build in (
        lambda: PotentialField(torch.zeros(1, 2), bandwidth),
        lambda: fit(torch.zeros(3, 2), bandwidth=bandwidth),
        lambda: select_bandwidth(torch.zeros(3, 2), bandwidth),
    ):
        with pytest.raises(ValueError, match="bandwidth must be finite and positive, got"):
            build()


@pytest.mark.parametrize("rule", ["scot", "", None, True])
def test_an_unknown_bandwidth_rule_is_an_error_that_names_the_choices(rule):
    with pytest.raises(ValueError, match=r"bandwidth must be one of .*scott.*silverman.*likelihood"):
        fit(torch.randn(10, 2), bandwidth=rule)


@pytest.mark.parametrize("alpha", [0.1, math.nan, -math.inf])
def test_an_alpha_of_the_wrong_sign_is_an_error(alpha):
    with pytest.raises(ValueError, match="alpha must be finite and at most 0"):
        fit(torch.randn(10, 2), alpha=alpha)


def test_a_log_threshold_that_is_not_a_number_is_an_error():
    with pytest.raises(ValueError, match="log_threshold must be a number"):
        PotentialField(torch.zeros(1, 2), 1.0, log_threshold=math.nan)


@pytest.mark.parametrize("quantile", [-0.01, 1.01, math.nan])
def test_a_threshold_quantile_outside_zero_to_one_is_an_error(quantile):
    with pytest.raises(ValueError, match=r"threshold_quantile must lie in \[0, 1\]"):
        fit(torch.randn(10, 2), threshold_quantile=quantile)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_points_that_are_not_finite_are_an_error(value):
    points = torch.randn(10, 2)
    points[3, 1] = value
    with pytest.raises(ValueError, match="points must be finite"):
        fit(points)
    with pytest.raises(ValueError, match="anchors must be finite"):
        PotentialField(points, 1.0)


@pytest.mark.parametrize("shape", [(10,), (0, 2), (10, 0), (2, 3, 4)])
def test_points_of_the_wrong_shape_are_an_error(shape):
    with pytest.raises(ValueError, match=r"points must have shape \(P, D\)"):
        fit(torch.zeros(shape))
    with pytest.raises(ValueError, match=r"anchors must have shape \(M, D\)"):
        PotentialField(torch.zeros(shape), 1.0)


@pytest.mark.parametrize("method", ["log_density", "score", "offset_to_safe_set", "potential_gradient"])
@pytest.mark.parametrize("shape", [(5, 3), (5, 1), ()])
def test_actions_of_another_dimension_are_an_error(method, shape):
    with pytest.raises(ValueError, match="the field covers 2 action dimensions"):
        getattr(fit(torch.randn(10, 2), alpha=-1.0), method)(torch.zeros(shape))


@pytest.mark.parametrize("n_anchors", [0, -1])
def test_keeping_no_anchors_is_an_error(n_anchors):
    with pytest.raises(ValueError, match="n_anchors must be at least 1"):
        fit(torch.randn(10, 2), n_anchors=n_anchors)


def test_anchors_are_drawn_from_the_points_without_replacement():
    points = torch.randn(500, 2)
    draw = [fit(points, n_anchors=100, generator=torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)]
    chosen = (draw[0].anchors.unsqueeze(1) == points).all(dim=-1)
    assert (chosen.sum(dim=1) == 1).all()
    assert (chosen.sum(dim=0) <= 1).all()
    assert torch.equal(draw[0].anchors, draw[1].anchors)
    assert not torch.equal(draw[0].anchors, draw[2].anchors)


@pytest.mark.parametrize("n_anchors", [None, 20, 100])
def test_all_points_are_kept_if_there_are_no_more_than_asked_for(n_anchors):
    points = torch.randn(20, 2)
    assert torch.equal(fit(points, n_anchors=n_anchors).anchors, points)


def test_a_field_already_on_the_device_is_not_copied():
    field = fit(torch.randn(20, 2))
    assert field.to("cpu") is field


def test_twenty_thousand_anchors_serve_thousands_of_queries():
    anchors, a, h = torch.randn(20_000, 2), torch.randn(3000, 2), 0.1
    log_density = PotentialField(anchors, h).log_density(a)
    some = torch.arange(0, 3000, 60)
    torch.testing.assert_close(
        log_density[some].double(), log_density_float64(anchors, h, a[some]), rtol=1e-5, atol=1e-4
    )


def test_the_blocks_do_not_change_the_result(monkeypatch):
    points, a = clusters(300, 3), torch.randn(100, 3)

    def results():
        field = fit(points, bandwidth=0.3, threshold_quantile=0.3)
        offsets, log_sums = KernelSums(points, 0.3)._from_differences(a)
        likelihood = leave_one_out_log_likelihood(points, 0.3)
        return offsets, log_sums, offsets_to_nearest(a, field._safe_anchors, 0.3), torch.tensor(likelihood)

    expected = results()
    for module in (kernels, bandwidths, kernel_sums):
        monkeypatch.setattr(module, "PAIRS_PER_BLOCK", 1000)
    for result, wanted in zip(results(), expected, strict=True):
        torch.testing.assert_close(result, wanted, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("has_extension", [True, False])
@pytest.mark.parametrize(("share", "reach"), [(0.0, 0.05), (0.4, 0.05), (1.0, 100.0)])
def test_a_step_to_safety_is_part_of_the_mean_shift_and_then_of_the_offset_to_the_safe_set(
    share, reach, has_extension, monkeypatch
):
    if not has_extension:
        monkeypatch.setattr("lerobot_pf2mp.density.kernel_tree._kernel_tree", None)
    points = clusters(500, 2)
    field = fit(points, threshold_quantile=0.2)
    a = (points + 3 * field.bandwidth * torch.randn_like(points)).reshape(50, 10, 2)
    shift = share * field.mean_shift(a)
    offset = field.offset_to_safe_set(a + shift)
    length = offset.norm(dim=-1, keepdim=True)
    wanted = shift + offset * (reach / length.clamp_min(reach))
    torch.testing.assert_close(field.step_to_safety(a, share, reach), wanted, rtol=1e-5, atol=1e-5)
    assert (length > 0).any() and (length == 0).any()


def test_a_mean_shift_raises_the_density_by_at_least_its_square():
    # Comaniciu and Meer 2002, Theorem 1, by which the extension knows actions to be safe.
    points = clusters(500, 2)
    field = fit(points)
    a = points + 3 * field.bandwidth * torch.randn_like(points)
    before, shift = field.log_density_and_mean_shift(a)
    for share in (0.1, 0.5, 1.0):
        gain = share * (2 - share) / (2 * field.bandwidth**2) * shift.square().sum(dim=1)
        assert (field.log_density(a + share * shift) >= before + gain - 1e-4).all()
        assert (field.log_density(a + share * shift) <= before + gain + 10).any()


def test_offsets_without_a_look_at_the_values_are_the_same(monkeypatch):
    points = clusters(500, 2)
    field = fit(points, threshold_quantile=0.2)
    a = points + 3 * field.bandwidth * torch.randn_like(points)
    expected = field.offset_to_safe_set(a)
    assert (expected != 0).any()
    monkeypatch.setattr("lerobot_pf2mp.density.kernel_tree._kernel_tree", None)
    without = fit(points, threshold_quantile=0.2)
    torch.testing.assert_close(without.offset_to_safe_set(a), expected)
    assert "_safe_tree" not in vars(without)
