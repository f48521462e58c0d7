# SPDX-License-Identifier: Apache-2.0
import math

import pytest
import torch
from lerobot.lerobot_types import TransitionKey
from lerobot.processor import PolicyProcessorPipeline
from lerobot.processor.converters import batch_to_transition, create_transition, transition_to_batch
from torch import Tensor

from lerobot_pf2mp.policies.batch_keys import POTENTIAL_FIELD
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.policies.guided.field_settings import FieldSettings
from lerobot_pf2mp.policies.guided.frame_ranks import rank_of
from lerobot_pf2mp.policies.guided.potential_field_step import PotentialFieldProcessorStep

HORIZON = 8
SETTINGS = FieldSettings(n_points=50, bandwidth="likelihood", threshold_quantile=0.1, alpha=-0.5)


def demonstration(n_frames: int = 300, dim: int = 3) -> Tensor:
    return torch.randn(n_frames, dim)


def chunks(actions: Tensor, frames: Tensor) -> tuple[Tensor, Tensor]:
    """The chunks ``(B, HORIZON, A)`` that start at these frames, and where they reach beyond the last frame."""
    wanted = frames.unsqueeze(1) + torch.arange(HORIZON)
    return actions[wanted.clamp_max(len(actions) - 1)], wanted >= len(actions)


def show(demonstrations: DemonstratedActions, actions: Tensor, frames: Tensor, **options) -> None:
    options = {"settings": demonstrations.settings, **options}
    for batch in frames.split(16):
        demonstrations.observe(*chunks(actions, batch), batch, **options)


def demonstrated(actions: Tensor, settings: FieldSettings = SETTINGS, frames: Tensor | None = None):
    demonstrations = DemonstratedActions(settings)
    show(demonstrations, actions, torch.arange(len(actions)) if frames is None else frames)
    return demonstrations


def rows(points: Tensor) -> set[tuple[float, ...]]:
    return {tuple(point) for point in points.tolist()}


def assert_same_state(one: DemonstratedActions, other: DemonstratedActions) -> None:
    a, b = one.state_dict(), other.state_dict()
    assert set(a) == set(b)
    for key in a:
        assert a[key].dtype == b[key].dtype
        assert torch.equal(a[key], b[key]), key


def test_anchors_are_actions_that_were_shown_as_many_as_asked_for():
    actions = demonstration()
    field = demonstrated(actions).field()
    assert len(field.anchors) == 50
    assert len(rows(field.anchors)) == 50
    assert rows(field.anchors) <= rows(actions)
    assert (field.alpha, field.dim) == (-0.5, 3)


def test_all_actions_are_anchors_while_they_are_few():
    actions = demonstration(20)
    demonstrations = demonstrated(actions)
    assert rows(demonstrations.field().anchors) == rows(actions)
    assert len(demonstrations) == 20


def test_padded_actions_never_enter():
    actions = demonstration(60)
    demonstrations = DemonstratedActions(FieldSettings(n_points=1000))
    shown, is_pad = chunks(actions, torch.arange(60))
    shown = shown.masked_fill(is_pad.unsqueeze(-1), 777.0)
    demonstrations.observe(shown, is_pad, torch.arange(60), settings=demonstrations.settings)
    assert rows(demonstrations.field().anchors) == rows(actions)


def test_a_batch_of_nothing_but_padding_changes_nothing():
    demonstrations = DemonstratedActions(SETTINGS)
    demonstrations.observe(torch.zeros(2, 4, 3), torch.ones(2, 4).bool(), torch.arange(2), settings=SETTINGS)
    assert len(demonstrations) == 0
    assert demonstrations.state_dict() == {}


def test_frames_shown_fifty_times_count_once():
    actions = demonstration()
    often = torch.arange(100).repeat(50)
    frames = torch.cat([torch.arange(300), often])[torch.randperm(300 + 5000)]
    assert_same_state(demonstrated(actions, frames=frames), demonstrated(actions))


def test_the_order_in_which_frames_are_shown_does_not_matter():
    actions = demonstration()
    expected = demonstrated(actions)
    for frames in (torch.arange(300).flip(0), torch.randperm(300)):
        assert_same_state(demonstrated(actions, frames=frames), expected)


