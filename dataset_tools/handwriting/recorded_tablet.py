# SPDX-License-Identifier: Apache-2.0
"""Reads recorded handwriting of Wacom tablets, in the SVC and JSON layouts of the package handwriting-sample.

Both hold a value of x, y, time, pen status (0 up, 1 down), azimuth, tilt and pressure for each sample. An SVC file has their
number in its first line and a sample in each of the others; a JSON file has lists below ``"data"``. Positions are in
millimetres, or counts of the tablet, whole numbers, as many in an inch as ``"lpi"`` of a JSON file's ``"meta_data"`` says,
5080 by default. See https://github.com/BDALab/handwriting-sample.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lerobot_pf2mp.dataset_tools.handwriting.recorded_episode import RecordedEpisode, Recording

_COLUMNS = ("x", "y", "time", "pen_status", "azimuth", "tilt", "pressure")
_NEEDED = _COLUMNS[:4]
_INCH = 0.0254  # [m]
_COUNTS_PER_INCH = 5080.0


def read_svc(path: Path) -> Recording:
    """Reads the one episode of an SVC file.

    Raises:
        ValueError: If it has another layout.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} must be an SVC file in UTF-8, got {error}") from error
    rows = [(number, line.split()) for number, line in enumerate(lines, 1) if line.strip()]
    if not rows or len(rows[0][1]) != 1 or not rows[0][1][0].isdecimal():
        got = f"{lines[0]!r:.40}" if lines else "an empty file"
        raise ValueError(f"{path} must have the number of its samples in the first line, got {got}")
    n_samples = int(rows[0][1][0])
    if n_samples != len(rows) - 1:
        raise ValueError(f"{path} must hold {n_samples} samples as its first line says, got {len(rows) - 1}")
    samples = np.array([_sample(cells, line, path) for line, cells in rows[1:]]).reshape(-1, len(_COLUMNS))
    return _recording(dict(zip(_COLUMNS, samples.T, strict=True)), _COUNTS_PER_INCH, path)


def is_tablet_json(content: Any) -> bool:
    """Whether the content of a JSON file has the tablets' layout."""
    return isinstance(content, dict) and isinstance(content.get("data"), dict) and "episodes" not in content


def tablet_recording(content: dict[str, Any], path: Path) -> Recording:
    """The one episode of a JSON file.

    Raises:
        ValueError: If lists are missing, hold something else than numbers, or differ in length.
    """
    data = content["data"]
    missing = [name for name in _NEEDED if name not in data]
    if missing:
        raise ValueError(
            f"data in {path} must hold lists {', '.join(_NEEDED)}, got none of {', '.join(missing)}"
        )
    columns = {name: _numbers(data[name], name, path) for name in _NEEDED}
    n_samples = len(columns["x"])
    for name, column in columns.items():
        if len(column) != n_samples:
            raise ValueError(
                f"{name} in {path} must hold a number for each of {n_samples} samples, got {len(column)}"
            )
    about = content.get("meta_data")
    counts = about.get("lpi", _COUNTS_PER_INCH) if isinstance(about, dict) else _COUNTS_PER_INCH
    if isinstance(counts, bool) or not isinstance(counts, int | float) or not 0 < counts < 10**6:
        raise ValueError(f"lpi in {path} must be the tablet's counts in an inch, got {counts!r:.40}")
    return _recording(columns, float(counts), path)


def _recording(columns: dict[str, np.ndarray], counts_per_inch: float, path: Path) -> Recording:
    positions = np.stack([columns["x"], columns["y"]], axis=1)
    status = columns["pen_status"]
    if (unknown := ~np.isin(status, (0, 1))).any():
        row = int(unknown.argmax())
        raise ValueError(f"pen_status must be 0 or 1, got {status[row]:g} in row {row} of {path}")
    scale, unit = 0.001, "millimetres, because not all are whole numbers"
    if (positions == np.round(positions)).all():
        scale = _INCH / counts_per_inch
        unit = f"counts of a tablet with {counts_per_inch:g} in an inch, because all are whole numbers"
    episode = RecordedEpisode("the drawing", columns["time"], positions, is_down=status > 0)
    return Recording([episode], scale, unit, is_of_another_sheet=True)


def _sample(cells: list[str], line: int, path: Path) -> list[float]:
    if len(cells) != len(_COLUMNS):
        raise ValueError(
            f"{path} must hold {len(_COLUMNS)} numbers in each line, {', '.join(_COLUMNS)}, got {len(cells)} in line {line}"
        )
    try:
        return [float(cell) for cell in cells]
    except ValueError as error:
        raise ValueError(f"{path} must hold numbers, got {' '.join(cells)!r:.60} in line {line}") from error


def _numbers(content: Any, name: str, path: Path) -> np.ndarray:
    is_list = isinstance(content, list)
    for row, value in enumerate(content if is_list else ()):
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"{name} in {path} must be a list of numbers, got {value!r:.40} in row {row}")
    if not is_list:
        raise ValueError(f"{name} in {path} must be a list of numbers, got {content!r:.40}")
    return np.array([_float(value) for value in content])


def _float(value: float) -> float:
    try:
        return float(value)
    except OverflowError:  # a whole number beyond all floats; refused like infinity
        return float("inf")
