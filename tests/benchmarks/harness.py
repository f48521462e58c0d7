# SPDX-License-Identifier: Apache-2.0
"""How speed is measured: side by side, in turns, and as medians."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from statistics import median

import numpy as np
import torch


@dataclass(frozen=True)
class Row:
    """One measured number.

    Args:
        part: The part of the suite, for example guidance.
        case: What was measured, with its sizes.
        quantity: What the number says, for example "pf2mp / fmp".
        value: The number.
        unit: Its unit; x for a ratio.
        threads: Threads that torch used; 0 where a GPU did the work.
        target: What is wanted; None where nothing is.
        at_least: Whether the target is a lower bound; otherwise an upper one.
    """

    part: str
    case: str
    quantity: str
    value: float
    unit: str
    threads: int = 1
    target: float | None = None
    at_least: bool = False

    @property
    def verdict(self) -> str:
        """Met or missed; empty without a target."""
        if self.target is None:
            return ""
        is_met = self.value >= self.target if self.at_least else self.value <= self.target
        return "met" if is_met else "missed"


def time_in_turns(
    calls: Mapping[str, Callable[[], object]], n_rounds: int = 15, min_seconds: float = 0.02
) -> dict[str, list[float]]:
    """Times calls side by side, so that whatever slows the machine slows them alike.

    Args:
        calls: What to time, by name.
        n_rounds: In each round every call has its turn, and every round begins with another one.
        min_seconds: A turn repeats a call until this long has passed.

    Returns:
        For each name the time of a call in every round [s].
    """
    names = list(calls)
    n_calls = {name: max(1, round(min_seconds / _warm_seconds(calls[name], min_seconds))) for name in names}
    times: dict[str, list[float]] = {name: [] for name in names}
    for round_number in range(n_rounds):
        first = round_number % len(names)
        for name in names[first:] + names[:first]:
            times[name].append(_seconds(calls[name], n_calls[name]))
    return times


def ratio(times: Mapping[str, Sequence[float]], name: str, to: str) -> float:
    """The median over rounds of how much longer one call took than another one."""
    return median(one / other for one, other in zip(times[name], times[to], strict=True))


def growth_exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """The exponent k of the power law costs ~ sizes^k, by least squares on logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


@contextmanager
def threads(n_threads: int) -> Iterator[None]:
    """Has torch use this many threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(n_threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def synchronise() -> None:
    """Waits for the GPU, if there is one."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def _warm_seconds(call: Callable[[], object], enough: float) -> float:
    """The time of a second call; of the first one, if it took long."""
    first = _seconds(call, 1)
    return first if first > 10 * enough else max(_seconds(call, 1), 1e-9)


def _seconds(call: Callable[[], object], n_calls: int) -> float:
    synchronise()
    start = time.perf_counter()
    for _ in range(n_calls):
        call()
    synchronise()
    return (time.perf_counter() - start) / n_calls
