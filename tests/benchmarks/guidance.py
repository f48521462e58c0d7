# SPDX-License-Identifier: Apache-2.0
"""What guidance costs: a chunk of pf2mp beside one of fmp, and of dppf beside diffusion, the same network in both.

N = 5 steps, chunks of 80 actions, a field over 3000 demonstrated actions, default options. What the field costs depends on
how many actions are unsafe, because only for them the way to the safe set is looked up: there is a case with the actions
that a trained policy plans, and a worst case, in which all of them are unsafe and guidance is too weak to change that.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from statistics import median
from typing import Any

import torch
from harness import Row, ratio, threads, time_in_turns
from maze_policies import HORIZON, NAMES, PAPER, SMALL, Planner, make_planner, replay

from lerobot_pf2mp.policies.batch_keys import POTENTIAL_FIELD
from lerobot_pf2mp.policies.guided.fitted_field import fitted_field
from lerobot_pf2mp.potential_field import PotentialField

BATCH_SIZES = (1, 64)
TARGETS = {SMALL: 1.25, PAPER: 1.05}
UNGUIDED = {"pf2mp": "fmp", "dppf": "diffusion"}
MIN_SECONDS = 0.1
CPU_THREADS = (1, 2)
LONG_CALL = (PAPER, 64)  # takes seconds on a CPU
N_ROUNDS, N_LONG_ROUNDS = 11, 3

# Moves an action by a thousandth of its way in a whole chunk.
TOO_WEAK = 1e-6


def measure() -> Iterator[Row]:
    """The rows of this part."""
    for guided in UNGUIDED:
        for down_dims in (SMALL, PAPER):
            for batch_size in BATCH_SIZES:
                yield from _measure_on("cpu", guided, down_dims, batch_size)
                if torch.cuda.is_available():
                    yield from _measure_on("cuda", guided, down_dims, batch_size)


def _measure_on(device: str, guided: str, down_dims: tuple[int, ...], batch_size: int) -> Iterator[Row]:
    unguided = UNGUIDED[guided]
    worst = f"{guided}, all unsafe"
    case = f"{NAMES[down_dims]}, batch {batch_size}"
    calls = {name: make_planner(name, down_dims, batch_size, device) for name in (unguided, guided)}
    calls[worst] = _make_worst(guided, down_dims, batch_size, device)
    for name in (guided, worst):
        yield _row(case, f"unsafe actions of {name}", 100 * _unsafe_share(calls[name]), "%")
    is_long = device == "cpu" and (down_dims, batch_size) == LONG_CALL
    for n_threads in CPU_THREADS if device == "cpu" else (0,):
        with threads(n_threads or 1), torch.inference_mode():
            times = time_in_turns(calls, N_LONG_ROUNDS if is_long else N_ROUNDS, MIN_SECONDS)
        for name, seconds in times.items():
            yield _row(case, f"chunk of {name}", 1000 * median(seconds), "ms", threads=n_threads)
        target = TARGETS[down_dims]
        yield _row(
            case, f"{guided} / {unguided}", ratio(times, guided, unguided), threads=n_threads, target=target
        )
        yield _row(case, f"{worst} / {unguided}", ratio(times, worst, unguided), threads=n_threads)


def _row(case: str, quantity: str, value: float, unit: str = "x", **options: Any) -> Row:
    return Row("guidance", case, quantity, value, unit, **options)


def _make_worst(guided: str, down_dims: tuple[int, ...], batch_size: int, device: str) -> Planner:
    """Plans a chunk that begins, stays and ends between the demonstrations."""
    planner = make_planner(guided, down_dims, batch_size, device, guidance_scale=TOO_WEAK)
    generator = torch.Generator().manual_seed(0)
    spread = (2 * torch.rand(50 * batch_size * HORIZON, 2, generator=generator) - 1).to(device)
    unsafe = spread[_is_unsafe(_field_of(planner), spread)]
    actions = unsafe[: batch_size * HORIZON].reshape(batch_size, HORIZON, 2)
    # What the network says leaves the actions where they are: no velocity, or, for diffusion, the clean sample itself.
    is_flow = guided == "pf2mp"
    replay(planner, [torch.zeros_like(actions) if is_flow else actions])
    return replace(planner, noise=actions)


def _unsafe_share(planner: Planner) -> float:
    """The share of a planned chunk's actions that lie outside the safe set."""
    with torch.inference_mode():
        return _is_unsafe(_field_of(planner), planner()).float().mean().item()


def _is_unsafe(field: PotentialField, actions: torch.Tensor) -> torch.Tensor:
    return field.log_density(actions) <= field.log_threshold


def _field_of(planner: Planner) -> PotentialField:
    return fitted_field(planner.batch[POTENTIAL_FIELD], planner.policy.config, planner.noise.device)
