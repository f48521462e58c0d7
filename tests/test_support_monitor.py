# SPDX-License-Identifier: Apache-2.0
"""The monitor that tells how far a plan leaves the demonstrated region, and may hold the robot inside it."""

import logging
from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from torch import Tensor

from lerobot_pf2mp import DPPFConfig, PF2MPConfig
from lerobot_pf2mp.policies.batch_keys import POTENTIAL_FIELD
from lerobot_pf2mp.policies.dppf.modeling_dppf import DPPFPolicy
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.policies.guided.support_monitor import SupportMonitor
from lerobot_pf2mp.policies.pf2mp.modeling_pf2mp import PF2MPPolicy
from lerobot_pf2mp.potential_field import PotentialField, fit

HORIZON, STATE, ENV = 8, "observation.state", "observation.environment_state"


@pytest.fixture(scope="module")
def field() -> PotentialField:
    """A density around the origin of the plane."""
    points = 0.1 * torch.randn(200, 2, generator=torch.Generator().manual_seed(0))
    return fit(points, bandwidth=0.1)


def chunk_from(*inside: str) -> Tensor:
    """A chunk for each string: "x" is an action far outside, any digit one inside, each different."""
    rows = [[(9.0, 9.0) if mark == "x" else (0.01 * int(mark), 0.0) for mark in row] for row in inside]
    return torch.tensor(rows)


def marks_of(chunk: Tensor) -> list[str]:
    return ["".join("x" if x > 1 else str(round(100 * x)) for x in row) for row in chunk[..., 0].tolist()]


def test_support_is_the_log_density_above_the_threshold(field: PotentialField) -> None:
    monitor = SupportMonitor("warn")
    chunk = torch.randn(3, 5, 2, generator=torch.Generator().manual_seed(1))
    assert monitor.support is None
    assert torch.equal(monitor(chunk, field), chunk)
    assert monitor.support is not None and monitor.support.shape == (3, 5)
    torch.testing.assert_close(monitor.support, field.log_density(chunk) - field.log_threshold)
    monitor.reset()
    assert monitor.support is None


def test_only_the_covered_dimensions_count(field: PotentialField) -> None:
    monitor = SupportMonitor("hold", action_dims=(0, 2))
    chunk = torch.tensor([[[0.0, 99.0, 0.0], [9.0, 1.0, 9.0]]])
    assert monitor(chunk, field).tolist() == [[[0.0, 99.0, 0.0], [0.0, 99.0, 0.0]]]


@pytest.mark.parametrize(
    ("planned", "executed"),
    [
        ("12345", "12345"),
        ("12xx5", "12225"),
        ("x23xx", "22333"),
        ("1xxxx", "11111"),
        ("xxxxx", "xxxxx"),  # nowhere to hold
    ],
)
def test_the_last_supported_action_is_held(field: PotentialField, planned: str, executed: str) -> None:
    assert marks_of(SupportMonitor("hold")(chunk_from(planned), field)) == [executed]


def test_robots_side_by_side_are_held_each_for_itself(field: PotentialField) -> None:
    held = SupportMonitor("hold")(chunk_from("1xx", "x23", "123"), field)
    assert marks_of(held) == ["111", "223", "123"]


def test_a_chunk_is_held_where_the_one_before_left_off_until_the_next_episode(field: PotentialField) -> None:
    monitor = SupportMonitor("hold")
    monitor(chunk_from("12x"), field)
    assert marks_of(monitor(chunk_from("xx5"), field)) == ["225"]
    assert marks_of(monitor(chunk_from("xxx"), field)) == ["555"]
    monitor.reset()
    assert marks_of(monitor(chunk_from("xx7"), field)) == ["777"]


