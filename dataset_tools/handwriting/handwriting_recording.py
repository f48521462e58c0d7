# SPDX-License-Identifier: Apache-2.0
"""Reads recorded handwriting: joint positions or positions of a pen, with times.

| source | holds |
|---|---|
| CSV file | columns ``time`` [s], optionally ``episode``, and either ``joint_1`` to ``joint_7`` [rad], optionally with ``finger_1`` and ``finger_2`` [m], or ``x`` and ``y`` of the pen [m] |
| JSON file | ``{"episodes": [{"time": [...], "joints": [[7 or 9 positions], ...]}, ...]}``, or ``"pen": [[x, y], ...]`` instead |
| folder of a LeRobotDataset | actions of 7 joints, or of 7 joints and 2 fingers, as absolute positions |

Joint angles are those of the model in `lerobot_pf2mp.envs.handwriting.panda`. Its sixth and seventh joint are at 0 where those of a
real Panda are at pi/2 and pi/4. Positions of the pen are in the frame of the arm's base.
"""  # noqa: E501

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_pf2mp.envs.handwriting.panda import GRIP, JOINT_NAMES, N_ARM_JOINTS
from lerobot_pf2mp.errors import explained

_MIN_SAMPLES = 3


@dataclass(frozen=True)
class HandwritingRecording:
    """One recorded episode.

    Args:
        times: ``(N,)`` [s], increasing.
        values: ``(N, 9)`` positions of joints [rad] and fingers [m], or ``(N, 2)`` positions x, y of the pen [m].
        name: Name for error messages.

    Raises:
        ValueError: If a number is not finite, the times do not increase, or the recording is too short.
    """

    times: np.ndarray
    values: np.ndarray
    name: str

    def __post_init__(self) -> None:
        if len(self.times) != len(self.values) or len(self.times) < _MIN_SAMPLES:
            raise ValueError(
                f"{self.name} must have at least {_MIN_SAMPLES} samples, each with a time, got {len(self.times)} times "
                f"and {len(self.values)} samples"
            )
        for what, numbers in (("times", self.times), ("positions", self.values)):
            if not np.isfinite(numbers).all():
                row = int(np.argwhere(~np.isfinite(numbers))[0][0])
                raise ValueError(f"{what} must be finite, got NaN or infinity in row {row} of {self.name}")
        if (np.diff(self.times) <= 0).any():
            row = int(np.flatnonzero(np.diff(self.times) <= 0)[0]) + 1
            raise ValueError(
                f"times must increase, got {self.times[row]:g} s after {self.times[row - 1]:g} s in row {row} of {self.name}"
            )

    def resampled(self, n_steps: int) -> np.ndarray:
        """``(n_steps + 1, 9 or 2)`` positions at equal time intervals, by linear interpolation."""
        at = np.linspace(self.times[0], self.times[-1], n_steps + 1)
        columns = [np.interp(at, self.times, column) for column in self.values.T]
        return np.stack(columns, axis=1)


def read_handwriting(path: Path, joint_offsets: Sequence[float] = ()) -> list[HandwritingRecording]:
    """Reads the recorded episodes.

    Args:
        path: One of the sources in the docstring of this module.
        joint_offsets: Added to the seven joints of the recording [rad]; an empty sequence adds nothing.

    Raises:
        FileNotFoundError: If there is no such file or folder.
        ValueError: If it has another layout.
    """
    path = path.expanduser()
    if not path.exists():
        raise FileNotFoundError(f"source.path must be a file or folder, got {path}, which does not exist")
    if len(joint_offsets) not in (0, N_ARM_JOINTS) or not np.isfinite(joint_offsets).all():
        raise ValueError(
            f"joint_offsets must be {N_ARM_JOINTS} finite angles [rad], got {list(joint_offsets)}"
        )
    if path.is_dir():
        episodes = _read_dataset(path)
    elif path.suffix == ".csv":
        episodes = _read_csv(path)
    elif path.suffix == ".json":
        episodes = _read_json(path)
    else:
        raise ValueError(f"a recording must be a .csv or .json file or a LeRobotDataset's folder, got {path}")
    offsets = np.array([*joint_offsets, 0.0, 0.0] if len(joint_offsets) else np.zeros(len(JOINT_NAMES)))
    recordings = []
    for name, times, values in episodes:
        if values.shape[1] == N_ARM_JOINTS:
            values = np.column_stack([values, np.full((len(values), 2), GRIP)])
        if values.shape[1] == len(JOINT_NAMES):
            values = values + offsets
        recordings.append(HandwritingRecording(times, values, f"{name} of {path}"))
    if len(joint_offsets) and not any(each.values.shape[1] == len(JOINT_NAMES) for each in recordings):
        raise ValueError(f"joint_offsets are for recordings of joints, got one of the pen: {path}")
    if not recordings:
        raise ValueError(f"{path} must hold at least one episode, got none")
    return recordings