def test_frames_that_overlap_in_chunks_count_once_wherever_they_are_in_the_chunk():
    actions = demonstration(96)
    every_eighth = demonstrated(actions, frames=torch.arange(0, 96, HORIZON))
    assert_same_state(demonstrated(actions), every_eighth)


def test_the_sample_is_uniform_over_the_frames():
    actions = torch.arange(40_000.0).unsqueeze(1)
    demonstrations = DemonstratedActions(FieldSettings(n_points=4000, bandwidth=1.0))
    frames = torch.arange(0, 40_000, HORIZON)
    # The first tenth of the frames is shown five times as often.
    for batch in torch.cat([frames, frames[:500].repeat(4)])[torch.randperm(7000)].split(1000):
        demonstrations.observe(*chunks(actions, batch), batch, settings=demonstrations.settings)
    counts = torch.histc(demonstrations.field().anchors, bins=20, min=0, max=40_000)
    chi_square = ((counts - 200) ** 2 / 200).sum().item()
    assert chi_square < 45  # 0.1 % of the chi-square distribution with 19 degrees of freedom


def test_without_frame_indices_every_action_is_a_frame_of_its_own():
    settings = FieldSettings(n_points=1000)
    demonstrations = DemonstratedActions(settings)
    actions = torch.randn(3, 5, HORIZON, 2)
    is_pad = torch.rand(5, HORIZON) < 0.3
    demonstrations.observe(actions[0], is_pad, None, settings=settings)
    demonstrations.observe(actions[1], None, None, settings=settings)
    demonstrations.observe(actions[2], None, None, settings=settings)
    assert rows(demonstrations.field().anchors) == rows(
        torch.cat([actions[0][~is_pad], actions[1].flatten(0, 1), actions[2].flatten(0, 1)])
    )


def test_without_frame_indices_the_count_goes_on_after_loading():
    settings, actions = FieldSettings(n_points=1000), torch.randn(2, 5, HORIZON, 2)
    demonstrations = DemonstratedActions(settings)
    demonstrations.observe(actions[0], None, None, settings=settings)
    loaded = DemonstratedActions(settings)
    loaded.load_state_dict(demonstrations.state_dict())
    loaded.observe(actions[1], None, None, settings=settings)
    assert rows(loaded.field().anchors) == rows(actions.flatten(0, 2))


def test_only_the_chosen_dimensions_are_kept():
    settings = FieldSettings(n_points=1000, action_dims=(2, 0))
    actions = demonstration(40)
    assert rows(demonstrated(actions, settings).field().anchors) == rows(actions[:, [2, 0]])


@pytest.mark.parametrize("action_dims", [None, (2, 0)])
def test_saving_and_loading_restores_state_and_field_bit_for_bit(action_dims):
    settings = FieldSettings(n_points=50, action_dims=action_dims, threshold_quantile=0.1, alpha=-0.5)
    demonstrations = demonstrated(demonstration(), settings)
    loaded = DemonstratedActions(settings)
    loaded.load_state_dict(demonstrations.state_dict())
    assert_same_state(loaded, demonstrations)
    field, restored = demonstrations.field(), loaded.field()
    assert torch.equal(restored.anchors, field.anchors)
    assert (restored.bandwidth, restored.log_threshold, restored.alpha) == (
        field.bandwidth,
        field.log_threshold,
        field.alpha,
    )
    a = torch.randn(20, field.dim)
    assert torch.equal(restored.potential_gradient(a), field.potential_gradient(a))


def test_continuing_after_loading_equals_never_having_saved():
    actions, frames = demonstration(), torch.randperm(300)
    loaded = DemonstratedActions(SETTINGS)
    loaded.load_state_dict(demonstrated(actions, frames=frames[:150]).state_dict())
    show(loaded, actions, frames[150:])
    assert_same_state(loaded, demonstrated(actions, frames=frames))


def test_looking_at_the_field_between_batches_changes_nothing():
    actions, frames = demonstration(), torch.randperm(300)
    looked_at = DemonstratedActions(SETTINGS)
    for half in (frames[:150], frames[150:]):
        show(looked_at, actions, half)
        looked_at.field()
        looked_at.state_dict()
    assert_same_state(looked_at, demonstrated(actions, frames=frames))


