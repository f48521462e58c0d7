# SPDX-License-Identifier: Apache-2.0
"""How long a chunk takes beside LeRobot's diffusion policy, with the same U-Net, on the same observation.

LeRobot's small flow matching policy, multi_task_dit, has no row: it cannot be made without CLIP's text encoder, whose
weights are on the Hub, and without the package transformers.
"""

from __future__ import annotations

from collections.abc import Iterator
from statistics import median
from typing import Any

import torch
from harness import Row, ratio, threads, time_in_turns
from maze_policies import NAMES, PAPER, SMALL, make_planner

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


def measure() -> Iterator[Row]:
    """The rows of this part."""
    for down_dims in (SMALL, PAPER):
        yield from _measure_on("cpu", down_dims)
        if torch.cuda.is_available():
            yield from _measure_on("cuda", down_dims)


def _measure_on(device: str, down_dims: tuple[int, ...]) -> Iterator[Row]:
    case = f"{NAMES[down_dims]}, batch 1"
    calls = {
        name: make_planner(kind, down_dims, 1, device, **options)
        for name, (kind, options) in POLICIES.items()
    }
    for n_threads in CPU_THREADS if device == "cpu" else (0,):
        with threads(n_threads or 1), torch.inference_mode():
            times = time_in_turns(calls, N_ROUNDS, MIN_SECONDS)
        for name, seconds in times.items():
            yield Row("chunk", case, name, 1000 * median(seconds), "ms", n_threads)
        yield _compare(times, case, n_threads, "DDPM, 100 steps", "pf2mp, 5 steps", target=15, at_least=True)
        yield _compare(times, case, n_threads, "pf2mp, 5 steps", "DDIM, 5 steps", target=1)
        yield _compare(times, case, n_threads, "pf2mp, 10 steps", "DDIM, 10 steps", target=1)


def _compare(
    times: dict[str, list[float]],
    case: str,
    n_threads: int,
    name: str,
    to: str,
    target: float,
    at_least: bool = False,
) -> Row:
    value = ratio(times, name, to)
    return Row("chunk", case, f"{name} / {to}", value, "x", n_threads, target, at_least)
