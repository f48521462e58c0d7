# SPDX-License-Identifier: Apache-2.0
"""Real-time chunking: chunks that go on from the one that is being executed."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature, RTCAttentionSchedule
from lerobot.policies.rtc.action_queue import ActionQueue
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.policies.rtc.modeling_rtc import RTCProcessor
from lerobot.rollout.inference.rtc import _normalize_prev_actions_length, supports_rtc_inference
from torch import Tensor

from lerobot_pf2mp import DPPFConfig, PF2MPConfig
from lerobot_pf2mp.flow_matching import integrate
from lerobot_pf2mp.policies.batch_keys import POTENTIAL_FIELD
from lerobot_pf2mp.policies.dppf.modeling_dppf import DPPFPolicy
from lerobot_pf2mp.policies.fmp.real_time_chunking import continuing, is_committed, n_executed_of
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.policies.pf2mp.modeling_pf2mp import PF2MPPolicy

HORIZON, ACTION_DIM, STATE = 16, 2, "observation.state"
FEATURES: dict[str, Any] = {
    "input_features": {STATE: PolicyFeature(FeatureType.STATE, (3,))},
    "output_features": {"action": PolicyFeature(FeatureType.ACTION, (ACTION_DIM,))},
}
SMALL: dict[str, Any] = {"device": "cpu", "horizon": HORIZON, "n_action_steps": 4, "down_dims": (8, 16)}
FIRM = RTCConfig(prefix_attention_schedule=RTCAttentionSchedule.ONES, execution_horizon=6)


def pf2mp(rtc_config: RTCConfig | None, **options: Any) -> PF2MPPolicy:
    torch.manual_seed(0)
    config = PF2MPConfig(
        **SMALL, **FEATURES, n_groups=4, diffusion_step_embed_dim=16, num_inference_steps=10, **options
    )
    policy = PF2MPPolicy(config).eval()
    policy.config.rtc_config = rtc_config  # as lerobot-rollout does it
    policy.init_rtc_processor()
    return policy


def batch_for(policy: PF2MPPolicy) -> dict[str, Any]:
    generator = torch.Generator().manual_seed(1)
    demonstrated = DemonstratedActions(policy.config.field_settings)
    actions = 0.2 * torch.randn(40, HORIZON, ACTION_DIM, generator=generator)
    demonstrated.observe(
        actions,
        None,
        HORIZON * torch.arange(40),
        torch.arange(40),
        settings=policy.config.field_settings,
        n_executed=HORIZON,
    )
    return {STATE: torch.rand(1, 3, generator=generator), POTENTIAL_FIELD: demonstrated}


def chunk_of(policy: PF2MPPolicy, seed: int = 2, **options: Any) -> Tensor:
    noise = torch.randn(1, HORIZON, ACTION_DIM, generator=torch.Generator().manual_seed(seed))
    return policy.predict_action_chunk(batch_for(policy), noise=noise, **options)


def straight(target: Tensor) -> Any:
    """The exact velocity towards one target, in this package's time."""
    return lambda x_t, t: (target - x_t) / (1 - t.view(-1, 1, 1)).clamp_min(1e-6)


