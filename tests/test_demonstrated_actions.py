# SPDX-License-Identifier: Apache-2.0
"""The field covers the frames of this run, knows their episodes and angles, and says what it leaves out."""

import logging
import math
import re

import pytest
import torch
from demonstrated_paths import paths

from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.policies.guided.field_settings import FieldSettings
from lerobot_pf2mp.policies.guided.frame_ranks import frame_of, rank_of
from lerobot_pf2mp.policies.guided.recorded_angles import JUMP, LEAP, steps_seen
from lerobot_pf2mp.potential_field import fit


def recorded(n_episodes=10, n_frames=40, dim=2):
    """Actions ``(N, D)`` and episode numbers ``(N,)`` of smooth episodes near one another."""
    t = torch.linspace(0, 1, n_frames).unsqueeze(1)
    curve = torch.sin(2 * math.pi * t + torch.linspace(0, 2, dim))
    actions = torch.cat([curve + 0.05 * torch.randn(1, dim) for _ in range(n_episodes)])
    return actions, torch.arange(n_episodes).repeat_interleave(n_frames)


def shown(actions, episodes, settings=None, frames=None, **options):
    settings = settings or FieldSettings(n_points=10_000)
    demonstrations = DemonstratedActions(settings)
    show(demonstrations, actions, episodes, settings, frames, **options)
    return demonstrations


def show(demonstrations, actions, episodes, settings=None, frames=None, **options):
    frames = torch.arange(len(actions)) if frames is None else frames
    settings = settings or demonstrations.settings
    demonstrations.observe(actions.unsqueeze(1), None, frames, episodes, settings=settings, **options)


def test_frames_come_back_from_their_ranks():
    frames = torch.cat([torch.arange(10_000), torch.randint(-(2**62), 2**62, (1000,))])
    assert torch.equal(frame_of(rank_of(frames)), frames)


def test_the_field_is_that_of_the_episodes_it_was_shown():
    actions, episodes = recorded()
    demonstrations = shown(actions, episodes)
    order = demonstrations.frames
    assert torch.equal(demonstrations.episodes, episodes[order])
    expected = fit(actions[order], episodes=episodes[order], times=order, alpha=-0.1)
    field = demonstrations.field()
    assert field.bandwidth == expected.bandwidth
    assert field.log_threshold == expected.log_threshold
    assert torch.equal(field.anchor_is_safe, expected.anchor_is_safe)


def test_the_old_rule_is_available_by_name():
    actions, episodes = recorded()
    settings = FieldSettings(n_points=10_000, leave_out="nothing")
    demonstrations = shown(actions, episodes, settings)
    field = demonstrations.field()
    expected = fit(actions[demonstrations.frames], leave_out="nothing", alpha=-0.1)
    assert (field.bandwidth, field.log_threshold) == (expected.bandwidth, expected.log_threshold)
    judged_by_others = demonstrations.field(FieldSettings(n_points=10_000))
    assert field.log_threshold > judged_by_others.log_threshold + 0.1


def test_everything_about_the_field_is_saved_and_restored():
    actions, episodes = recorded(dim=3)
    actions[17] = 50.0
    actions[:, 2] = torch.remainder(actions[:, 2] + 3 + math.pi, 2 * math.pi) - math.pi
    demonstrations = shown(actions, episodes)
    is_start = torch.zeros(1, len(actions), dtype=torch.bool)
    is_start[0, ::40] = True
    demonstrations.recognise_angles(
        torch.where(actions == 50.0, 0.0, actions).unsqueeze(0), is_start, torch.ones(3)
    )
    state = demonstrations.state_dict()
    loaded = DemonstratedActions(demonstrations.settings)
    loaded.load_state_dict(state)
    field, expected = loaded.field(), demonstrations.field()
    assert torch.equal(field.anchors, expected.anchors)
    assert len(field.anchors) == len(actions) - 1
    assert torch.equal(field.anchor_is_safe, expected.safe_anchors)
    assert torch.equal(field.periods, torch.tensor([0.0, 0.0, 2 * math.pi]))
    assert torch.equal(loaded.episodes, demonstrations.episodes)
    again = loaded.state_dict()
    assert state.keys() == again.keys()
    assert all(torch.equal(state[key], again[key]) for key in state)


def test_a_file_of_before_has_no_episodes_and_keeps_its_field():
    actions, episodes = recorded()
    state = shown(actions, episodes).state_dict()
    for name in ("episodes", "unit", "steps", "role"):
        del state[name]
    loaded = DemonstratedActions(FieldSettings(n_points=10_000))
    loaded.load_state_dict(state)
    assert loaded.episodes is None
    assert loaded.field().log_threshold == state["log_threshold"].item()
    # Fitted anew, blocks of time are left out.
    assert math.isfinite(loaded.field(FieldSettings(n_points=10_000, threshold_quantile=0.1)).log_threshold)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("episodes", torch.zeros(3, dtype=torch.int64)),
        ("role", torch.full((400,), 3, dtype=torch.uint8)),
        ("role", torch.zeros(400, dtype=torch.uint8)),
        ("role", torch.ones(400)),
        ("unit", torch.tensor([1.0, math.nan])),
        ("steps", torch.zeros(3, dtype=torch.uint8)),
    ],
)
def test_a_corrupted_entry_is_an_error(name, value):
    state = shown(*recorded()).state_dict()
    with pytest.raises(ValueError, match=f"{name} in a potential field file must be .* corrupted"):
        DemonstratedActions(FieldSettings(n_points=10_000)).load_state_dict({**state, name: value})


def test_more_points_than_were_kept_are_an_error_that_names_both_numbers():
    settings = FieldSettings(n_points=50)
    demonstrations = shown(*recorded(), settings)
    assert len(demonstrations.field(FieldSettings(n_points=30)).anchors) == 30
    with pytest.raises(ValueError, match="n_field_points must be at most 50, .* got 200"):
        demonstrations.field(FieldSettings(n_points=200))


