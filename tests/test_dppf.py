# SPDX-License-Identifier: Apache-2.0
"""DPPF against LeRobot's own Diffusion Policy, which it differs from by guidance alone."""

import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.policies.factory import get_policy_class
from lerobot.processor import PolicyProcessorPipeline
from safetensors.torch import load_file
from torch import Tensor

from lerobot_pf2mp import DPPFConfig, PotentialFieldProcessorStep, load_policy
from lerobot_pf2mp.dataset_tools.maze.collect_maze import collect_maze
from lerobot_pf2mp.errors import ConfigError
from lerobot_pf2mp.guidance import GUIDANCE_INTEGRATORS, GUIDANCE_POINTS, EulerGuide, ProximalGuide
from lerobot_pf2mp.policies.batch_keys import POTENTIAL_FIELD
from lerobot_pf2mp.policies.dppf.modeling_dppf import DPPFPolicy
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions

STATE, ENV, ACTION = "observation.state", "observation.environment_state", "action"
FRONT = "observation.images.front"
HORIZON, ACTION_DIM, N_TRAIN = 8, 2, 20
SHAPES = {STATE: (3,), ENV: (2,), FRONT: (3, 32, 32), ACTION: (ACTION_DIM,)}
SMALL: dict[str, Any] = {
    "device": "cpu",
    "down_dims": (8, 16),
    "horizon": HORIZON,
    "n_action_steps": 4,
    "diffusion_step_embed_dim": 16,
    "num_train_timesteps": N_TRAIN,
    "input_features": {
        STATE: PolicyFeature(FeatureType.STATE, SHAPES[STATE]),
        ENV: PolicyFeature(FeatureType.ENV, SHAPES[ENV]),
    },
    "output_features": {ACTION: PolicyFeature(FeatureType.ACTION, SHAPES[ACTION])},
}
STATS = {
    key: {"min": -2 * torch.ones(SHAPES[key]), "max": 2 * torch.ones(SHAPES[key])}
    for key in (STATE, ENV, ACTION)
}
OTHER_STATS = {**STATS, ACTION: {"min": -3 * torch.ones(ACTION_DIM), "max": 3 * torch.ones(ACTION_DIM)}}
SCHEDULERS = ("DDIM", "DDPM")
BANDWIDTH = 0.3
SCALE = 0.3 * 5 * BANDWIDTH**2  # in each of 5 steps, euler goes 0.3 of the offset to the local mean

every_scheduler = pytest.mark.parametrize("scheduler", SCHEDULERS)
every_number_of_steps = pytest.mark.parametrize("n_steps", [1, 5, 7, None])
every_window = pytest.mark.parametrize("n_obs_steps", [1, 2])


def dppf(dataset_stats: Any = None, **options: Any) -> DPPFPolicy:
    return DPPFPolicy(DPPFConfig(**{**SMALL, "n_obs_steps": 1, **options}), dataset_stats).eval()


def stock(like: DPPFPolicy) -> DiffusionPolicy:
    """LeRobot's policy with the same sampler and weights."""
    config = like.config
    result = DiffusionPolicy(
        DiffusionConfig(
            **SMALL,
            n_obs_steps=config.n_obs_steps,
            noise_scheduler_type=config.noise_scheduler_type,
            num_inference_steps=config.num_inference_steps,
        )
    ).eval()
    result.load_state_dict(like.state_dict(), strict=True)
    return result


def observations(policy: DiffusionPolicy, batch_size: int = 3, *, window: bool = True) -> dict[str, Any]:
    frames = (policy.config.n_obs_steps,) if window else ()
    return {key: torch.rand(batch_size, *frames, *SHAPES[key]) for key in policy.config.input_features}


