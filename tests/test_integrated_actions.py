# SPDX-License-Identifier: Apache-2.0
"""Displacements become positions and come back, and a guide over positions bends displacements alike."""

from dataclasses import replace

import pytest
import torch
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
from lerobot.processor import NormalizerProcessorStep

from lerobot_pf2mp.flow_matching import integrate
from lerobot_pf2mp.guidance import GuidanceSettings, make_guide
from lerobot_pf2mp.policies.guided.displacement_scale import measured_scale
from lerobot_pf2mp.policies.guided.field_settings import FieldSettings
from lerobot_pf2mp.policies.guided.integrated_actions import (
    IntegratedActions,
    IntegratedGuide,
    Integration,
    guide_for_rows,
    guide_from_now_on,
)
from lerobot_pf2mp.potential_field import fit

STATE, ACTION = "observation.state", "action"
SCALE = 0.01  # [m per action]
# Displacements in [-1, 1], an effort of the gripper in [0, 2]; a position [m] and an opening of the gripper.
STATS = {
    ACTION: {"min": torch.tensor([-1.0, -1.0, 0.0]), "max": torch.tensor([1.0, 0.5, 2.0])},
    STATE: {"min": torch.tensor([-0.3, 0.4, 0.0]), "max": torch.tensor([0.1, 1.4, 1.0])},
}
SETTINGS = FieldSettings(action_dims=(0, 1), over="integrated", displacement_scale=SCALE)


def normaliser(mode=NormalizationMode.MIN_MAX, stats=STATS):
    with_moments = {
        key: {**ends, "mean": (ends["min"] + ends["max"]) / 3, "std": 0.4 * (ends["max"] - ends["min"])}
        for key, ends in stats.items()
    }
    return NormalizerProcessorStep(
        features={
            ACTION: PolicyFeature(FeatureType.ACTION, (3,)),
            STATE: PolicyFeature(FeatureType.STATE, (3,)),
        },
        norm_map={"ACTION": mode, "STATE": mode},
        stats=with_moments,
        device="cpu",
    )


def normalised(step, key, values):
    named = {"action": values} if key == ACTION else {"observation": {key: values}}
    done = step(named)
    return done["action"] if key == ACTION else done["observation"][key]


def integration(mode=NormalizationMode.MIN_MAX, settings=SETTINGS):
    return Integration.of(normaliser(mode), settings, 3, STATS[ACTION])


def robots(n_robots=4, settings=SETTINGS, n_past=0):
    made = IntegratedActions.of_robots(integration(), settings, torch.randn(n_robots, 3).double(), 3)
    return replace(made, n_past=n_past)


def chunks(n_robots=4, n_steps=12):
    return torch.rand(n_robots, n_steps, 3, dtype=torch.float64) * 1.4 - 0.7


def test_displacements_come_back_from_their_positions():
    actions, chunk = robots(), chunks()
    torch.testing.assert_close(actions.displacements(actions.positions(chunk)), chunk, rtol=0, atol=1e-12)


def test_positions_come_back_from_their_displacements():
    actions, placed = robots(), torch.randn(4, 12, 3, dtype=torch.float64)
    torch.testing.assert_close(actions.positions(actions.displacements(placed)), placed, rtol=0, atol=1e-12)


def test_dimensions_that_the_field_does_not_cover_stay_as_they_are():
    actions, chunk = robots(), chunks()
    assert torch.equal(actions.positions(chunk)[..., 2], chunk[..., 2])
    assert torch.equal(actions.displacements(chunk)[..., 2], chunk[..., 2])


@pytest.mark.parametrize(
    "mode", [NormalizationMode.MIN_MAX, NormalizationMode.MEAN_STD, NormalizationMode.IDENTITY]
)
def test_positions_are_the_room_up_to_one_factor_and_an_origin(mode):
    """Whatever normalises: p_0 + scale (u_1 + ... + u_k) in metres, and the same factor in all dimensions."""
    step, raw, state = normaliser(mode), torch.rand(2, 9, 3) * 2 - 1, torch.rand(2, 3)
    actions = IntegratedActions.of_robots(integration(mode), SETTINGS, normalised(step, STATE, state), 3)
    found = actions.positions(normalised(step, ACTION, raw))[..., :2]
    in_metres = state[:, None, :2] + SCALE * raw[..., :2].cumsum(dim=1)
    differences, expected = found.diff(dim=1), in_metres.diff(dim=1)
    factor = (differences / expected).mean()
    torch.testing.assert_close(differences, factor * expected, rtol=1e-3, atol=1e-5)
    offset = found - factor * in_metres
    torch.testing.assert_close(offset, offset[:1, :1].expand_as(offset), rtol=0, atol=1e-4)


