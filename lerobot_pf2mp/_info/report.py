# SPDX-License-Identifier: Apache-2.0
"""The report: all lines, as text and as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from functools import partial

from .line import PROBLEM, Line, line_or_reason
from .probes import message_of
from .trials import LINES, train_line, trial_line
from .versions import EXTRAS, PACKAGES, extra_line, package_line, python_line, ranges

# Width of a value in the table [characters], for nearly all of them. It is not measured, so that no line waits for others.
_VALUE_WIDTH = 34


def gather(seconds: float) -> Iterator[Line]:
    """Makes the lines of the report, each as soon as it is known. A line that cannot be made contains the reason.

    Args:
        seconds: Largest duration of each trial [s].
    """
    with ThreadPoolExecutor() as pool:
        trials = [pool.submit(line_or_reason, name, partial(trial_line, name, seconds)) for name in LINES]
        yield from _version_lines()
        yield line_or_reason("lerobot-train", train_line)
        yield from (trial.result() for trial in trials)


def is_well(lines: Sequence[Line]) -> bool:
    """Whether no line names a problem."""
    return all(line.status != PROBLEM for line in lines)


def as_row(line: Line) -> str:
    """A line of the report as a row of a table, with the remedy at its end."""
    name_width = max(map(len, (*PACKAGES, *EXTRAS, *LINES)))
    remedy = f": {line.remedy}" if line.remedy else ""
    return f"{line.name:{name_width}}  {line.value:{_VALUE_WIDTH}}  {line.status}{remedy}"


def verdict(lines: Sequence[Line]) -> str:
    """The last row: how many lines name a problem."""
    n_problems = sum(line.status == PROBLEM for line in lines)
    return f"{n_problems} of {len(lines)} lines name a problem." if n_problems else "No problem found."


def as_json(lines: Sequence[Line]) -> str:
    """The report as JSON, for programs and issue reports."""
    return json.dumps({"ok": is_well(lines), "lines": [asdict(line) for line in lines]}, indent=2)


def _version_lines() -> Iterator[Line]:
    """The lines of the packages, and those of the extras."""
    try:
        wanted = ranges()
    except Exception as error:
        wanted = {}
        yield Line("version ranges", "not checked", PROBLEM, message_of(error))
    yield line_or_reason("python", lambda: python_line(wanted.get("python")))
    for name in PACKAGES:
        yield line_or_reason(name, partial(package_line, name, wanted.get(name)))
    for purpose, (package, _, _) in EXTRAS.items():
        yield line_or_reason(purpose, partial(extra_line, purpose, wanted.get(package)))
