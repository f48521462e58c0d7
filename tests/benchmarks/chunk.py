# SPDX-License-Identifier: Apache-2.0
"""How long a chunk takes beside LeRobot's own policies on the same observation: diffusion and multi_task_dit.

Diffusion has the same U-Net. LeRobot's small flow matching policy, multi_task_dit, has a transformer instead, here with its
default options, and CLIP's text encoder, here with random weights, on which the time does not depend. It needs the package
transformers, and has no row where that is not installed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from statistics import median
from typing import Any
from unittest.mock import patch

import torch
from harness import Row, ratio, threads, time_in_turns
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.multi_task_dit.configuration_multi_task_dit import MultiTaskDiTConfig
from lerobot.policies.multi_task_dit.modeling_multi_task_dit import MultiTaskDiTPolicy
from lerobot.utils.constants import ACTION, OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS, OBS_STATE
from lerobot.utils.import_utils import is_package_available
from maze_policies import HORIZON, NAMES, PAPER, SMALL, Planner, make_planner

N_ROUNDS = 15
MIN_SECONDS = 0.1
CPU_THREADS = (1, 2)
POLICIES: dict[str, tuple[str, dict[str, Any]]] = {
    "pf2mp, 5 steps": ("pf2mp", {"num_inference_steps": 5}),
    "pf2mp, 10 steps": ("pf2mp", {"num_inference_steps": 10}),
    "DDIM, 5 steps": ("diffusion", {"num_inference_steps": 5}),
    "DDIM, 10 steps": ("diffusion", {"num_inference_steps": 10}),
    "DDPM, 100 steps": ("diffusion", {"num_inference_steps": 100, "noise_scheduler_type": "DDPM"}),
}
DIT_STEPS = (5, 100)  # 100 are its default
N_TOKENS = 77  # of CLIP's texts


def measure() -> Iterator[Row]:
    """The rows of this part."""
    for down_dims in (SMALL, PAPER):
        yield from _measure_on("cpu", down_dims)
        if torch.cuda.is_available():
            yield from _measure_on("cuda", down_dims)


def _measure_on(device: str, down_dims: tuple[int, ...]) -> Iterator[Row]:
    case = f"{NAMES[down_dims]}, batch 1"
    calls: dict[str, Callable[[], torch.Tensor]] = {
        name: make_planner(kind, down_dims, 1, device, **options)
        for name, (kind, options) in POLICIES.items()
    }
    transformers = {}
    if is_package_available("transformers"):
        transformers = {
            f"multi_task_dit, {n_steps} steps": _make_multi_task_dit(n_steps, device) for n_steps in DIT_STEPS
        }
    calls |= transformers
    plain, compiled = "pf2mp, 5 steps", "pf2mp, 5 steps, compiled"
    if down_dims == SMALL:  # the other one's outputs are replaced, at which a graph would end
        calls[compiled] = _compile(make_planner("pf2mp", SMALL, 1, device, num_inference_steps=5))
    for n_threads in CPU_THREADS if device == "cpu" else (0,):
        with threads(n_threads or 1), torch.inference_mode():
            times = time_in_turns(calls, N_ROUNDS, MIN_SECONDS)
        for name, seconds in times.items():
            yield Row("chunk", case, name, 1000 * median(seconds), "ms", n_threads)
        yield _compare(times, case, n_threads, "DDPM, 100 steps", "pf2mp, 5 steps", target=15, at_least=True)
        yield _compare(times, case, n_threads, "pf2mp, 5 steps", "DDIM, 5 steps", target=1)
        yield _compare(times, case, n_threads, "pf2mp, 10 steps", "DDIM, 10 steps", target=1)
        for name in transformers:
            yield _compare(times, case, n_threads, name, plain)
        if compiled in calls:
            yield _compare(times, case, n_threads, compiled, plain)


def _compile(planner: Planner) -> Callable[[], torch.Tensor]:
    """The same as ``lerobot-rollout --use_torch_compile=true`` makes it, which takes a minute at the first chunk."""
    planner.policy.predict_action_chunk = torch.compile(planner.policy.predict_action_chunk)
    return planner


def _make_multi_task_dit(n_steps: int, device: str) -> Callable[[], torch.Tensor]:
    """Plans one chunk with LeRobot's multi_task_dit, which observes start and goal as one state."""
    # The defaults of CLIPTextConfig are those of the policy's text encoder.
    from transformers import CLIPTextConfig, CLIPTextModel

    config = MultiTaskDiTConfig(
        device=device,
        push_to_hub=False,
        objective="flow_matching",
        num_integration_steps=n_steps,
        n_obs_steps=1,
        horizon=HORIZON,
        n_action_steps=HORIZON,
        input_features={OBS_STATE: PolicyFeature(FeatureType.STATE, (4,))},
        output_features={ACTION: PolicyFeature(FeatureType.ACTION, (2,))},
    )
    torch.manual_seed(0)
    with patch.object(CLIPTextModel, "from_pretrained", lambda _: CLIPTextModel(CLIPTextConfig())):
        policy = MultiTaskDiTPolicy(config).to(device).eval()
    batch = {
        OBS_STATE: torch.zeros(1, 4, device=device),
        OBS_LANGUAGE_TOKENS: torch.arange(N_TOKENS, device=device)[None],
        OBS_LANGUAGE_ATTENTION_MASK: torch.ones(1, N_TOKENS, dtype=torch.bool, device=device),
    }

    def plan() -> torch.Tensor:
        policy.reset()  # or the action would be one of the last chunk's
        return policy.select_action(dict(batch))  # which it changes

    return plan


def _compare(
    times: dict[str, list[float]],
    case: str,
    n_threads: int,
    name: str,
    to: str,
    target: float | None = None,
    at_least: bool = False,
) -> Row:
    value = ratio(times, name, to)
    return Row("chunk", case, f"{name} / {to}", value, "x", n_threads, target, at_least)
