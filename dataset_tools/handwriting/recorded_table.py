# SPDX-License-Identifier: Apache-2.0
"""Reads recorded handwriting from text files with a table: CSV, TSV, and JSON lines with one sample each."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from lerobot_pf2mp.dataset_tools.handwriting.recorded_episode import RecordedEpisode, Recording
from lerobot_pf2mp.dataset_tools.handwriting.recorded_names import (
    ARM,
    ARM_AND_FINGERS,
    PEN,
    PEN_STATES,
    are_poses,
    length_unit,
    meanings,
    other_data,
)

_SEPARATORS = ",;\t"
_SEP = re.compile(r'"?sep=([,;\t|])"?', re.IGNORECASE)  # a first line of Excel's
_TRUE, _FALSE = ("true", "yes", "down"), ("false", "no", "up")

_Row = tuple[int, Sequence[str]]  # the number of its line in the file, and its cells


def read_table(path: Path) -> Recording:
    """Reads a CSV or TSV file.

    Columns are separated by commas, semicolons or tabs, whichever the header holds most of, or by what a first line ``sep=``
    says. Numbers may have a decimal comma. Empty lines are skipped.

    Args:
        path: The file, in UTF-8 with or without a mark at its beginning.

    Raises:
        ValueError: If it has another layout.
    """
    try:
        rows = _rows(path.read_text(encoding="utf-8-sig"))
        _, header = next(rows, (1, []))
        return Recording(episodes_of(header, list(rows), path), *_length_unit(header, path))
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} must be a CSV file in UTF-8, got {error}") from error


def _length_unit(header: Sequence[str], path: Path) -> tuple[float | None, str]:
    try:
        return length_unit(header)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _number(cell: str) -> float:
    """The number in a cell; its decimal point may be a comma."""
    return float(cell.replace(",", ".") if cell.count(",") == 1 and "." not in cell else cell)


def _truth(cell: str) -> float:
    lower = cell.lower()
    return float(lower in _TRUE) if lower in _TRUE or lower in _FALSE else _number(cell)


def episodes_of(header: Sequence[str], rows: Sequence[_Row], path: Path) -> list[RecordedEpisode]:
    """The episodes of a table, in the order of their first rows.

    Args:
        header: The names of the columns.
        rows: The number of each row's line in the file, and its cells.
        path: The file, for error messages.

    Raises:
        ValueError: If columns are missing or cells hold no numbers.
    """
    found = meanings(header)
    names = _value_columns(header, found, path)
    for number, (line, cells) in enumerate(rows):
        if len(cells) > len(header) and any(cells[len(header) :]):
            raise ValueError(
                f"{path} must have as many cells in each row as columns, {len(header)}, got {len(cells)} in row {number} "
                f"(line {line}); decimal commas need another separator, for example semicolons"
            )

    def column(name: str, number_of: Callable[[str], float] = _number) -> np.ndarray:
        return _column(rows, found.index(name), header[found.index(name)], number_of, path)

    times, values = column("time"), np.stack([column(name) for name in names], axis=1)
    heights = column("z") if names == PEN and "z" in found else None
    is_down = _is_down(found, column)
    of_label: dict[str, list[int]] = {}
    for number, (line, cells) in enumerate(rows):
        label = _cell(cells, found.index("episode")) if "episode" in found else "0"
        if not label:
            raise ValueError(
                f"{path} must name the episode of each row, got none in row {number} (line {line})"
            )
        of_label.setdefault(label, []).append(number)
    return [
        RecordedEpisode(
            f"episode {label}",
            times[mine],
            values[mine],
            None if heights is None else heights[mine],
            None if is_down is None else is_down[mine],
        )
        for label, mine in of_label.items()
    ]


def _rows(text: str) -> Iterator[_Row]:
    """The rows of a table that are not empty, the header first."""
    first, _, rest = text.partition("\n")
    told = _SEP.fullmatch(first)
    if told:
        text, separator = rest, told[1]
    else:
        header = next((line for line in text.splitlines() if line.strip(_SEPARATORS + " ")), "")
        separator = max(_SEPARATORS, key=header.count)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
    for row in reader:
        cells = [cell.strip() for cell in row]
        if any(cells):
            yield reader.line_num + bool(told), cells


def _value_columns(header: Sequence[str], found: Sequence[str | None], path: Path) -> tuple[str, ...]:
    choices = (ARM_AND_FINGERS, ARM) if are_poses(header) else (ARM_AND_FINGERS, ARM, PEN)
    for choice in choices:
        if "time" in found and set(choice) <= set(found):
            twice = [name for name in choice if found.count(name) > 1]
            if twice:
                raise ValueError(f"{path} must have one column for {twice[0]}, got several: {list(header)}")
            return choice
    other = other_data(header)
    raise ValueError(
        f"{path} must have a column time and {ARM[0]} to {ARM[-1]}, or x and y; got {list(header)}"
        f"{f': {other}' if other else ''}"
    )


def _column(
    rows: Sequence[_Row], index: int, name: str, number_of: Callable[[str], float], path: Path
) -> np.ndarray:
    numbers = np.empty(len(rows))
    for number, (line, cells) in enumerate(rows):
        cell = _cell(cells, index)
        try:
            numbers[number] = number_of(cell)
        except ValueError as error:
            raise ValueError(
                f"{path} must hold a number in each column of each row: got {cell!r:.40} as {name} in row {number} "
                f"(line {line})"
            ) from error
    return numbers


def _cell(cells: Sequence[str], index: int) -> str:
    return cells[index] if index < len(cells) else ""


def _is_down(found: Sequence[str | None], column: Callable[..., np.ndarray]) -> np.ndarray | None:
    """Whether the pen writes, by all columns that say so; None if there is none."""
    states = [
        column(name, _truth) <= 0 if name == "pen_up" else column(name, _truth) > 0
        for name in PEN_STATES
        if name in found
    ]
    return np.all(states, axis=0) if states else None
