# SPDX-License-Identifier: Apache-2.0
import math
from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.optim import AdamWConfig
from lerobot.policies import make_pre_post_processors
from lerobot.policies.factory import get_policy_class
from torch import Tensor

from lerobot_pf2mp import DPPFConfig, FMPConfig, PF2MPConfig, PotentialFieldProcessorStep
from lerobot_pf2mp.errors import ConfigError
from lerobot_pf2mp.policies.batch_keys import POTENTIAL_FIELD
from lerobot_pf2mp.policies.dppf.modeling_dppf import DPPFPolicy
from lerobot_pf2mp.policies.fmp.fused_adamw import FusedAdamWConfig
from lerobot_pf2mp.policies.fmp.modeling_fmp import FMPPolicy
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.policies.pf2mp.modeling_pf2mp import PF2MPPolicy

STATE, ENV, ACTION = "observation.state", "observation.environment_state", "action"
FRONT, WRIST = "observation.images.front", "observation.images.wrist"
HORIZON, ACTION_DIM = 8, 2
SMALL: dict[str, Any] = {
    "device": "cpu",
    "down_dims": (8, 16),
    "horizon": HORIZON,
    "n_action_steps": 4,
    "n_groups": 4,
    "diffusion_step_embed_dim": 16,
}
SHAPES = {STATE: (3,), ENV: (2,), FRONT: (3, 64, 64), WRIST: (3, 64, 64)}
TYPES = {STATE: FeatureType.STATE, ENV: FeatureType.ENV, FRONT: FeatureType.VISUAL, WRIST: FeatureType.VISUAL}


def features(*keys: str) -> dict[str, Any]:
    return {
        "input_features": {key: PolicyFeature(TYPES[key], SHAPES[key]) for key in keys},
        "output_features": {ACTION: PolicyFeature(FeatureType.ACTION, (ACTION_DIM,))},
    }


def fmp(*inputs: str, **options: Any) -> FMPPolicy:
    return FMPPolicy(FMPConfig(**SMALL, **features(*inputs or (STATE, ENV)), **options))


def pf2mp(dataset_stats: Any = None, **options: Any) -> PF2MPPolicy:
    return PF2MPPolicy(PF2MPConfig(**SMALL, **features(STATE, ENV), **options), dataset_stats)


def observations(policy: FMPPolicy, batch_size: int = 3, n_frames: int | None = None) -> dict[str, Any]:
    window = () if n_frames is None else (n_frames,)
    return {
        key: torch.rand(batch_size, *window, *feature.shape)
        for key, feature in policy.config.input_features.items()
    }