_Episode = tuple[str, np.ndarray, np.ndarray]


def _read_csv(path: Path) -> list[_Episode]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            columns, *lines = [[cell.strip() for cell in line] for line in csv.reader(file) if line] or [[]]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} must be a CSV file in UTF-8, got {error}") from error
    rows = [dict(zip_longest(columns, line)) for line in lines]
    names = _value_columns(columns, path)
    try:
        numbers = np.array(
            [[float(row[name]) for name in ("time", *names)] for row in rows], dtype=np.float64
        ).reshape(len(rows), 1 + len(names))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path} must hold a number in each column of each row: {error}") from error
    labels = [row["episode"] for row in rows] if "episode" in columns else ["0"] * len(rows)
    episodes = []
    for label in dict.fromkeys(labels):
        mine = np.array([each == label for each in labels])
        episodes.append((f"episode {label}", numbers[mine, 0], numbers[mine, 1:]))
    return episodes


def _value_columns(columns: list[str], path: Path) -> list[str]:
    choices = [list(JOINT_NAMES), list(JOINT_NAMES[:N_ARM_JOINTS]), ["x", "y"]]
    for choice in choices:
        if "time" in columns and set(choice) <= set(columns):
            return choice
    raise ValueError(
        f"{path} must have a column time and {JOINT_NAMES[0]} to {JOINT_NAMES[N_ARM_JOINTS - 1]}, or x and y; got {columns}"
    )


def _read_json(path: Path) -> list[_Episode]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} must be a JSON file, got {error}") from error
    if not isinstance(content, dict) or not isinstance(content.get("episodes"), list):
        raise ValueError(f'{path} must hold {{"episodes": [...]}}')
    return [_json_episode(each, number, path) for number, each in enumerate(content["episodes"])]


def _json_episode(content: Any, number: int, path: Path) -> _Episode:
    for key, widths in (("joints", (N_ARM_JOINTS, len(JOINT_NAMES))), ("pen", (2,))):
        if isinstance(content, dict) and set(content) == {"time", key}:
            try:
                times = np.array(content["time"], dtype=np.float64)
                values = np.array(content[key], dtype=np.float64)
            except (TypeError, ValueError, OverflowError):
                break
            if times.ndim == 1 and values.ndim == 2 and values.shape[1] in widths:
                return f"episode {number}", times, values
    raise ValueError(
        f'an episode must be {{"time": [...], "joints": [[7 or 9 numbers], ...]}} or {{"time": [...], "pen": '
        f"[[x, y], ...]}}, got something else as episode {number} of {path}"
    )


def _read_dataset(path: Path) -> list[_Episode]:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    if not (path / "meta" / "info.json").is_file():
        raise ValueError(f"{path} must be the folder of a LeRobotDataset, got one without meta/info.json")
    with explained(f"{path} cannot be read as a LeRobotDataset"):
        table = LeRobotDataset(f"local/{path.name}", root=path).hf_dataset.with_format("numpy")
    actions = np.asarray(table["action"][:], dtype=np.float64) if "action" in table.column_names else None
    if actions is None or actions.ndim != 2 or actions.shape[1] not in (N_ARM_JOINTS, len(JOINT_NAMES)):
        found = None if actions is None else actions.shape[1:]
        raise ValueError(
            f"the actions of {path} must be {N_ARM_JOINTS} joint positions or {len(JOINT_NAMES)} with fingers, got {found}"
        )
    times = np.asarray(table["timestamp"][:], dtype=np.float64)
    labels = np.asarray(table["episode_index"][:])
    return [
        (f"episode {label}", times[labels == label], actions[labels == label]) for label in np.unique(labels)
    ]