def test_the_end_point_that_lerobot_sees_is_the_one_that_the_flow_predicts() -> None:
    # With a weight of 1 everywhere and a last chunk that is the predicted end point there is nothing to correct: only if
    # both times and both velocities are turned round.
    target = torch.randn(1, HORIZON, ACTION_DIM, generator=torch.Generator().manual_seed(0))
    velocity = straight(target)
    all_kept = RTCConfig(prefix_attention_schedule=RTCAttentionSchedule.ONES, execution_horizon=HORIZON)
    steer = continuing(RTCProcessor(all_kept), target, inference_delay=2)
    x_t = torch.randn(1, HORIZON, ACTION_DIM, generator=torch.Generator().manual_seed(1))
    for time in (0.0, 0.3, 0.9):
        t = torch.tensor([time])
        wanted = velocity(x_t, t)
        torch.testing.assert_close(steer(x_t, t, wanted), wanted, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("guidance_scale", [0.0, 0.5])
def test_a_chunk_begins_with_what_is_left_of_the_last_one(guidance_scale: float) -> None:
    policy = pf2mp(FIRM, guidance_scale=guidance_scale)
    left_over = chunk_of(policy, seed=3)[0, 4:10]
    fresh = chunk_of(policy)
    continued = chunk_of(policy, prev_chunk_left_over=left_over, inference_delay=2)
    before = (fresh[0, :6] - left_over).abs().mean()
    after = (continued[0, :6] - left_over).abs().mean()
    assert after < 0.5 * before
    assert fresh.shape == continued.shape == (1, HORIZON, ACTION_DIM)


def test_guidance_still_raises_the_density_of_a_chunk_that_goes_on() -> None:
    left_over = torch.full((6, ACTION_DIM), 0.3)
    densities = []
    for scale in (0.0, 0.5):
        policy = pf2mp(FIRM, guidance_scale=scale)
        chunk = chunk_of(policy, prev_chunk_left_over=left_over, inference_delay=2)
        field = batch_for(policy)[POTENTIAL_FIELD].field(policy.config.field_settings)
        densities.append(field.log_density(chunk).mean())
    assert densities[1] > densities[0] + 0.1


def test_without_a_last_chunk_nothing_changes_but_the_length() -> None:
    with_chunking, without = pf2mp(FIRM), pf2mp(None)
    assert torch.equal(chunk_of(with_chunking)[:, :4], chunk_of(without))


def test_a_short_execution_horizon_leaves_the_rest_of_the_chunk_to_the_flow() -> None:
    target = torch.zeros(1, HORIZON, ACTION_DIM)
    steer = continuing(RTCProcessor(FIRM), torch.ones(6, ACTION_DIM), 0, execution_horizon=3)
    x_1 = integrate(straight(target), torch.randn(1, HORIZON, ACTION_DIM), 20, steer=steer)
    assert (x_1[:, :3] > 0.5).all()
    torch.testing.assert_close(x_1[:, 3:], target[:, 3:], atol=1e-5, rtol=0)


def test_lerobot_knows_which_policies_can_do_it() -> None:
    assert supports_rtc_inference(pf2mp(None))
    assert not supports_rtc_inference(pf2mp(None, n_obs_steps=2))
    cameras = {"observation.environment_state": PolicyFeature(FeatureType.ENV, (2,))}
    features = {**FEATURES, "input_features": {**FEATURES["input_features"], **cameras}}
    assert not supports_rtc_inference(DPPFPolicy(DPPFConfig(**SMALL, **features)))


def test_single_actions_and_a_last_chunk_without_it_are_errors() -> None:
    with pytest.raises(RuntimeError, match="use predict_action_chunk instead of select_action"):
        pf2mp(FIRM).select_action({STATE: torch.zeros(1, 3)})
    with pytest.raises(ValueError, match="prev_chunk_left_over needs rtc_config, got none"):
        chunk_of(pf2mp(None), prev_chunk_left_over=torch.zeros(4, ACTION_DIM))


# What is left of the last chunk.


def steered(left_over: Tensor, delay: int = 2) -> Tensor:
    """How much the processor changes each velocity, ``(B, HORIZON)``."""
    generator = torch.Generator().manual_seed(3)
    x_t, velocity = torch.randn(2, 2, HORIZON, ACTION_DIM, generator=generator)
    steer = continuing(RTCProcessor(FIRM), left_over, delay)
    return (steer(x_t, torch.full((2,), 0.4), velocity) - velocity).norm(dim=-1)


def test_in_inference_mode_chunks_continue_too() -> None:
    policy = pf2mp(FIRM)
    left_over = torch.full((5, ACTION_DIM), 0.3)
    wanted = chunk_of(policy, prev_chunk_left_over=left_over, inference_delay=2)
    with torch.inference_mode():
        found = chunk_of(policy, prev_chunk_left_over=left_over.clone(), inference_delay=2)
    assert torch.equal(found, wanted)
    assert not torch.allclose(found, chunk_of(policy))


@pytest.mark.parametrize("n_zeros", [0, 1, 5])
def test_zeros_that_lerobot_appends_are_no_actions(n_zeros: int) -> None:
    left_over = torch.randn(4, ACTION_DIM, generator=torch.Generator().manual_seed(4))
    padded = torch.cat([left_over, torch.zeros(n_zeros, ACTION_DIM)])
    assert torch.equal(steered(padded, delay=8), steered(left_over, delay=8))
    assert (steered(padded, delay=8)[:, :4] > 0.1).all()
    assert steered(padded, delay=8)[:, 4:].abs().max() < 1e-4


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_from_an_action_that_is_not_finite_on_nothing_is_continued(value: float) -> None:
    left_over = torch.randn(2, 6, ACTION_DIM, generator=torch.Generator().manual_seed(4))
    broken = left_over.clone()
    broken[1, 2, 0] = value  # of the second robot only
    found = steered(broken)
    torch.testing.assert_close(found[0], steered(left_over)[0])
    torch.testing.assert_close(found[1, :2], steered(left_over)[1, :2])
    assert found.isfinite().all() and found[1, 2:].abs().max() < 1e-4


@pytest.mark.parametrize("left_over", [torch.zeros(10, ACTION_DIM), torch.full((3, ACTION_DIM), torch.nan)])
def test_a_left_over_of_nothing_is_none(left_over: Tensor) -> None:
    policy = pf2mp(FIRM)
    found = chunk_of(policy, prev_chunk_left_over=left_over, inference_delay=3)
    torch.testing.assert_close(found, chunk_of(policy), rtol=1e-5, atol=1e-5)


def test_an_action_at_zero_among_others_is_an_action() -> None:
    left_over = torch.tensor([[0.0, 0.0], [0.1, 0.0], [0.0, 0.0], [0.0, 0.2], [0.0, 0.0]])
    assert is_committed(left_over).tolist() == [True, True, True, True, False]


@pytest.mark.parametrize("n_executed", [0, 1, 7, 15])
@pytest.mark.parametrize("n_kept", [3, 10, HORIZON])
def test_how_many_actions_were_executed_is_told_by_what_is_left(n_executed: int, n_kept: int) -> None:
    chunk = torch.randn(1, HORIZON, ACTION_DIM, generator=torch.Generator().manual_seed(5))
    left_over = _normalize_prev_actions_length(chunk[0, n_executed:], n_kept)  # as LeRobot cuts and pads it
    assert n_executed_of(chunk, left_over) == n_executed
    assert n_executed_of(chunk + 1, left_over) is None


def test_all_actions_were_executed_if_nothing_is_left() -> None:
    assert n_executed_of(torch.ones(1, HORIZON, ACTION_DIM), torch.zeros(10, ACTION_DIM)) == HORIZON


@pytest.mark.parametrize("n_taken", [5, HORIZON])
def test_with_lerobots_queue_the_next_plan_begins_where_the_robot_is(n_taken: int) -> None:
    """A plan that takes longer than its chunk leaves nothing, and LeRobot's engine then hands over zeros."""
    policy = pf2mp(FIRM, max_plans=1, guidance_scale=0.0)
    policy.guidance.measures_plans = True
    queue = ActionQueue(RTCConfig(enabled=True, execution_horizon=6))
    batch, places = batch_for(policy), []
    original = policy.guidance._places_of_robots
    policy.guidance._places_of_robots = lambda *args: places.append(original(*args)) or places[-1]  # type: ignore[method-assign]
    chunk = policy.predict_action_chunk(batch)
    queue.merge(chunk[0], chunk[0], 0)
    taken = [queue.get() for _ in range(n_taken)]
    left_over = _normalize_prev_actions_length(queue.get_left_over(), 6)
    policy.predict_action_chunk(batch, prev_chunk_left_over=left_over, inference_delay=2)
    assert torch.equal(places[1], taken[-1].unsqueeze(0))
    # Not to the middle of the range, where the zeros are.
    plain = policy.predict_action_chunk(batch, noise=torch.ones(1, HORIZON, ACTION_DIM))
    again = policy.predict_action_chunk(
        batch, noise=torch.ones(1, HORIZON, ACTION_DIM), prev_chunk_left_over=left_over, inference_delay=2
    )
    if n_taken == HORIZON:
        torch.testing.assert_close(again, plain, rtol=1e-5, atol=1e-5)
    else:
        assert (again[0, :2] - left_over[:2]).norm() < 0.5 * (plain[0, :2] - left_over[:2]).norm()


def continued_plan(
    policy: PF2MPPolicy, n_taken: int = 5, between: Callable[[], None] = lambda: None
) -> Tensor:
    """The second chunk of a robot that has moved on the first one, and takes two more of its actions meanwhile."""
    batch, noise = batch_for(policy), torch.ones(1, HORIZON, ACTION_DIM)
    chunk = policy.predict_action_chunk(batch, noise=noise)
    between()
    return policy.predict_action_chunk(
        batch, noise=-noise, prev_chunk_left_over=chunk[0, n_taken:], inference_delay=2
    )


def test_a_robot_that_moves_while_its_plan_is_made_stops_where_it_then_is() -> None:
    policy = pf2mp(FIRM, max_plans=1, guidance_scale=0.0)
    policy.guidance.measures_plans = True
    planned = continued_plan(policy)
    assert policy.plans is not None and (policy.plans.action_support < 0).all()  # of an untrained network
    policy.reset()
    held = continued_plan(policy, between=lambda: setattr(policy.config, "on_unsupported", "hold"))
    assert torch.equal(held[:, :2], planned[:, :2])
    assert torch.equal(held[:, 2:], planned[:, 1:2].expand_as(held[:, 2:]))


@pytest.mark.parametrize(("pause", "n_drawn"), [(1.0, 8), (0.0, 1)])
def test_another_plan_is_drawn_only_if_it_is_there_in_time(
    pause: float, n_drawn: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [0.0]

    def perf_counter() -> float:
        clock[0] += 0.01  # so long take the first plan, and the seven others
        return clock[0]

    def wait() -> None:
        clock[0] += pause  # five actions were executed meanwhile

    policy = pf2mp(FIRM, guidance_scale=0.0)
    monkeypatch.setattr("lerobot_pf2mp.policies.plans.plan_choice.time.perf_counter", perf_counter)
    continued_plan(policy, between=wait)
    assert policy.plans is not None
    assert policy.plans.is_flagged.all() and policy.plans.n_drawn.tolist() == [n_drawn]


def test_a_guide_of_the_callers_own_does_not_hide_where_the_robot_is() -> None:
    policy = pf2mp(FIRM, max_plans=1, guidance_scale=0.0)
    policy.guidance.measures_plans = True
    batch = batch_for(policy)
    chunk = policy.predict_action_chunk(batch, guide=lambda x_t, x_next, x_1, dt: x_next)
    places = policy.guidance._places_of_robots
    seen: list[Tensor | None] = []
    policy.guidance._places_of_robots = lambda *args: seen.append(places(*args)) or seen[-1]  # type: ignore[method-assign]
    policy.predict_action_chunk(
        batch, guide=lambda x_t, x_next, x_1, dt: x_next, prev_chunk_left_over=chunk[0, 5:], inference_delay=2
    )
    assert seen[0] is not None and torch.equal(seen[0], chunk[:, 4])
