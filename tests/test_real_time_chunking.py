# SPDX-License-Identifier: Apache-2.0
"""Real-time chunking: chunks that go on from the one that is being executed."""

from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature, RTCAttentionSchedule
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.policies.rtc.modeling_rtc import RTCProcessor
from lerobot.rollout.inference.rtc import supports_rtc_inference
from torch import Tensor

from lerobot_pf2mp import DPPFConfig, PF2MPConfig
from lerobot_pf2mp.flow_matching import integrate
from lerobot_pf2mp.policies.batch_keys import POTENTIAL_FIELD
from lerobot_pf2mp.policies.dppf.modeling_dppf import DPPFPolicy
from lerobot_pf2mp.policies.fmp.real_time_chunking import continuing
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
    demonstrated.observe(actions, None, None, settings=policy.config.field_settings)
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
