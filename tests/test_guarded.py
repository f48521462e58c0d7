# SPDX-License-Identifier: Apache-2.0
"""Policies of LeRobot that a potential field guides and checks."""

import copy
import json
import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import draccus
import pytest
import torch
from forked_commands import BIN, SECONDS, run_well
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.policies import make_pre_post_processors
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.factory import get_policy_class
from lerobot.policies.tdmpc.configuration_tdmpc import TDMPCConfig
from lerobot.policies.vqbet.configuration_vqbet import VQBeTConfig
from torch import Tensor
from untrained_policies import DENOISING, TRANSFORMER, write_checkpoint

from lerobot_pf2mp import DPPFConfig, FMPConfig, GuardedConfig, PF2MPMazeEnv, load_policy
from lerobot_pf2mp.errors import ConfigError
from lerobot_pf2mp.figures.policy_figures import GuidedPolicyFigures
from lerobot_pf2mp.flow_matching import integrate
from lerobot_pf2mp.loading import loaded_demonstrations
from lerobot_pf2mp.policies.dppf.modeling_dppf import DPPFPolicy
from lerobot_pf2mp.policies.guarded.generation import N_STEPS_AT_THE_END, VelocitySteps, generation_of
from lerobot_pf2mp.policies.guarded.modeling_guarded import GuardedPolicy
from lerobot_pf2mp.policies.guarded.repeated_rows import repeated_rows
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.policies.plans.plans import UnsupportedPlanError

STATE, ENV, ACTION, IMAGE = (
    "observation.state",
    "observation.environment_state",
    "action",
    "observation.image",
)
A = 2
N_EXECUTED = 4
PLAIN: dict[str, Any] = {"guidance_scale": 0, "max_plans": 1}


def vqbet() -> VQBeTConfig:
    return VQBeTConfig(
        device="cpu",
        n_obs_steps=2,
        n_action_pred_token=3,
        action_chunk_size=N_EXECUTED,
        crop_shape=None,
        pretrained_backbone_weights=None,
        gpt_input_dim=16,
        gpt_output_dim=16,
        gpt_n_layer=1,
        gpt_n_head=2,
        gpt_hidden_dim=16,
        vqvae_n_embed=4,
        vqvae_embedding_dim=8,
        vqvae_enc_hidden_dim=8,
        input_features={
            STATE: PolicyFeature(FeatureType.STATE, (A,)),
            IMAGE: PolicyFeature(FeatureType.VISUAL, (3, 64, 64)),
        },
        output_features={ACTION: PolicyFeature(FeatureType.ACTION, (A,))},
    )


def tdmpc() -> TDMPCConfig:
    features = {key: TRANSFORMER[key] for key in ("device", "input_features", "output_features")}
    return TDMPCConfig(
        **features, horizon=N_EXECUTED, n_action_steps=N_EXECUTED, n_action_repeats=1, latent_dim=8, mlp_dim=8
    )


BASES: dict[str, Callable[[], PreTrainedConfig]] = {
    "act": lambda: ACTConfig(**TRANSFORMER),
    "act, temporal ensembling": lambda: ACTConfig(
        **{**TRANSFORMER, "n_action_steps": 1}, temporal_ensemble_coeff=0.01
    ),
    "diffusion": lambda: DiffusionConfig(**DENOISING),
    "vqbet": vqbet,
    "tdmpc": tdmpc,
}
every_base = pytest.mark.parametrize("base", BASES)


def guarded(base: str, **options: Any) -> GuardedPolicy:
    torch.manual_seed(1)
    policy = GuardedPolicy(GuardedConfig(base=BASES[base](), **options))
    return policy.eval()


def stock(policy: GuardedPolicy) -> Any:
    """The base as a user has it, with the same weights."""
    config = policy.config.base_config
    plain = get_policy_class(config.type)(config).eval()
    plain.load_state_dict(policy.base.state_dict())
    return plain


def demonstrated(policy: GuardedPolicy, spread: float = 0.05) -> DemonstratedActions:
    """Twenty demonstrations near 0.5, as long as the policy's chunks."""
    settings = policy.config.field_settings
    shown = DemonstratedActions(settings)
    n_past = -policy.config.action_delta_indices[0]
    n_actions = max(len(policy.config.action_delta_indices), n_past + policy.config.n_action_steps)
    generator = torch.Generator().manual_seed(0)
    actions = 0.5 + spread * torch.randn(20, n_actions, A, generator=generator)
    shown.observe(
        actions,
        None,
        n_actions * torch.arange(20),
        torch.arange(20),
        settings=settings,
        n_past=n_past,
        n_executed=policy.config.n_action_steps,
    )
    return shown