def training_batch(policy: FMPPolicy, batch_size: int = 3) -> dict[str, Any]:
    """A batch as LeRobot's loader makes it, the second half of the last chunk being padding."""
    n_obs_steps = policy.config.n_obs_steps
    is_pad = torch.zeros(batch_size, HORIZON, dtype=torch.bool)
    is_pad[-1, HORIZON // 2 :] = True
    return {
        **observations(policy, batch_size, None if n_obs_steps == 1 else n_obs_steps),
        ACTION: torch.randn(batch_size, HORIZON, ACTION_DIM),
        f"{ACTION}_is_pad": is_pad,
        "index": torch.arange(batch_size) * HORIZON,
        "task": ["x"] * batch_size,
    }


def noise_for(batch_size: int = 3) -> Tensor:
    return torch.randn(batch_size, HORIZON, ACTION_DIM)


def loss_of(policy: FMPPolicy, batch: dict[str, Any], reduction: str = "mean") -> Tensor:
    torch.manual_seed(1)
    return policy(batch, reduction=reduction)[0]


def demonstrations(config: PF2MPConfig, dim: int = ACTION_DIM) -> DemonstratedActions:
    result = DemonstratedActions(config.field_settings)
    result.observe(torch.randn(40, HORIZON, dim), None, None, settings=config.field_settings)
    return result


def train_a_little(policy: FMPPolicy, n_updates: int = 3) -> None:
    """Makes the network and its average differ."""
    policy.train()
    for _ in range(n_updates):
        with torch.no_grad():
            for weight in policy.network.parameters():
                weight.add_(0.1 * torch.randn_like(weight))
        policy.update()
    policy.eval()


# The loss.


@pytest.mark.parametrize("n_obs_steps", [1, 2])
def test_the_mean_loss_is_the_mean_of_the_losses_of_the_samples_if_nothing_is_padded(n_obs_steps):
    policy = fmp(n_obs_steps=n_obs_steps).train()
    batch = training_batch(policy)
    batch["action_is_pad"].zero_()
    losses = loss_of(policy, batch, "none")
    assert losses.shape == (3,)
    torch.testing.assert_close(loss_of(policy, batch), losses.mean())


def test_the_mean_loss_weighs_every_action_that_is_not_padded_alike():
    policy = fmp().train()
    batch = training_batch(policy)
    losses, counts = loss_of(policy, batch, "none"), torch.tensor([8.0, 8.0, 4.0])
    torch.testing.assert_close(loss_of(policy, batch), (losses * counts).sum() / 20)


@pytest.mark.parametrize("reduction", ["mean", "none"])
def test_padded_actions_do_not_change_the_loss(reduction):
    policy = fmp().train()
    batch = training_batch(policy)
    other = {**batch, ACTION: batch[ACTION].clone()}
    other[ACTION][batch["action_is_pad"]] = 3.0
    torch.testing.assert_close(loss_of(policy, other, reduction), loss_of(policy, batch, reduction))


def test_what_the_network_says_about_padding_does_not_change_the_loss():
    policy = fmp().train()
    batch = training_batch(policy)
    expected = loss_of(policy, batch)
    policy.network.register_forward_hook(
        lambda module, arguments, velocity: velocity + 9 * batch["action_is_pad"].unsqueeze(-1)
    )
    torch.testing.assert_close(loss_of(policy, batch), expected)


def test_padded_actions_do_change_the_loss_if_asked_to():
    policy = fmp(do_mask_loss_for_padding=False).train()
    batch = training_batch(policy)
    other = {**batch, ACTION: batch[ACTION].clone()}
    other[ACTION][batch["action_is_pad"]] = 3.0
    assert loss_of(policy, other) > loss_of(policy, batch)


def test_a_sample_of_nothing_but_padding_has_no_loss():
    policy = fmp().train()
    batch = training_batch(policy)
    batch["action_is_pad"][1] = True
    assert loss_of(policy, batch, "none")[1] == 0
    batch["action_is_pad"][:] = True
    assert loss_of(policy, batch) == 0


@pytest.mark.slow
def test_training_lowers_the_loss():
    policy = fmp().train()
    batch = training_batch(policy, 16)
    optimiser = (
        FMPConfig(device="cpu", optimizer_lr=1e-2).get_optimizer_preset().build(policy.get_optim_params())
    )
    start = loss_of(policy, batch).item()
    for _ in range(40):
        loss = policy(batch)[0]
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert loss_of(policy, batch).item() < 0.9 * start


def test_the_optimiser_takes_the_steps_of_lerobots_adamw():
    options = {"lr": 1e-2, "betas": (0.9, 0.99), "eps": 1e-7, "weight_decay": 0.1, "grad_clip_norm": 1.0}
    gradients = torch.randn(5, 3, 50, generator=torch.Generator().manual_seed(0))
    found = []
    for config in (FusedAdamWConfig(**options), AdamWConfig(**options)):
        weights = torch.nn.Parameter(torch.ones(3, 50))
        optimiser = config.build([weights])
        for weights.grad in gradients:
            optimiser.step()
        found.append(weights.detach())
    torch.testing.assert_close(*found, rtol=1e-5, atol=1e-7)
    assert not torch.equal(found[0], torch.ones(3, 50))
    assert FMPConfig(device="cpu").get_optimizer_preset().build([weights]).param_groups[0]["fused"]


@pytest.mark.slow
def test_gradient_checkpointing_changes_neither_loss_nor_gradient():
    results = []
    for checkpointing in (False, True):
        torch.manual_seed(0)
        policy = fmp(gradient_checkpointing=checkpointing).train()
        loss = loss_of(policy, training_batch(policy))
        results.append([loss, *torch.autograd.grad(loss, list(policy.network.parameters()))])
    for plain, checkpointed in zip(*results, strict=True):
        torch.testing.assert_close(checkpointed, plain)


@pytest.mark.parametrize("key", [STATE, ENV, ACTION])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_batch_that_is_not_finite_is_an_error_that_names_the_key(key, value):
    policy = fmp().train()
    batch = training_batch(policy)
    batch[key].view(-1)[0] = value
    with pytest.raises(ValueError, match=rf"dataset must be finite, got NaN or infinite values in {key}$"):
        policy(batch)


def test_a_loss_that_is_not_finite_though_the_batch_is_blames_the_learning_rate():
    policy = fmp().train()
    with torch.no_grad():
        next(iter(policy.get_optim_params())).fill_(math.inf)
    with pytest.raises(ValueError, match="lower the learning rate"):
        policy(training_batch(policy))


def test_an_unknown_reduction_is_an_error():
    policy = fmp()
    with pytest.raises(ValueError, match="reduction must be 'mean' or 'none', got 'sum'"):
        policy(training_batch(policy), reduction="sum")


@pytest.mark.parametrize("shape", [(3, 7, 2), (3, 2)])
def test_a_chunk_of_another_length_than_the_horizon_is_an_error(shape):
    policy = fmp()
    with pytest.raises(ValueError, match=r"action must have shape \(B, horizon=8, A\)"):
        policy({**training_batch(policy), ACTION: torch.zeros(shape)})


# Observations.


@pytest.mark.parametrize("n_obs_steps", [1, 2])
@pytest.mark.parametrize("inputs", [(STATE,), (ENV,), (STATE, ENV)])
def test_every_observed_frame_of_every_state_matters(inputs, n_obs_steps):
    policy = fmp(*inputs, n_obs_steps=n_obs_steps, use_ema=False).eval()
    batch, noise = observations(policy, n_frames=n_obs_steps), noise_for()
    chunk = policy.predict_action_chunk(batch, noise=noise)
    assert chunk.shape == (3, 4, ACTION_DIM)
    assert loss_of(policy.train(), training_batch(policy)).isfinite()
    policy.eval()
    for key in inputs:
        for frame in range(n_obs_steps):
            other = {**batch, key: batch[key].clone()}
            other[key][:, frame] += 1
            changed = policy.predict_action_chunk(other, noise=noise) != chunk
            assert changed.any(dim=-1).any(dim=-1).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("inputs", "options"),
    [
        ((FRONT,), {}),
        ((STATE, FRONT, WRIST), {}),
        ((STATE, FRONT, WRIST), {"use_separate_rgb_encoder_per_camera": True, "n_obs_steps": 2}),
        ((FRONT, WRIST), {"n_obs_steps": 2}),
        ((FRONT,), {"resize_shape": (80, 96), "crop_ratio": 0.8}),
        ((FRONT,), {"crop_shape": (48, 56), "crop_is_random": False, "use_group_norm": False}),
    ],
    ids=["one_camera", "two_cameras", "separate_encoders", "windows", "resize_and_crop", "crop"],
)
def test_every_observed_frame_of_every_camera_matters(inputs, options):
    policy = fmp(*inputs, use_ema=False, spatial_softmax_num_keypoints=4, **options)
    n_obs_steps = policy.config.n_obs_steps
    loss = loss_of(policy.train(), training_batch(policy, 2))
    loss.backward()
    assert all(w.grad is not None and w.grad.isfinite().all() for w in policy.get_optim_params())
    policy.eval()
    batch = observations(policy, 2, n_obs_steps)
    noise = noise_for(2)
    chunk = policy.predict_action_chunk(batch, noise=noise)
    assert torch.equal(policy.predict_action_chunk(batch, noise=noise), chunk)
    for key in set(inputs) - {STATE}:
        for frame in range(n_obs_steps):
            other = {**batch, key: batch[key].clone()}
            other[key][:, frame] = 1 - other[key][:, frame]
            assert not torch.equal(policy.predict_action_chunk(other, noise=noise), chunk)


