# SPDX-License-Identifier: Apache-2.0
"""Checkpoints that an earlier version has written, and the actions that it planned with them."""

from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open

from lerobot_pf2mp import load_policy

CHECKPOINTS = Path(__file__).parent / "checkpoints"
OPTIONS: dict[str, dict[str, Any]] = {
    "default": {},
    "euler": {"guidance_integrator": "euler", "guidance_scale": 0.0005},
    "unguided": {"guidance_scale": 0.0},
}


def processor() -> str:
    """The processor, on which the last bit of a network's output depends."""
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    name = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return f"{name}, {torch.backends.cpu.get_cpu_capability()}"


@pytest.mark.parametrize("options", OPTIONS)
@pytest.mark.parametrize("policy_type", ["pf2mp", "dppf"])
def test_a_checkpoint_of_before_plans_the_same_actions(policy_type: str, options: str) -> None:
    folder = CHECKPOINTS / policy_type
    with safe_open(folder / "expected_actions.safetensors", "pt") as file:
        saved = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        made_with = file.metadata()
    policy, preprocess, _ = load_policy(folder, device="cpu", **OPTIONS[options])
    observation = {key: saved[key] for key in ("observation.state", "observation.environment_state")}
    n_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.inference_mode():
            chunk = policy.predict_action_chunk(preprocess(observation), noise=saved["noise"])
    finally:
        torch.set_num_threads(n_threads)
    if made_with == {"torch": torch.__version__, "processor": processor()}:
        assert torch.equal(chunk, saved[options])
    torch.testing.assert_close(chunk, saved[options], rtol=0, atol=5e-4)


@pytest.mark.parametrize("policy_type", ["pf2mp", "dppf"])
def test_the_saved_cases_differ_from_each_other(policy_type: str) -> None:
    with safe_open(CHECKPOINTS / policy_type / "expected_actions.safetensors", "pt") as file:
        chunks = [file.get_tensor(name) for name in OPTIONS]
    for i, chunk in enumerate(chunks):
        for other in chunks[:i]:
            assert (chunk - other).abs().max() > 1e-3
