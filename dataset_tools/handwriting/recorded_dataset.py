# SPDX-License-Identifier: Apache-2.0
"""Reads recorded handwriting from the actions of a LeRobotDataset in a local folder. Videos are never looked at."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_pf2mp.dataset_tools.handwriting.recorded_episode import RecordedEpisode
from lerobot_pf2mp.dataset_tools.handwriting.recorded_names import ARM, ARM_AND_FINGERS, meanings, other_data
from lerobot_pf2mp.errors import explained

_COLUMNS = ("action", "timestamp", "episode_index")
# The fourth joint of a Panda is never above this angle [rad].
_ELBOW, _LARGEST_ELBOW = 3, -0.06


def read_dataset(path: Path) -> list[RecordedEpisode]:
    """Reads the episodes of a LeRobotDataset, whose actions are positions of joints.

    Joints are found by their names. Without names they must be in the order of the arm.

    Args:
        path: The dataset's folder.

    Raises:
        OSError, ValueError: If it cannot be read, is incomplete, or has other actions.
    """
    if not (path / "meta" / "info.json").is_file():
        raise ValueError(f"{path} must be the folder of a LeRobotDataset, got one without meta/info.json")
    with explained(f"{path} cannot be read as a LeRobotDataset"):
        info = json.loads((path / "meta" / "info.json").read_text(encoding="utf-8"))
        feature, n_frames = info["features"].get("action"), int(info["total_frames"])
        shape = tuple(feature["shape"]) if feature else ()
        names = _names(feature.get("names"), len(shape) and shape[0]) if feature else []
    order = _order(names, shape, path)
    with explained(f"{path} cannot be read as a LeRobotDataset"):
        columns = _read_columns(path, n_frames, width=shape[0])
    actions = columns["action"][:, order]
    if not names:
        _check_elbow(actions[:, _ELBOW], path)
    labels = columns["episode_index"]
    starts = np.flatnonzero(np.diff(labels)) + 1
    return [
        RecordedEpisode(f"episode {labels[rows[0]]:.0f}", columns["timestamp"][rows], actions[rows])
        for rows in np.split(np.arange(len(labels)), starts)
        if len(rows)
    ]


def _check_elbow(angles: np.ndarray, path: Path) -> None:
    if (angles > _LARGEST_ELBOW).all():
        raise ValueError(
            f"the actions of {path} must be joint positions, got numbers without names of which the fourth, the elbow, is "
            f"{angles[0]:g} rad in row 0 and always above {_LARGEST_ELBOW}: displacements or poses of an end effector?"
        )


def _names(names: Any, n: int) -> list[str]:
    """The names of the n elements of an action; none if they were not recorded."""
    if isinstance(names, dict):  # of older datasets: {"motors": [...]}
        (names,) = names.values() if len(names) == 1 else ([],)
    return [str(name) for name in names or [] if len(names) == n]


def _order(names: list[str], shape: tuple[int, ...], path: Path) -> list[int]:
    """The element of an action for each joint of the arm."""
    found = meanings(names)
    for choice in (ARM_AND_FINGERS, ARM):
        if shape == (len(choice),) and (not names or set(found) == set(choice)):
            return [found.index(name) for name in choice] if names else list(range(len(choice)))
    unknown = [name for name, meaning in zip(names, found, strict=True) if meaning not in ARM_AND_FINGERS]
    hint = other_data(names) or (f"unknown names {', '.join(unknown)}" if unknown else "")
    if shape == (len(ARM) + 1,) and not other_data(names):
        hint = f"as of seven joints and a gripper {hint}".strip()
    raise ValueError(
        f"the actions of {path} must be {len(ARM)} joint positions or {len(ARM_AND_FINGERS)} with fingers, got "
        f"{shape or None}{f': {hint}' if hint else ''}"
    )


def _read_columns(path: Path, n_frames: int, width: int) -> dict[str, np.ndarray]:
    """Actions ``(N, A)``, times ``(N,)`` [s] and numbers of episodes ``(N,)``, in order."""
    files = sorted((path / "data").rglob("*.parquet"), key=_numbers_in)
    if not files:
        raise ValueError("it holds no data/*.parquet")
    table = pa.concat_tables([pq.ParquetFile(file).read(columns=list(_COLUMNS)) for file in files])
    if not len(table) == n_frames > 0:
        raise ValueError(
            f"it must hold the {n_frames} frames of its meta/info.json, and one at least, got {len(table)}"
        )
    columns = {name: _matrix(table[name]) for name in _COLUMNS}
    if columns["action"].shape[1] != width:
        raise ValueError(f"its actions must be {width} numbers, got {columns['action'].shape[1]}")
    return {**columns, **{name: columns[name][:, 0] for name in _COLUMNS[1:]}}


def _matrix(column: pa.ChunkedArray) -> np.ndarray:
    """The numbers of a column ``(N, A)``, whether it holds lists or numbers."""
    values = column.combine_chunks()
    flat = values.flatten() if pa.types.is_nested(values.type) else values
    return np.asarray(flat.to_numpy(zero_copy_only=False), dtype=np.float64).reshape(len(column), -1)


def _numbers_in(file: Path) -> list[int]:
    """Chunk and number of a file, in whose order the frames are."""
    return [int(number) for number in re.findall(r"\d+", f"{file.parent.name} {file.name}")]
