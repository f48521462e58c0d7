# SPDX-License-Identifier: Apache-2.0
"""Policies whose actions are displacements, guided and checked over the positions to which these lead."""

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies import make_pre_post_processors
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.factory import get_policy_class
from lerobot.policies.rtc.configuration_rtc import RTCConfig

from lerobot_pf2mp import DPPFConfig, GuardedConfig, PF2MPConfig, load_policy
from lerobot_pf2mp.dataset_tools.writing.lerobot_writer import DatasetSpec, write_dataset
from lerobot_pf2mp.fit_field import fit_field
from lerobot_pf2mp.loading import loaded_demonstrations
from lerobot_pf2mp.policies.guided.action_kind import warn_about_actions
from lerobot_pf2mp.policies.plans.plan_choice import PlanCheck
from lerobot_pf2mp.policies.plans.plans import UnsupportedPlanError

STATE, ENV, ACTION = "observation.state", "observation.environment_state", "action"
SCALE, N_EPISODES, N_FRAMES, T = 0.01, 12, 24, 8
INTEGRATED: dict[str, Any] = {
    "field_over": "integrated",
    "field_displacement_scale": SCALE,
    "field_action_dims": (0, 1),
}
FEATURES: dict[str, Any] = {
    "device": "cpu",
    "input_features": {
        STATE: PolicyFeature(FeatureType.STATE, (3,)),
        ENV: PolicyFeature(FeatureType.ENV, (2,)),
    },
    "output_features": {ACTION: PolicyFeature(FeatureType.ACTION, (3,))},
}
U_NET: dict[str, Any] = {**FEATURES, "horizon": T, "n_action_steps": 4, "down_dims": (8, 16), "n_groups": 4}
DENOISING: dict[str, Any] = {**U_NET, "num_train_timesteps": 20, "noise_scheduler_type": "DDIM"}
ACT: dict[str, Any] = {
    **FEATURES,
    "chunk_size": T,
    "n_action_steps": 4,
    "dim_model": 16,
    "dim_feedforward": 16,
    "n_heads": 2,
    "n_encoder_layers": 1,
    "use_vae": False,
}
KINDS: dict[str, Any] = {
    "pf2mp": lambda **given: PF2MPConfig(**U_NET, **given),
    "pf2mp with the past": lambda **given: PF2MPConfig(**U_NET, n_obs_steps=2, **given),
    "dppf": lambda **given: DPPFConfig(**DENOISING, **given),
    "guarded act": lambda **given: GuardedConfig(base=ACTConfig(**ACT), **given),
    "guarded diffusion": lambda **given: GuardedConfig(
        base=DiffusionConfig(**DENOISING, num_inference_steps=2), **given
    ),
}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> LeRobotDataset:
    """A robot that goes along a band 0.2 m long and 2 cm wide, by displacements of up to 1 cm."""
    rng = np.random.default_rng(0)

    def episode() -> dict[str, np.ndarray]:
        actions = np.stack(
            [rng.uniform(0.5, 1.0, N_FRAMES), rng.uniform(-0.3, 0.3, N_FRAMES), rng.uniform(0, 1, N_FRAMES)],
            axis=1,
        )
        ways = SCALE * np.cumsum(actions[:, :2], axis=0)
        start = np.array([0.5, 0.1]) + rng.uniform(-0.01, 0.01, 2)
        positions = np.concatenate([start[None], start + ways[:-1]])
        states = np.concatenate([positions, rng.uniform(0, 1, (N_FRAMES, 1))], axis=1)
        frames = {STATE: states, ENV: rng.normal(size=(N_FRAMES, 2)), ACTION: actions}
        return {key: value.astype(np.float32) for key, value in frames.items()}

    features = {
        key: {"dtype": "float32", "shape": (size,), "names": None}
        for key, size in ((STATE, 3), (ENV, 2), (ACTION, 3))
    }
    root = tmp_path_factory.mktemp("data") / "displacements"
    spec = DatasetSpec("local/displacements", 10, features, "go", "")
    write_dataset(root, spec, [episode() for _ in range(N_EPISODES)])
    return LeRobotDataset("local/displacements", root=root)