def observations(policy: GuardedPolicy, n_robots: int = 3, seed: int = 0) -> dict[str, Any]:
    generator = torch.Generator().manual_seed(seed)
    return {
        key: torch.rand(n_robots, *feature.shape, generator=generator)
        for key, feature in (policy.config.input_features or {}).items()
    }


def field_batch(policy: GuardedPolicy, n_robots: int = 3, seed: int = 0, **shown: Any) -> dict[str, Any]:
    return {**observations(policy, n_robots, seed), "potential_field": demonstrated(policy, **shown)}


def actions_of(policy: Any, batch: dict[str, Any], n_steps: int = 6, seed: int = 5) -> Tensor:
    """The first actions ``(T, B, A)`` that a policy selects."""
    torch.manual_seed(seed)
    policy.reset()
    return torch.stack([policy.select_action(dict(batch)) for _ in range(n_steps)])


# Without guidance and check it is the base.


@pytest.mark.filterwarnings("ignore:To evaluate in the environment")
@every_base
def test_without_guidance_and_check_actions_are_bit_for_bit_the_bases(base):
    policy = guarded(base, **PLAIN)
    batch = observations(policy)
    torch.testing.assert_close(
        actions_of(policy, batch), actions_of(stock(policy), batch), rtol=0, atol=0, equal_nan=True
    )


@pytest.mark.parametrize("base", ["act", "diffusion"])
def test_the_loss_is_the_bases_and_its_actions_enter_the_field(base):
    policy = guarded(base).train()
    plain = stock(policy).train()
    shown = DemonstratedActions(policy.config.field_settings)
    n_actions = len(policy.config.action_delta_indices)
    batch = {
        **{
            key: value.unsqueeze(1) if base == "diffusion" else value
            for key, value in observations(policy).items()
        },
        ACTION: torch.rand(3, n_actions, A),
        "action_is_pad": torch.zeros(3, n_actions, dtype=torch.bool),
        "index": n_actions * torch.arange(3),
        "episode_index": torch.arange(3),
    }
    if base == "diffusion":
        batch[STATE] = batch[STATE].expand(-1, 2, -1)
        batch[ENV] = batch[ENV].expand(-1, 2, -1)
    torch.manual_seed(3)
    loss, _ = policy({**batch, "potential_field": shown})
    torch.manual_seed(3)
    expected, _ = plain(batch)
    assert loss.item() == expected.item()
    assert len(shown) == 3 * n_actions
    assert {id(p) for group in _groups(policy) for p in group} == {
        id(p) for p in policy.base.parameters() if p.requires_grad
    }


def _groups(policy: Any) -> list[list[Any]]:
    found = policy.get_optim_params()
    return (
        [list(group["params"]) for group in found]
        if isinstance(found, list)
        else [[p for p in found if p.requires_grad] if not isinstance(found, dict) else list(found.values())]
    )


@pytest.mark.filterwarnings("ignore:To evaluate in the environment")
@every_base
def test_nothing_of_the_base_is_replaced_for_good(base):
    policy = guarded(base)
    before = {id(module): dict(vars(module)) for module in policy.base.modules()}
    actions_of(policy, field_batch(policy))
    for module in policy.base.modules():
        then, now = before[id(module)], vars(module)
        assert set(then) == set(now)
        for name, value in now.items():
            if callable(value) or "scheduler" in name:
                assert value is then[name]


@every_base
def test_a_copy_is_guarded_by_itself(base):
    policy = guarded(base, max_plans=2)
    copied = copy.deepcopy(policy)
    assert copied.guidance.config is copied.config
    assert copied.base.config is copied.config.base
    copied.config.guidance_scale = 0.1
    copied.config.device = "meta"
    assert policy.config.guidance_scale == 0.8
    assert policy.base.config.device == "cpu"


def test_a_call_that_fails_leaves_the_base_as_it_was():
    policy = guarded("diffusion")

    def broken(*_: Any, **__: Any) -> Tensor:
        raise RuntimeError("broken")

    policy.base.diffusion.unet.forward = broken
    with pytest.raises(RuntimeError, match="broken"):
        policy.select_action(field_batch(policy))
    assert "predict_action_chunk" not in vars(policy.base)
    assert "Guided" not in type(policy.base.diffusion.noise_scheduler).__name__
    assert policy._selecting is None


# Guidance.


@pytest.mark.filterwarnings("ignore:To evaluate in the environment")
@every_base
def test_guidance_raises_the_density_of_the_actions(base):
    policy = guarded(base, max_plans=1)
    batch = field_batch(policy)
    field = batch["potential_field"].field(policy.config.field_settings)
    guided = actions_of(policy, batch)
    policy.config.guidance_scale = 0
    unguided = actions_of(policy, batch)
    assert (field.log_density(guided) >= field.log_density(unguided) - 1e-4).all()
    assert field.log_density(guided).mean() > field.log_density(unguided).mean() + 1


