# SPDX-License-Identifier: Apache-2.0
"""Intervals for rates of rare events."""

from __future__ import annotations

from dataclasses import dataclass

from scipy.stats import binomtest


@dataclass(frozen=True)
class Rate:
    """The rate of an event, with its 95 % Wilson interval (Wilson, 1927).

    Args:
        count: Number of events.
        total: Number of trials, at least 1.
    """

    count: int
    total: int

    @property
    def value(self) -> float:
        """The fraction of trials with the event."""
        return self.count / self.total

    @property
    def interval(self) -> tuple[float, float]:
        """The lower and upper end of the interval."""
        ends = binomtest(self.count, self.total).proportion_ci(0.95, method="wilson")
        return float(ends.low), float(ends.high)

    def __str__(self) -> str:
        low, high = self.interval
        return f"{100 * self.value:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"
