# SPDX-License-Identifier: Apache-2.0
"""The policy server serves one client, and only checked checkpoints."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import grpc
import pytest
import torch
from lerobot.async_inference import policy_server
from lerobot.async_inference.configs import PolicyServerConfig
from lerobot.async_inference.helpers import RemotePolicyConfig
from untrained_policies import ENV, STATE, write_checkpoint

from lerobot_pf2mp.serving import OneClientPolicyServer, load_checked_processors


class AbortedError(Exception):
    """A call that the server has ended."""


class Context:
    """What gRPC tells of a call."""

    def __init__(self, client: str) -> None:
        self._client = client

    def peer(self) -> str:
        return self._client

    def abort(self, code: grpc.StatusCode, details: str) -> None:
        raise AbortedError(code, details)


ROBOT, OTHER = Context("ipv4:10.0.0.1:5000"), Context("ipv4:10.0.0.2:6000")


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [100.0]
    monkeypatch.setattr("lerobot_pf2mp.serving.time.monotonic", lambda: now[0])
    return now


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> OneClientPolicyServer:
    monkeypatch.setattr(
        policy_server, "make_pre_post_processors", load_checked_processors
    )  # as `serve` does it
    monkeypatch.setattr(
        policy_server, "pickle", SimpleNamespace(loads=lambda data: data)
    )  # these tests send none
    return OneClientPolicyServer(PolicyServerConfig(obs_queue_timeout=0.01), client_timeout=30.0)


def instructions(kind: str, checkpoint: str) -> Any:
    specs = RemotePolicyConfig(kind, checkpoint, {}, 4, "cpu")
    return SimpleNamespace(data=specs)


def test_a_second_client_is_refused_until_the_first_is_silent(
    server: OneClientPolicyServer, clock: list[float]
) -> None:
    server.Ready(None, ROBOT)
    for call in (server.Ready, server.SendPolicyInstructions, server.SendObservations, server.GetActions):
        with pytest.raises(AbortedError) as refused:
            call(None, OTHER)
        code, details = refused.value.args
        assert code == grpc.StatusCode.RESOURCE_EXHAUSTED
        assert "serves one client at a time, and ipv4:10.0.0.1:5000 was heard 0.0 s ago" in details
    clock[0] += 29
    server.GetActions(None, ROBOT)  # it is heard again
    clock[0] += 29
    with pytest.raises(AbortedError):
        server.Ready(None, OTHER)
    clock[0] += 2
    server.Ready(None, OTHER)
    with pytest.raises(AbortedError):
        server.GetActions(None, ROBOT)


def test_a_guarded_policy_is_served_with_its_field(
    server: OneClientPolicyServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(policy_server, "SUPPORTED_POLICIES", ["guarded"])
    checkpoint = write_checkpoint(tmp_path / "policy", "guarded")
    server.Ready(None, ROBOT)
    server.SendPolicyInstructions(instructions("guarded", checkpoint), ROBOT)
    served: Any = server.policy
    seen = {STATE: torch.full((2,), 0.9), ENV: torch.zeros(2)}
    chunk = server._get_action_chunk(server.preprocessor(seen))
    assert chunk.shape == (1, 4, 2)  # as many actions as the client asked for
    batch = server.preprocessor(seen)
    field = batch["potential_field"].field(served.config.field_settings)
    served.config.guidance_scale = 0
    unguided = server._get_action_chunk(batch)
    assert field.log_density(chunk).mean() > field.log_density(unguided).mean()


def test_a_served_policy_is_not_replaced(
    server: OneClientPolicyServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(policy_server, "SUPPORTED_POLICIES", ["pf2mp"])
    checkpoint = write_checkpoint(tmp_path / "policy", "pf2mp")
    server.Ready(None, ROBOT)
    server.SendPolicyInstructions(instructions("pf2mp", checkpoint), ROBOT)
    served = server.policy
    assert served.name == "pf2mp"
    with pytest.raises(AbortedError):
        server.SendPolicyInstructions(instructions("pf2mp", checkpoint), OTHER)
    assert server.policy is served


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("act", "got the class 'subprocess.Popen': nothing of it was imported"),
        ("incomplete", "must hold its processors, got "),
    ],
)
def test_the_client_is_told_what_is_wrong_with_its_checkpoint(
    kind: str, said: str, server: OneClientPolicyServer, tmp_path: Path
) -> None:
    checkpoint = write_checkpoint(tmp_path / "policy", "act")
    path = Path(checkpoint) / "policy_postprocessor.json"
    if kind == "incomplete":
        path.unlink()
    else:
        pipeline = json.loads(path.read_text())
        pipeline["steps"].append({"class": "subprocess.Popen", "config": {"args": ["true"]}})
        path.write_text(json.dumps(pipeline))
    server.Ready(None, ROBOT)
    with pytest.raises(AbortedError) as refused:
        server.SendPolicyInstructions(instructions("act", checkpoint), ROBOT)
    code, details = refused.value.args
    assert code == grpc.StatusCode.INVALID_ARGUMENT and said in details
    assert server.policy is None


def test_a_policy_opened_without_its_field_is_refused(
    server: OneClientPolicyServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(policy_server, "SUPPORTED_POLICIES", ["fmp", "diffusion"])
    server.Ready(None, ROBOT)
    for kind, opened_as in (("pf2mp", "fmp"), ("dppf", "diffusion")):
        checkpoint = write_checkpoint(tmp_path / kind, kind)
        with pytest.raises(AbortedError, match=f"must be opened as a policy of type {kind}, got {opened_as}"):
            server.SendPolicyInstructions(instructions(opened_as, checkpoint), ROBOT)