def test_a_finished_chunk_is_guided_as_often_as_the_flow_takes_steps():
    policy = guarded("act", max_plans=1)
    batch = field_batch(policy)
    chunk = policy.predict_action_chunk(batch)
    x = stock(policy).predict_action_chunk(observations(policy))
    guide = policy.guidance.guide(batch, x.device)
    assert guide is not None
    for _ in range(N_STEPS_AT_THE_END):
        x = guide(x, x, x, 1 / N_STEPS_AT_THE_END)
    torch.testing.assert_close(chunk, x)


def test_temporal_ensembling_is_guided_after_its_mean():
    policy = guarded("act, temporal ensembling", max_plans=1)
    batch = field_batch(policy)
    field = batch["potential_field"].field(policy.config.field_settings)
    mean = actions_of(stock(policy), observations(policy), n_steps=3)
    guide = policy.guidance.guide(batch, mean.device)
    assert guide is not None
    x = mean
    for _ in range(N_STEPS_AT_THE_END):
        x = guide(x, x, x, 1 / N_STEPS_AT_THE_END)
    torch.testing.assert_close(actions_of(policy, batch, n_steps=3), x)
    assert field.is_safe(x).all()


@pytest.mark.parametrize("is_forward", [True, False])
@pytest.mark.parametrize("n_padding", [0, 3])
def test_a_velocity_is_bent_so_that_its_euler_step_is_the_guided_one(is_forward, n_padding):
    """The loop of another package, with time in either direction, ends where `integrate` does."""
    policy = guarded("act")
    guide = policy.guidance.guide(field_batch(policy), torch.device("cpu"))
    n_steps, x_0 = 4, torch.randn(3, 8, A)
    weight = 0.5 * torch.randn(A, A)

    def velocity(x: Tensor, t: Tensor) -> Tensor:  # of our own direction, noise at 0
        return 0.3 - x @ weight * (1 + t.reshape(-1, 1, 1))

    expected = integrate(velocity, x_0, n_steps, guide=guide)
    steps = VelocitySteps(n_steps, is_forward, A)
    padding = torch.randn(3, 8, n_padding)
    x = torch.cat([x_0, padding], dim=-1)
    sign = 1 if is_forward else -1
    for step in range(n_steps):
        ours = step / n_steps
        time = torch.full((3,), ours if is_forward else 1 - ours)
        v = sign * torch.cat([velocity(x[..., :A], torch.full((3,), ours)), 0.1 * padding], dim=-1)
        assert guide is not None
        x = x + sign / n_steps * steps.guided_velocity(v, x, time, guide)
    torch.testing.assert_close(x[..., :A], expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(x[..., A:], 1.1 * padding)


def test_no_gradient_runs_through_the_offset_of_the_guide():
    policy = guarded("act")
    guide = policy.guidance.guide(field_batch(policy), torch.device("cpu"))
    assert guide is not None
    x = torch.randn(1, 8, A, requires_grad=True)
    bent = VelocitySteps(5, False, A).guided_velocity(2 * x, x, torch.ones(1), guide)
    (gradient,) = torch.autograd.grad(bent.sum(), x)
    torch.testing.assert_close(gradient, torch.full_like(x, 2.0))


def test_where_each_policy_is_guided():
    wanted = {
        "act": "on the finished chunk",
        "act, temporal ensembling": "on the finished chunk",
        "diffusion": "in every denoising step",
        "vqbet": "on the finished chunk",
        "tdmpc": "on the finished chunk",
    }
    assert {name: generation_of(guarded(name).base).where for name in BASES} == wanted


def test_guidance_without_a_field_is_an_error():
    with pytest.raises(ValueError, match="guidance needs the potential field"):
        policy = guarded("act")
        policy.select_action(observations(policy))


@pytest.mark.parametrize("max_plans", [1, 4])
def test_a_guarded_diffusion_policy_is_dppf_bit_for_bit(max_plans):
    policy = guarded("diffusion", max_plans=max_plans)
    dppf = DPPFPolicy(DPPFConfig(**DENOISING, max_plans=max_plans)).eval()
    dppf.load_state_dict(policy.base.state_dict())
    batch = field_batch(policy)
    assert torch.equal(actions_of(policy, batch), actions_of(dppf, batch))


# Checked plans.


def test_flagged_plans_of_a_policy_that_draws_noise_are_drawn_again_at_once():
    policy = guarded("diffusion", guidance_scale=0, max_plans=4)
    passes = _count_calls(policy.base.diffusion, "conditional_sample")
    policy.select_action(field_batch(policy, spread=1e-3))
    assert policy.plans is not None
    assert policy.plans.n_drawn.tolist() == [4, 4, 4]
    assert policy.plans.is_flagged.all()
    assert passes == [3, 9]  # three more for each of three robots, in one pass


def test_others_are_drawn_for_the_flagged_robots_only_with_their_own_observations():
    policy = guarded("diffusion", guidance_scale=0, max_plans=5)
    batch, seen = field_batch(policy, spread=1e-3), []
    original = policy.base.diffusion.generate_actions

    # The first plan of two robots is made to be supported.
    def first_two_supported(inputs: dict[str, Tensor], **kwargs: Any) -> Tensor:
        chunk = original(inputs, **kwargs)
        seen.append(inputs[STATE][:, -1])
        if len(seen) == 1:
            chunk[:2] = 0.5
        return chunk

    policy.base.diffusion.generate_actions = first_two_supported
    policy.select_action(batch)
    assert policy.plans is not None
    assert policy.plans.n_drawn.tolist() == [1, 1, 5]
    torch.testing.assert_close(seen[1], batch[STATE][2:].expand(4, -1))


@pytest.mark.filterwarnings("ignore:To evaluate in the environment")
def test_a_policy_that_happened_to_draw_the_same_plan_is_asked_again():
    policy = guarded("vqbet", guidance_scale=0, max_plans=2)
    batch = field_batch(policy, n_robots=1, spread=1e-3)
    constant = torch.zeros(1, N_EXECUTED, A)

    def same(inputs: dict[str, Tensor], rollout: bool) -> Tensor:
        torch.rand(1)  # it draws its codes
        return constant.expand(len(inputs[STATE]), -1, -1)

    policy.base.vqbet.forward = same
    for _ in range(3):
        policy._queues[ACTION].clear()
        policy.select_action(batch)
        assert policy.plans is not None
        assert policy.plans.n_drawn.tolist() == [2]


def test_another_plan_of_a_policy_with_memory_sees_the_same_window_as_the_first():
    policy = guarded("diffusion", guidance_scale=0, max_plans=3)
    windows = []
    original = policy.base.diffusion.generate_actions

    def seen(inputs: dict[str, Tensor], **kwargs: Any) -> Tensor:
        windows.append(inputs[STATE])
        return original(inputs, **kwargs)

    policy.base.diffusion.generate_actions = seen
    shown = field_batch(policy, spread=1e-3)
    for step in range(N_EXECUTED + 1):
        policy.select_action({**shown, **observations(policy, seed=step)})
    assert [len(window) for window in windows] == [3, 6, 3, 6]
    first, more = windows[2:]
    assert not torch.equal(first[:, 0], first[:, 1])  # it remembers the observation before
    torch.testing.assert_close(more, first.repeat_interleave(2, dim=0))


def test_a_policy_of_unknown_inputs_is_asked_for_plans_of_the_whole_batch():
    policy = guarded("diffusion", guidance_scale=0, max_plans=3)
    policy.base.config.__class__ = type("ElseConfig", (DiffusionConfig,), {"type": "else"})
    passes = _count_calls(policy.base.diffusion, "conditional_sample")
    policy.select_action(field_batch(policy, spread=1e-3))
    assert passes == [3, 3, 3]
    assert policy.plans is not None
    assert policy.plans.n_drawn.tolist() == [3, 3, 3]


def test_a_policy_that_would_plan_the_same_is_asked_once_and_not_again():
    policy = guarded("act", guidance_scale=0, max_plans=3)
    passes = _count_calls(policy.base, "model")
    batch = field_batch(policy, spread=1e-3)
    policy.predict_action_chunk(batch)
    assert passes == [3, 6]
    assert policy.plans is not None
    assert policy.plans.is_flagged.all()
    policy.predict_action_chunk(batch)
    assert passes == [3, 6, 3]


def test_only_the_actions_that_are_executed_are_checked():
    policy = guarded("act", guidance_scale=0, max_plans=1, on_unsupported="stop")
    n_executed, chunk_size = policy.config.n_action_steps, policy.config.chunk_size
    assert n_executed < chunk_size
    batch = field_batch(policy)
    chunk = torch.full((3, chunk_size, A), 0.5)
    chunk[:, n_executed:] = 50.0
    policy.base.model.forward = lambda *_: (chunk, (None, None))
    policy.select_action(batch)
    with pytest.raises(UnsupportedPlanError):
        policy.predict_action_chunk(batch)


def test_a_policy_that_is_held_stays_where_its_way_leaves_the_region():
    policy = guarded("act", guidance_scale=0, max_plans=1, on_unsupported="hold")
    chunk = torch.full((1, policy.config.chunk_size, A), 0.5)
    chunk[:, 2:] = 5.0
    policy.base.model.forward = lambda *_: (chunk, (None, None))
    actions = actions_of(policy, field_batch(policy, n_robots=1), n_steps=4)
    torch.testing.assert_close(actions, torch.full_like(actions, 0.5))


def test_a_plan_that_is_not_finite_is_never_executed():
    policy = guarded("act", **PLAIN)
    chunk = torch.full((1, policy.config.chunk_size, A), torch.nan)
    policy.base.model.forward = lambda *_: (chunk, (None, None))
    with pytest.raises(ValueError, match="planned actions must be finite"):
        policy.select_action(observations(policy, 1))


def test_a_policy_that_selects_actions_without_chunks_is_guarded_action_by_action():
    policy = guarded("act", max_plans=1)
    batch = field_batch(policy)
    policy.base.select_action = lambda inputs: inputs[STATE] - 0.2
    field = batch["potential_field"].field(policy.config.field_settings)
    actions = actions_of(policy, batch, n_steps=3)
    assert field.is_safe(actions).all()
    assert not field.is_safe(batch[STATE] - 0.2).all()


def test_rows_of_tensors_and_lists_are_repeated_and_all_else_stays():
    rows = torch.tensor([2, 0])
    values = {"x": torch.arange(3.0), "task": ["a", "b", "c"], "scale": torch.tensor(2.0), "none": None}
    repeated = repeated_rows(values, rows, 2, 3)
    assert repeated["x"].tolist() == [2, 2, 0, 0]
    assert repeated["task"] == ["c", "c", "a", "a"]
    assert repeated["scale"] is values["scale"]
    assert repeated["none"] is None


def _count_calls(owner: Any, name: str) -> list[int]:
    """The batch sizes with which a function, or a module, is called from now on."""
    sizes: list[int] = []
    original = getattr(owner, name)
    if isinstance(original, torch.nn.Module):
        original.register_forward_pre_hook(lambda _, args: sizes.append(len(args[0][STATE])))
        return sizes

    def counted(*args: Any, **kwargs: Any) -> Any:
        result = original(*args, **kwargs)
        sizes.append(len(result))
        return result

    setattr(owner, name, counted)
    return sizes


def test_the_steps_of_a_policy_that_has_none_are_not_drawn(tmp_path):
    figures = GuidedPolicyFigures(write_checkpoint(tmp_path / "guarded", "guarded"), PF2MPMazeEnv(), seed=0)
    with pytest.raises(ValueError, match="steps of a policy of type pf2mp or dppf, got 'guarded'"):
        figures.trace_flow(1)


# The configuration.


def test_all_but_its_own_options_are_the_bases():
    base = ACTConfig(**TRANSFORMER)
    config = GuardedConfig(base=base, max_plans=3)
    assert config.chunk_size == base.chunk_size
    assert config.action_delta_indices == base.action_delta_indices
    assert config.normalization_mapping is base.normalization_mapping
    assert config.get_optimizer_preset() == base.get_optimizer_preset()
    config.optimizer_lr = 0.5
    assert base.optimizer_lr == 0.5
    config.input_features = {**(config.input_features or {}), "more": PolicyFeature(FeatureType.STATE, (1,))}
    assert "more" in (base.input_features or {})
    config.max_plans = 2
    assert not hasattr(base, "max_plans")
    with pytest.raises(AttributeError, match="nothing_like_it"):
        _ = config.nothing_like_it


def test_a_saved_configuration_comes_back_equal(tmp_path):
    config = GuardedConfig(base=ACTConfig(**TRANSFORMER), max_plans=3, field_action_dims=(0,))
    config._save_pretrained(tmp_path)
    assert json.loads((tmp_path / "config.json").read_text())["base"]["type"] == "act"
    loaded = PreTrainedConfig.from_pretrained(tmp_path)
    assert loaded == config
    changed = PreTrainedConfig.from_pretrained(
        tmp_path, cli_overrides=["--max_plans=5", "--base.n_action_steps=2"]
    )
    assert (changed.max_plans, changed.n_action_steps) == (5, 2)


def test_lerobots_command_line_makes_one():
    options = ["--policy.type=guarded", "--policy.base.type=act", "--policy.base.chunk_size=20"]
    more = ["--policy.base.n_action_steps=10", "--policy.max_plans=2", "--policy.device=cpu"]
    config = draccus.parse(TrainPipelineConfig, args=["--dataset.repo_id=a/b", *options, *more])
    policy = cast(GuardedConfig, config.policy)
    assert (policy.type, policy.base_config.type) == ("guarded", "act")
    assert (policy.chunk_size, policy.n_action_steps, policy.max_plans) == (20, 10, 2)
    assert policy.base_config.device == "cpu"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: GuardedConfig(), "needs the policy that it guards, got none: give --policy.base.type"),
        (lambda: GuardedConfig(base=FMPConfig(device="cpu")), "a policy of type pf2mp is its guided form"),
        (
            lambda: GuardedConfig(base=GuardedConfig(base=ACTConfig(device="cpu"))),
            "got guarded: it is guarded already",
        ),
        (
            lambda: GuardedConfig(
                base=PreTrainedConfig.get_choice_class("gaussian_actor")(device="cpu")
            ),
            "must plan chunks of actions, got gaussian_actor",
        ),
        (lambda: GuardedConfig(base=ACTConfig(device="cpu"), max_plans=0), "max_plans must be at least 1"),
        (lambda: GuardedConfig(base=ACTConfig(device="cpu", use_peft=True)), "got act with an adapter"),
        (
            lambda: GuardedConfig(base=PreTrainedConfig.get_choice_class("xvla")(device="cpu")),
            "cannot have the base xvla: LeRobot chooses",
        ),
        (
            lambda: GuardedConfig(base=ACTConfig(device="cpu"), n_obs_steps=2),
            "give --policy.base.n_obs_steps, got 2 and 1",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_guarded_is_named(make, message):
    with pytest.raises(ConfigError, match=message):
        make()


def test_a_field_dimension_that_the_action_does_not_have_is_an_error():
    with pytest.raises(ValueError, match="field_action_dims must be below the action dimension 2"):
        GuardedPolicy(GuardedConfig(base=ACTConfig(**TRANSFORMER), field_action_dims=(2,)))


# Checkpoints.


def test_a_checkpoint_comes_back_with_identical_actions_and_the_bases_own_weights(tmp_path):
    path = write_checkpoint(tmp_path / "guarded", "guarded")
    policy, preprocessor, _ = load_policy(path, device="cpu")
    assert policy.name == "guarded"
    batch = preprocessor({STATE: torch.zeros(1, 2), ENV: torch.ones(1, 2)})
    again, _, _ = load_policy(path, device="cpu")
    torch.testing.assert_close(
        policy.predict_action_chunk(batch), again.predict_action_chunk(batch), rtol=0, atol=0
    )
    base = get_policy_class("act").from_pretrained(path, config=ACTConfig(**TRANSFORMER))
    for name, value in base.state_dict().items():
        assert torch.equal(value, cast(Any, policy).base.state_dict()[name])


def test_the_preprocessor_ends_with_the_field():
    config = GuardedConfig(base=ACTConfig(**TRANSFORMER))
    stats = {key: {"mean": torch.zeros(2), "std": torch.ones(2)} for key in (STATE, ENV, ACTION)}
    preprocessor, postprocessor = make_pre_post_processors(config, dataset_stats=stats)
    plain, plain_post = make_pre_post_processors(config.base_config, dataset_stats=stats)
    names = [type(step).__name__ for step in preprocessor.steps]
    assert names == [*(type(step).__name__ for step in plain.steps), "PotentialFieldProcessorStep"]
    assert [type(s) for s in postprocessor.steps] == [type(s) for s in plain_post.steps]


def test_weights_that_lack_a_tensor_are_an_error(tmp_path):
    from safetensors.torch import load_file, save_file

    path = Path(write_checkpoint(tmp_path / "guarded", "guarded"))
    weights = load_file(path / "model.safetensors")
    del weights["model.action_head.bias"]
    save_file(weights, path / "model.safetensors")
    with pytest.raises(ValueError, match=r"without 1 of them \(model\.action_head\.bias\)"):
        load_policy(path, device="cpu")


def test_a_processor_that_is_not_registered_is_refused(tmp_path):
    path = Path(write_checkpoint(tmp_path / "guarded", "guarded"))
    written = json.loads((path / "policy_preprocessor.json").read_text())
    written["steps"].append(
        {"class": "subprocess.Popen", "config": {"args": ["touch", str(tmp_path / "ran")]}}
    )
    (path / "policy_preprocessor.json").write_text(json.dumps(written))
    with pytest.raises(ValueError, match=r"subprocess\.Popen"):
        GuardedPolicy.from_pretrained(path)
    assert not (tmp_path / "ran").exists()


# As a user does it.


@pytest.fixture(scope="module")
def maze(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("guarded") / "maze"
    run_well("pf2mp-collect", "--task=maze_umaze", "--n_episodes=20", f"--root={root}")
    return root


SMALL_ACT = (
    "chunk_size=8",
    "n_action_steps=8",
    "dim_model=16",
    "dim_feedforward=16",
    "n_heads=2",
    "use_vae=false",
)
EVALUATION = (
    "--env.type=pf2mp_maze",
    "--env.task=MazeUMaze-v0",
    "--eval.n_episodes=2",
    "--eval.batch_size=2",
)


def train(output: Path, maze: Path, *options: str) -> Path:
    run_well(
        "lerobot-train",
        *options,
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        "--dataset.repo_id=local/maze",
        f"--dataset.root={maze}",
        "--steps=2",
        "--batch_size=4",
        "--num_workers=0",
        "--seed=1",
        f"--output_dir={output}",
    )
    return output / "checkpoints/last/pretrained_model"


def fit(checkpoint: Path, output: Path, maze: Path, **options: Any) -> str:
    arguments = [f"--policy.path={checkpoint}", "--dataset.repo_id=local/maze", f"--dataset.root={maze}"]
    return run_well("pf2mp-fit-field", *arguments, f"--output_dir={output}", **options)


@pytest.mark.slow
def test_a_policy_is_guarded_by_one_command_and_given_back_by_another(maze, tmp_path):
    base = train(tmp_path / "act", maze, "--policy.type=act", *(f"--policy.{option}" for option in SMALL_ACT))
    said = fit(base, tmp_path / "guarded", maze)
    assert "Wrote a guarded checkpoint" in said
    weights = (base / "model.safetensors").read_bytes()
    assert (tmp_path / "guarded/model.safetensors").read_bytes() == weights
    said = run_well(
        "lerobot-eval",
        f"--policy.path={tmp_path / 'guarded'}",
        *EVALUATION,
        f"--output_dir={tmp_path / 'eval'}",
    )
    assert "Plans are not checked" not in said
    assert "pc_success" in said
    back = tmp_path / "back"
    arguments = (f"--policy.path={tmp_path / 'guarded'}", "--unguard=true", f"--output_dir={back}")
    said = run_well("pf2mp-fit-field", *arguments)
    assert "Wrote a checkpoint of type act" in said
    assert (back / "model.safetensors").read_bytes() == weights
    assert {path.name for path in back.iterdir()} == {
        path.name for path in base.iterdir() if path.name != "train_config.json"
    }
    written, before = (json.loads((path / "config.json").read_text()) for path in (back, base))
    assert written == before
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        assert json.loads((back / name).read_text()) == json.loads((base / name).read_text())


@pytest.mark.slow
def test_a_guarded_policy_is_trained_from_the_start_as_its_base_would_be(maze, tmp_path):
    base = train(tmp_path / "act", maze, "--policy.type=act", *(f"--policy.{option}" for option in SMALL_ACT))
    new = train(
        tmp_path / "guarded",
        maze,
        "--policy.type=guarded",
        "--policy.base.type=act",
        *(f"--policy.base.{option}" for option in SMALL_ACT),
        "--policy.n_field_points=50",
    )
    assert (new / "model.safetensors").read_bytes() == (base / "model.safetensors").read_bytes()
    shown = demonstrations_of(new)
    assert len(shown) == 50
    # Resumed, the field goes on with what it has.
    run_well("lerobot-train", f"--config_path={new / 'train_config.json'}", "--resume=true", "--steps=3")
    resumed = set(demonstrations_of(new).frames.tolist())
    assert resumed & set(shown.frames.tolist())
    assert resumed - set(shown.frames.tolist())
    # Fine-tuned on other episodes, it holds only those.
    tuned = train(tmp_path / "tuned", maze, f"--policy.path={new}", "--dataset.episodes=[3,4]")
    episodes = demonstrations_of(tuned).episodes
    assert episodes is not None
    assert set(episodes.tolist()) == {3, 4}


def demonstrations_of(checkpoint: Path) -> DemonstratedActions:
    _, preprocessor, _ = load_policy(checkpoint, device="cpu")
    return loaded_demonstrations(preprocessor)


TOY = {
    "__init__.py": "from . import configuration_toy\n",
    "configuration_toy.py": '''
from dataclasses import dataclass, field
from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim.optimizers import AdamConfig

@PreTrainedConfig.register_subclass("toy")
@dataclass
class ToyConfig(PreTrainedConfig):
    length: int = 8
    normalization_mapping: dict = field(default_factory=lambda: {"ACTION": NormalizationMode.MIN_MAX})
    observation_delta_indices = reward_delta_indices = None

    @property
    def action_delta_indices(self):
        return list(range(self.length))

    def get_optimizer_preset(self):
        return AdamConfig()

    def get_scheduler_preset(self):
        return None

    def validate_features(self):
        pass
''',
    "modeling_toy.py": '''
import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from .configuration_toy import ToyConfig

class ToyPolicy(PreTrainedPolicy):
    config_class = ToyConfig
    name = "toy"

    def __init__(self, config, **kwargs):
        super().__init__(config)
        self.layer = torch.nn.Linear(2, 2 * config.length)

    def get_optim_params(self):
        return self.parameters()

    def reset(self):
        pass

    def predict_action_chunk(self, batch, **kwargs):
        return self.layer(batch["observation.state"]).unflatten(-1, (-1, 2))

    def select_action(self, batch, **kwargs):
        return self.predict_action_chunk(batch)[:, 0]

    def forward(self, batch):
        return (self.predict_action_chunk(batch) - batch["action"]).square().mean(), None
''',
    "processor_toy.py": '''
from lerobot.processor import make_default_pre_post_processors

def make_toy_pre_post_processors(config, dataset_stats=None):
    return make_default_pre_post_processors(config, dataset_stats)
''',
}  # fmt: skip


@pytest.mark.slow
def test_a_policy_of_another_plug_in_is_guarded_by_the_same_commands(maze, tmp_path):
    package = tmp_path / "site/lerobot_policy_toy"
    (tmp_path / "site/lerobot_policy_toy-1.0.dist-info").mkdir(parents=True)
    (tmp_path / "site/lerobot_policy_toy-1.0.dist-info/METADATA").write_text(
        "Metadata-Version: 2.1\nName: lerobot_policy_toy\nVersion: 1.0\n"
    )
    package.mkdir()
    for name, text in TOY.items():
        (package / name).write_text(text)
    env = {**os.environ, "PYTHONPATH": str(tmp_path / "site")}

    def run_in_a_process(command: str, *arguments: str) -> str:
        finished = subprocess.run(
            [str(BIN / command), *arguments],
            env=env,
            capture_output=True,
            text=True,
            check=False,
            timeout=SECONDS,
        )
        assert finished.returncode == 0, finished.stdout[-2000:] + finished.stderr[-4000:]
        return finished.stdout + finished.stderr

    data = ("--dataset.repo_id=local/maze", f"--dataset.root={maze}")
    training = ("--steps=2", "--batch_size=4", "--num_workers=0", f"--output_dir={tmp_path / 'toy'}")
    run_in_a_process(
        "lerobot-train",
        "--policy.type=toy",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        *data,
        *training,
    )
    base = tmp_path / "toy/checkpoints/last/pretrained_model"
    said = run_in_a_process(
        "pf2mp-fit-field", f"--policy.path={base}", *data, f"--output_dir={tmp_path / 'guarded'}"
    )
    assert "Wrote a guarded checkpoint" in said
    said = run_in_a_process(
        "lerobot-eval",
        f"--policy.path={tmp_path / 'guarded'}",
        *EVALUATION,
        f"--output_dir={tmp_path / 'eval'}",
    )
    assert "How toy generates chunks is not known: they are guided when they are finished." in said
    assert "pc_success" in said


@pytest.mark.slow
@pytest.mark.parametrize(
    ("collected", "env"),
    [
        ("maze_umaze", ("--env.type=pf2mp_maze", "--env.task=MazeUMaze-v0")),
        ("fetch_reach", ("--env.type=pf2mp_fetch", "--env.task=FetchReachWall-v0")),
    ],
)  # fmt: skip
def test_a_policy_that_sees_images_is_guarded(collected, env, tmp_path):
    data = tmp_path / "data"
    run_well(
        "pf2mp-collect",
        f"--task={collected}",
        "--n_episodes=3",
        "--obs_type=pixels_agent_pos",
        f"--root={data}",
    )
    options = (*SMALL_ACT, "pretrained_backbone_weights=null")
    base = train(tmp_path / "act", data, "--policy.type=act", *(f"--policy.{option}" for option in options))
    assert "Wrote a guarded checkpoint" in fit(base, tmp_path / "guarded", data)
    said = run_well(
        "lerobot-eval",
        f"--policy.path={tmp_path / 'guarded'}",
        *env,
        "--env.obs_type=pixels_agent_pos",
        "--eval.n_episodes=1",
        "--eval.batch_size=1",
        f"--output_dir={tmp_path / 'eval'}",
    )
    assert "pc_success" in said
    policy, _, _ = load_policy(tmp_path / "guarded", device="cpu")
    assert policy.config.image_features