def test_a_warning_says_how_many_actions_leave_the_region_and_how_far(
    field: PotentialField, caplog: pytest.LogCaptureFixture
) -> None:
    monitor = SupportMonitor("warn")
    with caplog.at_level(logging.WARNING):
        monitor(chunk_from("123"), field)
        assert not caplog.records
        monitor(chunk_from("1xx"), field)
    assert monitor.support is not None
    expected = (
        f"2 of 3 planned actions leave the demonstrated region, by up to {-monitor.support.min():.1f} nats"
    )
    assert [record.message for record in caplog.records] == [expected]


def policy_of(kind: str, **options: Any) -> Any:
    torch.manual_seed(0)
    common: dict[str, Any] = {
        "device": "cpu",
        "horizon": HORIZON,
        "n_action_steps": 4,
        "n_obs_steps": 1,
        "down_dims": (8, 16),
        "n_groups": 4,
        "diffusion_step_embed_dim": 16,
        "guidance_scale": 0.0,
        "input_features": {
            STATE: PolicyFeature(FeatureType.STATE, (3,)),
            ENV: PolicyFeature(FeatureType.ENV, (2,)),
        },
        "output_features": {"action": PolicyFeature(FeatureType.ACTION, (2,))},
        **options,
    }
    if kind == "dppf":
        return DPPFPolicy(DPPFConfig(**common)).eval()
    return PF2MPPolicy(PF2MPConfig(**common)).eval()


def batch_for(policy: Any) -> dict[str, Any]:
    demonstrated = DemonstratedActions(policy.config.field_settings)
    actions = 0.3 * torch.randn(40, HORIZON, 2, generator=torch.Generator().manual_seed(0))
    demonstrated.observe(actions, None, None, settings=policy.config.field_settings)
    return {STATE: torch.zeros(1, 3), ENV: torch.zeros(1, 2), POTENTIAL_FIELD: demonstrated}


@pytest.mark.parametrize("kind", ["pf2mp", "dppf"])
def test_a_policy_holds_what_it_executes_and_reports_its_support(kind: str) -> None:
    noise = torch.randn(1, HORIZON, 2, generator=torch.Generator().manual_seed(1))
    chunks, supports = {}, {}
    for choice in ("ignore", "warn", "hold"):
        policy = policy_of(kind, on_unsupported=choice)
        chunks[choice] = policy.predict_action_chunk(batch_for(policy), noise=noise)
        supports[choice] = policy.support
    assert supports["ignore"] is None
    assert torch.equal(chunks["warn"], chunks["ignore"])
    assert torch.equal(supports["warn"], supports["hold"]) and supports["hold"].shape == (1, 4)
    unsupported = supports["hold"] < 0
    assert unsupported.any(), "the case says nothing if the plan stays inside"
    assert not torch.equal(chunks["hold"], chunks["ignore"]) or unsupported.all()


def test_an_option_that_is_changed_later_takes_effect() -> None:
    noise = torch.randn(1, HORIZON, 2, generator=torch.Generator().manual_seed(1))
    held = policy_of("pf2mp", on_unsupported="hold")
    changed = policy_of("pf2mp", on_unsupported="ignore")
    before = changed.predict_action_chunk(batch_for(changed), noise=noise)
    changed.config.on_unsupported = "hold"
    after = changed.predict_action_chunk(batch_for(changed), noise=noise)
    assert torch.equal(after, held.predict_action_chunk(batch_for(held), noise=noise))
    assert not torch.equal(after, before)


def test_a_policy_forgets_at_reset() -> None:
    policy = policy_of("pf2mp", on_unsupported="hold")
    policy.predict_action_chunk(batch_for(policy))
    assert policy.support is not None
    policy.reset()
    assert policy.support is None


def test_holding_without_a_field_and_an_unknown_choice_are_errors() -> None:
    policy = policy_of("pf2mp", on_unsupported="hold")
    with pytest.raises(ValueError, match="guidance needs the potential field"):
        policy.predict_action_chunk({STATE: torch.zeros(1, 3), ENV: torch.zeros(1, 2)})
    with pytest.raises(Exception, match="on_unsupported must be one of .*, got 'stop'"):
        policy_of("pf2mp", on_unsupported="stop")
