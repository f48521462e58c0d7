# SPDX-License-Identifier: Apache-2.0
"""Plans are checked on their whole way, drawn again if they leave the demonstrated region, and held if none is left."""

import copy
import logging
import math
from dataclasses import fields
from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from torch import Tensor

from lerobot_pf2mp import DPPFConfig, FMPConfig, PF2MPConfig
from lerobot_pf2mp.policies.batch_keys import POTENTIAL_FIELD
from lerobot_pf2mp.policies.dppf.modeling_dppf import DPPFPolicy
from lerobot_pf2mp.policies.fmp.modeling_fmp import FMPPolicy
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.policies.guided.field_settings import FieldSettings
from lerobot_pf2mp.policies.pf2mp.modeling_pf2mp import PF2MPPolicy
from lerobot_pf2mp.policies.plans.demonstrated_plans import (
    DemonstratedPlans,
    choose_plans_of_episodes,
    states_are_places,
)
from lerobot_pf2mp.policies.plans.plan_choice import LatencyBudget, PlanCheck, choose_plans, react
from lerobot_pf2mp.policies.plans.plans import UnsupportedPlanError
from lerobot_pf2mp.potential_field import PotentialField
from lerobot_pf2mp.potential_field.ways import conformal_threshold, way_log_density

HORIZON, N_EXECUTED = 8, 4
STATE, ENV = "observation.state", "observation.environment_state"


# The support of a way.


def two_islands() -> PotentialField:
    """Two islands of anchors around x = -1 and x = 1."""
    islands = 0.05 * torch.randn(400, 2, generator=torch.Generator().manual_seed(0))
    islands[:, 0] += torch.tensor([-1.0, 1.0]).repeat(200)
    return PotentialField(islands, 0.1, log_threshold=-3.0)


def support_of(field: PotentialField, ways: Tensor) -> Tensor:
    return way_log_density(lambda points, _: field.log_density(points), ways, field.bandwidth, field.periods)


def test_a_way_between_two_supported_actions_is_unsupported_where_nobody_went() -> None:
    field = two_islands()
    way = torch.tensor([[[-1.0, 0.0], [-0.95, 0.0], [1.0, 0.0], [1.05, 0.0]]])
    assert field.is_safe(way).all()
    inside, across, after = support_of(field, way)[0].tolist()
    assert inside > field.log_threshold and after > field.log_threshold
    assert across < -20


def test_the_support_of_a_way_is_the_smallest_density_on_it() -> None:
    field = two_islands()
    ways = torch.randn(5, 7, 2, generator=torch.Generator().manual_seed(1))
    shares = torch.linspace(0, 1, 400).view(-1, 1)
    for way, found in zip(ways, support_of(field, ways), strict=True):
        for k in range(6):
            dense = field.log_density(way[k] + shares * (way[k + 1] - way[k])).min()
            ends = field.log_density(way[k : k + 2]).min()
            assert found[k] <= ends + 1e-3
            # Between judged points at most h/2 away: about a nat where the anchors are two bandwidths off.
            distance = torch.cdist(way[k] + shares * (way[k + 1] - way[k]), field.anchors).amin(1).max()
            assert dense - 1e-3 <= found[k] <= dense + (0.5 * distance / 0.1 + 0.125)


def test_judged_points_are_at_most_a_bandwidth_apart_and_include_all_corners() -> None:
    seen: list[Tensor] = []

    def record(points: Tensor, piece: Tensor) -> Tensor:
        seen.append(torch.cat([points, piece.unsqueeze(1)], dim=1))
        return points.sum(dim=1)

    way = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [1.0, 0.25]]])
    found = way_log_density(record, way, 0.1)
    (points,) = seen
    assert found.shape == (1, 3)
    for corner in way[0]:
        assert ((points[:, :2] - corner).norm(dim=1) < 1e-6).any()
    for piece, start in enumerate(way[0, :-1]):
        of_piece = points[1:][points[1:, 2] == piece, :2]
        steps = torch.cat([start.unsqueeze(0), of_piece]).diff(dim=0).norm(dim=1)
        assert steps.max() <= 0.1 + 1e-6


def test_an_angles_way_is_the_short_one() -> None:
    anchors = torch.tensor([[3.1], [-3.1], [3.14]])
    field = PotentialField(anchors, 0.1, periods=torch.tensor([2 * math.pi]))
    across = support_of(field, torch.tensor([[[3.1], [-3.1]]]))
    assert across.item() > -3