def training_batch(policy: DiffusionPolicy, batch_size: int = 3) -> dict[str, Any]:
    """A batch as LeRobot's loader makes it, the second half of the last chunk being padding."""
    is_pad = torch.zeros(batch_size, HORIZON, dtype=torch.bool)
    is_pad[-1, HORIZON // 2 :] = True
    return {
        **observations(policy, batch_size),
        ACTION: torch.randn(batch_size, HORIZON, ACTION_DIM),
        f"{ACTION}_is_pad": is_pad,
        "index": torch.arange(batch_size) * HORIZON,
        "task": ["x"] * batch_size,
    }


def demonstrations(policy: DPPFPolicy, dim: int = ACTION_DIM) -> DemonstratedActions:
    """Demonstrations around one corner of the action space."""
    settings = policy.config.field_settings
    result = DemonstratedActions(settings)
    result.observe(0.5 + 0.2 * torch.randn(40, HORIZON, dim), None, None, settings=settings)
    return result


def noise_for(batch_size: int = 3) -> Tensor:
    return torch.randn(batch_size, HORIZON, ACTION_DIM)


def chunk_of(policy: DiffusionPolicy, batch: dict[str, Any], noise: Tensor, **options: Any) -> Tensor:
    """A chunk with the same noise inside the scheduler each time, of which DDPM draws some in every step."""
    torch.manual_seed(1)
    return policy.predict_action_chunk(dict(batch), noise=noise, **options)


class Recorder:
    """A guide that moves every step by the same offset and remembers what it was given."""

    def __init__(self, offset: float = 0.0) -> None:
        self.offset = offset
        self.steps: list[tuple[Tensor, Tensor, Tensor, float]] = []

    def __call__(self, x_t: Tensor, x_next: Tensor, x_1: Tensor, dt: float) -> Tensor:
        self.steps.append((x_t.clone(), x_next.clone(), x_1.clone(), dt))
        return x_next + self.offset if self.offset else x_next


# Without guidance.


def test_the_weights_are_those_of_the_diffusion_policy():
    ours, theirs = dppf().state_dict(), DiffusionPolicy(DiffusionConfig(**SMALL, n_obs_steps=1)).state_dict()
    assert list(ours) == list(theirs)
    assert [weight.shape for weight in ours.values()] == [weight.shape for weight in theirs.values()]


@every_window
@every_number_of_steps
@every_scheduler
def test_a_chunk_with_guidance_scale_zero_is_bit_for_bit_that_of_the_diffusion_policy(
    scheduler, n_steps, n_obs_steps
):
    policy = dppf(
        n_obs_steps=n_obs_steps,
        noise_scheduler_type=scheduler,
        num_inference_steps=n_steps,
        guidance_scale=0.0,
    )
    batch, noise = observations(policy), noise_for()
    expected = chunk_of(stock(policy), batch, noise)
    assert expected.shape == (3, 4, ACTION_DIM)
    assert torch.equal(chunk_of(policy, batch, noise), expected)
    with_field = {**batch, POTENTIAL_FIELD: demonstrations(policy)}
    assert torch.equal(chunk_of(policy, with_field, noise), expected)


@every_window
@every_number_of_steps
@every_scheduler
def test_selected_actions_with_guidance_scale_zero_are_bit_for_bit_those_of_the_diffusion_policy(
    scheduler, n_steps, n_obs_steps
):
    policy = dppf(
        n_obs_steps=n_obs_steps,
        noise_scheduler_type=scheduler,
        num_inference_steps=n_steps,
        guidance_scale=0.0,
    )
    # A chunk of four actions, and a second one.
    stream = [observations(policy, window=False) for _ in range(6)]
    selected = []
    for one in (policy, stock(policy)):
        torch.manual_seed(1)
        selected.append(torch.stack([one.select_action(dict(batch)) for batch in stream]))
    assert torch.equal(*selected)


@every_window
def test_both_policies_learn_from_the_same_loss(n_obs_steps):
    guided = dppf(n_obs_steps=n_obs_steps).train()
    plain, batch = stock(guided).train(), training_batch(guided)
    with_field = {**batch, POTENTIAL_FIELD: DemonstratedActions(guided.config.field_settings)}
    losses = []
    for policy, seen in ((plain, batch), (guided, with_field)):
        torch.manual_seed(1)
        losses.append(policy(seen)[0])
    assert losses[0].isfinite()
    assert torch.equal(*losses)


@pytest.mark.parametrize("inputs", [(STATE, ENV), (STATE, ENV, FRONT)])
@every_window
def test_a_single_frame_stands_for_the_whole_window(inputs, n_obs_steps):
    types = {STATE: FeatureType.STATE, ENV: FeatureType.ENV, FRONT: FeatureType.VISUAL}
    policy = dppf(
        n_obs_steps=n_obs_steps,
        num_inference_steps=1,
        guidance_scale=0.0,
        input_features={key: PolicyFeature(types[key], SHAPES[key]) for key in inputs},
        pretrained_backbone_weights=None,
        use_group_norm=True,
        spatial_softmax_num_keypoints=4,
    )
    frame, noise = observations(policy, window=False), noise_for()
    before = dict(frame)
    window = {key: torch.stack([value] * n_obs_steps, dim=1) for key, value in frame.items()}
    chunk = policy.predict_action_chunk(frame, noise=noise)
    assert torch.equal(chunk, DiffusionPolicy.predict_action_chunk(policy, window, noise=noise))
    assert torch.equal(chunk, policy.predict_action_chunk(window, noise=noise))
    assert frame.keys() == before.keys()
    assert all(frame[key] is value for key, value in before.items())


# With guidance.


@pytest.mark.parametrize("point", [None, *GUIDANCE_POINTS])
@pytest.mark.parametrize("integrator", GUIDANCE_INTEGRATORS)
@every_scheduler
def test_guidance_raises_the_log_density_of_the_actions(scheduler, integrator, point):
    policy = dppf(
        n_obs_steps=2,
        noise_scheduler_type=scheduler,
        guidance_scale=SCALE,
        guidance_integrator=integrator,
        guidance_point=point,
        field_bandwidth=BANDWIDTH,
    )
    batch, noise, shown = observations(policy, 8), noise_for(8), demonstrations(policy)
    before = chunk_of(stock(policy), batch, noise)
    after = chunk_of(policy, {**batch, POTENTIAL_FIELD: shown}, noise)
    assert after.shape == before.shape
    log_density = shown.field().log_density
    assert log_density(after).mean() > log_density(before).mean() + 0.5


@pytest.mark.parametrize("n_steps", [1, 5])
def test_the_limit_of_the_explicit_step_is_that_of_a_step_of_one_nth(n_steps):
    limit = 2 * BANDWIDTH**2 * n_steps
    for share in (0.99, 1.01):
        policy = dppf(
            num_inference_steps=n_steps,
            guidance_scale=share * limit,
            guidance_integrator="euler",
            field_bandwidth=BANDWIDTH,
        )
        batch = {**observations(policy), POTENTIAL_FIELD: demonstrations(policy)}
        if share < 1:
            assert chunk_of(policy, batch, noise_for()).isfinite().all()
        else:
            with pytest.raises(ValueError, match="guidance_integrator=euler diverges unless"):
                chunk_of(policy, batch, noise_for())


@pytest.mark.parametrize(("integrator", "kind"), [("euler", EulerGuide), ("proximal", ProximalGuide)])
@pytest.mark.parametrize("point", [None, *GUIDANCE_POINTS])
def test_the_configured_guide_is_made_over_the_field_of_the_batch(integrator, kind, point):
    policy = dppf(guidance_scale=0.3, guidance_integrator=integrator, guidance_point=point)
    shown = demonstrations(policy)
    guide = policy.guidance.guide({POTENTIAL_FIELD: shown}, torch.device("cpu"))
    default = {"euler": "current", "proximal": "end"}[integrator]
    assert isinstance(guide, kind)
    assert (guide.scale, guide.point) == (0.3, point or default)
    assert guide.field is shown.field()


@every_number_of_steps
@every_scheduler
def test_a_guide_is_called_once_for_each_denoising_step_and_dt_adds_up_to_one(scheduler, n_steps):
    policy = dppf(noise_scheduler_type=scheduler, num_inference_steps=n_steps)
    guide, calls = Recorder(), []
    policy.diffusion.unet.register_forward_hook(lambda *_: calls.append(1))
    chunk_of(policy, observations(policy), noise_for(), guide=guide)
    n = n_steps or N_TRAIN
    assert len(guide.steps) == len(calls) == n
    assert [dt for *_, dt in guide.steps] == [1 / n] * n


@every_window
@every_scheduler
def test_a_guide_sees_the_sample_the_schedulers_step_and_its_predicted_clean_sample(scheduler, n_obs_steps):
    policy = dppf(noise_scheduler_type=scheduler, n_obs_steps=n_obs_steps)
    noise, guide, seen = noise_for(), Recorder(offset=0.1), []
    policy.diffusion.unet.register_forward_hook(lambda _, inputs, output: seen.append((*inputs[:2], output)))
    chunk = chunk_of(policy, observations(policy), noise, guide=guide)

    theirs = stock(policy).diffusion.noise_scheduler
    theirs.set_timesteps(5)
    torch.manual_seed(1)
    sample = noise
    for (x_t, x_next, x_1, _), (network_input, timesteps, network_output) in zip(
        guide.steps, seen, strict=True
    ):
        assert torch.equal(x_t, sample)
        assert torch.equal(network_input, sample)
        step = theirs.step(network_output, timesteps[0], sample)
        assert torch.equal(x_next, step.prev_sample)
        assert torch.equal(x_1, step.pred_original_sample)
        assert not torch.equal(x_next, x_t)
        sample = x_next + 0.1
    assert torch.equal(chunk, sample[:, n_obs_steps - 1 : n_obs_steps + 3])


@every_number_of_steps
@every_scheduler
def test_the_last_step_ends_at_its_predicted_clean_sample(scheduler, n_steps):
    policy, guide = dppf(noise_scheduler_type=scheduler, num_inference_steps=n_steps), Recorder(offset=0.1)
    chunk_of(policy, observations(policy), noise_for(), guide=guide)
    ends = [torch.allclose(x_next, x_1, rtol=0, atol=1e-5) for _, x_next, x_1, _ in guide.steps]
    assert ends == [False] * (len(ends) - 1) + [True]
    if scheduler == "DDIM":
        assert torch.equal(guide.steps[-1][1], guide.steps[-1][2])


@every_scheduler
def test_a_guide_that_bends_nothing_leaves_the_actions_bit_for_bit(scheduler):
    policy = dppf(noise_scheduler_type=scheduler)
    batch, noise, guide = observations(policy), noise_for(), Recorder()
    assert torch.equal(chunk_of(policy, batch, noise, guide=guide), chunk_of(stock(policy), batch, noise))
    assert len(guide.steps) == 5


def test_a_guide_takes_the_place_of_the_configured_guidance_also_where_that_is_off():
    noise = noise_for()
    for scale in (0.0, 0.8):
        policy = dppf(guidance_scale=scale)
        batch = observations(policy)
        before = chunk_of(stock(policy), batch, noise)
        after = chunk_of(policy, batch, noise, guide=lambda x_t, x_next, x_1, dt: torch.full_like(x_next, 7))
        assert (after == 7).all()
        assert not torch.equal(before, after)


def test_selected_actions_are_those_of_the_guided_chunk():
    policy = dppf(guidance_scale=SCALE, field_bandwidth=BANDWIDTH)
    noise, field = noise_for(), {POTENTIAL_FIELD: demonstrations(policy)}
    batch = observations(policy, window=False)
    window = {key: value.unsqueeze(1) for key, value in batch.items()}
    expected = policy.predict_action_chunk({**window, **field}, noise=noise)
    actions = [policy.select_action({**batch, **field}, noise=noise) for _ in range(4)]
    assert torch.equal(torch.stack(actions, dim=1), expected)
    assert not torch.equal(stock(policy).predict_action_chunk(window, noise=noise), expected)


def test_guidance_on_some_dimensions_leaves_the_only_step_of_the_others_alone():
    options = {"num_inference_steps": 1, "field_bandwidth": BANDWIDTH, "field_alpha": -1.0}
    policy = dppf(field_action_dims=(1,), **options)
    batch, noise, shown = observations(policy), noise_for(), demonstrations(policy)
    before = chunk_of(stock(policy), batch, noise)
    after = chunk_of(policy, {**batch, POTENTIAL_FIELD: shown}, noise)
    assert shown.field().dim == 1
    assert torch.equal(after[..., 0], before[..., 0])
    assert (after[..., 1] != before[..., 1]).all()


def test_settings_changed_at_evaluation_take_effect():
    policy = dppf(field_bandwidth=BANDWIDTH)
    batch, noise = {**observations(policy), POTENTIAL_FIELD: demonstrations(policy)}, noise_for()
    seen = [chunk_of(policy, batch, noise)]
    changes = {
        "guidance_scale": 0.1,
        "guidance_point": "next",
        "guidance_integrator": "euler",
        "field_bandwidth": 0.2,
        "field_alpha": -5.0,
    }
    for name, value in changes.items():
        setattr(policy.config, name, value)
        seen.append(chunk_of(policy, batch, noise))
        assert not torch.equal(seen[-1], seen[-2]), name


@every_scheduler
def test_actions_are_the_same_in_inference_mode(scheduler):
    policy = dppf(noise_scheduler_type=scheduler, field_alpha=-1.0)
    batch, noise = observations(policy, window=False), noise_for()
    with torch.inference_mode():
        torch.manual_seed(1)
        first = policy.select_action({**batch, POTENTIAL_FIELD: demonstrations(policy)}, noise=noise)
    policy.reset()
    torch.manual_seed(1)
    again = policy.select_action({**batch, POTENTIAL_FIELD: demonstrations(policy)}, noise=noise)
    assert torch.equal(first, again)
    assert not first.requires_grad


@every_scheduler
def test_actions_are_float32_and_guided_under_bfloat16_autocast(scheduler):
    policy = dppf(noise_scheduler_type=scheduler, field_bandwidth=BANDWIDTH, field_alpha=-1.0)
    batch, noise = observations(policy), noise_for()
    guided_batch = {**batch, POTENTIAL_FIELD: demonstrations(policy)}
    expected, unguided = chunk_of(policy, guided_batch, noise), chunk_of(stock(policy), batch, noise)
    with torch.autocast("cpu", torch.bfloat16):
        chunk = chunk_of(policy, guided_batch, noise)
    assert chunk.dtype == torch.float32
    assert (chunk - expected).abs().mean() < 0.3 * (unguided - expected).abs().mean()


@pytest.mark.parametrize("fails_at", [1, 3, math.inf])
def test_guidance_leaves_nothing_behind_even_where_it_fails(fails_at):
    policy = dppf()
    batch, noise, calls = observations(policy), noise_for(), []
    scheduler, before = policy.diffusion.noise_scheduler, chunk_of(stock(policy), batch, noise)

    def guide(x_t: Tensor, x_next: Tensor, x_1: Tensor, dt: float) -> Tensor:
        calls.append(policy.diffusion.noise_scheduler)
        if len(calls) == fails_at:
            raise ArithmeticError("this guide fails")
        return x_next + 1

    if fails_at < math.inf:
        with pytest.raises(ArithmeticError, match="this guide fails"):
            chunk_of(policy, batch, noise, guide=guide)
        assert len(calls) == fails_at
    else:
        chunk_of(policy, batch, noise, guide=guide)
    assert scheduler not in calls
    assert policy.diffusion.noise_scheduler is scheduler
    policy.config.guidance_scale = 0.0
    assert torch.equal(chunk_of(policy, batch, noise), before)


@pytest.mark.parametrize("value", [None, "not a field"])
@pytest.mark.parametrize("method", ["predict_action_chunk", "select_action"])
def test_guidance_without_a_field_is_an_error(method, value):
    policy = dppf()
    batch = observations(policy, window=method == "predict_action_chunk")
    if value is not None:
        batch[POTENTIAL_FIELD] = value
    with pytest.raises(ValueError, match=r"guidance needs the potential field.*or set guidance_scale=0"):
        getattr(policy, method)(batch)


def test_guidance_with_an_unfitted_field_is_an_error():
    policy = dppf()
    batch = {**observations(policy), POTENTIAL_FIELD: DemonstratedActions(policy.config.field_settings)}
    with pytest.raises(ValueError, match="potential field is not fitted"):
        policy.predict_action_chunk(batch)


@pytest.mark.parametrize("dim", [1, 3])
def test_a_field_over_other_dimensions_is_an_error(dim):
    policy = dppf()
    batch = {**observations(policy), POTENTIAL_FIELD: demonstrations(policy, dim)}
    with pytest.raises(ValueError, match=rf"must cover 2 action dimensions, got a field over {dim}"):
        policy.predict_action_chunk(batch)


# What the field learns from.


@pytest.mark.slow
def test_the_field_holds_every_action_that_training_saw_once_whatever_is_observed():
    episode = torch.randn(30, ACTION_DIM)
    field = DemonstratedActions(DPPFConfig(**SMALL).field_settings)
    for n_obs_steps in (1, 2, 3):
        policy = dppf(n_obs_steps=n_obs_steps).train()
        for frames in torch.randperm(30).split(6):
            wanted = frames.unsqueeze(1) + torch.tensor(policy.config.action_delta_indices)
            batch = {
                **observations(policy, 6),
                ACTION: episode[wanted.clamp(0, 29)],
                "action_is_pad": (wanted < 0) | (wanted > 29),
                "index": frames,
                POTENTIAL_FIELD: field,
            }
            policy(batch)
        assert len(field) == 30
        assert torch.equal(field.field().anchors.sort(dim=0).values, episode.sort(dim=0).values)


@pytest.mark.parametrize("held_out", ["eval", "no_grad"])
def test_batches_that_are_not_trained_on_do_not_enter_the_field(held_out):
    policy = dppf()
    field = DemonstratedActions(policy.config.field_settings)
    batch = {**training_batch(policy), POTENTIAL_FIELD: field}
    with torch.set_grad_enabled(held_out != "no_grad"):
        policy.train(held_out != "eval")(batch)
    assert len(field) == 0
    policy.train()(batch)
    assert len(field) == 20  # all but the four padded ones


def test_a_batch_without_a_field_is_trained_on_as_well():
    policy = dppf().train()
    loss = policy(training_batch(policy))[0]
    loss.backward()
    assert all(weight.grad.isfinite().all() for weight in policy.get_optim_params())


def test_the_field_goes_on_with_the_same_statistics_and_starts_afresh_with_others():
    first, resumed, fine_tuned = (dppf(stats).train() for stats in (STATS, STATS, OTHER_STATS))
    field = DemonstratedActions(first.config.field_settings)
    for policy, n_points in ((first, 20), (resumed, 40), (fine_tuned, 20)):
        batch = training_batch(policy)
        batch["index"] += 1000 * (policy is resumed)
        policy({**batch, POTENTIAL_FIELD: field})
        assert len(field) == n_points


# Saving and loading.


def trained_with_its_processors(
    **options: Any,
) -> tuple[DPPFPolicy, PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """A policy, its preprocessor with a field of what it was shown, and its postprocessor."""
    policy = dppf(STATS, **options).train()
    preprocessor, postprocessor = make_pre_post_processors(policy.config, dataset_stats=STATS)
    for _ in range(5):
        policy(preprocessor(training_batch(policy)))
    return policy.eval(), preprocessor, postprocessor


def test_the_preprocessor_ends_with_the_field_in_normalised_units():
    policy, preprocessor, _ = trained_with_its_processors(n_field_points=11, field_alpha=-2.0)
    assert isinstance(preprocessor.steps[-1], PotentialFieldProcessorStep)
    shown = preprocessor(observations(policy))[POTENTIAL_FIELD]
    assert shown is preprocessor.steps[-1].demonstrations
    assert shown.settings == policy.config.field_settings
    assert len(shown) == 11
    batch = training_batch(policy)
    batch[ACTION] = torch.full_like(batch[ACTION], 2.0)  # the statistics' maximum
    fresh, _ = make_pre_post_processors(policy.config, dataset_stats=STATS)
    assert fresh.steps[-1].demonstrations.settings == policy.config.field_settings
    policy.train()(fresh(batch))
    torch.testing.assert_close(
        fresh.steps[-1].demonstrations.field().anchors, torch.ones(11, ACTION_DIM), rtol=0, atol=1e-5
    )


@pytest.mark.parametrize("options", [{}, {"field_action_dims": (1,), "guidance_point": "next"}])
@every_scheduler
def test_a_saved_policy_comes_back_with_identical_actions(tmp_path, scheduler, options):
    policy, preprocessor, postprocessor = trained_with_its_processors(
        noise_scheduler_type=scheduler, field_alpha=-1.0, **options
    )
    for part in (policy, preprocessor, postprocessor):
        part.save_pretrained(tmp_path)
    batch, noise = observations(policy), noise_for()
    expected = postprocessor(chunk_of(policy, preprocessor(batch), noise))
    loaded, loaded_preprocessor, loaded_postprocessor = load_policy(tmp_path, device="cpu")
    assert isinstance(loaded, DPPFPolicy)
    actions = loaded_postprocessor(chunk_of(loaded, loaded_preprocessor(batch), noise))
    assert torch.equal(actions, expected)
    unguided, loaded_preprocessor, loaded_postprocessor = load_policy(
        tmp_path, device="cpu", guidance_scale=0
    )
    plain = loaded_postprocessor(chunk_of(unguided, loaded_preprocessor(batch), noise))
    assert torch.equal(plain, postprocessor(chunk_of(stock(policy), preprocessor(batch), noise)))
    assert not torch.equal(plain, expected)


def test_options_of_the_sampler_and_of_guidance_can_be_changed_when_loading(tmp_path):
    for part in trained_with_its_processors():
        part.save_pretrained(tmp_path)
    options = {
        "num_inference_steps": 3,
        "noise_scheduler_type": "DDPM",
        "guidance_scale": 0.1,
        "guidance_point": "end",
        "guidance_integrator": "euler",
        "field_bandwidth": 0.7,
    }
    policy, preprocessor, _ = load_policy(tmp_path, device="cpu", **options)
    batch, calls = preprocessor(observations(policy)), []
    policy.diffusion.unet.register_forward_hook(lambda *_: calls.append(1))
    policy.predict_action_chunk(batch)
    assert len(calls) == 3
    assert type(policy.diffusion.noise_scheduler).__name__ == "DDPMScheduler"
    guide = policy.guidance.guide(batch, torch.device("cpu"))
    assert isinstance(guide, EulerGuide)
    assert (guide.scale, guide.point) == (0.1, "end")
    assert guide.field.bandwidth == 0.7


# The configuration.


def test_the_defaults_are_those_of_the_papers_comparison():
    config = DPPFConfig(device="cpu")
    assert (config.noise_scheduler_type, config.num_inference_steps) == ("DDIM", 5)
    assert (config.guidance_scale, config.guidance_integrator, config.guidance_point) == (
        0.8,
        "proximal",
        None,
    )
    assert config.type == "dppf"
    assert get_policy_class("dppf") is DPPFPolicy


def test_all_other_defaults_are_those_of_the_diffusion_policy():
    ours, theirs = DPPFConfig(device="cpu"), DiffusionConfig(device="cpu")
    differing = {key for key, value in vars(theirs).items() if getattr(ours, key) != value}
    assert differing == {"noise_scheduler_type", "num_inference_steps"}


@pytest.mark.parametrize("n_steps", [1, N_TRAIN, None])
def test_one_to_all_denoising_steps_are_valid(n_steps):
    assert DPPFConfig(**SMALL, num_inference_steps=n_steps).num_inference_steps == n_steps


def test_a_saved_configuration_comes_back_equal(tmp_path):
    config = DPPFConfig(
        **SMALL,
        num_inference_steps=None,
        guidance_point="end",
        field_action_dims=(1, 0),
        field_bandwidth="scott",
    )
    config.save_pretrained(tmp_path)
    assert PreTrainedConfig.from_pretrained(tmp_path) == config


BROKEN_RULES = [
    ({"num_inference_steps": 0}, "num_inference_steps must lie in 1 to num_train_timesteps=20, got 0"),
    ({"num_inference_steps": -5}, "num_inference_steps must lie in 1 to num_train_timesteps=20, got -5"),
    ({"num_inference_steps": 21}, "num_inference_steps must lie in 1 to num_train_timesteps=20, got 21"),
    ({"guidance_scale": -1}, "guidance_scale must be finite and at least 0, got -1"),
    ({"guidance_scale": math.nan}, "guidance_scale must be finite and at least 0, got nan"),
    ({"guidance_integrator": "rk4"}, "guidance_integrator must be one of .*euler.*proximal.* got 'rk4'"),
    ({"guidance_point": "start"}, "guidance_point must be one of .*current.*end.*next.* null, got 'start'"),
    ({"n_field_points": 0}, "n_field_points must be at least 1, got 0"),
    ({"field_action_dims": (0, 0)}, r"field_action_dims must be distinct indices from 0 on, got \(0, 0\)"),
    ({"field_action_dims": (-1,)}, r"field_action_dims must be distinct indices from 0 on, got \(-1,\)"),
    ({"field_bandwidth": -1.0}, "field_bandwidth must be finite and positive, got -1.0"),
    ({"field_threshold_quantile": 2.0}, r"field_threshold_quantile must lie in \[0, 1\], got 2.0"),
    ({"field_alpha": 1.0}, "field_alpha must be finite and at most 0, got 1.0"),
    ({"noise_scheduler_type": "PNDM"}, "noise_scheduler_type` must be one of .*DDPM.*DDIM.* Got PNDM"),
    ({"horizon": 10}, "horizon should be an integer multiple of the downsampling factor"),
]


@pytest.mark.parametrize(("options", "message"), BROKEN_RULES)
def test_values_that_break_their_rule_are_an_error(options, message):
    with pytest.raises(ConfigError, match=message):
        DPPFConfig(**{**SMALL, **options})


@pytest.mark.parametrize(("options", "message"), [BROKEN_RULES[0], BROKEN_RULES[3], BROKEN_RULES[6]])
def test_values_that_break_their_rule_are_an_error_on_the_command_line_too(tmp_path, options, message):
    DPPFConfig(**SMALL).save_pretrained(tmp_path)
    overrides = [f"--{name}={value}" for name, value in options.items()]
    with pytest.raises(ConfigError, match=message):
        PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=overrides)


def test_a_field_dimension_that_the_action_does_not_have_is_an_error():
    with pytest.raises(
        ValueError, match=r"field_action_dims must be below the action dimension 2, got \(0, 2\)"
    ):
        dppf(field_action_dims=(0, 2))


# The stock commands.


@pytest.mark.slow
def test_stock_training_and_evaluation_need_no_more_than_the_policys_name(tmp_path: Path) -> None:
    def run_well(command: str, *options: str) -> None:
        finished = subprocess.run(
            [str(Path(sys.executable).parent / command), *options],
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert finished.returncode == 0, finished.stdout[-2000:] + finished.stderr[-6000:]

    data, output = tmp_path / "umaze", tmp_path / "training"
    collect_maze(
        "umaze",
        root=data,
        repo_id="local/umaze",
        n_episodes=12,
        n_steps=24,
        action_noise=0.0,
        seed=0,
        overwrite=False,
    )
    run_well(
        "lerobot-train",
        "--policy.type=dppf",
        "--dataset.repo_id=local/umaze",
        f"--dataset.root={data}",
        "--policy.push_to_hub=false",
        "--policy.device=cpu",
        "--policy.horizon=16",
        "--policy.n_action_steps=8",
        "--policy.down_dims=[8,16]",
        "--policy.diffusion_step_embed_dim=16",
        "--batch_size=8",
        "--num_workers=0",
        "--steps=3",
        f"--output_dir={output}",
    )
    checkpoint = output / "checkpoints/last/pretrained_model"
    (field_file,) = checkpoint.glob("*potential_field*.safetensors")
    assert len(load_file(field_file)["points"]) > 50  # 3 batches of 8 chunks of up to 16 actions
    run_well(
        "lerobot-eval",
        f"--policy.path={checkpoint}",
        "--env.type=pf2mp_maze",
        "--env.task=MazeUMaze-v0",
        "--env.episode_length=16",
        "--eval.n_episodes=2",
        "--eval.batch_size=2",
        f"--output_dir={tmp_path / 'evaluation'}",
    )
    assert (tmp_path / "evaluation/eval_info.json").is_file()
