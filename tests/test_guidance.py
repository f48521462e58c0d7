# SPDX-License-Identifier: Apache-2.0
import math

import pytest
import torch

from lerobot_pf2mp.flow_matching import integrate
from lerobot_pf2mp.guidance import GUIDANCE_INTEGRATORS, make_guide
from lerobot_pf2mp.potential_field import PotentialField, fit


def random_field(dim: int = 2, alpha: float = 0.0, bandwidth: float = 0.2) -> PotentialField:
    return fit(torch.randn(200, dim), bandwidth=bandwidth, threshold_quantile=0.2, alpha=alpha)


@pytest.mark.parametrize("alpha", [0.0, -3.0])
def test_the_euler_guide_is_algorithm_2_as_printed(alpha):
    field, scale, dt = random_field(3, alpha), 0.05, 0.2
    x_t, v = 2 * torch.randn(4, 8, 3), torch.randn(4, 8, 3)
    phi = field.potential_gradient(x_t)
    guided = make_guide(field, scale, "euler")(x_t, x_t + v * dt, x_t + v, dt)
    torch.testing.assert_close(guided, x_t + (v + scale * phi) * dt, rtol=1e-5, atol=1e-5)


def test_a_whole_euler_integration_is_algorithm_2_as_printed():
    field, scale = random_field(2, -1.0), 0.02
    a = torch.randn(4, 8, 2)
    guided = integrate(lambda x, t: -x, a, 5, guide=make_guide(field, scale, "euler"))
    for _ in range(5):
        a = a + (-a + scale * field.potential_gradient(a)) * 0.2
    torch.testing.assert_close(guided, a, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("integrator", GUIDANCE_INTEGRATORS)
def test_no_guidance_is_no_guide(integrator):
    assert make_guide(random_field(), 0, integrator) is None
    assert make_guide(random_field(), 0.0, integrator, [0]) is None


def test_the_proximal_step_solves_the_guidance_equation_with_the_local_mean_held_fixed():
    field, scale, dt = random_field(), 0.3, 0.2
    x = torch.randn(50, 2)
    mean, fine = field.local_mean(x).double(), x.double()
    for _ in range(20_000):
        fine = fine + scale * dt / 20_000 * (mean - fine) / field.bandwidth**2
    torch.testing.assert_close(make_guide(field, scale)(x, x, x, dt).double(), fine, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("alpha", [0.0, -3.0])
def test_the_proximal_step_tends_to_the_euler_step_as_lambda_tends_to_zero(alpha):
    field = random_field(2, alpha)
    x = torch.randn(100, 2)
    x = x[field.log_density(x) - field.log_threshold < -1]  # the distance term acts on all of them or on none
    if alpha == 0:
        x = torch.randn(100, 2)
    difference, step = [], []
    for scale in (1e-2, 1e-3):
        euler, proximal = (make_guide(field, scale, name)(x, x, x, 0.2) for name in ("euler", "proximal"))
        difference.append((euler - proximal).norm().item())
        step.append((euler - x).norm().item())
    assert len(x) > 5
    assert step[0] / step[1] == pytest.approx(10, rel=0.01)  # first order in lambda
    assert difference[0] / difference[1] == pytest.approx(100, rel=0.15)  # second order in lambda
    assert difference[1] < 0.01 * step[1]


@pytest.mark.parametrize("scale", [1.0, 1e2, 1e4, 1e6])
def test_the_proximal_step_stays_among_the_anchors_however_large_lambda(scale):
    field = random_field(3)
    x_t, x_next = torch.randn(50, 3), 2 * torch.randn(50, 3)
    guided = make_guide(field, scale)(x_t, x_next, x_next, 0.2)
    mean = field.local_mean(x_next)
    decay = math.exp(-scale * 0.2 / field.bandwidth**2)
    torch.testing.assert_close(guided - mean, decay * (x_next - mean), rtol=1e-4, atol=1e-5)
    # In the anchors' hull: no direction reaches further than the outermost anchor.
    directions = torch.nn.functional.normalize(torch.randn(3, 500), dim=0)
    reach = (field.anchors @ directions).amax(dim=0) + decay * (x_next @ directions).clamp_min(0).amax(dim=0)
    assert ((guided @ directions).amax(dim=0) <= reach + 1e-4).all()


def test_the_euler_guide_diverges_where_the_proximal_one_does_not():
    field, x_0 = random_field(), torch.randn(50, 2)
    for scale in (1.0, 1e6):
        euler, proximal = (
            integrate(lambda x, t: -x, x_0, 5, guide=make_guide(field, scale, name))
            for name in ("euler", "proximal")
        )
        assert not (euler.abs().amax() < 100)
        assert proximal.abs().amax() <= field.anchors.abs().amax() + 1e-4


@pytest.mark.parametrize("scale", [0.01, 1.0, 1e6])
def test_the_proximal_distance_step_ends_at_most_at_the_safe_anchor(scale):
    field, dt = random_field(2, -2.0, bandwidth=0.1), 0.2
    without = PotentialField(field.anchors, field.bandwidth, field.log_threshold)
    x = 3 * torch.randn(100, 2)
    before = make_guide(without, scale)(x, x, x, dt)
    after = make_guide(field, scale)(x, x, x, dt)
    offset = field.offset_to_safe_set(before)
    moved = after - before
    assert (offset.norm(dim=-1) > 0).any()
    # Towards the safe anchor, by lambda |alpha| dt or all the way, whichever is less.
    length = offset.norm(dim=-1, keepdim=True)
    share = (2 * scale * dt / length.clamp_min(1e-12)).clamp_max(1)
    torch.testing.assert_close(moved, share * offset, rtol=1e-4, atol=1e-5)
    assert (moved.norm(dim=-1) <= length.squeeze(-1) + 1e-5).all()


def test_a_tiny_alpha_does_not_divide_zero_by_zero():
    field = random_field(2, -1e-30)
    guided = make_guide(field, 1e-20)(field.anchors, field.anchors, field.anchors, 0.2)
    torch.testing.assert_close(guided, field.anchors)


@pytest.mark.parametrize("alpha", [0.0, -1.0])
@pytest.mark.parametrize(("integrator", "scale"), [("euler", 0.01), ("proximal", 0.01), ("proximal", 10.0)])
def test_a_guided_step_raises_the_log_density(integrator, scale, alpha):
    field = random_field(2, alpha)
    x = torch.cat([2 * torch.randn(200, 2), 10 * torch.randn(200, 2)])
    guided = make_guide(field, scale, integrator)(x, x, x, 0.2)
    unsafe = field.offset_to_safe_set(x).norm(dim=-1) > 0.1
    assert unsafe.sum() > 200
    assert (field.log_density(guided) > field.log_density(x))[unsafe].all()
    # In the safe set the distance term is silent, and mean shift never goes down.
    assert (field.log_density(guided) >= field.log_density(x) - 1e-4)[~unsafe].all()


@pytest.mark.parametrize("integrator", GUIDANCE_INTEGRATORS)
@pytest.mark.parametrize("dims", [(0,), (2, 0), (1, 3)])
def test_dimensions_without_a_field_pass_bit_for_bit(integrator, dims):
    field = random_field(len(dims), -1.0)
    x_t, x_next = torch.randn(4, 8, 4), torch.randn(4, 8, 4)
    before = x_next.clone()
    guided = make_guide(field, 0.05, integrator, dims)(x_t, x_next, x_next, 0.2)
    alone = make_guide(field, 0.05, integrator)(x_t[..., list(dims)], *2 * [x_next[..., list(dims)]], 0.2)
    others = [dim for dim in range(4) if dim not in dims]
    assert torch.equal(guided[..., others], x_next[..., others])
    assert torch.equal(guided[..., list(dims)], alone)
    assert torch.equal(x_next, before)
    assert not torch.equal(alone, x_next[..., list(dims)])


@pytest.mark.parametrize("integrator", GUIDANCE_INTEGRATORS)
@pytest.mark.parametrize("scale", [-0.1, math.nan, math.inf])
def test_a_guidance_scale_that_is_not_finite_and_at_least_zero_is_an_error(integrator, scale):
    with pytest.raises(ValueError, match="guidance_scale must be finite and at least 0, got"):
        make_guide(random_field(), scale, integrator)


@pytest.mark.parametrize("scale", [0.0, 0.5])
def test_an_unknown_guidance_integrator_is_an_error_that_names_the_choices(scale):
    with pytest.raises(ValueError, match=r"guidance_integrator must be one of .*euler.*proximal.*got 'rk4'"):
        make_guide(random_field(), scale, "rk4")


@pytest.mark.parametrize("integrator", GUIDANCE_INTEGRATORS)
def test_guides_work_under_inference_mode_and_autocast(integrator):
    field = random_field(2, -1.0)
    x_t, x_next = torch.randn(4, 8, 3), torch.randn(4, 8, 3)
    guide = make_guide(field, 0.05, integrator, [2, 1])
    expected = guide(x_t, x_next, x_next, 0.2)
    with torch.inference_mode():
        assert torch.equal(guide(x_t, x_next, x_next, 0.2), expected)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(guide(x_t, x_next, x_next, 0.2), expected)