@pytest.mark.slow
def test_cameras_are_told_apart_with_shared_and_with_separate_encoders():
    for separate in (False, True):
        policy = fmp(FRONT, WRIST, use_ema=False, use_separate_rgb_encoder_per_camera=separate).eval()
        batch, noise = observations(policy), noise_for()
        swapped = {FRONT: batch[WRIST], WRIST: batch[FRONT]}
        chunk = policy.predict_action_chunk(batch, noise=noise)
        assert len(policy.network.encoder.rgb_encoders) == (2 if separate else 1)
        assert not torch.equal(policy.predict_action_chunk(swapped, noise=noise), chunk)


def test_the_crop_follows_from_resize_shape_and_crop_ratio_and_is_central_at_evaluation():
    policy = fmp(FRONT, use_ema=False, resize_shape=(80, 96), crop_ratio=0.5).eval()
    assert policy.config.crop_shape == (40, 48)
    images, seen = observations(policy), []
    policy.network.encoder.rgb_encoders[0].backbone.register_forward_pre_hook(
        lambda module, arguments: seen.append(arguments[0])
    )
    policy.predict_action_chunk(images)
    resized = torch.nn.functional.interpolate(images[FRONT], (80, 96), mode="bilinear", antialias=True)
    torch.testing.assert_close(seen[0], resized[:, :, 20:60, 24:72])


def test_a_single_frame_stands_for_the_whole_window():
    policy = fmp(n_obs_steps=2).eval()
    batch, noise = observations(policy), noise_for()
    window = {key: torch.stack([value, value], dim=1) for key, value in batch.items()}
    assert torch.equal(
        policy.predict_action_chunk(batch, noise=noise), policy.predict_action_chunk(window, noise=noise)
    )


def test_a_window_of_another_length_is_an_error():
    policy = fmp(n_obs_steps=2).eval()
    with pytest.raises(
        ValueError, match=r"observation.state must hold n_obs_steps=2 frames, got \(3, 3, 3\)"
    ):
        policy.predict_action_chunk(observations(policy, n_frames=3))


def test_a_batch_without_an_observation_is_an_error_that_names_it():
    policy = fmp().eval()
    batch = observations(policy)
    del batch[ENV]
    with pytest.raises(ValueError, match="got a batch without 'observation.environment_state'"):
        policy.predict_action_chunk(batch)


# Inference.


def count_network_calls(policy: FMPPolicy) -> list[int]:
    calls: list[int] = []
    policy.inference_network.register_forward_hook(lambda *_: calls.append(1))
    return calls


@pytest.mark.parametrize(("integrator", "per_step"), [("euler", 1), ("midpoint", 2)])
def test_a_chunk_takes_num_inference_steps_network_calls_and_serves_n_action_steps(integrator, per_step):
    policy = fmp(num_inference_steps=3, integrator=integrator).eval()
    calls, counts = count_network_calls(policy), []
    for _ in range(10):
        assert policy.select_action(observations(policy)).shape == (3, ACTION_DIM)
        counts.append(len(calls))
    chunk = 3 * per_step
    assert counts == [chunk] * 4 + [2 * chunk] * 4 + [3 * chunk] * 2


@pytest.mark.parametrize("n_obs_steps", [1, 3])
def test_selected_actions_are_those_of_the_chunk_predicted_from_the_latest_observations(n_obs_steps):
    policy = fmp(n_obs_steps=n_obs_steps).eval()
    noise, stream = noise_for(), [observations(policy) for _ in range(8)]
    actions = [policy.select_action(batch, noise=noise) for batch in stream]
    start = [stream[max(0, 0 - back)] for back in reversed(range(n_obs_steps))]
    later = [stream[max(0, 4 - back)] for back in reversed(range(n_obs_steps))]
    for first, frames in ((0, start), (4, later)):
        window = {key: torch.stack([frame[key] for frame in frames], dim=1) for key in (STATE, ENV)}
        expected = policy.predict_action_chunk(window, noise=noise)
        assert torch.equal(torch.stack(actions[first : first + 4], dim=1), expected)


def test_the_chunk_begins_at_the_current_step():
    policy = fmp(n_obs_steps=3).eval()
    noise, batch = noise_for(), observations(policy)
    whole = []
    policy.inference_network.register_forward_hook(
        lambda _, arguments, v: whole.append(arguments[0] + 0.2 * v)
    )
    chunk = policy.predict_action_chunk(batch, noise=noise)
    torch.testing.assert_close(chunk, whole[-1][:, 2:6])


