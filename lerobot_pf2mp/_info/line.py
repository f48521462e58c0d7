# SPDX-License-Identifier: Apache-2.0
"""One line of the report."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from .probes import said_by

OK = "ok"
OPTIONAL = "optional"  # not here, and needed only for what the line says
PROBLEM = "problem"  # something essential is wrong


@dataclass(frozen=True)
class Line:
    """One line of the report.

    Args:
        name: What it is about.
        value: What was found.
        status: `OK`, `OPTIONAL` or `PROBLEM`.
        remedy: What is wrong and what to do, if anything.
    """

    name: str
    value: str
    status: str = OK
    remedy: str = ""


def line_or_reason(name: str, make: Callable[[], Line]) -> Line:
    """The line, or one that says why it could not be made."""
    try:
        return make()
    except Exception as error:
        return Line(name, "not known", PROBLEM, said_by(error))