def test_another_dataset_starts_afresh():
    old, new = demonstration(), demonstration() + 100
    demonstrations = DemonstratedActions(SETTINGS)
    show(demonstrations, old, torch.arange(300), dataset_id=b"old")
    loaded = DemonstratedActions(SETTINGS)
    loaded.load_state_dict(demonstrations.state_dict())
    for sample in (demonstrations, loaded):
        show(sample, new, torch.arange(20), dataset_id=b"new")
        assert rows(sample.field().anchors) <= rows(new)
        assert len(sample) == 20 + HORIZON - 1


def test_the_same_dataset_goes_on_after_loading():
    actions = demonstration()
    demonstrations = DemonstratedActions(SETTINGS)
    show(demonstrations, actions, torch.arange(10), dataset_id=b"same")
    loaded = DemonstratedActions(SETTINGS)
    loaded.load_state_dict(demonstrations.state_dict())
    show(loaded, actions, torch.arange(10, 20), dataset_id=b"same")
    assert rows(loaded.field().anchors) == rows(actions[: 20 + HORIZON - 1])


def test_other_action_dimensions_start_afresh():
    actions = demonstration(100)
    demonstrations = demonstrated(actions, FieldSettings(n_points=1000, action_dims=(0, 1)))
    show(demonstrations, actions, torch.arange(5), settings=FieldSettings(n_points=1000, action_dims=(0, 2)))
    assert rows(demonstrations.field().anchors) == rows(actions[: 5 + HORIZON - 1, [0, 2]])


@pytest.mark.parametrize("n_points", [10, 50, 120])
def test_changing_the_number_of_points_while_training_gives_that_number(n_points):
    actions, settings = demonstration(), FieldSettings(n_points=n_points)
    demonstrations = demonstrated(actions)
    show(demonstrations, actions, torch.arange(300), settings=settings)
    assert rows(demonstrations.field().anchors) == rows(demonstrated(actions, settings).field().anchors)
    assert len(demonstrations.field().anchors) == n_points
    loaded = DemonstratedActions(settings)
    loaded.load_state_dict(demonstrations.state_dict())
    assert torch.equal(loaded.field().anchors, demonstrations.field().anchors)


def test_fewer_points_at_evaluation_are_those_that_training_would_have_kept():
    actions, settings = demonstration(), FieldSettings(n_points=10)
    few = demonstrated(actions).field(settings)
    assert torch.equal(few.anchors, demonstrated(actions, settings).field().anchors)


def test_another_alpha_at_evaluation_keeps_everything_else():
    demonstrations = demonstrated(demonstration())
    field = demonstrations.field()
    other = demonstrations.field(
        FieldSettings(n_points=50, bandwidth="likelihood", threshold_quantile=0.1, alpha=-3.0)
    )
    assert other.alpha == -3.0
    assert torch.equal(other.anchors, field.anchors)
    assert (other.bandwidth, other.log_threshold) == (field.bandwidth, field.log_threshold)


@pytest.mark.parametrize("bandwidth", [0.7, "scott", "silverman"])
def test_another_bandwidth_at_evaluation_fits_anew_and_that_of_training_comes_back(bandwidth):
    actions = demonstration()
    demonstrations = demonstrated(actions)
    before, state = demonstrations.field(), demonstrations.state_dict()
    settings = FieldSettings(n_points=50, bandwidth=bandwidth, threshold_quantile=0.1)
    other, trained_so = demonstrations.field(settings), demonstrated(actions, settings).field()
    assert other.bandwidth != before.bandwidth
    assert (other.bandwidth, other.log_threshold) == (trained_so.bandwidth, trained_so.log_threshold)
    again = demonstrations.state_dict()
    assert all(torch.equal(again[key], state[key]) for key in state)


def test_another_threshold_at_evaluation_fits_anew():
    demonstrations = demonstrated(demonstration())
    strict = demonstrations.field(FieldSettings(n_points=50, threshold_quantile=0.5))
    assert strict.log_threshold > demonstrations.field().log_threshold


def test_the_field_is_fitted_once_until_something_new_is_shown():
    actions = demonstration()
    demonstrations = demonstrated(actions, frames=torch.arange(100))
    field = demonstrations.field()
    assert demonstrations.field() is field
    show(demonstrations, actions, torch.arange(100, 300))
    assert demonstrations.field() is not field


