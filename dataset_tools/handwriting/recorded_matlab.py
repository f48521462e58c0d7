# SPDX-License-Identifier: Apache-2.0
"""Reads recorded handwriting from MATLAB files: LASA's shapes, and the symbols of the Panda co-manipulation dataset.

| variable | holds, for each demonstration | unit |
|---|---|---|
| ``demos`` (LASA) | a struct with ``pos`` (2, T) and ``t`` (1, T) | millimetres, seconds |
| ``symbol_data`` (Panda symbols) | a struct with ``pos`` (3, T), the arm's end effector, 1000 samples a second | metres |

Velocities, accelerations and forces are not needed. A third coordinate is a height; the lowest point is on the table.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lerobot_pf2mp.dataset_tools.handwriting.matlab_file import Unread, read_matlab_variables
from lerobot_pf2mp.dataset_tools.handwriting.recorded_episode import RecordedEpisode, Recording

_UNITS = {
    "demos": (0.001, "millimetres, as in LASA's files"),
    "symbol_data": (1.0, "metres, as in the Panda symbols"),
}
_RATE = 1000.0  # of the Panda symbols [Hz]


def read_matlab(path: Path) -> Recording:
    """Reads the demonstrations of a MATLAB file, version 7 or before. Nothing in it is executed.

    Raises:
        ValueError: If it is damaged, has another layout, or claims to hold much more than is stored.
    """
    names, values = read_matlab_variables(path, list(_UNITS))
    if len(values) != 1:
        raise ValueError(
            f"{path} must hold one of the variables {', '.join(_UNITS)}: LASA's demos with pos and t, or the Panda symbols' "
            f"symbol_data with pos; got {', '.join(names) or 'none'}"
        )
    ((variable, content),) = values.items()
    if not isinstance(content, list):
        raise ValueError(f"{variable} in {path} must be a cell or a struct, got {_kind(content)}")
    demonstrations = [each[0] if isinstance(each, list) and len(each) == 1 else each for each in content]
    scale, unit = _UNITS[variable]
    episodes = [_episode(each, f"{variable} {number}", path) for number, each in enumerate(demonstrations, 1)]
    return Recording(episodes, scale, unit, is_of_another_sheet=True)


def _episode(content: Any, name: str, path: Path) -> RecordedEpisode:
    if not isinstance(content, dict) or "pos" not in content:
        got = ", ".join(content) if isinstance(content, dict) else _kind(content)
        raise ValueError(f"{name} of {path} must be a struct with pos, got {got}")
    positions = _numbers(content["pos"], f"pos in {name} of {path}")
    if positions.ndim != 2 or len(positions) not in (2, 3):
        raise ValueError(
            f"pos in {name} of {path} must have 2 or 3 rows, x, y and z, got an array of shape {positions.shape}"
        )
    n_samples = positions.shape[1]
    times = np.arange(n_samples) / _RATE
    if "t" in content:
        times = _numbers(content["t"], f"t in {name} of {path}")
        if times.size != n_samples or times.ndim != 2 or 1 not in times.shape:
            raise ValueError(
                f"t in {name} of {path} must hold the time of each of {n_samples} positions, got an array of shape "
                f"{times.shape}"
            )
    heights = positions[2] - positions[2].min() if len(positions) == 3 and n_samples else None
    return RecordedEpisode(name, times.ravel(), positions[:2].T, heights)


def _numbers(content: Any, name: str) -> np.ndarray:
    if not isinstance(content, np.ndarray):
        raise ValueError(f"{name} must hold real numbers, got {_kind(content)}")
    return content


def _kind(content: Any) -> str:
    """What a value is, for error messages."""
    if isinstance(content, np.ndarray):
        return "an array of numbers"
    return str(content) if isinstance(content, Unread) else "a cell or a struct of another shape"
