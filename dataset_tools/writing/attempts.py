# SPDX-License-Identifier: Apache-2.0
"""Sorts an expert's attempts into demonstrations and failures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator

# With fewer successes in its first attempts, an expert would need too long.
_N_FIRST_ATTEMPTS, _MIN_SUCCESSES = 200, 4


def successful[T](attempts: Iterable[T | str], failed: Counter[str]) -> Iterator[T]:
    """The attempts that succeeded.

    Args:
        attempts: For each attempt its recording if it succeeded, otherwise the reason for the failure.
        failed: Counts the failures, by reason.

    Raises:
        ValueError: If almost none of the first attempts succeeds.
    """
    for n_attempts, attempt in enumerate(attempts):
        if n_attempts == _N_FIRST_ATTEMPTS and n_attempts - failed.total() < _MIN_SUCCESSES:
            reasons = ", ".join(f"{number} {reason}" for reason, number in failed.items())
            raise ValueError(
                f"the expert must succeed in at least {_MIN_SUCCESSES} of its first {n_attempts} attempts, "
                f"got {n_attempts - failed.total()} ({reasons})"
            )
        if isinstance(attempt, str):
            failed[attempt] += 1
        else:
            yield attempt