def test_the_field_of_nothing_is_an_error_that_says_what_to_do():
    with pytest.raises(ValueError, match=r"potential field is not fitted.*guidance_scale=0"):
        DemonstratedActions(SETTINGS).field()


def test_asking_for_other_dimensions_than_were_kept_is_an_error():
    with pytest.raises(ValueError, match=r"field_action_dims must be None, as in training, got \(0,\)"):
        demonstrated(demonstration()).field(FieldSettings(action_dims=(0,)))


def test_a_dimension_that_does_not_exist_is_an_error():
    settings = FieldSettings(action_dims=(0, 3))
    with pytest.raises(ValueError, match="field_action_dims must be below the action dimension 3"):
        demonstrated(demonstration(), settings)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_an_action_that_is_not_finite_is_an_error(value):
    actions = demonstration()
    actions[17, 1] = value
    with pytest.raises(ValueError, match="demonstrated actions must be finite"):
        demonstrated(actions)


def corrupted(state: dict[str, Tensor], key: str, value: Tensor | None) -> dict[str, Tensor]:
    return {name: tensor for name, tensor in {**state, key: value}.items() if tensor is not None}


@pytest.mark.parametrize("key", ["points", "ranks", "n_shown", "dataset_id", "bandwidth", "log_threshold"])
def test_a_state_with_a_missing_entry_is_an_error(key):
    state = demonstrated(demonstration()).state_dict()
    with pytest.raises(ValueError, match="a potential field file must hold .* it is corrupted"):
        DemonstratedActions(SETTINGS).load_state_dict(corrupted(state, key, None))


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("points", torch.zeros(50), "finite points .* corrupted"),
        ("points", torch.zeros(49, 3), "finite points .* corrupted"),
        ("points", torch.full((50, 3), math.nan), "finite points .* corrupted"),
        ("points", torch.full((50, 3), math.inf), "finite points .* corrupted"),
        ("ranks", torch.zeros(50, 1, dtype=torch.int64), "finite points .* corrupted"),
        ("bandwidth", torch.tensor(math.nan), "bandwidth"),
        ("bandwidth", torch.tensor(-1.0), "bandwidth"),
        ("bandwidth", torch.ones(2), "bandwidth"),
        ("log_threshold", torch.tensor(math.nan), "log_threshold"),
        ("log_threshold", torch.ones(2), "log_threshold"),
    ],
)
def test_a_corrupted_state_is_an_error(key, value, message):
    state = demonstrated(demonstration()).state_dict()
    with pytest.raises(ValueError, match=message):
        DemonstratedActions(SETTINGS).load_state_dict(corrupted(state, key, value))


def test_a_state_of_other_dimensions_is_an_error():
    state = demonstrated(demonstration()).state_dict()
    with pytest.raises(ValueError, match=r"must cover the action dimensions \(0, 1\), got points of 3"):
        DemonstratedActions(FieldSettings(action_dims=(0, 1))).load_state_dict(state)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"n_points": 0}, "n_field_points must be at least 1, got 0"),
        ({"action_dims": ()}, "field_action_dims must be distinct indices from 0 on"),
        ({"action_dims": (0, "1")}, "field_action_dims must be whole numbers"),
        (
            {"action_dims": (0,), "angle_dims": (1,)},
            r"field_angle_dims must be among field_action_dims \(0,\)",
        ),
        ({"angle_dims": (1, 1)}, "field_angle_dims must be distinct indices from 0 on"),
        ({"angle_period": 0.0}, "field_angle_period must be finite and positive, got 0.0"),
        ({"leave_out": "frame"}, r"field_leave_out must be one of \('episode', 'nothing'\), got 'frame'"),
        ({"bandwidth": 1e300}, "field_bandwidth must lie between 1e-12 and 1e\\+12, got 1e\\+300"),
        ({"action_dims": (-1, 0)}, "field_action_dims must be distinct indices from 0 on"),
        ({"action_dims": (1, 1)}, "field_action_dims must be distinct indices from 0 on"),
        ({"bandwidth": "scot"}, r"field_bandwidth must be one of .*'scot'"),
        ({"bandwidth": 0}, "field_bandwidth must be finite and positive, got 0"),
        ({"bandwidth": math.nan}, "field_bandwidth must be finite and positive, got nan"),
        ({"bandwidth": math.inf}, "field_bandwidth must be finite and positive, got inf"),
        ({"threshold_quantile": 1.5}, r"field_threshold_quantile must lie in \[0, 1\], got 1.5"),
        ({"threshold_quantile": math.nan}, r"field_threshold_quantile must lie in \[0, 1\], got nan"),
        ({"alpha": 0.1}, "field_alpha must be finite and at most 0, got 0.1"),
        ({"alpha": math.nan}, "field_alpha must be finite and at most 0, got nan"),
    ],
)
def test_settings_that_break_their_rule_are_an_error(settings, message):
    with pytest.raises(ValueError, match=message):
        FieldSettings(**settings)