def trained(dataset: LeRobotDataset, kind: str, **options: Any) -> tuple[Any, Any, Any]:
    """A policy with random weights that has seen the dataset's chunks once, and its processors."""
    torch.manual_seed(0)
    config = KINDS[kind](**{**INTEGRATED, **options})
    stats = dataset.meta.stats
    policy = get_policy_class(config.type)(config, dataset_stats=stats, dataset_meta=dataset.meta)
    pre, post = make_pre_post_processors(config, dataset_stats=stats)
    policy.train()
    for first in range(0, len(dataset), 48):
        batch = pre(batch_of(dataset, config, range(first, min(first + 48, len(dataset)))))
        with torch.enable_grad():
            policy.forward(batch)
    policy.eval()
    return policy, pre, post


def batch_of(dataset: LeRobotDataset, config: Any, rows: Any) -> dict[str, Any]:
    """A training batch as LeRobot's loader makes it."""
    table = dataset.hf_dataset.with_format("torch")[:]
    rows = torch.tensor(list(rows))
    starts = rows // N_FRAMES * N_FRAMES

    def window(key: str, deltas: Any) -> torch.Tensor:
        if deltas is None:
            return table[key][rows]
        at = rows.unsqueeze(1) + torch.tensor(list(deltas))
        return table[key][at.clamp(starts.unsqueeze(1), starts.unsqueeze(1) + N_FRAMES - 1)]

    at = rows.unsqueeze(1) + torch.tensor(list(config.action_delta_indices))
    is_pad = (at < starts.unsqueeze(1)) | (at >= starts.unsqueeze(1) + N_FRAMES)
    observed = config.observation_delta_indices
    return {
        STATE: window(STATE, observed),
        ENV: window(ENV, observed),
        ACTION: window(ACTION, config.action_delta_indices),
        f"{ACTION}_is_pad": is_pad,
        "index": table["index"][rows],
        "episode_index": table["episode_index"][rows],
        "task": ["go"] * len(rows),
    }


def seen() -> dict[str, Any]:
    """Robots in the band, at its edge, and beside it."""
    states = torch.tensor([[0.55, 0.1, 0.5], [0.6, 0.115, 0.5], [0.52, 0.14, 0.2]])
    return {STATE: states, ENV: torch.zeros(3, 2), "task": ["go"] * 3}


def act(policy: Any, pre: Any) -> torch.Tensor:
    """The first plan of robots, ``(B, 4, A)`` [normalised]."""
    torch.manual_seed(1)
    policy.reset()
    with torch.inference_mode():
        return torch.stack([policy.select_action(pre(seen())) for _ in range(4)], dim=1)


def positions_of(policy: Any, batch: dict[str, Any], chunk: torch.Tensor) -> torch.Tensor:
    return policy.guidance._integrated(batch).positions(chunk)


