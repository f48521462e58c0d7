# SPDX-License-Identifier: Apache-2.0
import copy
import math
import re
from collections.abc import Sequence
from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature

from lerobot_pf2mp import PF2MPConfig
from lerobot_pf2mp.errors import ConfigError
from lerobot_pf2mp.flow_matching import Guide, integrate
from lerobot_pf2mp.guidance import GUIDANCE_INTEGRATORS, GUIDANCE_POINTS, GuidanceSettings, make_guide
from lerobot_pf2mp.policies.batch_keys import POTENTIAL_FIELD
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.policies.guided.field_guidance import FieldGuidance
from lerobot_pf2mp.policies.pf2mp.modeling_pf2mp import PF2MPPolicy
from lerobot_pf2mp.potential_field import PotentialField, fit


def random_field(dim: int = 2, alpha: float = 0.0, bandwidth: float = 0.2) -> PotentialField:
    points = torch.randn(200, dim)
    return fit(points, bandwidth=bandwidth, threshold_quantile=0.2, alpha=alpha, leave_out="nothing")


def config_of(**options: Any) -> PF2MPConfig:
    return PF2MPConfig(
        device="cpu",
        horizon=8,
        n_action_steps=4,
        down_dims=(8, 16),
        diffusion_step_embed_dim=16,
        input_features={"observation.state": PolicyFeature(FeatureType.STATE, (3,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
        **options,
    )


def guide_of(
    field: PotentialField,
    scale: float,
    integrator: str = "proximal",
    action_dims: Sequence[int] | None = None,
    point: str | None = None,
) -> Guide | None:
    dims = None if action_dims is None else tuple(action_dims)
    return make_guide(field, GuidanceSettings(scale, integrator, point, dims))


@pytest.mark.parametrize("alpha", [0.0, -3.0])
def test_the_euler_guide_is_algorithm_2_as_printed(alpha):
    field, scale, dt = random_field(3, alpha), 0.05, 0.2
    x_t, v = 2 * torch.randn(4, 8, 3), torch.randn(4, 8, 3)
    phi = field.potential_gradient(x_t)
    guided = guide_of(field, scale, "euler")(x_t, x_t + v * dt, x_t + v, dt)
    torch.testing.assert_close(guided, x_t + (v + scale * phi) * dt, rtol=1e-5, atol=1e-5)


def test_a_whole_euler_integration_is_algorithm_2_as_printed():
    field, scale = random_field(2, -1.0), 0.02
    a = torch.randn(4, 8, 2)
    guided = integrate(lambda x, t: -x, a, 5, guide=guide_of(field, scale, "euler"))
    for _ in range(5):
        a = a + (-a + scale * field.potential_gradient(a)) * 0.2
    torch.testing.assert_close(guided, a, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("integrator", GUIDANCE_INTEGRATORS)
def test_no_guidance_is_no_guide(integrator):
    assert guide_of(random_field(), 0, integrator) is None
    assert guide_of(random_field(), 0.0, integrator, [0]) is None


def test_the_proximal_step_solves_the_guidance_equation_with_the_local_mean_held_fixed():
    field, scale, dt = random_field(), 0.3, 0.2
    x = torch.randn(50, 2)
    mean, fine = field.local_mean(x).double(), x.double()
    for _ in range(20_000):
        fine = fine + scale * dt / 20_000 * (mean - fine) / field.bandwidth**2
    torch.testing.assert_close(guide_of(field, scale)(x, x, x, dt).double(), fine, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("alpha", [0.0, -3.0])
def test_the_proximal_step_tends_to_the_euler_step_as_lambda_tends_to_zero(alpha):
    field = random_field(2, alpha)
    x = torch.randn(100, 2)
    x = x[field.log_density(x) - field.log_threshold < -1]  # the distance term acts on all of them or on none
    if alpha == 0:
        x = torch.randn(100, 2)
    difference, step = [], []
    for scale in (1e-2, 1e-3):
        euler, proximal = (guide_of(field, scale, name)(x, x, x, 0.2) for name in ("euler", "proximal"))
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
    guided = guide_of(field, scale)(x_t, x_next, x_next, 0.2)
    mean = field.local_mean(x_next)
    decay = math.exp(-scale * 0.2 / field.bandwidth**2)
    torch.testing.assert_close(guided - mean, decay * (x_next - mean), rtol=1e-4, atol=1e-5)
    # In the anchors' hull: no direction reaches further than the outermost anchor.
    directions = torch.nn.functional.normalize(torch.randn(3, 500), dim=0)
    reach = (field.anchors @ directions).amax(dim=0) + decay * (x_next @ directions).clamp_min(0).amax(dim=0)
    assert ((guided @ directions).amax(dim=0) <= reach + 1e-4).all()


@pytest.mark.parametrize("n_steps", [1, 5, 20])
def test_an_explicit_step_beyond_its_limit_diverges_so_the_euler_guide_refuses_it(n_steps):
    field, x_0, dt = random_field(), torch.randn(50, 2), 1 / n_steps
    limit = 2 * field.bandwidth**2 / dt
    a, x = field.anchors[:1], field.anchors[:1] + 1e-3
    alone = PotentialField(a, field.bandwidth)
    for scale, diverges in ((0.99 * limit, False), (1.01 * limit, True)):
        moved = x + scale * dt * alone.potential_gradient(x)
        assert ((moved - a).norm() > (x - a).norm()) == diverges
    below = integrate(lambda x, t: -x, x_0, n_steps, guide=guide_of(field, 0.99 * limit, "euler"))
    assert below.abs().amax() < 10
    for scale in (limit, 1.01 * limit, 1.0 + limit, 1e6):
        with pytest.raises(
            ValueError, match=r"guidance_scale \* dt / bandwidth\^2 is below 2, got .*proximal"
        ):
            integrate(lambda x, t: -x, x_0, n_steps, guide=guide_of(field, scale, "euler"))
        proximal = integrate(lambda x, t: -x, x_0, n_steps, guide=guide_of(field, scale))
        assert proximal.abs().amax() <= max(field.anchors.abs().amax(), x_0.abs().amax()) + 1e-4


@pytest.mark.parametrize("dt", [1.0, 0.2, 1 / 7, 0.01])
@pytest.mark.parametrize("bandwidth", [0.1, 0.2, 0.0153, 0.25, 1e-4, 3.0])
def test_the_largest_scale_that_the_error_names_is_accepted_and_close_to_the_limit(bandwidth, dt):
    field, x = random_field(bandwidth=bandwidth), torch.randn(5, 2)
    with pytest.raises(ValueError, match="guidance_scale to at most") as error:
        guide_of(field, 1e3 * bandwidth**2 / dt, "euler")(x, x, x, dt)
    named = re.search(r"to at most (\S+), or guidance_integrator=proximal", str(error.value))[1]
    limit = 2 * bandwidth**2 / dt
    assert 0.98 * limit < float(named) < limit
    assert guide_of(field, float(named), "euler")(x, x, x, dt).isfinite().all()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("scale", [0.01, 1.0, 1e6])
def test_the_proximal_distance_step_ends_at_most_at_the_safe_anchor(scale):
    field, dt = random_field(2, -2.0, bandwidth=0.1), 0.2
    without = PotentialField(field.anchors, field.bandwidth, field.log_threshold)
    x = 3 * torch.randn(100, 2)
    before = guide_of(without, scale)(x, x, x, dt)
    after = guide_of(field, scale)(x, x, x, dt)
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
    guided = guide_of(field, 1e-20)(field.anchors, field.anchors, field.anchors, 0.2)
    torch.testing.assert_close(guided, field.anchors)


@pytest.mark.parametrize("alpha", [0.0, -1.0])
@pytest.mark.parametrize(("integrator", "scale"), [("euler", 0.01), ("proximal", 0.01), ("proximal", 10.0)])
def test_a_guided_step_raises_the_log_density(integrator, scale, alpha):
    field = random_field(2, alpha)
    x = torch.cat([2 * torch.randn(200, 2), 10 * torch.randn(200, 2)])
    guided = guide_of(field, scale, integrator)(x, x, x, 0.2)
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
    guided = guide_of(field, 0.05, integrator, dims)(x_t, x_next, x_next, 0.2)
    alone = guide_of(field, 0.05, integrator)(x_t[..., list(dims)], *2 * [x_next[..., list(dims)]], 0.2)
    others = [dim for dim in range(4) if dim not in dims]
    assert torch.equal(guided[..., others], x_next[..., others])
    assert torch.equal(guided[..., list(dims)], alone)
    assert torch.equal(x_next, before)
    assert not torch.equal(alone, x_next[..., list(dims)])


# Where the field is asked.


def three_points(dim: int = 2) -> dict[str, torch.Tensor]:
    """Where a step begins, what it predicts and where it ends, by the names of `GUIDANCE_POINTS`."""
    return {point: torch.randn(4, 8, dim) for point in ("current", "end", "next")}


def test_the_guidance_points_are_the_start_the_predicted_end_and_the_next_sample():
    assert set(GUIDANCE_POINTS) == set(three_points())


@pytest.mark.parametrize(("integrator", "default"), [("euler", "current"), ("proximal", "end")])
@pytest.mark.parametrize("dims", [None, [1, 0]])
@pytest.mark.parametrize("alpha", [0.0, -3.0])
def test_the_default_point_of_each_integrator_can_be_named(integrator, default, dims, alpha):
    field, x = random_field(2, alpha), three_points()
    step = x["current"], x["next"], x["end"], 0.2
    unnamed = guide_of(field, 0.05, integrator, dims)(*step)
    for point in GUIDANCE_POINTS:
        named = guide_of(field, 0.05, integrator, dims, point)(*step)
        assert torch.equal(named, unnamed) == (point == default)


@pytest.mark.parametrize("alpha", [0.0, -3.0])
@pytest.mark.parametrize("point", GUIDANCE_POINTS)
def test_the_euler_guide_adds_lambda_dt_times_the_field_at_its_point(point, alpha):
    field, scale, dt, x = random_field(2, alpha), 0.05, 0.2, three_points()
    guided = guide_of(field, scale, "euler", point=point)(x["current"], x["next"], x["end"], dt)
    expected = x["next"] + scale * dt * field.potential_gradient(x[point])
    torch.testing.assert_close(guided, expected)


@pytest.mark.parametrize("scale", [0.05, 10.0])
@pytest.mark.parametrize("point", GUIDANCE_POINTS)
def test_the_proximal_guide_adds_its_share_of_the_mean_shift_at_its_point(point, scale):
    field, dt, x = random_field(), 0.2, three_points()
    guided = guide_of(field, scale, "proximal", point=point)(x["current"], x["next"], x["end"], dt)
    share = 1 - math.exp(-scale * dt / field.bandwidth**2)
    expected = x["next"] + share * (field.local_mean(x[point]) - x[point])
    torch.testing.assert_close(guided, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("point", GUIDANCE_POINTS)
def test_the_distance_term_of_the_proximal_guide_goes_on_from_its_shifted_point(point):
    field, scale, dt = random_field(2, -2.0, bandwidth=0.1), 0.5, 0.2
    x = {name: 3 * a for name, a in three_points().items()}
    guided = guide_of(field, scale, "proximal", point=point)(x["current"], x["next"], x["end"], dt)
    shift = (1 - math.exp(-scale * dt / field.bandwidth**2)) * field.mean_shift(x[point])
    offset = field.offset_to_safe_set(x[point] + shift)
    length = offset.norm(dim=-1, keepdim=True)
    assert (length > 0).any()
    expected = x["next"] + shift + (2 * scale * dt / length.clamp_min(1e-12)).clamp_max(1) * offset
    torch.testing.assert_close(guided, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("integrator", GUIDANCE_INTEGRATORS)
@pytest.mark.parametrize("n_steps", [1, 5])
def test_the_predicted_end_is_the_next_sample_on_the_last_step_of_a_flow_and_only_there(integrator, n_steps):
    field, agrees = random_field(2, -1.0), []
    end, after = (guide_of(field, 0.05, integrator, point=point) for point in ("end", "next"))

    def compare(*step):
        agrees.append(torch.equal(end(*step), after(*step)))
        return step[1]

    integrate(lambda x, t: -x, torch.randn(4, 8, 2), n_steps, guide=compare)
    assert agrees == [False] * (n_steps - 1) + [True]


@pytest.mark.parametrize("integrator", GUIDANCE_INTEGRATORS)
@pytest.mark.parametrize("point", GUIDANCE_POINTS)
def test_a_point_is_asked_for_in_the_dimensions_of_the_field(integrator, point):
    field, x, dims = random_field(2, -1.0), three_points(4), [3, 1]
    guided = guide_of(field, 0.05, integrator, dims, point)(x["current"], x["next"], x["end"], 0.2)
    covered = {name: a[..., dims] for name, a in x.items()}
    alone = guide_of(field, 0.05, integrator, point=point)(
        covered["current"], covered["next"], covered["end"], 0.2
    )
    assert torch.equal(guided[..., dims], alone)
    assert torch.equal(guided[..., [0, 2]], x["next"][..., [0, 2]])


@pytest.mark.parametrize("integrator", GUIDANCE_INTEGRATORS)
@pytest.mark.parametrize("scale", [0.0, 0.5])
def test_an_unknown_guidance_point_is_an_error_that_names_the_choices(integrator, scale):
    with pytest.raises(
        ValueError, match=r"guidance_point must be one of .*current.*end.*next.* or null, got 'start'"
    ):
        guide_of(random_field(), scale, integrator, point="start")


def test_an_unknown_guidance_point_in_a_configuration_is_an_error_that_names_the_choices():
    with pytest.raises(
        ConfigError, match=r"guidance_point must be one of .*current.*end.*next.* or null, got 'start'"
    ):
        PF2MPConfig(device="cpu", guidance_point="start")


@pytest.mark.parametrize(("integrator", "default"), [("euler", "current"), ("proximal", "end")])
@pytest.mark.parametrize("point", [None, *GUIDANCE_POINTS])
def test_the_guidance_point_of_the_configuration_is_that_of_the_policys_guide(integrator, default, point):
    config = config_of(guidance_integrator=integrator, guidance_point=point)
    shown = DemonstratedActions(config.field_settings)
    shown.observe(torch.randn(40, 8, 2), None, None, settings=config.field_settings)
    guide = PF2MPPolicy(config).guidance.guide({POTENTIAL_FIELD: shown}, torch.device("cpu"))
    assert guide.point == (point or default)


def test_a_guide_is_made_once_and_kept_until_the_field_or_a_setting_changes():
    config = config_of()
    guidance, cpu = FieldGuidance(config), torch.device("cpu")
    shown, other = DemonstratedActions(config.field_settings), DemonstratedActions(config.field_settings)
    for demonstrations in (shown, other):
        demonstrations.observe(torch.randn(40, 8, 2), None, None, settings=config.field_settings)
    kept = guidance.guide({POTENTIAL_FIELD: shown}, cpu)
    assert guidance.guide({POTENTIAL_FIELD: shown}, cpu) is kept
    assert guidance.guide({POTENTIAL_FIELD: other}, cpu).field is other.field()
    made = [kept]
    changes = {
        "guidance_scale": 0.1,
        "guidance_integrator": "euler",
        "guidance_point": "next",
        "field_alpha": -2.0,
        "field_bandwidth": 0.3,
        "field_threshold_quantile": 0.2,
        "n_field_points": 30,
        "field_action_dims": [1, 0],
    }
    for name, value in changes.items():
        setattr(config, name, value)
        if name == "field_action_dims":
            shown = DemonstratedActions(config.field_settings)
            shown.observe(torch.randn(40, 8, 2), None, None, settings=config.field_settings)
        guide = guidance.guide({POTENTIAL_FIELD: shown}, cpu)
        assert all(guide is not earlier for earlier in made), name
        assert guidance.guide({POTENTIAL_FIELD: shown}, cpu) is guide
        made.append(guide)


def test_a_copy_of_a_guidance_makes_its_own_guide():
    config = config_of()
    guidance, cpu = FieldGuidance(config), torch.device("cpu")
    shown = DemonstratedActions(config.field_settings)
    shown.observe(torch.randn(40, 8, 2), None, None, settings=config.field_settings)
    kept = guidance.guide({POTENTIAL_FIELD: shown}, cpu)
    copied = copy.deepcopy(guidance)
    assert not [value for value in vars(copied).values() if isinstance(value, tuple)]  # no field is copied
    other = copied.guide({POTENTIAL_FIELD: shown}, cpu)
    assert other is not kept and other.field is kept.field
    assert guidance.guide({POTENTIAL_FIELD: shown}, cpu) is kept


def test_a_copy_of_a_guidance_leaves_the_dataset_behind():
    class Meta:
        def __deepcopy__(self, memo: object) -> None:
            raise AssertionError("the metadata was copied")

    copied = copy.deepcopy(FieldGuidance(config_of(), dataset_meta=Meta()))
    assert copied.demonstrations is None


def test_settings_are_validated_once_for_all_plans():
    config = config_of()
    assert config.guidance_settings is config.guidance_settings
    assert config.field_settings is config.field_settings
    config.guidance_scale = -1.0
    with pytest.raises(ValueError, match="guidance_scale must be finite and at least 0, got -1.0"):
        _ = config.guidance_settings


# Rules and modes.


@pytest.mark.parametrize("integrator", GUIDANCE_INTEGRATORS)
@pytest.mark.parametrize("scale", [-0.1, math.nan, math.inf])
def test_a_guidance_scale_that_is_not_finite_and_at_least_zero_is_an_error(integrator, scale):
    with pytest.raises(ValueError, match="guidance_scale must be finite and at least 0, got"):
        guide_of(random_field(), scale, integrator)


@pytest.mark.parametrize("scale", [0.0, 0.5])
def test_an_unknown_guidance_integrator_is_an_error_that_names_the_choices(scale):
    with pytest.raises(ValueError, match=r"guidance_integrator must be one of .*euler.*proximal.*got 'rk4'"):
        guide_of(random_field(), scale, "rk4")


@pytest.mark.parametrize("integrator", GUIDANCE_INTEGRATORS)
def test_guides_work_under_inference_mode_and_autocast(integrator):
    field = random_field(2, -1.0)
    x_t, x_next = torch.randn(4, 8, 3), torch.randn(4, 8, 3)
    guide = guide_of(field, 0.05, integrator, [2, 1])
    expected = guide(x_t, x_next, x_next, 0.2)
    with torch.inference_mode():
        assert torch.equal(guide(x_t, x_next, x_next, 0.2), expected)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(guide(x_t, x_next, x_next, 0.2), expected)
