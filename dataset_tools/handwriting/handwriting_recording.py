# SPDX-License-Identifier: Apache-2.0
"""Reads recorded handwriting: joint positions or positions of a pen, with times.

| source | holds |
|---|---|
| CSV or TSV file | columns for the time [s], optionally the episode, and either seven joints [rad], optionally with two fingers [m], or ``x`` and ``y`` of the pen [m], optionally with its height ``z``; see `recorded_names` for their names |
| JSON file | ``{"episodes": [{"time": [...], "joints": [[7 or 9 positions], ...]}, ...]}``, or ``"pen": [[x, y], ...]`` instead |
| JSON lines | such an episode in each line, or a sample ``{"time": 0.1, "x": 0.5, "y": 0.1}`` with the columns of a CSV file |
| folder of a LeRobotDataset | actions of 7 joints, or of 7 joints and 2 fingers, as absolute positions, in any order if they have names |

Joint angles are those of the model in `lerobot_pf2mp.envs.handwriting.panda`. Its sixth and seventh joint are at 0 where those of a
real Panda are at pi/2 and pi/4. Positions of the pen are in the frame of the arm's base.

A demonstration is one stroke. Where the pen's height or state was recorded, the samples before it is put down and after it is
lifted for the last time are left out. An episode in which it is lifted in between is left out, because the way through the air
would become ink.
"""  # noqa: E501

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lerobot_pf2mp.dataset_tools.handwriting.recorded_dataset import read_dataset
from lerobot_pf2mp.dataset_tools.handwriting.recorded_episode import RecordedEpisode
from lerobot_pf2mp.dataset_tools.handwriting.recorded_json import read_json, read_json_lines
from lerobot_pf2mp.dataset_tools.handwriting.recorded_table import read_table
from lerobot_pf2mp.dataset_tools.handwriting.recording_frame import RecordingFrame
from lerobot_pf2mp.envs.handwriting.ink import INK_HEIGHT
from lerobot_pf2mp.envs.handwriting.panda import N_ARM_JOINTS

_MIN_SAMPLES = 3
_READERS = {".csv": read_table, ".tsv": read_table, ".json": read_json, ".jsonl": read_json_lines}


class _LeftOutError(ValueError):
    """An episode is left out, for a short reason; the message says more."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


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
        n_times, n_samples = len(self.times), len(self.values)
        if n_times != n_samples or n_times < _MIN_SAMPLES:
            raise _LeftOutError(
                f"shorter than {_MIN_SAMPLES} samples"
                if n_times == n_samples
                else "with another number of times",
                f"{self.name} must have at least {_MIN_SAMPLES} samples, each with a time, got {n_times} times and "
                f"{n_samples} samples",
            )
        for what, numbers in (("times", self.times), ("positions", self.values)):
            if not np.isfinite(numbers).all():
                row = int(np.argwhere(~np.isfinite(numbers))[0][0])
                raise ValueError(f"{what} must be finite, got NaN or infinity in row {row} of {self.name}")
        if (np.diff(self.times) <= 0).any():
            row = int(np.flatnonzero(np.diff(self.times) <= 0)[0]) + 1
            before, then = self.times[row - 1 : row + 1]
            raise _LeftOutError(
                "whose times do not increase",
                f"times must increase, got {then:g} s after {before:g} s in row {row} of {self.name}",
            )

    def resampled(self, n_steps: int) -> np.ndarray:
        """``(n_steps + 1, 9 or 2)`` positions at equal time intervals, by linear interpolation."""
        at = np.linspace(self.times[0], self.times[-1], n_steps + 1)
        columns = [np.interp(at, self.times, column) for column in self.values.T]
        return np.stack(columns, axis=1)


def read_handwriting(
    path: Path,
    joint_offsets: Sequence[float] = (),
    *,
    scale: float = 1.0,
    place: Sequence[float] | None = None,
    left_out: Counter[str] | None = None,
) -> list[HandwritingRecording]:
    """Reads the recorded episodes.

    Args:
        path: One of the sources in the docstring of this module.
        joint_offsets: As for `RecordingFrame`.
        scale: As for `RecordingFrame`.
        place: As for `RecordingFrame`.
        left_out: Counts the episodes that are left out, by reason: their times do not increase, they are too short, or the
            pen is lifted.

    Raises:
        FileNotFoundError: If there is no such file or folder.
        ValueError: If it has another layout, or no episode is usable.
    """
    path = path.expanduser()
    if not path.exists():
        raise FileNotFoundError(f"source.path must be a file or folder, got {path}, which does not exist")
    frame = RecordingFrame(joint_offsets, scale, place)
    if not path.is_dir() and path.suffix.lower() not in _READERS:
        raise ValueError(
            f"a recording must be a .csv or .json file or a LeRobotDataset's folder, or a .tsv or .jsonl file, got {path}"
        )
    episodes = read_dataset(path) if path.is_dir() else _READERS[path.suffix.lower()](path)
    are_joints = [each.values.shape[1] >= N_ARM_JOINTS for each in episodes]
    if episodes:
        frame.check_used(any(are_joints), not all(are_joints), path)
    recordings, faults = [], []
    for episode in episodes:
        try:
            recordings.append(_recording(episode, frame, path))
        except _LeftOutError as fault:
            faults.append(fault)
    if not recordings:
        reason = f": {faults[0]}" if faults else ""
        raise ValueError(
            f"{path} must hold at least one episode, got none{' that is usable' if faults else ''}{reason}"
        )
    if left_out is not None:
        left_out.update(fault.reason for fault in faults)
    return recordings


def _recording(episode: RecordedEpisode, frame: RecordingFrame, path: Path) -> HandwritingRecording:
    name = f"{episode.name} of {path}"
    is_of_joints = episode.values.shape[1] >= N_ARM_JOINTS
    values = frame.of_joints(episode.values) if is_of_joints else frame.of_pen(episode.values)
    recording = HandwritingRecording(episode.times, values, name)
    is_down = np.ones(len(values), bool)
    if episode.heights is not None:
        is_down &= frame.scale * episode.heights <= INK_HEIGHT
    if episode.is_down is not None:
        is_down &= episode.is_down
    if is_down.all():
        return recording
    written = _only_stroke(is_down, name)
    return HandwritingRecording(recording.times[written], values[written], name)


def _only_stroke(is_down: np.ndarray, name: str) -> slice:
    """The samples between which the pen stays down."""
    rows = np.flatnonzero(is_down)
    if not len(rows):
        raise _LeftOutError(
            "with the pen off the table", f"the pen must be down in {name}, got it up in each row"
        )
    stroke = slice(rows[0], rows[-1] + 1)
    if not is_down[stroke].all():
        row = rows[0] + int(np.argmin(is_down[stroke]))
        raise _LeftOutError(
            "with the pen lifted in between",
            f"a demonstration must be one stroke, got the pen lifted in row {row} of {name} and put down again",
        )
    return stroke