def test_a_robot_that_stands_outside_is_on_an_unsupported_way() -> None:
    found = support_of(two_islands(), torch.tensor([[[0.0, 0.0], [1.0, 0.0], [1.0, 0.0]]]))
    assert found[0, 0] < -20 < found[0, 1]


# Calibration.


@pytest.mark.parametrize(
    ("n", "rate", "k"),
    [(999, 0.01, 10), (1000, 0.01, 10), (99, 0.01, 1), (98, 0.01, 1), (20, 0.3, 6), (1, 0.5, 1)],
)
def test_the_threshold_is_the_split_conformal_quantile(n: int, rate: float, k: int) -> None:
    scores = torch.randn(n, generator=torch.Generator().manual_seed(n))
    threshold, kept = conformal_threshold(scores, rate)
    assert threshold == scores.sort().values[k - 1].item()
    assert kept == pytest.approx(k / (n + 1))


@pytest.mark.parametrize("n", [20, 300])
def test_a_fresh_score_is_flagged_at_most_at_the_rate(n: int) -> None:
    generator = torch.Generator().manual_seed(0)
    rate, flagged, trials = 0.1, 0, 2000
    for _ in range(trials):
        scores = torch.randn(n + 1, generator=generator)
        threshold, kept = conformal_threshold(scores[:-1], rate)
        flagged += int(scores[-1] < threshold)
    assert flagged / trials <= kept + 3 * math.sqrt(kept / trials)
    assert flagged / trials >= kept - 3 * math.sqrt(kept / trials) - 1 / (n + 1)