@pytest.mark.parametrize("start", [0, -1000, 2**40, -(2**63)])
def test_the_hash_is_one_to_one_on_a_million_consecutive_numbers(start):
    numbers = torch.arange(1_000_000) + start
    assert len(torch.unique(rank_of(numbers))) == 1_000_000


def test_the_hash_is_the_finaliser_of_splitmix64():
    def splitmix64(x: int) -> int:
        mask = 2**64 - 1
        x = (x + 0x9E3779B97F4A7C15) & mask
        x = ((x ^ (x >> 30)) * 0xBF58476D1CE4E5B9) & mask
        x = ((x ^ (x >> 27)) * 0x94D049BB133111EB) & mask
        return x ^ (x >> 31)

    numbers = [0, 1, 2, 12345, 2**40, 2**63 - 1]
    assert [value % 2**64 for value in rank_of(torch.tensor(numbers)).tolist()] == [
        splitmix64(x) for x in numbers
    ]


def pipeline(step: PotentialFieldProcessorStep) -> PolicyProcessorPipeline:
    return PolicyProcessorPipeline(
        [step], name="policy_preprocessor", to_transition=batch_to_transition, to_output=transition_to_batch
    )


def test_the_step_hands_over_the_demonstrations_and_leaves_the_transition_as_it_was():
    step = PotentialFieldProcessorStep(n_points=10)
    transition = create_transition(
        observation={"observation.state": torch.zeros(1, 2)}, complementary_data={"task": ["x"]}
    )
    result = step(transition)
    assert result[TransitionKey.COMPLEMENTARY_DATA][POTENTIAL_FIELD] is step.demonstrations
    assert result[TransitionKey.COMPLEMENTARY_DATA]["task"] == ["x"]
    assert transition[TransitionKey.COMPLEMENTARY_DATA] == {"task": ["x"]}
    assert result[TransitionKey.OBSERVATION] is transition[TransitionKey.OBSERVATION]
    assert step.transform_features({"a": {}}) == {"a": {}}


def test_a_saved_preprocessor_comes_back_with_settings_and_field(tmp_path):
    step = PotentialFieldProcessorStep(
        n_points=50, action_dims=(2, 0), bandwidth=0.3, threshold_quantile=0.1, alpha=-0.5
    )
    show(step.demonstrations, demonstration(), torch.arange(300), dataset_id=b"maze")
    pipeline(step).save_pretrained(tmp_path)
    loaded = PolicyProcessorPipeline.from_pretrained(
        tmp_path,
        config_filename="policy_preprocessor.json",
        to_transition=batch_to_transition,
        to_output=transition_to_batch,
    )
    restored = loaded({"observation.state": torch.zeros(1, 2)})[POTENTIAL_FIELD]
    assert restored.settings == step.demonstrations.settings
    assert_same_state(restored, step.demonstrations)
    a = torch.randn(20, 2)
    assert torch.equal(
        restored.field().potential_gradient(a), step.demonstrations.field().potential_gradient(a)
    )


def test_a_preprocessor_saved_before_training_comes_back_unfitted(tmp_path):
    pipeline(PotentialFieldProcessorStep(n_points=50)).save_pretrained(tmp_path)
    loaded = PolicyProcessorPipeline.from_pretrained(tmp_path, config_filename="policy_preprocessor.json")
    assert len(loaded.steps[0].demonstrations) == 0
    assert loaded.steps[0].demonstrations.settings.n_points == 50