def test_a_run_that_asks_for_more_points_than_before_starts_afresh(caplog):
    actions, episodes = recorded()
    demonstrations = shown(actions, episodes, FieldSettings(n_points=50))
    show(demonstrations, actions, episodes, FieldSettings(n_points=200))
    assert len(demonstrations) == 200
    assert "n_field_points is 200, before 50. The 50 actions kept before are dropped" in caplog.text


def test_other_actions_in_the_same_frames_replace_those_of_before(caplog):
    actions, episodes = recorded()
    demonstrations = shown(actions, episodes)
    show(demonstrations, actions, episodes)
    show(demonstrations, actions + 1e-6, episodes)
    assert "afresh" not in caplog.text
    relabelled = actions.clone()
    relabelled[:40] += 0.5
    for frames in torch.arange(400).split(100):
        show(demonstrations, relabelled[frames], episodes[frames], frames=frames)
    assert "its frames have other actions than before. The 400 actions kept before are dropped" in caplog.text
    field = demonstrations.field()
    assert len(field.anchors) == 400
    assert torch.cdist(actions[:40], field.anchors).amin(dim=1).min() > 0.01


def test_another_dataset_or_other_episodes_start_afresh_in_one_line(caplog):
    actions, episodes = recorded()
    demonstrations = shown(actions, episodes, dataset_id=b"all")
    show(demonstrations, actions[:80], episodes[:80], dataset_id=b"two episodes")
    assert len(demonstrations) == 80
    assert len(caplog.records) == 1
    assert "episodes or normalisation differ from those of before. The 400 actions" in caplog.text


def test_outlying_frames_are_reported_in_one_line(caplog):
    actions, episodes = recorded()
    actions[[57, 130]] = torch.tensor([[9.0, 9.0], [-30.0, 4.0]])
    with caplog.at_level(logging.WARNING):
        field = shown(actions, episodes).field()
    assert len(caplog.records) == 1
    message = caplog.records[0].getMessage()
    assert message.startswith("2 of the 400 actions kept for the potential field are far from all others")
    assert message.endswith("frame 57 of episode 1, frame 130 of episode 3.")
    assert not field.is_safe(actions[[57, 130]]).any()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda x: x * torch.tensor([1.0, 1e8]), "dimension 1 reaches .* in normalised units"),
        (lambda x: torch.stack([x[:, 0], (x[:, 1] > 0).float()], 1), "dimension 1 takes 2 values only"),
        (lambda x: x * torch.tensor([1.0, 1e-4]), "dimension 1 varies by .*, less than the bandwidth"),
    ],
)
def test_a_dimension_that_one_bandwidth_cannot_serve_is_named(spoil, message, caplog):
    actions, episodes = recorded()
    shown(spoil(actions), episodes).field()
    assert len(caplog.records) == 1
    assert re.search(message, caplog.text)


def test_a_constant_dimension_changes_nothing_and_needs_no_remark(caplog):
    actions, episodes = recorded()
    padded = torch.cat([actions, torch.full((400, 1), 0.3)], dim=1)
    plain, field = shown(actions, episodes).field(), shown(padded, episodes).field()
    assert not caplog.records
    assert field.bandwidth == pytest.approx(plain.bandwidth, rel=0.02)
    at_the_constant = torch.cat([actions[:9], torch.full((9, 1), 0.3)], dim=1)
    assert field.is_safe(at_the_constant).all()
    assert not field.is_safe(at_the_constant + torch.tensor([0.0, 0.0, 1.0])).any()


def test_angles_are_recognised_by_jumps_of_a_whole_turn():
    t = torch.linspace(0, 4, 200)
    turning = torch.remainder(t + 3 + math.pi, 2 * math.pi) - math.pi
    actions = torch.stack([turning, torch.sin(t), torch.rad2deg(turning)], dim=1).unsqueeze(0)
    assert steps_seen(actions, None, torch.full((3,), 2 * math.pi)).tolist() == [JUMP, 0, LEAP]
    assert steps_seen(actions, None, torch.full((3,), 360.0)).tolist() == [0, 0, JUMP]
    is_start = (actions[0, :, 0].diff().abs() > 1).unsqueeze(0)
    is_start = torch.cat([torch.zeros(1, 1, dtype=torch.bool), is_start], dim=1)
    assert steps_seen(actions, is_start, torch.full((3,), 2 * math.pi)).tolist() == [0, 0, LEAP]
    assert (steps_seen(2 * torch.randn(1, 500, 2), None, torch.full((2,), 2 * math.pi)) & LEAP).all()


def test_a_named_angle_wraps_and_an_unknown_unit_is_an_error():
    actions, episodes = recorded()
    settings = FieldSettings(n_points=10_000, angle_dims=(1,))
    field = shown(actions, episodes, settings, unit=torch.tensor([2.0, 0.5])).field()
    assert torch.equal(field.periods, torch.tensor([0.0, math.pi]))
    with pytest.raises(ValueError, match=r"field_angle_dims must be empty or null, got \(1,\)"):
        shown(actions, episodes, settings).field()


def test_the_smallest_sample_of_several_processes_is_that_of_one(caplog):
    actions = paths(400, 2)
    episodes = torch.arange(400) // 40
    whole, halves = shown(actions, episodes), DemonstratedActions(FieldSettings(n_points=10_000))
    for frames in torch.randperm(400).split(64):
        show(halves, actions[frames], episodes[frames], frames=frames)
    state, expected = halves.state_dict(), whole.state_dict()
    assert all(torch.equal(state[key], expected[key]) for key in expected)