def test_reset_forgets_observations_and_planned_actions():
    policy = fmp(n_obs_steps=2).eval()
    noise, last = noise_for(), observations(policy)
    fresh = policy.select_action(last, noise=noise)
    for _ in range(3):
        policy.reset()
        policy.select_action(observations(policy), noise=noise)
        policy.select_action(observations(policy), noise=noise)
    policy.reset()
    assert torch.equal(policy.select_action(last, noise=noise), fresh)


def test_the_batch_size_may_change_after_reset():
    policy = fmp().eval()
    assert policy.select_action(observations(policy, 3)).shape == (3, ACTION_DIM)
    policy.reset()
    assert policy.select_action(observations(policy, 1)).shape == (1, ACTION_DIM)


def test_selecting_an_action_leaves_the_batch_as_it_was():
    policy = fmp(FRONT, use_ema=False).eval()
    batch = observations(policy)
    keys, before = set(batch), batch[FRONT].clone()
    policy.select_action(batch)
    assert set(batch) == keys
    assert torch.equal(batch[FRONT], before)


@pytest.mark.parametrize("method", ["predict_action_chunk", "select_action"])
def test_noise_or_a_generator_makes_actions_repeatable(method):
    policy = fmp().eval()
    batch = observations(policy)

    def act(**options: Any) -> Tensor:
        policy.reset()
        return getattr(policy, method)(batch, **options)

    noise = noise_for()
    assert torch.equal(act(noise=noise), act(noise=noise))
    by_seed = [act(generator=torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)]
    assert torch.equal(by_seed[0], by_seed[1])
    assert not torch.equal(by_seed[0], by_seed[2])
    drawn = torch.randn(3, HORIZON, ACTION_DIM, generator=torch.Generator().manual_seed(1))
    assert torch.equal(act(noise=drawn), by_seed[0])
    assert not torch.equal(act(), act())


@pytest.mark.parametrize("shape", [(3, 4, 2), (1, 8, 2), (8, 2)])
def test_noise_of_the_wrong_shape_is_an_error(shape):
    policy = fmp().eval()
    with pytest.raises(ValueError, match=r"noise must have shape \(3, 8, 2\), got"):
        policy.predict_action_chunk(observations(policy), noise=torch.zeros(shape))


def test_actions_are_the_same_in_inference_mode():
    policy = pf2mp(field_alpha=-1.0).eval()
    batch, noise = {**observations(policy), POTENTIAL_FIELD: demonstrations(policy.config)}, noise_for()
    with torch.inference_mode():
        actions = policy.select_action(batch, noise=noise)
    policy.reset()
    assert torch.equal(policy.select_action(batch, noise=noise), actions)
    assert not actions.requires_grad


# Saving and loading.


@pytest.mark.parametrize("use_ema", [True, False])
def test_a_saved_policy_comes_back_with_identical_actions(tmp_path, use_ema):
    policy = fmp(use_ema=use_ema)
    train_a_little(policy)
    policy.save_pretrained(tmp_path)
    loaded = FMPPolicy.from_pretrained(tmp_path, strict=True)
    batch, noise = observations(policy), noise_for()
    assert torch.equal(
        loaded.predict_action_chunk(batch, noise=noise), policy.predict_action_chunk(batch, noise=noise)
    )
    assert loaded.config == policy.config
    state = loaded.state_dict()
    assert all(torch.equal(value, state[key]) for key, value in policy.state_dict().items())


def test_a_checkpoint_with_its_preprocessor_comes_back_with_identical_guided_actions(tmp_path):
    policy = pf2mp(field_bandwidth=0.3, field_action_dims=(1,), field_alpha=-1.0)
    stats = {
        key: {"min": -2 * torch.ones(dim), "max": 2 * torch.ones(dim)}
        for key, dim in {STATE: 3, ENV: 2, ACTION: ACTION_DIM}.items()
    }
    preprocessor, postprocessor = make_pre_post_processors(policy.config, dataset_stats=stats)
    assert isinstance(preprocessor.steps[-1], PotentialFieldProcessorStep)
    policy.train()
    for _ in range(5):
        policy(preprocessor(training_batch(policy)))
    train_a_little(policy)
    policy.save_pretrained(tmp_path)
    preprocessor.save_pretrained(tmp_path)
    postprocessor.save_pretrained(tmp_path)

    config = PreTrainedConfig.from_pretrained(tmp_path)
    assert config == policy.config
    assert get_policy_class(config.type) is PF2MPPolicy
    loaded = PF2MPPolicy.from_pretrained(tmp_path, config=config)
    loaded_preprocessor, loaded_postprocessor = make_pre_post_processors(
        config, pretrained_path=str(tmp_path)
    )
    batch, noise = observations(policy), noise_for()
    expected = postprocessor(policy.predict_action_chunk(preprocessor(batch), noise=noise))
    actions = loaded_postprocessor(loaded.predict_action_chunk(loaded_preprocessor(batch), noise=noise))
    assert torch.equal(actions, expected)
    loaded.config.guidance_scale = 0.0
    unguided = loaded_postprocessor(loaded.predict_action_chunk(loaded_preprocessor(batch), noise=noise))
    assert not torch.equal(unguided, expected)


# Guidance.


