# SPDX-License-Identifier: Apache-2.0
"""What LeRobot's own tests ask of its policies and no other test here does, for each of ours."""

import inspect
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from lerobot.policies.factory import get_policy_class, make_policy_config
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from untrained_policies import ACTION, ENV, MAKE_CONFIG, STATE

KINDS = ("fmp", "pf2mp", "dppf")
every_kind = pytest.mark.parametrize("kind", KINDS)


def batch_of(config: PreTrainedConfig, n_samples: int = 3) -> dict[str, Any]:
    horizon, n_obs_steps = config.horizon, config.n_obs_steps
    return {
        STATE: torch.randn(n_samples, n_obs_steps, 2),
        ENV: torch.randn(n_samples, n_obs_steps, 2),
        ACTION: torch.randn(n_samples, horizon, 2),
        "action_is_pad": torch.zeros(n_samples, horizon, dtype=torch.bool),
        "task": ["go"] * n_samples,
    }


@every_kind
def test_a_policy_says_which_configuration_it_takes(kind: str) -> None:
    policy_class = get_policy_class(kind)
    wanted = inspect.signature(policy_class.__init__).parameters["config"].annotation
    assert wanted is policy_class.config_class
    assert isinstance(make_policy_config(kind), wanted)
    assert policy_class.name == kind


@every_kind
def test_a_policy_is_saved_from_a_state_that_was_gathered_before(kind: str, tmp_path: Path) -> None:
    policy = get_policy_class(kind)(MAKE_CONFIG[kind]())
    state = {name: tensor + 1 for name, tensor in policy.state_dict().items()}
    policy.save_pretrained(tmp_path, state_dict=state)
    assert {path.name for path in tmp_path.iterdir()} == {"config.json", "model.safetensors"}
    loaded = get_policy_class(kind).from_pretrained(tmp_path).state_dict()
    assert loaded.keys() == state.keys()
    assert all(torch.equal(loaded[name], state[name]) for name in state)


@every_kind
def test_parts_of_the_state_and_of_the_action_are_not_taken_for_the_whole(kind: str) -> None:
    config = make_policy_config(
        kind,
        input_features={
            f"{STATE}.arm": PolicyFeature(FeatureType.STATE, (5,)),
            STATE: PolicyFeature(FeatureType.STATE, (7,)),
            ENV: PolicyFeature(FeatureType.ENV, (2,)),
        },
        output_features={
            f"{ACTION}.arm": PolicyFeature(FeatureType.ACTION, (3,)),
            ACTION: PolicyFeature(FeatureType.ACTION, (5,)),
        },
    )
    assert config.robot_state_feature == PolicyFeature(FeatureType.STATE, (7,))
    assert config.action_feature == PolicyFeature(FeatureType.ACTION, (5,))


@every_kind
def test_a_training_step_leaves_the_batch_as_it_was(kind: str) -> None:
    config = MAKE_CONFIG[kind]()
    policy = get_policy_class(kind)(config).train()
    batch = batch_of(config)
    before = {
        key: value.clone() if isinstance(value, torch.Tensor) else [*value] for key, value in batch.items()
    }
    loss, _ = policy(batch)
    loss.backward()
    assert batch.keys() == before.keys()
    for key, value in before.items():
        assert torch.equal(batch[key], value) if isinstance(value, torch.Tensor) else batch[key] == value


@every_kind
def test_processors_without_statistics_leave_the_values_alone(kind: str) -> None:
    config = MAKE_CONFIG[kind]()
    preprocess, postprocess = make_pre_post_processors(config)
    batch = batch_of(config)
    processed = preprocess(dict(batch))
    assert all(torch.equal(processed[key], batch[key]) for key in (STATE, ENV, ACTION))
    assert torch.equal(postprocess(batch[ACTION]), batch[ACTION])


@pytest.mark.parametrize("kind", ["fmp", "pf2mp"])
def test_the_processor_of_real_time_chunking_is_where_lerobots_policies_have_it(kind: str) -> None:
    config = MAKE_CONFIG[kind]()
    policy = get_policy_class(kind)(config)
    assert policy.rtc_processor is None
    config.rtc_config = RTCConfig(enabled=True, execution_horizon=4)
    policy.init_rtc_processor()
    assert policy.rtc_processor.rtc_config is config.rtc_config