@pytest.mark.parametrize("kind", KINDS)
def test_the_field_is_over_the_places_to_which_demonstrations_lead(dataset, kind):
    policy, _pre, _post = trained(dataset, kind)
    demonstrations = policy.guidance.demonstrations
    states = dataset.hf_dataset.with_format("torch")[:][STATE]
    places = states[:, :2].reshape(N_EPISODES, N_FRAMES, 2)
    at = demonstrations.frames
    within = at % N_FRAMES < N_FRAMES - 1
    expected = places[at[within] // N_FRAMES, at[within] % N_FRAMES + 1]
    unit = (states[:, :2].amax(dim=0) - states[:, :2].amin(dim=0)).max() / 2
    found = demonstrations.points[within]
    differences = (found - found[:1]) * unit
    if policy.config.normalization_mapping["STATE"].value != "MIN_MAX":
        scale = (differences * (expected - expected[:1])).sum() / differences.square().sum()
        differences = scale * differences
    torch.testing.assert_close(differences, expected - expected[:1], rtol=0, atol=2e-5)
    n_starts = N_EPISODES * sum(
        min(T - (policy.config.n_obs_steps - 1), N_FRAMES - first) for first in range(N_FRAMES)
    )
    assert len(demonstrations) == n_starts if policy.config.type != "guarded" else len(demonstrations) > 0


@pytest.mark.parametrize("kind", KINDS)
def test_switched_off_it_is_the_unguided_policy_bit_for_bit(dataset, kind):
    policy, pre, _ = trained(dataset, kind, guidance_scale=0.0, max_plans=1)
    integrated = act(policy, pre)
    plain, pre_of_plain, _ = trained(
        dataset, kind, guidance_scale=0.0, max_plans=1, field_over="actions", field_action_dims=(0, 1)
    )
    assert torch.equal(integrated, act(plain, pre_of_plain))
    policy.guidance.measures_plans = True
    assert torch.equal(integrated, act(policy, pre))
    assert policy.plans is not None


def test_obstacles_are_refused_because_displacements_have_no_place_among_them(dataset):
    ball = {"type": "ball", "centre": [0.5, 0.1], "radius": 0.1}
    policy, pre, _ = trained(dataset, "pf2mp", obstacles=[ball])
    with pytest.raises(
        ValueError, match="obstacles need actions that are positions, got field_over=integrated"
    ):
        act(policy, pre)
    policy.config.obstacle_rule = "ignore"
    act(policy, pre)


@pytest.mark.parametrize("kind", KINDS)
def test_guidance_leads_to_places_that_are_better_supported(dataset, kind):
    policy, pre, _ = trained(dataset, kind, guidance_scale=0.0, max_plans=1)
    field = policy.guidance.demonstrations.field()
    batch = pre(seen())

    def log_density(chunk: torch.Tensor) -> torch.Tensor:
        return field.log_density(positions_of(policy, batch, chunk)[..., :2].reshape(-1, 2))

    before = log_density(act(policy, pre))
    policy.config.guidance_scale, policy.config.guidance_region = 0.8, "everywhere"
    after = log_density(act(policy, pre))
    assert after.mean() > before.mean() + 0.1


def test_what_is_executed_stays_in_the_range_of_displacements(dataset):
    policy, pre, post = trained(
        dataset, "pf2mp", guidance_scale=5.0, max_plans=1, guidance_region="everywhere"
    )
    actions = post(act(policy, pre).reshape(-1, 3))
    stats = dataset.meta.stats[ACTION]
    low, high = (torch.as_tensor(np.asarray(stats[name]))[:2].float() for name in ("min", "max"))
    assert bool((actions[:, :2] >= low - 1e-4).all()) and bool((actions[:, :2] <= high + 1e-4).all())
    policy.config.guidance_scale = 0.0
    unguided = post(act(policy, pre).reshape(-1, 3))
    assert not bool((unguided[:, :2] <= high + 1e-4).all())


@pytest.mark.parametrize("kind", KINDS)
def test_plans_are_checked_on_their_whole_way_from_where_the_robot_is_seen(dataset, kind):
    policy, pre, _ = trained(dataset, kind, guidance_scale=0.0, max_plans=1)
    policy.guidance.measures_plans = True
    chunk, batch = act(policy, pre), pre(seen())
    settings, demonstrations = policy.config.field_settings, policy.guidance.demonstrations
    threshold = demonstrations.plan_threshold(settings, 4, policy.config.false_alarm_rate)
    check = PlanCheck(demonstrations.field(), threshold.log_density, (0, 1))
    robots = policy.guidance._integrated(batch)
    expected = check(robots.begun(chunk[:, 0]), robots.positions(chunk))
    torch.testing.assert_close(policy.support, expected, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("kind", ["pf2mp", "dppf", "guarded diffusion"])
def test_flagged_plans_are_drawn_again_from_the_same_places(dataset, kind):
    policy, pre, _ = trained(dataset, kind, guidance_scale=0.8, max_plans=1)
    policy.guidance.measures_plans = True
    first, support = act(policy, pre), policy.support.amin(dim=1)
    is_flagged = policy.plans.is_flagged
    assert bool(is_flagged[2]) and not bool(is_flagged[0])  # the robot beside the band
    policy.config.max_plans = 5
    chosen = act(policy, pre)
    assert policy.plans.n_drawn.tolist() == [5 if flagged else 1 for flagged in is_flagged.tolist()]
    assert torch.equal(chosen[~is_flagged], first[~is_flagged])
    assert policy.plans.support[2] >= support[2]
    robots = policy.guidance._integrated(pre(seen()))
    demonstrations = policy.guidance.demonstrations
    threshold = demonstrations.plan_threshold(policy.config.field_settings, 4, 0.01).log_density
    check = PlanCheck(demonstrations.field(), threshold, (0, 1))
    expected = check(robots.begun(chosen[:, 0]), robots.positions(chosen))
    torch.testing.assert_close(policy.support, expected, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("kind", ["pf2mp", "guarded act"])
def test_a_robot_that_holds_does_not_move(dataset, kind):
    policy, pre, post = trained(dataset, kind, guidance_scale=0.0, max_plans=1, on_unsupported="hold")
    chunk = act(policy, pre)
    is_held = (policy.support < 0).cumsum(dim=1) > 0
    assert bool(is_held.any()) and not bool(is_held.all())
    actions = post(chunk.reshape(-1, 3)).reshape(chunk.shape)
    torch.testing.assert_close(actions[is_held][:, :2], torch.zeros(int(is_held.sum()), 2), rtol=0, atol=2e-3)
    policy.config.on_unsupported = "stop"
    with pytest.raises(UnsupportedPlanError):
        act(policy, pre)


def test_a_saved_policy_comes_back_and_refuses_other_positions(dataset, tmp_path):
    policy, pre, post = trained(dataset, "pf2mp")
    expected = act(policy, pre)
    for part in (policy, pre, post):
        part.save_pretrained(tmp_path)
    loaded, pre, _ = load_policy(tmp_path)
    torch.testing.assert_close(act(loaded, pre), expected)
    for options, message in (
        (
            {"field_displacement_scale": 0.02},
            "must be integrated with field_displacement_scale 0.01, as in training",
        ),
        (
            {"field_over": "actions"},
            "must be integrated with field_displacement_scale 0.01, as in training, got actions",
        ),
        ({"field_state_dims": (1, 0)}, "field_state_dims"),
    ):
        with pytest.raises(ValueError, match=message):
            load_policy(tmp_path, **options)


def test_a_field_over_actions_is_no_field_over_sums(dataset, tmp_path):
    policy, pre, post = trained(dataset, "pf2mp", field_over="actions")
    for part in (policy, pre, post):
        part.save_pretrained(tmp_path)
    with pytest.raises(ValueError, match="field_over must be actions, as in training, got integrated"):
        load_policy(tmp_path, field_over="integrated", field_displacement_scale=SCALE)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pf2mp", "guarded act"])
def test_fit_field_makes_the_field_of_training(dataset, tmp_path, kind):
    policy, pre, post = trained(dataset, kind)
    for part in (policy, pre, post):
        part.save_pretrained(tmp_path / "trained")
    fit_field(
        tmp_path / "trained",
        tmp_path / "fitted",
        repo_id=dataset.repo_id,
        root=Path(dataset.root),
        options=INTEGRATED,
    )
    fitted, pre, _ = load_policy(tmp_path / "fitted")
    found, expected = loaded_demonstrations(pre), policy.guidance.demonstrations
    order, expected_order = (
        torch.argsort(one.points[:, 0] * 1000 + one.points[:, 1]) for one in (found, expected)
    )
    torch.testing.assert_close(found.points[order], expected.points[expected_order], rtol=0, atol=1e-5)
    torch.testing.assert_close(
        found.calibration.plans.ways, expected.calibration.plans.ways, rtol=0, atol=1e-5
    )
    assert act(fitted, pre).isfinite().all()


def test_real_time_chunking_is_refused(dataset):
    policy, pre, _ = trained(dataset, "pf2mp")
    policy.config.rtc_config = RTCConfig(enabled=True)
    policy.init_rtc_processor()
    with pytest.raises(ValueError, match="without real-time chunking"):
        policy.predict_action_chunk(pre(seen()))
    policy.config.guidance_scale, policy.config.max_plans = 0.0, 1
    assert policy.predict_action_chunk(pre(seen())).isfinite().all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"input_features": {ENV: FEATURES["input_features"][ENV]}}, r"needs observation\.state"),
        ({"field_state_dims": (0, 7)}, "field_state_dims must be one dimension of"),
        ({"field_action_dims": (0, 1, 2, 3)}, "field_action_dims must be below"),
    ],
)
def test_features_that_do_not_fit_are_an_error(options, message):
    with pytest.raises(ValueError, match=message):
        PF2MPConfig(**{**U_NET, **INTEGRATED, **options}).validate_features()


def test_displacements_are_no_reason_to_warn_where_they_are_added_up(dataset, caplog):
    settings = PF2MPConfig(**U_NET, **INTEGRATED).field_settings
    with caplog.at_level(logging.WARNING):
        warn_about_actions(dataset, settings)
    assert not caplog.records
    warn_about_actions(dataset, PF2MPConfig(**U_NET).field_settings)
    assert "--policy.field_over=integrated" in caplog.text
    caplog.clear()
    wrong = PF2MPConfig(**U_NET, **{**INTEGRATED, "field_displacement_scale": 1.0}).field_settings
    warn_about_actions(dataset, wrong)
    assert "moves observation.state by about 0.01 " in caplog.text
    caplog.clear()
    crossed = PF2MPConfig(**U_NET, **INTEGRATED, field_state_dims=(1, 2)).field_settings
    warn_about_actions(dataset, crossed)
    assert "are field_action_dims and field_state_dims right?" in caplog.text
