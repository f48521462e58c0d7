# SPDX-License-Identifier: Apache-2.0
"""The report: all lines, as text and as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from functools import partial

from .line import PROBLEM, Line, line_or_reason
from .probes import message_of
from .trials import LINES, train_line, trial_line
from .versions import EXTRAS, PACKAGES, extra_line, package_line, python_line, ranges


def gather(seconds: float) -> list[Line]:
    """Makes all lines of the report. A line that cannot be made contains the reason.

    Args:
        seconds: Largest duration of each trial [s].
    """
    with ThreadPoolExecutor() as pool:
        trials = [pool.submit(line_or_reason, name, partial(trial_line, name, seconds)) for name in LINES]
        packages, extras = _version_lines()
        train = line_or_reason("lerobot-train", train_line)
        return [*packages, train, *(trial.result() for trial in trials), *extras]


def is_well(lines: Sequence[Line]) -> bool:
    """Whether no line names a problem."""
    return all(line.status != PROBLEM for line in lines)


def as_text(lines: Sequence[Line]) -> str:
    """The report as a table. Remedies are at the ends of the lines."""
    name_width = max(len(line.name) for line in lines)
    value_width = max(len(line.value) for line in lines)
    rows = [
        f"{line.name:{name_width}}  {line.value:{value_width}}  {line.status}{line.remedy and ': '}{line.remedy}"
        for line in lines
    ]
    n_problems = sum(line.status == PROBLEM for line in lines)
    verdict = f"{n_problems} of {len(lines)} lines name a problem." if n_problems else "No problem found."
    return "\n".join([*rows, verdict])


def as_json(lines: Sequence[Line]) -> str:
    """The report as JSON, for programs and issue reports."""
    return json.dumps({"ok": is_well(lines), "lines": [asdict(line) for line in lines]}, indent=2)


def _version_lines() -> tuple[list[Line], list[Line]]:
    """The lines of the packages, and those of the extras."""
    lines = []
    try:
        wanted = ranges()
    except Exception as error:
        wanted = {}
        lines.append(Line("version ranges", "not checked", PROBLEM, message_of(error)))
    lines.append(line_or_reason("python", lambda: python_line(wanted.get("python"))))
    for name in PACKAGES:
        lines.append(line_or_reason(name, partial(package_line, name, wanted.get(name))))
    extras = [
        line_or_reason(purpose, partial(extra_line, purpose, wanted.get(package)))
        for purpose, (package, _, _) in EXTRAS.items()
    ]
    return lines, extras
