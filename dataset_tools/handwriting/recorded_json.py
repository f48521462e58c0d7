# SPDX-License-Identifier: Apache-2.0
"""Reads recorded handwriting from JSON files, and from JSON lines: one episode or one sample in each line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_pf2mp.dataset_tools.handwriting.recorded_episode import RecordedEpisode
from lerobot_pf2mp.dataset_tools.handwriting.recorded_names import (
    ARM,
    ARM_AND_FINGERS,
    PEN,
    PEN_STATES,
    meanings,
)
from lerobot_pf2mp.dataset_tools.handwriting.recorded_table import episodes_of

_WIDTHS = {"joints": (len(ARM), len(ARM_AND_FINGERS)), "pen": (len(PEN), len(PEN) + 1)}
_LAYOUT = (
    'an episode must be {"time": [...], "joints": [[7 or 9 numbers], ...]} or {"time": [...], "pen": [[x, y], ...]}, '
    "got something else as"
)


def episodes_of_json(content: Any, path: Path) -> list[RecordedEpisode]:
    """The episodes of a JSON file.

    Args:
        content: What it holds.
        path: The file, for error messages.

    Raises:
        ValueError: If it has another layout.
    """
    if not isinstance(content, dict) or not isinstance(content.get("episodes"), list):
        raise ValueError(
            f'{path} must hold {{"episodes": [...]}}, or {{"data": {{"x": [...], ...}}}} of a tablet'
        )
    return [_episode(each, number, path) for number, each in enumerate(content["episodes"])]


def read_json_lines(path: Path) -> list[RecordedEpisode]:
    """Reads the episodes of a file with a JSON object in each line: an episode, or a sample ``{"time": 0.1, "x": 0.5}``.

    Raises:
        ValueError: If it has another layout.
    """
    lines = [(number, line) for number, line in enumerate(path.read_bytes().splitlines(), 1) if line.strip()]
    contents = [(number, parsed(line, f"line {number} of {path}")) for number, line in lines]
    if not contents or not all(isinstance(content, dict) for _, content in contents):
        raise ValueError(f"{path} must hold a JSON object in each line")
    header = list(contents[0][1])
    if any(isinstance(value, list) for value in contents[0][1].values()):
        return [_episode(content, number, path) for number, (_, content) in enumerate(contents)]
    rows = [(number, [str(content.get(name, "")) for name in header]) for number, content in contents]
    return episodes_of(header, rows, path)


def parsed(content: bytes, name: str) -> Any:
    """What a JSON text holds.

    Args:
        content: The text, in UTF-8 with or without a mark at its beginning.
        name: Its name, for the error message.

    Raises:
        ValueError: If it is no JSON.
    """
    try:
        return json.loads(content.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{name} must be a JSON file, got {error}") from error


def _episode(content: Any, number: int, path: Path) -> RecordedEpisode:
    name = f"episode {number}"
    if not isinstance(content, dict):
        raise ValueError(f"{_LAYOUT} {name} of {path}")
    found = zip(content, meanings(list(content)), strict=True)
    columns = {key if key in _WIDTHS else meaning: _array(content[key]) for key, meaning in found}
    kinds = [kind for kind in _WIDTHS if kind in columns]
    if len(kinds) != 1 or not {"time"} <= set(columns) <= {"time", *kinds, *PEN_STATES}:
        raise ValueError(f"{_LAYOUT} {name} of {path}: {', '.join(content) or 'nothing'}")
    times, values = columns["time"], columns[kinds[0]]
    if times.ndim != 1 or values.ndim != 2 or values.shape[1] not in _WIDTHS[kinds[0]]:
        raise ValueError(f"{_LAYOUT} {name} of {path}{_width_of(values)}")
    heights = values[:, 2] if values.shape[1] == len(PEN) + 1 else None
    is_down = _is_down(columns, len(values), f"{name} of {path}")
    return RecordedEpisode(name, times, values if heights is None else values[:, :2], heights, is_down)


def _width_of(values: np.ndarray) -> str:
    if values.ndim != 2:
        return ""
    hint = ", which may be seven joints and a gripper" if values.shape[1] == len(ARM) + 1 else ""
    return f": {values.shape[1]} numbers in a sample{hint}"


def _array(content: Any) -> np.ndarray:
    """An array of numbers; one without dimensions if it is none."""
    try:
        return np.array(content, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return np.array(np.nan)


def _is_down(columns: dict[Any, np.ndarray], n_samples: int, name: str) -> np.ndarray | None:
    """Whether the pen writes, by all lists that say so; None if there is none."""
    states = {key: columns[key] for key in PEN_STATES if key in columns}
    for key, state in states.items():
        if state.shape != (n_samples,):
            raise ValueError(
                f"{key} must hold a number for each of {n_samples} samples, got {state.shape} in {name}"
            )
    marks = [state <= 0 if key == "pen_up" else state > 0 for key, state in states.items()]
    return np.all(marks, axis=0) if marks else None