def test_guidance_scale_zero_is_bit_for_bit_the_unguided_policy():
    plain, guided = fmp().eval(), pf2mp(guidance_scale=0.0, max_plans=1).eval()
    guided.load_state_dict(plain.state_dict())
    batch, noise = observations(plain), noise_for()
    expected = plain.predict_action_chunk(batch, noise=noise)
    assert torch.equal(guided.predict_action_chunk(batch, noise=noise), expected)
    batch[POTENTIAL_FIELD] = demonstrations(guided.config)
    assert torch.equal(guided.predict_action_chunk(batch, noise=noise), expected)
    assert torch.equal(guided.select_action(batch, noise=noise), plain.select_action(batch, noise=noise))


def test_both_policies_learn_from_the_same_loss():
    plain, guided = fmp().train(), pf2mp().train()
    guided.load_state_dict(plain.state_dict())
    batch = training_batch(plain)
    with_field = {**batch, POTENTIAL_FIELD: DemonstratedActions(guided.config.field_settings)}
    assert torch.equal(loss_of(guided, with_field), loss_of(plain, batch))


@pytest.mark.parametrize("guidance_integrator", ["euler", "proximal"])
def test_guidance_changes_the_actions_and_raises_their_log_density(guidance_integrator):
    plain = fmp().eval()
    guided = pf2mp(guidance_scale=0.05, guidance_integrator=guidance_integrator, field_bandwidth=0.3).eval()
    guided.load_state_dict(plain.state_dict())
    field = demonstrations(guided.config)
    batch, noise = observations(plain), 3 * noise_for()
    before = plain.predict_action_chunk(batch, noise=noise)
    after = guided.predict_action_chunk({**batch, POTENTIAL_FIELD: field}, noise=noise)
    assert not torch.equal(after, before)
    assert field.field().log_density(after).mean() > field.field().log_density(before).mean()


def test_guidance_on_some_dimensions_leaves_the_last_step_of_the_others_alone():
    plain = fmp(num_inference_steps=1).eval()
    guided = pf2mp(num_inference_steps=1, field_action_dims=(1,), field_alpha=-1.0).eval()
    guided.load_state_dict(plain.state_dict())
    batch, noise = observations(plain), noise_for()
    before = plain.predict_action_chunk(batch, noise=noise)
    batch[POTENTIAL_FIELD] = demonstrations(guided.config)
    after = guided.predict_action_chunk(batch, noise=noise)
    assert torch.equal(after[..., 0], before[..., 0])
    assert not torch.equal(after[..., 1], before[..., 1])


@pytest.mark.parametrize("value", [None, "not a field"])
def test_guidance_without_a_field_is_an_error(value):
    policy = pf2mp().eval()
    batch = observations(policy) if value is None else {**observations(policy), POTENTIAL_FIELD: value}
    with pytest.raises(ValueError, match="guidance needs the potential field"):
        policy.select_action(batch)


def test_guidance_with_an_unfitted_field_is_an_error():
    policy = pf2mp().eval()
    batch = {**observations(policy), POTENTIAL_FIELD: DemonstratedActions(policy.config.field_settings)}
    with pytest.raises(ValueError, match="potential field is not fitted"):
        policy.predict_action_chunk(batch)


def test_a_field_over_other_dimensions_is_an_error():
    policy = pf2mp().eval()
    batch = {**observations(policy), POTENTIAL_FIELD: demonstrations(policy.config, dim=3)}
    with pytest.raises(ValueError, match=r"must cover 2 action dimensions, got a field over 3"):
        policy.predict_action_chunk(batch)


def test_settings_changed_at_evaluation_take_effect():
    policy = pf2mp(field_bandwidth=0.3, field_threshold_quantile=0.5).eval()
    batch, noise = {**observations(policy), POTENTIAL_FIELD: demonstrations(policy.config)}, noise_for()
    seen = [policy.predict_action_chunk(batch, noise=noise)]
    for name, value in {"guidance_scale": 0.01, "field_bandwidth": 0.1, "field_alpha": -5.0}.items():
        setattr(policy.config, name, value)
        seen.append(policy.predict_action_chunk(batch, noise=noise))
        assert not torch.equal(seen[-1], seen[-2]), name


# What the field learns from.


