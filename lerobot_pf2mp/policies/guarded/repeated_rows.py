# SPDX-License-Identifier: Apache-2.0
"""Some robots of a batch, each several times, for a policy that is asked for more plans of theirs."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from lerobot.utils.constants import ACTION
from torch import Tensor


def repeated_rows(values: dict[str, Any], rows: Tensor, n_each: int, n_robots: int) -> dict[str, Any]:
    """The values of some robots of a batch, those of a robot one after the other.

    Args:
        values: Tensors ``(B, ...)`` and lists of B by key. Others, also None and tensors of other sizes, stay as they are.
        rows: ``(F,)`` the robots.
        n_each: How often each of them is repeated.
        n_robots: B.

    Returns:
        The same keys, with tensors ``(F n_each, ...)`` and lists of F n_each.
    """
    repeated = dict(values)
    for key, value in values.items():
        if isinstance(value, Tensor) and value.ndim and len(value) == n_robots:
            repeated[key] = value[rows.to(value.device)].repeat_interleave(n_each, dim=0)
        elif isinstance(value, list) and len(value) == n_robots:
            repeated[key] = [value[row] for row in rows.tolist() for _ in range(n_each)]
    return repeated


@contextmanager
def repeated_queues(policy: Any, rows: Tensor, n_each: int, n_robots: int) -> Iterator[None]:
    """A block in which a policy's queues of past observations are those of some robots. Arguments as above.

    Args:
        policy: A policy that may have queues, as LeRobot's do, in ``_queues``. They are unchanged after the block.
        rows: As for `repeated_rows`, like the other arguments.
        n_each: As there.
        n_robots: As there.
    """
    queues = getattr(policy, "_queues", None)
    if not isinstance(queues, dict):
        yield
        return
    policy._queues = {
        key: deque(
            ()
            if key == ACTION
            else (repeated_rows({"": frame}, rows, n_each, n_robots)[""] for frame in queue),
            maxlen=queue.maxlen,
        )
        for key, queue in queues.items()
    }
    try:
        yield
    finally:
        policy._queues = queues