def test_a_unit_of_positions_is_half_the_widest_range():
    actions, unit = robots(), 0.5  # [m], of the state's second dimension
    raw = normalised(normaliser(), ACTION, torch.ones(4, 3, 3))
    steps = actions.positions(raw).diff(dim=1)[..., :2]
    torch.testing.assert_close(steps, torch.full_like(steps, SCALE / unit), rtol=1e-4, atol=1e-6)


def test_positions_in_the_past_lead_to_where_the_robot_is():
    actions, chunk = robots(n_past=3), chunks()
    placed = actions.positions(chunk)
    torch.testing.assert_close(placed[:, 2, :2], actions.places)
    from_now_on = replace(actions, n_past=0)
    torch.testing.assert_close(placed[:, 3:], from_now_on.positions(chunk[:, 3:]))


def test_state_dimensions_are_chosen_by_their_option():
    settings = replace(SETTINGS, state_dims=(2, 0))
    states = torch.randn(5, 3)
    found = IntegratedActions.of_robots(integration(settings=settings), settings, states, 3)
    # Ranges of 1 and 0.4: the first one is the unit.
    torch.testing.assert_close(
        found.places, states[:, [2, 0]] * torch.tensor([1.0, 0.4]), rtol=1e-4, atol=1e-6
    )


def test_an_integration_comes_back_from_its_tensor():
    made = integration()
    found = Integration.of_tensor(made.tensor())
    assert torch.equal(found.tensor(), made.tensor())


class Towards:
    """A guide that pulls everything towards one point, by a share of the way."""

    def __call__(self, x_t, x_next, x_1, dt):
        return x_next + 0.3 * (0.1 - x_1)


def test_an_offset_of_positions_is_handed_back_as_one_of_displacements():
    actions, (x_t, x_next, x_1) = robots(), [chunks() for _ in range(3)]
    guided = IntegratedGuide(Towards(), actions)(x_t, x_next, x_1, 0.2)
    expected = actions.positions(x_next) + 0.3 * (0.1 - actions.positions(x_1))
    torch.testing.assert_close(actions.positions(guided)[..., :2], expected[..., :2], rtol=0, atol=1e-10)
    assert torch.equal(guided[..., 2], x_next[..., 2])


def test_actions_of_the_past_are_not_guided():
    actions, (x_t, x_next, x_1) = robots(n_past=2), [chunks() for _ in range(3)]
    guided = IntegratedGuide(Towards(), actions)(x_t, x_next, x_1, 0.2)
    assert torch.equal(guided[:, :2], x_next[:, :2])
    expected = actions.positions(x_next) + 0.3 * (0.1 - actions.positions(x_1))
    torch.testing.assert_close(actions.positions(guided)[:, 2:, :2], expected[:, 2:, :2], rtol=0, atol=1e-10)


def test_a_guide_that_pulls_nowhere_changes_nothing():
    actions, x_next = robots(), chunks()
    assert torch.equal(
        IntegratedGuide(lambda x_t, x_next, x_1, dt: x_next, actions)(x_next, x_next, x_next, 0.2), x_next
    )