def waves(n_episodes: int, length: int = 40, seed: int = 0) -> Tensor:
    """Demonstrations ``(E, length, 2)``: waves of slightly different heights."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.linspace(-1, 1, length).expand(n_episodes, -1)
    height = 0.5 + 0.05 * torch.randn(n_episodes, 1, generator=generator)
    return torch.stack([x, height * torch.sin(3 * x)], dim=2)


def demonstrated(
    episodes: Tensor, settings: FieldSettings | None = None, n_executed: int = HORIZON, **options: Any
) -> DemonstratedActions:
    """What training on all chunks of `HORIZON` actions of some episodes ``(E, L, D)`` leaves, in one batch."""
    n_episodes, length, dim = episodes.shape
    chunks = episodes.unfold(1, HORIZON, 1).transpose(2, 3)  # (E, L - T + 1, T, D)
    numbers = torch.arange(n_episodes).repeat_interleave(chunks.shape[1])
    frames = (torch.arange(n_episodes)[:, None] * length + torch.arange(chunks.shape[1])).flatten()
    kept = DemonstratedActions(settings or FieldSettings())
    kept.observe(
        chunks.reshape(-1, HORIZON, dim),
        None,
        frames,
        numbers,
        settings=kept.settings,
        n_executed=n_executed,
        **options,
    )
    return kept


@pytest.mark.parametrize("n_episodes", [20, 300])
def test_fresh_demonstrations_are_flagged_at_most_at_the_rate(n_episodes: int) -> None:
    kept = demonstrated(waves(n_episodes))
    threshold = kept.plan_threshold(kept.settings, HORIZON, 0.1)
    assert threshold.n_plans == n_episodes
    fresh = waves(400, seed=1)
    starts = torch.randint(0, 40 - HORIZON, (400,), generator=torch.Generator().manual_seed(2))
    chunks = torch.stack([episode[s : s + HORIZON] for episode, s in zip(fresh, starts, strict=True)])
    check = PlanCheck(kept.field(), threshold.log_density)
    flagged = (check(chunks[:, 0], chunks).amin(dim=1) < 0).float().mean().item()
    assert flagged <= threshold.false_alarm_rate + 3 * math.sqrt(0.1 / 400) + 1 / math.sqrt(n_episodes) * 0.2


def test_a_plan_is_calibrated_without_its_own_episode() -> None:
    """An episode that went where no other did is supported by itself alone."""
    episodes = waves(10)
    episodes[3, :, 1] += 3
    kept = demonstrated(episodes)
    scores = kept._score_plans(kept.settings, HORIZON)
    assert scores.min() < -10 and scores.sort().values[1] > -3
    own = demonstrated(episodes, FieldSettings(leave_out="nothing"))
    assert own._score_plans(own.settings, HORIZON).min() > -3


def test_a_wrong_value_in_a_plan_does_not_count() -> None:
    episodes = waves(30)
    clean = demonstrated(episodes).plan_threshold(FieldSettings(), HORIZON, 0.05).log_density
    broken = episodes.clone()
    broken[::6, 5::16] = 40.0  # 1 % of the frames
    kept = demonstrated(broken)
    threshold = kept.plan_threshold(kept.settings, HORIZON, 0.05)
    assert threshold.log_density == pytest.approx(clean, abs=4.0)
    assert threshold.n_plans < 30


def test_one_recording_is_calibrated_by_blocks_of_time() -> None:
    time = torch.linspace(0, 60, 3000)
    recording = torch.stack([time.sin(), time.cos()], dim=1)[None]
    recording = recording + 0.02 * torch.randn(recording.shape, generator=torch.Generator().manual_seed(0))
    kept = demonstrated(recording)
    assert 50 < kept.plan_threshold(kept.settings, HORIZON, 0.1).n_plans <= 100


# The sample of demonstrated plans.


def shown(order: Tensor, batch_size: int, n_episodes: int, n_frames: int) -> DemonstratedPlans:
    plans = DemonstratedPlans()
    frames = torch.arange(n_episodes * n_frames)[order]
    ways = frames.view(-1, 1, 1).expand(-1, 3, 2).float()
    for some in torch.arange(len(frames)).split(batch_size):
        plans.observe(ways[some], frames[some] // n_frames, frames[some])
    return plans


@pytest.mark.parametrize(("n_episodes", "n_frames"), [(1, 300), (7, 50), (1300, 3)])
def test_the_sample_of_plans_does_not_depend_on_their_order(n_episodes: int, n_frames: int) -> None:
    n = n_episodes * n_frames
    generator = torch.Generator().manual_seed(0)
    one = shown(torch.randperm(n, generator=generator), 64, n_episodes, n_frames)
    twice = torch.cat([torch.randperm(n, generator=generator), torch.randperm(n, generator=generator)])
    other = shown(twice, 1000, n_episodes, n_frames)
    assert torch.equal(one.ranks, other.ranks)
    assert torch.equal(one.episodes, other.episodes) and torch.equal(one.ways, other.ways)
    assert len(one) == {1: 100, 7: 7, 1300: 1000}[n_episodes]
    chosen = choose_plans_of_episodes(torch.arange(n) // n_frames, torch.arange(n), 0)
    assert torch.equal(one.ways[:, 0, 0].long(), chosen)


def test_plans_do_not_begin_in_the_last_frames_that_training_drops() -> None:
    episodes = torch.arange(5).repeat_interleave(10)
    chosen = choose_plans_of_episodes(episodes, torch.arange(50), drop_n_last_frames=9)
    assert sorted(chosen.tolist()) == [0, 10, 20, 30, 40]


def test_calibration_is_saved_and_restored_with_the_field() -> None:
    kept = demonstrated(waves(20), n_executed=5, states=None, places=None)
    state = kept.state_dict()
    restored = DemonstratedActions(kept.settings)
    restored.load_state_dict(state)
    scores = restored.calibration._scores
    assert scores is not None and len(scores[2]) == 20
    for n_actions in (5, HORIZON):
        found = restored.plan_threshold(kept.settings, n_actions, 0.1)
        assert found == kept.plan_threshold(kept.settings, n_actions, 0.1)
    again = restored.state_dict()
    assert all(torch.equal(value, again[name]) for name, value in state.items())


def test_states_in_other_units_are_not_where_the_robot_is() -> None:
    episodes = waves(20)
    places = torch.stack([torch.ones(2), torch.zeros(2)])
    chunks = episodes.unfold(1, HORIZON, 1).transpose(2, 3)
    states = chunks[:, :, 0].reshape(-1, 2)
    assert demonstrated(episodes, states=states, places=places).calibration.starts_at_state(None)
    in_degrees = torch.stack([torch.full((2,), 57.3), torch.zeros(2)])
    assert not demonstrated(episodes, states=states, places=in_degrees).calibration.starts_at_state(None)
    assert not demonstrated(episodes, states=-states, places=places).calibration.starts_at_state(None)
    assert not demonstrated(episodes).calibration.starts_at_state(None)


def test_states_at_the_seam_of_an_angle_are_where_the_robot_is() -> None:
    turn = 2 * math.pi
    ways = (
        torch.linspace(-0.4, 0.4, 11).view(11, 1, 1) + torch.tensor([0.0, 0.01, 0.02]).view(1, 3, 1) + math.pi
    )
    wrapped = (ways + math.pi) % turn - math.pi
    wrapped[:, 0] = ways[:, 0]  # states that go on beyond pi, actions that do not
    assert states_are_places(wrapped, torch.tensor([turn]))
    assert not states_are_places(wrapped[6:], None)
    assert states_are_places(wrapped[6:], torch.tensor([turn]))


# The choice among plans.


def plans_of(*marks: str) -> Tensor:
    """A plan for each string: "x" is an action between the islands, a digit one on an island, each different."""
    rows = [[(0.0, 0.0) if mark == "x" else (1 + 0.01 * int(mark), 0.0) for mark in row] for row in marks]
    return torch.tensor(rows)


def marks_of(chunk: Tensor) -> list[str]:
    return [
        "".join("x" if x < 0.5 else str(round(100 * (x - 1))) for x in row) for row in chunk[..., 0].tolist()
    ]


CHECK = PlanCheck(two_islands(), -5.0)


def at_home(n: int) -> Tensor:
    return torch.tensor([[1.0, 0.0]]).repeat(n, 1)


@pytest.mark.parametrize(
    ("others", "chosen", "is_flagged"),
    [
        (["x11", "222", "333"], "222", False),  # the first supported one, not the best
        (["x11", "x22", "33x"], "1xx", True),  # all are equally bad: the first
    ],
)
def test_the_first_supported_plan_is_chosen(others: list[str], chosen: str, is_flagged: bool) -> None:
    asked: list[tuple[list[int], int]] = []

    def draw(rows: Tensor, n: int) -> Tensor:
        asked.append((rows.tolist(), n))
        return plans_of(*others)

    chunk, plans = choose_plans(CHECK, at_home(3), plans_of("123", "1xx", "456"), 4, draw)
    assert asked == [([1], 3)]  # all others in one pass, for the flagged robot only
    assert marks_of(chunk) == ["123", chosen, "456"]
    assert plans.n_drawn.tolist() == [1, 4, 1]
    assert plans.is_flagged.tolist() == [False, is_flagged, False]
    torch.testing.assert_close(plans.support, CHECK(at_home(3), chunk).amin(dim=1))
    torch.testing.assert_close(plans.action_support, CHECK(at_home(3), chunk))


def test_if_none_is_supported_the_best_is_chosen() -> None:
    worse, better = torch.full((1, 2, 2), 5.0), torch.tensor([[[1.5, 0.0], [1.5, 0.0]]])
    chunk, plans = choose_plans(
        CHECK, at_home(1), worse, 3, lambda rows, n: torch.cat([better, torch.full_like(worse, math.nan)])
    )
    assert torch.equal(chunk, better)
    assert plans.is_flagged.item() and plans.support.item() > -30


def test_each_robot_gets_a_plan_of_its_own() -> None:
    def draw(rows: Tensor, n: int) -> Tensor:
        return plans_of("x11", "222", "333", "x44")

    chunk, _ = choose_plans(CHECK, at_home(3), plans_of("xx1", "555", "1xx"), 3, draw)
    assert marks_of(chunk) == ["222", "555", "333"]


@pytest.mark.parametrize("max_plans", [1, 8])
def test_no_plan_is_drawn_again_without_need_or_time(max_plans: int) -> None:
    def draw(rows: Tensor, n: int) -> Tensor:
        raise AssertionError("another plan was drawn")

    chunk, plans = choose_plans(CHECK, at_home(1), plans_of("123"), max_plans, draw)
    assert marks_of(chunk) == ["123"] and not plans.is_flagged.any()
    chunk, plans = choose_plans(
        CHECK, at_home(1), plans_of("1x3"), max_plans, None if max_plans > 1 else draw
    )
    assert marks_of(chunk) == ["1x3"] and plans.is_flagged.all() and plans.n_drawn.tolist() == [1]


# What is done about plans that stay flagged.


def reaction(on_unsupported: str, *marks: str, places: Tensor | None = None) -> list[str]:
    chunk = plans_of(*marks)
    places = at_home(len(chunk)) if places is None else places
    _, plans = choose_plans(CHECK, places, chunk, 1, None)
    return marks_of(react(on_unsupported, plans, chunk, places))


@pytest.mark.parametrize(
    ("planned", "executed"),
    [
        ("12345", "12345"),
        ("12xx5", "12222"),  # what comes after the gap is not reached
        ("x2345", "00000"),  # where the robot is
        ("1xxxx", "11111"),
        ("xxxxx", "00000"),
    ],
)
def test_a_robot_is_held_where_its_way_leaves_the_region(planned: str, executed: str) -> None:
    assert reaction("hold", planned) == [executed]
    assert reaction("ignore", planned) == [planned]


def test_a_robot_that_moves_meanwhile_is_not_sent_back() -> None:
    chunk = plans_of("1x345x")
    _, plans = choose_plans(CHECK, at_home(1), chunk, 1, None)
    assert marks_of(react("hold", plans, chunk, at_home(1), n_committed=3)) == ["1x3455"]


def test_robots_side_by_side_are_held_each_for_itself() -> None:
    places = at_home(3)
    places[:, 0] += torch.tensor([0.07, 0.08, 0.09])
    assert reaction("hold", "1xx", "x23", "123", places=places) == ["111", "888", "123"]


def test_a_warning_says_how_many_plans_leave_the_region_and_how_far(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        reaction("warn", "123")
        assert not caplog.records
        assert reaction("warn", "123", "1x3") == ["123", "1x3"]
    (record,) = caplog.records
    smallest = -CHECK(at_home(1), plans_of("1x3")).min().item()
    assert record.message == (
        f"1 of 2 plans leave the demonstrated region by up to {smallest:.1f} nats, the best of 1 drawn"
    )


def test_stop_is_one_clear_error() -> None:
    with pytest.raises(
        UnsupportedPlanError, match="^The plan leaves the demonstrated region by .*on_unsupported=stop"
    ):
        reaction("stop", "1x3")
    assert reaction("stop", "123") == ["123"]


def test_another_pass_must_end_before_its_plan_is_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("lerobot_pf2mp.policies.plans.plan_choice.time.perf_counter", lambda: now[0])
    budget = LatencyBudget()
    budget.begin(None)
    assert budget.allows_another_pass(None)  # the robot waits
    assert not budget.allows_another_pass(10)  # how long a step lasts is not known
    now[0] = 1.0
    budget.begin(10)  # a step lasts 0.1 s
    now[0] = 1.05
    assert not budget.allows_another_pass(0)
    assert not budget.allows_another_pass(0.9)
    assert budget.allows_another_pass(1.01)  # 0.05 s passed, and as much again fits into 0.101 s
    budget.took(0.5)
    assert not budget.allows_another_pass(5)
    assert budget.allows_another_pass(6)


# In the policies.


def policy_of(kind: str, **options: Any) -> Any:
    torch.manual_seed(0)
    common: dict[str, Any] = {
        "device": "cpu",
        "horizon": HORIZON,
        "n_action_steps": N_EXECUTED,
        "n_obs_steps": 1,
        "down_dims": (8, 16),
        "n_groups": 4,
        "diffusion_step_embed_dim": 16,
        "input_features": {
            STATE: PolicyFeature(FeatureType.STATE, (2,)),
            ENV: PolicyFeature(FeatureType.ENV, (2,)),
        },
        "output_features": {"action": PolicyFeature(FeatureType.ACTION, (2,))},
        **options,
    }
    if kind == "dppf":
        return DPPFPolicy(DPPFConfig(**common)).eval()
    if kind == "fmp":
        return FMPPolicy(FMPConfig(**common)).eval()
    return PF2MPPolicy(PF2MPConfig(**common)).eval()


def batch_for(policy: Any, n_robots: int = 1, state: float = 0.0, **options: Any) -> dict[str, Any]:
    chunks = waves(20).unfold(1, HORIZON, 1).transpose(2, 3)
    states = chunks[:, :, 0].reshape(-1, 2)
    places = torch.stack([torch.ones(2), torch.zeros(2)])
    kept = demonstrated(
        waves(20),
        policy.config.field_settings,
        n_executed=N_EXECUTED,
        **{"states": states, "places": places, **options},
    )
    states = torch.full((n_robots, 2), state)
    return {STATE: states, ENV: torch.zeros(n_robots, 2), POTENTIAL_FIELD: kept}


@pytest.mark.parametrize("kind", ["pf2mp", "dppf"])
def test_without_guidance_and_other_plans_nothing_changes(kind: str) -> None:
    noise = torch.randn(2, HORIZON, 2, generator=torch.Generator().manual_seed(1))
    guided = policy_of(kind, guidance_scale=0.0, max_plans=1)
    batch = batch_for(guided, n_robots=2)
    found = guided.predict_action_chunk(dict(batch), noise=noise)
    assert guided.plans is None and guided.support is None
    guided.guidance.measures_plans = True
    assert torch.equal(guided.predict_action_chunk(dict(batch), noise=noise), found)
    assert guided.plans.is_flagged.all(), (
        "the untrained network must be flagged for this case to say something"
    )
    if kind == "pf2mp":
        plain = policy_of("fmp")
        plain.load_state_dict(guided.state_dict())
    else:
        own = {
            field.name: getattr(guided.config, field.name) for field in fields(DiffusionConfig) if field.init
        }
        plain = DiffusionPolicy(DiffusionConfig(**own)).eval()
        plain.load_state_dict(guided.state_dict())
    observation = {key: value for key, value in batch.items() if key != POTENTIAL_FIELD}
    if kind == "dppf":
        observation = {key: value.unsqueeze(1) for key, value in observation.items()}
    assert torch.equal(plain.predict_action_chunk(observation, noise=noise), found)


@pytest.mark.parametrize("kind", ["pf2mp", "dppf"])
def test_other_plans_continue_the_same_randomness(kind: str) -> None:
    policy = policy_of(kind, guidance_scale=0.0, max_plans=3)
    batch = batch_for(policy, n_robots=2)
    torch.manual_seed(5)
    chosen = policy.predict_action_chunk(dict(batch))
    assert policy.plans.n_drawn.tolist() == [3, 3]
    one = policy_of(kind, guidance_scale=0.0, max_plans=1)
    torch.manual_seed(5)
    first = one.predict_action_chunk(dict(batch))
    doubled = {**batch, STATE: torch.zeros(4, 2), ENV: torch.zeros(4, 2)}
    more = one.predict_action_chunk(doubled).unflatten(0, (2, 2))  # from the noise that comes next
    candidates = torch.cat([first.unsqueeze(1), more], dim=1)
    field = batch[POTENTIAL_FIELD].field()
    check, places = PlanCheck(field, 0.0), batch[STATE].repeat_interleave(3, dim=0)
    best = check(places, candidates.flatten(0, 1)).amin(dim=1).unflatten(0, (2, 3)).argmax(dim=1)
    torch.testing.assert_close(chosen, candidates[torch.arange(2), best], atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("kind", ["pf2mp", "dppf"])
@pytest.mark.parametrize("n_obs_steps", [1, 2])
@pytest.mark.parametrize("in_queues", [True, False])
def test_plans_from_images_are_drawn_again_from_the_robots_own_observations(
    kind: str, n_obs_steps: int, in_queues: bool
) -> None:
    image = "observation.images.front"
    inputs = {
        STATE: PolicyFeature(FeatureType.STATE, (2,)),
        image: PolicyFeature(FeatureType.VISUAL, (3, 64, 64)),
    }
    options = {"crop_shape": None, "pretrained_backbone_weights": None} if kind == "dppf" else {}
    policy = policy_of(
        kind, n_obs_steps=n_obs_steps, input_features=inputs, max_plans=3, guidance_scale=0.0, **options
    )
    batch = {key: value for key, value in batch_for(policy, n_robots=3).items() if key != ENV}
    batch[image] = torch.rand(3, 3, 64, 64, generator=torch.Generator().manual_seed(1))
    torch.manual_seed(5)
    if in_queues:
        policy.select_action(dict(batch))
        chosen = torch.stack(list(policy._queues["action"]), dim=1)
    else:
        chosen = policy.predict_action_chunk(dict(batch))[:, 1:]
    assert policy.plans.n_drawn.tolist() == [3, 3, 3]
    # The second robot alone, with the noise that it had among the three.
    policy.reset()
    torch.manual_seed(5)
    horizon = (3, HORIZON, 2)
    noise = [torch.randn(horizon), torch.randn(9 - 3, HORIZON, 2)]
    rows = torch.cat([noise[0][1:2], noise[1][2:4]])
    one = {
        key: value[1:2].expand(3, *value.shape[1:]) for key, value in batch.items() if key != POTENTIAL_FIELD
    }
    policy.config.max_plans = 1
    plans = policy.predict_action_chunk({**one, POTENTIAL_FIELD: batch[POTENTIAL_FIELD]}, noise=rows)
    assert any(torch.allclose(chosen[1], plan[1:], atol=1e-4) for plan in plans)


def test_a_generator_of_ones_own_draws_all_plans() -> None:
    policy = policy_of("pf2mp", max_plans=4)
    batch, chunks = batch_for(policy), []
    for seed in (1, 2):
        torch.manual_seed(seed)  # must not matter
        chunks.append(policy.predict_action_chunk(batch, generator=torch.Generator().manual_seed(3)))
        policy.reset()
    assert policy_of("pf2mp").config.max_plans == 8
    assert torch.equal(*chunks)


@pytest.mark.parametrize("kind", ["pf2mp", "dppf"])
def test_the_way_of_the_next_plan_begins_at_the_last_executed_action(kind: str) -> None:
    policy = policy_of(kind, max_plans=1, on_unsupported="hold", guidance_scale=0.0)
    batch = batch_for(policy)
    places = []
    original = policy.guidance._places_of_robots

    def watched(*args: Any) -> Tensor:
        places.append(original(*args))
        return places[-1]

    policy.guidance._places_of_robots = watched
    executed = [policy.select_action(dict(batch)) for _ in range(2 * N_EXECUTED + 1)]
    assert torch.equal(places[0], batch[STATE])  # where the robot is seen
    assert torch.equal(places[1], executed[N_EXECUTED - 1])
    assert torch.equal(places[2], executed[2 * N_EXECUTED - 1])
    # All plans of this network are flagged at once, so the robot stays where it is.
    assert all(torch.equal(action, batch[STATE]) for action in executed)


def test_a_caller_that_plans_early_is_held_where_the_robot_is_seen() -> None:
    policy = policy_of("pf2mp", max_plans=1, on_unsupported="hold", guidance_scale=0.0)
    for state in (0.0, 0.1, -0.2):
        batch = batch_for(policy, state=state)
        held = policy.predict_action_chunk(batch)
        assert torch.equal(held, torch.full_like(held, state))


def test_without_a_state_the_way_begins_at_the_first_action_which_must_be_supported_to_hold() -> None:
    policy = policy_of("pf2mp", max_plans=1, on_unsupported="hold", guidance_scale=0.0)
    noise = torch.randn(1, HORIZON, 2, generator=torch.Generator().manual_seed(1))
    batch = batch_for(policy, states=None, places=None)
    with pytest.raises(UnsupportedPlanError, match="already the first action does. Where the robot is"):
        policy.predict_action_chunk(batch, noise=noise)


def test_a_robot_whose_place_is_unknown_is_held_at_its_last_supported_action() -> None:
    chunk = plans_of("12x4", "1234")
    _, plans = choose_plans(CHECK, chunk[:, 0], chunk, 1, None)
    assert marks_of(react("hold", plans, chunk, None)) == ["1222", "1234"]


def test_a_state_in_other_units_is_said_once(caplog: pytest.LogCaptureFixture) -> None:
    policy = policy_of("pf2mp", max_plans=1, on_unsupported="warn", guidance_scale=0.0)
    batch = batch_for(policy, places=torch.stack([torch.full((2,), 57.3), torch.zeros(2)]))
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            policy.predict_action_chunk(batch)
    assert sum("or is not in its units" in r.message for r in caplog.records) == 1


@pytest.mark.parametrize("kind", ["pf2mp", "dppf"])
def test_a_copy_of_a_policy_follows_a_robot_of_its_own(kind: str) -> None:
    policy = policy_of(kind, max_plans=1, on_unsupported="hold", guidance_scale=0.0)
    policy.select_action(batch_for(policy))
    other = copy.deepcopy(policy)
    other.reset()
    held = other.select_action(batch_for(other, n_robots=2, state=0.1))
    assert torch.equal(held, torch.full((2, 2), 0.1))
    assert torch.equal(policy.select_action(batch_for(policy)), torch.zeros(1, 2))


@pytest.mark.parametrize("kind", ["pf2mp", "dppf"])
def test_a_plan_of_one_action_is_checked_too(kind: str) -> None:
    policy = policy_of(kind, n_action_steps=1, guidance_scale=0.0)
    policy.select_action(batch_for(policy))
    assert policy.support.shape == (1, 1) and policy.plans.n_drawn.tolist() == [8]


def test_another_number_of_robots_needs_a_reset() -> None:
    policy = policy_of("pf2mp", max_plans=1, on_unsupported="warn")
    for _ in range(N_EXECUTED):
        policy.select_action(batch_for(policy, n_robots=2))
    with pytest.raises(ValueError, match="as many robots as before, 2, until reset"):
        policy.predict_action_chunk(batch_for(policy, n_robots=3))
    policy.reset()
    policy.predict_action_chunk(batch_for(policy, n_robots=3))


@pytest.mark.parametrize("kind", ["fmp", "pf2mp", "dppf"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_plan_that_is_not_finite_is_never_returned(kind: str, value: float) -> None:
    policy = policy_of(kind)
    batch = batch_for(policy) if kind != "fmp" else {STATE: torch.zeros(1, 2), ENV: torch.zeros(1, 2)}
    batch[ENV] = torch.full((1, 2), value)
    with pytest.raises(ValueError, match=f"planned actions must be finite.*observations {ENV}$"):
        policy.select_action(batch)


def test_a_compiled_plan_that_is_not_finite_is_never_returned() -> None:
    torch.compiler.reset()
    policy = policy_of("fmp")
    compiled = torch.compile(policy.predict_action_chunk, backend="eager", fullgraph=True)
    batch = {STATE: torch.zeros(1, 2), ENV: torch.zeros(1, 2)}
    assert compiled(batch).isfinite().all()
    # PyTorch's compiled code does not restore the gradient mode when an error ends it.
    with torch.no_grad(), pytest.raises(Exception, match="planned actions must be finite"):
        compiled({**batch, ENV: torch.full((1, 2), math.nan)})
    assert torch.is_grad_enabled()


def test_plans_that_cannot_be_checked_are_said_once_and_an_error_if_asked_for(
    caplog: pytest.LogCaptureFixture,
) -> None:
    policy = policy_of("pf2mp")
    batch = batch_for(policy)
    batch[POTENTIAL_FIELD].calibration.plans.forget()
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            policy.predict_action_chunk(batch)
    said = [record.message for record in caplog.records if "Plans are not checked" in record.message]
    assert len(said) == 1 and "pf2mp-fit-field" in said[0]
    assert policy.plans is None
    policy.config.on_unsupported = "warn"
    with pytest.raises(
        ValueError, match="needs demonstrated plans, got a potential field without them: pf2mp-fit-field"
    ):
        policy.predict_action_chunk(batch)


def test_plans_longer_than_the_demonstrated_ones_cannot_be_checked() -> None:
    kept = demonstrated(waves(20))
    with pytest.raises(
        ValueError, match="demonstrated plans of 9 actions, got a potential field with plans of 8"
    ):
        kept.plan_threshold(kept.settings, HORIZON + 1, 0.01)


@pytest.mark.parametrize("kind", ["pf2mp", "dppf"])
def test_a_check_that_is_asked_for_needs_the_field(kind: str) -> None:
    policy = policy_of(kind, guidance_scale=0.0, on_unsupported="stop")
    with pytest.raises(ValueError, match="guidance needs the potential field"):
        policy.predict_action_chunk({STATE: torch.zeros(1, 2), ENV: torch.zeros(1, 2)})


def test_an_option_that_is_changed_later_takes_effect() -> None:
    noise = torch.randn(1, HORIZON, 2, generator=torch.Generator().manual_seed(1))
    policy = policy_of("pf2mp", max_plans=1, guidance_scale=0.0)
    batch = batch_for(policy)
    before = policy.predict_action_chunk(batch, noise=noise)
    policy.config.on_unsupported = "hold"
    assert not torch.equal(policy.predict_action_chunk(batch, noise=noise), before)
    policy.config.on_unsupported = "stop"
    with pytest.raises(UnsupportedPlanError):
        policy.predict_action_chunk(batch, noise=noise)
    policy.reset()
    assert policy.plans is None and policy.support is None


@pytest.mark.parametrize(
    ("option", "value", "rule"),
    [
        ("max_plans", 0, "max_plans must be at least 1, got 0"),
        ("false_alarm_rate", 0.0, "false_alarm_rate must lie between 0 and 1, got 0.0"),
        ("false_alarm_rate", 1.0, "false_alarm_rate must lie between 0 and 1, got 1.0"),
        ("guidance_quantile", 0.0, "guidance_quantile must lie between 0 and 1, got 0.0"),
        ("guidance_quantile", 1.5, "guidance_quantile must lie between 0 and 1, got 1.5"),
        ("guidance_region", "here", "guidance_region must be one of .*, got 'here'"),
        ("on_unsupported", "halt", "on_unsupported must be one of .*, got 'halt'"),
    ],
)
@pytest.mark.parametrize("kind", ["pf2mp", "dppf"])
def test_an_option_that_breaks_its_rule_is_one_clear_error(
    kind: str, option: str, value: Any, rule: str
) -> None:
    with pytest.raises(Exception, match=rule):
        policy_of(kind, **{option: value})