def test_the_field_holds_every_action_that_training_saw_once_whatever_is_observed():
    episode = torch.randn(30, ACTION_DIM)
    field = DemonstratedActions(PF2MPConfig(**SMALL).field_settings)
    for n_obs_steps in (1, 2):
        policy = pf2mp(n_obs_steps=n_obs_steps).train()
        for frames in torch.randperm(30).split(6):
            wanted = frames.unsqueeze(1) + torch.tensor(policy.config.action_delta_indices)
            batch = {
                **observations(policy, 6, n_obs_steps),
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
    policy = pf2mp()
    field = DemonstratedActions(policy.config.field_settings)
    batch = {**training_batch(policy), POTENTIAL_FIELD: field}
    with torch.set_grad_enabled(held_out != "no_grad"):
        policy.train(held_out != "eval")(batch)
    assert len(field) == 0
    policy.train()(batch)
    assert len(field) == 20


def test_the_field_goes_on_with_the_same_statistics_and_starts_afresh_with_others():
    stats = {ACTION: {"min": torch.zeros(2), "max": torch.ones(2)}}
    other = {ACTION: {"min": torch.zeros(2), "max": 2 * torch.ones(2)}}
    first, resumed, fine_tuned = pf2mp(stats).train(), pf2mp(stats).train(), pf2mp(other).train()
    field = DemonstratedActions(first.config.field_settings)
    for policy, n_points in ((first, 20), (resumed, 40), (fine_tuned, 20)):
        batch = training_batch(policy)
        batch["index"] += 1000 * (policy is resumed)
        policy({**batch, POTENTIAL_FIELD: field})
        assert len(field) == n_points


def test_the_field_starts_afresh_if_the_normalisation_changes():
    stats = {ACTION: {"min": torch.zeros(2), "max": torch.ones(2)}}
    first = pf2mp(stats).train()
    mapping = {**first.config.normalization_mapping, "ACTION": "IDENTITY"}
    second = pf2mp(stats, normalization_mapping=mapping).train()
    field = DemonstratedActions(first.config.field_settings)
    for policy in (first, second):
        policy({**training_batch(policy), POTENTIAL_FIELD: field})
        assert len(field) == 20
    assert torch.equal(first.state_dict()["ema.n_averaged"], second.state_dict()["ema.n_averaged"])


# The moving average.


def test_evaluation_uses_the_average_and_training_the_weights():
    policy = fmp()
    train_a_little(policy)
    averaged, calls = count_network_calls(policy), []
    policy.network.register_forward_hook(lambda *_: calls.append(1))
    policy.predict_action_chunk(observations(policy))
    loss_of(policy.eval(), training_batch(policy))
    assert (len(averaged), len(calls)) == (5 + 1, 0)
    loss_of(policy.train(), training_batch(policy))
    assert (len(averaged), len(calls)) == (5 + 1, 1)


@pytest.mark.parametrize("decay", [0.0, 0.15, 0.999])
def test_the_average_follows_its_closed_form(decay):
    policy = fmp(ema_decay=decay)
    expected = None
    for n in range(6):
        train_a_little(policy, 1)
        weights = [weight.detach().double().clone() for weight in policy.network.parameters()]
        keep = 0.0 if n == 0 else min(decay, (1 + n) / (10 + n))  # the first update forgets the random start
        expected = (
            weights if n == 0 else [keep * e + (1 - keep) * w for e, w in zip(expected, weights, strict=True)]
        )
        for average, value in zip(policy.inference_network.parameters(), expected, strict=True):
            torch.testing.assert_close(average.double(), value, rtol=1e-5, atol=1e-6)
    differs = any(
        not torch.equal(average, weight)
        for average, weight in zip(
            policy.inference_network.parameters(), policy.network.parameters(), strict=True
        )
    )
    assert differs == (decay > 0)


@pytest.mark.slow
def test_the_average_goes_on_exactly_after_saving_and_loading(tmp_path):
    policy = fmp()
    train_a_little(policy)
    policy.save_pretrained(tmp_path)
    loaded = FMPPolicy.from_pretrained(tmp_path)
    for one in (policy, loaded):
        torch.manual_seed(5)
        train_a_little(one, 2)
    state = loaded.state_dict()
    assert all(torch.equal(value, state[key]) for key, value in policy.state_dict().items())
    assert state["ema.n_averaged"] == 5


def test_the_average_is_not_trained():
    policy = fmp().train()
    policy(training_batch(policy))[0].backward()
    assert all(weight.grad is None and not weight.requires_grad for weight in policy.ema.parameters())
    trained = {id(weight) for weight in policy.get_optim_params()}
    assert trained == {id(weight) for weight in policy.network.parameters()}


def test_without_the_average_there_is_none_in_the_state():
    policy = fmp(use_ema=False)
    assert policy.inference_network is policy.network
    assert not [key for key in policy.state_dict() if key.startswith("ema")]
    policy.update()


def test_weights_saved_without_an_average_become_the_average(tmp_path):
    plain = fmp(use_ema=False).eval()
    plain.save_pretrained(tmp_path)
    config = PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=["--use_ema=true"])
    loaded = FMPPolicy.from_pretrained(tmp_path, config=config, strict=True)
    assert loaded.ema is not None
    batch, noise = observations(plain), noise_for()
    assert torch.equal(
        loaded.predict_action_chunk(batch, noise=noise), plain.predict_action_chunk(batch, noise=noise)
    )
    train_a_little(loaded, 1)
    for average, weight in zip(loaded.ema.module.parameters(), loaded.network.parameters(), strict=True):
        assert torch.equal(average, weight)


# Mixed precision and compilation.


def test_actions_and_the_field_are_float32_and_finite_under_bfloat16_autocast():
    policy = pf2mp(field_alpha=-1.0, field_bandwidth=0.2).eval()
    field = demonstrations(policy.config)
    batch, noise = {**observations(policy), POTENTIAL_FIELD: field}, noise_for()
    expected = policy.predict_action_chunk(batch, noise=noise)
    with torch.autocast("cpu", torch.bfloat16):
        chunk = policy.predict_action_chunk(batch, noise=noise)
        gradient = field.field().potential_gradient(chunk)
    assert chunk.dtype == gradient.dtype == torch.float32
    assert chunk.isfinite().all()
    assert torch.equal(gradient, field.field().potential_gradient(chunk))
    torch.testing.assert_close(chunk, expected, rtol=0, atol=0.1)


def test_training_under_bfloat16_autocast_gives_a_finite_loss_and_a_field_of_exact_actions():
    policy = pf2mp().train()
    field = DemonstratedActions(policy.config.field_settings)
    batch = {**training_batch(policy), POTENTIAL_FIELD: field}
    with torch.autocast("cpu", torch.bfloat16):
        loss = policy(batch)[0]
    loss.backward()
    assert loss.dtype == torch.float32
    assert all(weight.grad.isfinite().all() for weight in policy.get_optim_params())
    actions = batch[ACTION][~batch["action_is_pad"]]
    assert torch.equal(field.field().anchors.sort(dim=0).values, actions.sort(dim=0).values)


# The configuration.