@pytest.mark.parametrize("integrator", ["proximal", "euler"])
def test_a_flow_of_displacements_is_guided_as_the_flow_of_their_positions(integrator):
    """The same field, guide and flow, once over displacements and once over the positions to which they lead."""
    torch.manual_seed(0)
    actions, x_0, target = robots(), chunks(), chunks()
    anchors = actions.positions(target)[..., :2].flatten(0, 1) + 0.02 * torch.randn(48, 2)
    field = fit(anchors.float(), bandwidth=0.3, alpha=0.0)
    field = replace(field, anchors=field.anchors.double())
    guide = make_guide(field, GuidanceSettings(scale=0.05, integrator=integrator, action_dims=(0, 1)))

    def velocity(x, t):
        return (target - x) / (1 - t.reshape(-1, 1, 1)) + 0.5 * torch.sin(3 * x)

    def velocity_of_positions(y, t):
        x = actions.displacements(y)
        return actions.positions(x + velocity(x, t)) - actions.positions(x)

    of_displacements = integrate(velocity, x_0, 5, guide=IntegratedGuide(guide, actions))
    of_positions = integrate(velocity_of_positions, actions.positions(x_0), 5, guide=guide)
    unguided = integrate(velocity, x_0, 5)
    torch.testing.assert_close(actions.positions(of_displacements), of_positions, rtol=0, atol=1e-5)
    assert (of_displacements - unguided).abs().max() > 0.01


def test_displacements_within_their_limits_stay_as_they_are():
    chunk = chunks()
    assert robots().within_limits(chunk) is chunk


def test_displacements_beyond_their_limits_are_cut_and_catch_up():
    actions, chunk = robots(), torch.zeros(4, 10, 3, dtype=torch.float64)
    chunk[1, 2, 0] = 3.5  # at most 1
    limited = actions.within_limits(chunk)
    assert torch.equal(limited[[0, 2, 3]], chunk[[0, 2, 3]])
    torch.testing.assert_close(
        limited[1, :, 0], torch.tensor([0, 0, 1, 1, 1, 0.5, 0, 0, 0, 0], dtype=torch.float64)
    )
    torch.testing.assert_close(actions.positions(limited)[:, -1], actions.positions(chunk)[:, -1])


def test_limits_are_those_of_the_demonstrated_displacements():
    actions = robots()
    limited = actions.within_limits(20 * chunks())
    low, high = limited[..., :2].amin(dim=(0, 1)), limited[..., :2].amax(dim=(0, 1))
    torch.testing.assert_close(low.float(), -torch.ones(2), rtol=0, atol=1e-5)
    torch.testing.assert_close(high.float(), torch.ones(2), rtol=0, atol=1e-5)


def test_robots_that_are_asked_again_keep_their_places():
    actions = robots()
    rows = torch.tensor([3, 1])
    again = guide_for_rows(IntegratedGuide(Towards(), actions), rows, 2)
    assert torch.equal(again.actions.places, actions.places[[3, 3, 1, 1]])
    assert guide_for_rows(Towards, rows, 2) is Towards
    assert guide_from_now_on(replace(again, actions=replace(actions, n_past=2))).actions.n_past == 0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"state_dims": (0, 3)}, "field_state_dims must be one dimension of observation.state"),
        ({"state_dims": (0,)}, "field_state_dims must be as many as field_action_dims"),
        ({"displacement_scale": 0.0}, "field_displacement_scale must be finite and positive"),
        ({"displacement_scale": float("inf")}, "field_displacement_scale must be finite and positive"),
        ({"over": "sums"}, "field_over must be one of"),
        ({"angle_dims": (0,)}, "field_angle_dims must be empty or null with field_over=integrated"),
    ],
)
def test_settings_that_break_their_rule_are_an_error(settings, message):
    with pytest.raises(ValueError, match=message):
        integration(settings=replace(SETTINGS, **settings))


def test_a_policy_without_a_state_is_an_error():
    step = normaliser()
    step.features = {ACTION: step.features[ACTION]}
    with pytest.raises(ValueError, match=r"needs observation\.state"):
        Integration.of(step, SETTINGS, 3, STATS[ACTION])


def test_the_scale_is_measured_on_the_way_from_the_start_of_each_episode():
    torch.manual_seed(0)
    actions = (torch.rand(200, 2) - 0.3).double().numpy()
    episodes = torch.arange(5).repeat_interleave(40).numpy()
    states = torch.zeros(200, 2).double().numpy()
    for start in range(0, 200, 40):
        states[start : start + 40] = start + 0.02 * (
            actions[start : start + 40].cumsum(axis=0) - actions[start : start + 40]
        )
    scale, correlation = measured_scale(actions, states, episodes)
    assert scale == pytest.approx(0.02)
    assert correlation == pytest.approx(1.0)
    assert measured_scale(0 * actions, states, episodes) == (0.0, 0.0)
