# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
import torch

from lerobot_pf2mp.flow_matching import (
    INTEGRATORS,
    TIME_SAMPLINGS,
    flow_matching_loss,
    integrate,
    sample_path,
    sample_time,
)


def test_the_path_runs_from_noise_at_zero_to_data_at_one():
    x_0, x_1 = torch.randn(2, 5, 8, 3)
    assert torch.equal(sample_path(x_0, x_1, torch.zeros(5)).x_t, x_0)
    assert torch.equal(sample_path(x_0, x_1, torch.ones(5)).x_t, x_1)


def test_the_velocity_is_data_minus_noise_and_the_derivative_of_the_path():
    x_0, x_1 = torch.randn(2, 5, 8, 3, dtype=torch.float64)
    t = torch.rand(5, dtype=torch.float64)
    path = sample_path(x_0, x_1, t)
    assert torch.equal(path.velocity, x_1 - x_0)
    ahead = sample_path(x_0, x_1, t + 1e-3)
    torch.testing.assert_close((ahead.x_t - path.x_t) / 1e-3, path.velocity, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("shape", [(4, 4, 4), (4, 4), (4, 2, 4), (4,)])
def test_times_belong_to_the_samples_also_if_the_batch_is_as_large_as_another_dimension(shape):
    x_0, x_1, t = torch.randn(shape), torch.randn(shape), torch.rand(4)
    x_t = sample_path(x_0, x_1, t).x_t
    for i in range(4):
        torch.testing.assert_close(x_t[i], (1 - t[i]) * x_0[i] + t[i] * x_1[i])


@pytest.mark.parametrize(
    ("noise", "data", "time"),
    [((4, 8, 2), (4, 8, 3), (4,)), ((4, 8, 2),) * 2 + ((8,),), ((4, 8, 2),) * 2 + ((4, 1),)],
)
def test_shapes_that_do_not_match_are_an_error(noise, data, time):
    with pytest.raises(ValueError, match=r"x_0 and x_1 must have one shape .* and t the shape \(B,\)"):
        sample_path(torch.zeros(noise), torch.zeros(data), torch.zeros(time))


def test_the_loss_of_the_true_constant_velocity_is_zero():
    x_0, c = torch.randn(5, 8, 3, dtype=torch.float64), torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    loss = flow_matching_loss(lambda x_t, t: c.expand_as(x_t), x_0, x_0 + c, torch.rand(5).double())
    assert loss.shape == (5, 8)
    torch.testing.assert_close(loss, torch.zeros_like(loss), atol=1e-24, rtol=0)


def test_the_loss_is_the_squared_error_averaged_over_action_dimensions():
    x_0, x_1 = torch.randn(2, 5, 8, 3)
    loss = flow_matching_loss(lambda x_t, t: torch.zeros_like(x_t), x_0, x_1, torch.rand(5))
    torch.testing.assert_close(loss, ((x_1 - x_0) ** 2).sum(dim=-1) / 3)


def test_the_network_is_asked_at_the_point_on_the_path_and_the_time_of_each_sample():
    x_0, x_1, t = torch.randn(5, 8, 3), torch.randn(5, 8, 3), torch.rand(5)
    asked = []
    flow_matching_loss(lambda *arguments: asked.append(arguments) or x_1, x_0, x_1, t)
    ((x_t, times),) = asked
    assert torch.equal(times, t)
    assert torch.equal(x_t, sample_path(x_0, x_1, t).x_t)


def test_padding_contributes_neither_loss_nor_gradient():
    x_0, x_1, t = torch.randn(5, 8, 3), torch.randn(5, 8, 3), torch.rand(5)
    is_pad = torch.rand(5, 8) < 0.4
    prediction = torch.randn(5, 8, 3, requires_grad=True)
    loss = flow_matching_loss(lambda x_t, t: prediction, x_0, x_1, t, is_pad)
    unpadded = flow_matching_loss(lambda x_t, t: prediction, x_0, x_1, t)
    assert (loss[is_pad] == 0).all()
    assert torch.equal(loss[~is_pad], unpadded[~is_pad])
    gradient = torch.autograd.grad(loss.sum(), prediction)[0]
    assert (gradient[is_pad] == 0).all()
    assert (gradient[~is_pad] != 0).all()


def test_infinite_errors_under_padding_do_not_reach_the_loss():
    x_0, x_1 = torch.randn(2, 3, 8, 2)
    is_pad = torch.arange(8).expand(3, 8) >= 5
    x_1 = x_1.masked_fill(is_pad.unsqueeze(-1), math.nan)
    loss = flow_matching_loss(lambda x_t, t: torch.zeros_like(x_t), x_0, x_1, torch.rand(3), is_pad)
    assert loss.isfinite().all()


@pytest.mark.parametrize("distribution", TIME_SAMPLINGS)
def test_training_times_lie_between_zero_and_one_and_repeat_with_the_generator(distribution):
    t = [sample_time(10_000, distribution, generator=torch.Generator().manual_seed(s)) for s in (1, 1, 2)]
    assert t[0].shape == (10_000,)
    assert 0 <= t[0].min() < 0.01
    assert 0.99 < t[0].max() <= 1
    assert torch.equal(t[0], t[1])
    assert not torch.equal(t[0], t[2])


@pytest.mark.parametrize(
    ("distribution", "cdf"),
    [("uniform", lambda t: t), ("beta", lambda t: 1 - (1 - t) ** 1.5)],
    ids=["uniform", "beta"],
)
def test_training_times_follow_their_distribution(distribution, cdf):
    t = sample_time(100_000, distribution).double().sort().values
    expected = cdf(t)
    actual = (torch.arange(100_000, dtype=torch.float64) + 0.5) / 100_000
    assert (actual - expected).abs().max() < 1.95 / math.sqrt(100_000)  # Kolmogorov-Smirnov at 0.1 %


def test_beta_times_have_the_mean_and_quantiles_of_one_minus_beta_three_halves_one():
    noise_level = 1 - sample_time(200_000, "beta").double()
    assert noise_level.mean().item() == pytest.approx(0.6, abs=0.003)
    for q in (0.1, 0.5, 0.9):
        assert noise_level.quantile(q).item() == pytest.approx(q ** (1 / 1.5), abs=0.005)


def test_an_unknown_distribution_of_times_is_an_error_that_names_the_choices():
    with pytest.raises(ValueError, match=r"time sampling must be one of .*uniform.*beta.*got 'normal'"):
        sample_time(3, "normal")


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("num_steps", [1, 2, 5, 7])
def test_a_constant_field_is_integrated_exactly(integrator, num_steps):
    x_0, c = torch.randn(4, 8, 3, dtype=torch.float64), torch.randn(3, dtype=torch.float64)
    x_1 = integrate(lambda x, t: c.expand_as(x), x_0, num_steps, integrator=integrator)
    torch.testing.assert_close(x_1, x_0 + c, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize(("integrator", "order"), [("euler", 1), ("midpoint", 2)])
@pytest.mark.parametrize(
    ("velocity", "solution"),
    [
        (lambda x, t: x, lambda x_0: math.e * x_0),
        (lambda x, t: torch.cos(3 * t).unsqueeze(-1).expand_as(x), lambda x_0: x_0 + math.sin(3) / 3),
        (lambda x, t: t.unsqueeze(-1) * x, lambda x_0: math.exp(0.5) * x_0),
    ],
    ids=["growth", "time_dependent", "both"],
)
def test_the_order_of_the_integrator_is_the_slope_of_its_error(integrator, order, velocity, solution):
    x_0 = torch.rand(4, 3, dtype=torch.float64) + 0.5
    steps = np.array([8, 16, 32, 64, 128])
    errors = [
        (integrate(velocity, x_0, int(n), integrator=integrator) - solution(x_0)).abs().max().item()
        for n in steps
    ]
    slope = np.polyfit(np.log(1 / steps), np.log(errors), deg=1)[0]
    assert slope == pytest.approx(order, abs=0.1)


@pytest.mark.parametrize(
    ("integrator", "times"), [("euler", [0, 0.25, 0.5, 0.75]), ("midpoint", [k / 8 for k in range(8)])]
)
def test_each_step_calls_the_network_once_or_twice_at_the_right_times(integrator, times):
    asked = []

    def velocity(x, t):
        assert t.shape == (3,)
        asked.append(t)
        return torch.zeros_like(x)

    integrate(velocity, torch.randn(3, 8, 2), 4, integrator=integrator)
    assert torch.equal(torch.stack(asked), torch.tensor(times).unsqueeze(-1).expand(-1, 3))


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_the_guide_sees_every_step_once_and_its_answer_is_where_the_next_step_starts(integrator):
    x_0, c, seen = torch.randn(3, 8, 2), torch.tensor([1.0, -1.0]), []

    def guide(x_t, x_next, x_1, dt):
        seen.append((x_t, x_next, x_1, dt))
        return x_next + 10

    x_1 = integrate(lambda x, t: c.expand_as(x), x_0, 4, integrator=integrator, guide=guide)
    assert [dt for *_, dt in seen] == [0.25] * 4
    expected = x_0
    for step, (x_t, x_next, predicted_end, _) in enumerate(seen):
        torch.testing.assert_close(x_t, expected)
        torch.testing.assert_close(x_next, x_t + 0.25 * c)
        torch.testing.assert_close(predicted_end, x_t + (1 - 0.25 * step) * c)
        expected = x_next + 10
    assert torch.equal(x_1, expected)


def test_the_starting_points_are_not_modified():
    x_0 = torch.randn(3, 8, 2)
    before = x_0.clone()
    integrate(lambda x, t: x, x_0, 3, guide=lambda x_t, x_next, x_1, dt: x_next.add_(1))
    assert torch.equal(x_0, before)


@pytest.mark.parametrize("num_steps", [0, -3])
def test_a_number_of_steps_that_is_not_positive_is_an_error(num_steps):
    with pytest.raises(ValueError, match=f"num_steps must be at least 1, got {num_steps}"):
        integrate(lambda x, t: x, torch.zeros(1, 2), num_steps)


def test_an_unknown_integrator_is_an_error_that_names_the_choices():
    with pytest.raises(ValueError, match=r"integrator must be one of .*euler.*midpoint.*got 'rk4'"):
        integrate(lambda x, t: x, torch.zeros(1, 2), 1, integrator="rk4")