def test_one_observed_frame_needs_no_window():
    assert FMPConfig(**SMALL).observation_delta_indices is None
    assert FMPConfig(**SMALL, n_obs_steps=3).observation_delta_indices == [-2, -1, 0]


@pytest.mark.parametrize("n_obs_steps", [1, 2, 5])
def test_derived_values_follow_from_the_others(n_obs_steps):
    config = FMPConfig(**SMALL, n_obs_steps=n_obs_steps)
    actions = config.action_delta_indices
    assert (len(actions), actions[0]) == (HORIZON, 1 - n_obs_steps)
    assert actions == list(range(actions[0], actions[0] + HORIZON))
    assert actions[n_obs_steps - 1 : n_obs_steps - 1 + config.n_action_steps] == [0, 1, 2, 3]
    assert config.reward_delta_indices is None


def test_the_defaults_are_valid_and_the_most_actions_may_be_executed():
    assert FMPConfig(device="cpu").n_action_steps == 32
    assert PF2MPConfig(device="cpu").guidance_scale == 0.8
    assert FMPConfig(**{**SMALL, "n_action_steps": 7}, n_obs_steps=2).n_action_steps == 7


def test_the_presets_carry_the_values_of_the_configuration():
    config = FMPConfig(
        **SMALL,
        optimizer_lr=1e-4,
        optimizer_betas=(0.8, 0.9),
        optimizer_eps=1e-7,
        optimizer_weight_decay=0.01,
        optimizer_grad_clip_norm=3.0,
        scheduler_warmup_steps=17,
    )
    optimiser = config.get_optimizer_preset()
    assert (optimiser.lr, optimiser.betas, optimiser.eps) == (1e-4, (0.8, 0.9), 1e-7)
    assert (optimiser.weight_decay, optimiser.grad_clip_norm) == (0.01, 3.0)
    assert config.get_scheduler_preset().num_warmup_steps == 17


@pytest.mark.parametrize("bandwidth", [0.05, "scott"])
def test_a_saved_configuration_comes_back_equal(tmp_path, bandwidth):
    config = PF2MPConfig(
        **SMALL,
        **features(STATE, FRONT),
        field_bandwidth=bandwidth,
        field_action_dims=(1, 0),
        guidance_scale=0.3,
        resize_shape=(48, 48),
        crop_ratio=0.5,
    )
    config.save_pretrained(tmp_path)
    assert PreTrainedConfig.from_pretrained(tmp_path) == config


def test_options_on_the_command_line_reach_the_configuration(tmp_path):
    PF2MPConfig(**SMALL).save_pretrained(tmp_path)
    options = ["--guidance_scale=0.4", "--field_bandwidth=0.07", "--field_action_dims=[0,1]"]
    config = PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=options)
    assert (config.guidance_scale, config.field_bandwidth, config.field_action_dims) == (0.4, 0.07, (0, 1))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_obs_steps": 0}, "n_obs_steps must be at least 1, got 0"),
        ({"horizon": 0}, "horizon must be at least 1, got 0"),
        ({"n_action_steps": 0}, "n_action_steps must be at least 1, got 0"),
        ({"num_inference_steps": 0}, "num_inference_steps must be at least 1, got 0"),
        ({"horizon": 9}, "horizon must be a multiple of 2, .* got horizon=9"),
        ({"n_action_steps": 9}, r"n_action_steps must be at most horizon - n_obs_steps \+ 1 = 8"),
        (
            {"n_action_steps": 8, "n_obs_steps": 2},
            r"n_action_steps must be at most .* = 7, got n_action_steps=8",
        ),
        ({"drop_n_last_frames": -1}, "drop_n_last_frames must be at least 0, got -1"),
        ({"down_dims": ()}, r"every entry of down_dims must be a positive multiple of n_groups=4, got \(\)"),
        ({"down_dims": (8, 10)}, "every entry of down_dims must be a positive multiple of n_groups=4"),
        ({"down_dims": (8, 0)}, "every entry of down_dims must be a positive multiple of n_groups=4"),
        ({"n_groups": 3}, "every entry of down_dims must be a positive multiple of n_groups=3"),
        ({"n_groups": 0}, "n_groups must be at least 1, got 0"),
        ({"kernel_size": 4}, "kernel_size must be odd, .* got 4"),
        ({"diffusion_step_embed_dim": 2}, "diffusion_step_embed_dim must be even and at least 4, got 2"),
        ({"integrator": "rk4"}, "integrator must be one of .*euler.*midpoint.* got 'rk4'"),
        ({"time_sampling": "normal"}, "time_sampling must be one of .*uniform.*beta.* got 'normal'"),
        ({"ema_decay": 1.0}, r"ema_decay must lie in \[0, 1\), got 1.0"),
        ({"ema_decay": -0.1}, r"ema_decay must lie in \[0, 1\), got -0.1"),
        ({"ema_decay": math.nan}, r"ema_decay must lie in \[0, 1\), got nan"),
        ({"optimizer_lr": 0.0}, "optimizer_lr must be finite and positive, got 0.0"),
        ({"optimizer_lr": math.nan}, "optimizer_lr must be finite and positive, got nan"),
        ({"vision_backbone": "vit_b_16"}, "vision_backbone must be a torchvision ResNet, got 'vit_b_16'"),
        (
            {"pretrained_backbone_weights": "DEFAULT"},
            "use_group_norm must be false with pretrained_backbone_weights",
        ),
        ({"crop_ratio": 0.0}, r"crop_ratio must lie in \(0, 1\], got 0.0"),
        ({"crop_ratio": 1.5}, r"crop_ratio must lie in \(0, 1\], got 1.5"),
        ({"resize_shape": (32,)}, "resize_shape must be two positive numbers of pixels"),
        ({"crop_shape": (0, 32)}, "crop_shape must be two positive numbers of pixels"),
    ],
)
@pytest.mark.parametrize("make_config", [FMPConfig, PF2MPConfig])
def test_values_that_break_their_rule_are_an_error(make_config, options, message):
    with pytest.raises(ConfigError, match=message):
        make_config(**{**SMALL, **options})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"guidance_scale": -0.1}, "guidance_scale must be finite and at least 0, got -0.1"),
        ({"guidance_scale": math.nan}, "guidance_scale must be finite and at least 0, got nan"),
        ({"guidance_scale": math.inf}, "guidance_scale must be finite and at least 0, got inf"),
        ({"guidance_integrator": "rk4"}, "guidance_integrator must be one of .*euler.*proximal.* got 'rk4'"),
        ({"n_field_points": 0}, "n_field_points must be at least 1, got 0"),
        ({"field_action_dims": ()}, r"field_action_dims must be distinct indices from 0 on, got \(\)"),
        (
            {"field_action_dims": (0, 0)},
            r"field_action_dims must be distinct indices from 0 on, got \(0, 0\)",
        ),
        ({"field_bandwidth": 0.0}, "field_bandwidth must be finite and positive, got 0.0"),
        ({"field_bandwidth": -1.0}, "field_bandwidth must be finite and positive, got -1.0"),
        ({"field_bandwidth": math.nan}, "field_bandwidth must be finite and positive, got nan"),
        ({"field_bandwidth": "scot"}, "field_bandwidth must be one of .*scott.* got 'scot'"),
        ({"field_threshold_quantile": 2.0}, r"field_threshold_quantile must lie in \[0, 1\], got 2.0"),
        ({"field_alpha": 1.0}, "field_alpha must be finite and at most 0, got 1.0"),
    ],
)
def test_guidance_and_field_values_that_break_their_rule_are_an_error(options, message):
    with pytest.raises(ConfigError, match=message):
        PF2MPConfig(**SMALL, **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({**features(STATE), "output_features": {}}, r"output_features must hold 'action', got \[\]"),
        (features(), "input_features must hold observation.state, .* or a camera, got"),
        (
            {**features(FRONT), "crop_shape": (65, 64)},
            r"crop_shape must fit into the images of \(64, 64\) pixels",
        ),
        (
            {**features(FRONT), "resize_shape": (32, 32), "crop_shape": (33, 32)},
            r"crop_shape must fit into the images of \(32, 32\) pixels",
        ),
    ],
)
def test_features_that_do_not_fit_are_an_error(options, message):
    with pytest.raises(ValueError, match=message):
        FMPPolicy(FMPConfig(**SMALL, **options))


