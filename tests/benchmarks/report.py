# SPDX-License-Identifier: Apache-2.0
"""Where the numbers of the benchmark suite go: CSV, a table, and what they were measured with."""

from __future__ import annotations

import csv
import json
import os
import platform
from collections.abc import Iterable, Sequence
from dataclasses import asdict, fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch
from harness import Row

from lerobot_pf2mp.process.atomic_files import file_written_beside

PACKAGES = (
    "torch",
    "lerobot",
    "diffusers",
    "transformers",
    "numpy",
    "scipy",
    "scikit-learn",
    "torch-kde",
    "pykeops",
    "pyarrow",
)
_COLUMNS = [field.name for field in fields(Row)]


def read_rows(path: Path) -> list[Row]:
    """The rows of a CSV file, none if there is no such file."""
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return [
            Row(
                record["part"],
                record["case"],
                record["quantity"],
                float(record["value"]),
                record["unit"],
                int(record["threads"]),
                float(record["target"]) if record["target"] else None,
                record["at_least"] == "True",
            )
            for record in csv.DictReader(file)
        ]


def write_report(folder: Path, rows: Iterable[Row]) -> list[Row]:
    """Writes ``bench.csv``, ``table.md``, ``overview.md`` and ``run.json``; other parts that the folder holds already stay.

    Returns:
        All rows of the folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    new = list(rows)
    parts = {row.part for row in new}
    kept = [row for row in read_rows(folder / "bench.csv") if row.part not in parts]
    every = sorted(kept + new, key=lambda row: row.part)
    with (
        file_written_beside(folder / "bench.csv") as partial,
        partial.open("w", encoding="utf-8", newline="") as file,
    ):
        writer = csv.DictWriter(file, [*_COLUMNS, "verdict"])
        writer.writeheader()
        writer.writerows(
            {**asdict(row), "value": f"{row.value:.6g}", "verdict": row.verdict} for row in every
        )
    with file_written_beside(folder / "table.md") as partial:
        partial.write_text(make_table([row for row in every if row.target is not None]), encoding="utf-8")
    with file_written_beside(folder / "overview.md") as partial:
        partial.write_text(make_overview(every), encoding="utf-8")
    with file_written_beside(folder / "run.json") as partial:
        partial.write_text(json.dumps(made_with(), indent=2) + "\n", encoding="utf-8")
    return every


def make_table(rows: Sequence[Row]) -> str:
    """A markdown table of rows."""
    lines = ["| part | case | measured | value | target | verdict |", "|---|---|---|---|---|---|"]
    for row in rows:
        used = "GPU" if row.threads == 0 else f"{row.threads} thread{'s' * (row.threads > 1)}"
        bound = (
            "" if row.target is None else f"{'≥' if row.at_least else '≤'} {_number(row.target, row.unit)}"
        )
        value = _number(row.value, row.unit)
        lines.append(
            f"| {row.part} | {row.case}, {used} | {row.quantity} | {value} | {bound} | {row.verdict} |"
        )
    return "\n".join(lines) + "\n"


def make_overview(rows: Sequence[Row]) -> str:
    """A markdown table of what is wanted: a line for each wish, with its best and worst case and how many met it."""
    wishes: dict[tuple[str, str, float, bool], list[Row]] = {}
    for row in rows:
        if row.target is not None:
            quantity = (
                "ours / the fastest exact peer" if "fastest exact peer" in row.quantity else row.quantity
            )
            wishes.setdefault((row.part, quantity, row.target, row.at_least), []).append(row)
    lines = ["| part | measured | target | best | worst | met |", "|---|---|---|---|---|---|"]
    for (part, quantity, target, at_least), cases in wishes.items():
        best, *_, worst = sorted(cases * 2, key=lambda row: row.value, reverse=at_least)
        numbers = (_number(row.value, row.unit) for row in (best, worst))
        n_met = sum(row.verdict == "met" for row in cases)
        bound = f"{'≥' if at_least else '≤'} {_number(target, cases[0].unit)}"
        lines.append(f"| {part} | {quantity} | {bound} | {' | '.join(numbers)} | {n_met} of {len(cases)} |")
    return "\n".join(lines) + "\n"


def made_with() -> dict[str, str]:
    """Versions and hardware."""
    found = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    machine = f"{platform.machine()}, {os.cpu_count()} cores"
    if torch.cuda.is_available():
        machine += f", {torch.cuda.get_device_name()}"
    return {**found, "python": platform.python_version(), "machine": machine, "cpu": _cpu()}


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), "")


def _number(value: float, unit: str) -> str:
    if unit == "x":
        return f"{value:.3g}"
    return f"{value:,.0f} {unit}" if abs(value) >= 1000 else f"{value:.3g} {unit}"
