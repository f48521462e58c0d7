# SPDX-License-Identifier: Apache-2.0
"""Intervals for rates of rare events."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Rate:
    """How often something happened, with its 95 % Wilson interval (Wilson, 1927).

    Args:
        count: Events.
        total: Trials, at least 1.
    """

    count: int
    total: int

    @property
    def value(self) -> float:
        """The share of events."""
        return self.count / self.total

    @property
    def interval(self) -> tuple[float, float]:
        """The lower and upper end of the interval."""
        z = 1.959964
        share, n = self.value, self.total
        centre = (share + z**2 / (2 * n)) / (1 + z**2 / n)
        reach = z / (1 + z**2 / n) * math.sqrt(share * (1 - share) / n + z**2 / (4 * n**2))
        return max(0.0, centre - reach), min(1.0, centre + reach)

    def __str__(self) -> str:
        low, high = self.interval
        return f"{100 * self.value:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"