def test_cameras_of_different_shapes_are_an_error():
    options = features(FRONT, WRIST)
    options["input_features"][WRIST] = PolicyFeature(FeatureType.VISUAL, (3, 32, 32))
    with pytest.raises(ValueError, match="all cameras must have one image shape"):
        FMPPolicy(FMPConfig(**SMALL, **options))


def test_a_field_dimension_that_the_action_does_not_have_is_an_error():
    with pytest.raises(
        ValueError, match=r"field_action_dims must be below the action dimension 2, got \(0, 2\)"
    ):
        pf2mp(field_action_dims=(0, 2))


@pytest.mark.parametrize("kind", ["fmp", "dppf"])
def test_images_of_another_size_than_the_policy_was_made_for_are_named(kind: str) -> None:
    camera = "observation.images.front"
    options: dict[str, Any] = {
        "device": "cpu",
        "horizon": 8,
        "n_action_steps": 4,
        "n_obs_steps": 1,
        "down_dims": (8, 16),
        "n_groups": 4,
        "diffusion_step_embed_dim": 16,
        "pretrained_backbone_weights": None,
        "use_group_norm": True,
        "spatial_softmax_num_keypoints": 4,
        "input_features": {
            "observation.state": PolicyFeature(FeatureType.STATE, (2,)),
            camera: PolicyFeature(FeatureType.VISUAL, (3, 64, 64)),
        },
        "output_features": {"action": PolicyFeature(FeatureType.ACTION, (2,))},
    }
    config_class, policy_class = (FMPConfig, FMPPolicy) if kind == "fmp" else (DPPFConfig, DPPFPolicy)
    batch = {"observation.state": torch.zeros(1, 2), camera: torch.rand(1, 3, 96, 96)}
    unguided: dict[str, Any] = {} if kind == "fmp" else {"max_plans": 1, "guidance_scale": 0.0}
    for more, fits in (({}, False), ({"resize_shape": (64, 64)}, True), ({"crop_shape": (56, 56)}, True)):
        policy = policy_class(config_class(**{**options, "crop_shape": None, **unguided, **more})).eval()
        if fits:
            assert policy.select_action(dict(batch)).shape == (1, 2)
            continue
        with pytest.raises(ValueError, match=f"images of {camera} must be of 64 x 64 pixels.*got 96 x 96"):
            policy.select_action(dict(batch))


def test_dppf_says_that_it_needs_more_than_the_state() -> None:
    features = {"observation.state": PolicyFeature(FeatureType.STATE, (2,))}
    config = DPPFConfig(
        input_features=features, output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))}
    )
    with pytest.raises(
        ValueError, match=r"must hold a camera or observation.environment_state.*type pf2mp take"
    ):
        DPPFPolicy(config)
