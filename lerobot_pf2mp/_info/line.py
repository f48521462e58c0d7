# SPDX-License-Identifier: Apache-2.0
"""One line of the report."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from .probes import message_of

OK = "ok"
OPTIONAL = "optional"  # missing, but needed only for the feature that the line names
PROBLEM = "problem"  # something essential is wrong


@dataclass(frozen=True)
class Line:
    """One line of the report.

    Args:
        name: Its subject.
        value: The finding.
        status: `OK`, `OPTIONAL` or `PROBLEM`.
        remedy: The fault and how to repair it; empty without a fault.
    """

    name: str
    value: str
    status: str = OK
    remedy: str = ""


def line_or_reason(name: str, make: Callable[[], Line]) -> Line:
    """The line, or a line with the reason why it could not be made."""
    try:
        return make()
    except Exception as error:
        return Line(name, "not known", PROBLEM, message_of(error))
