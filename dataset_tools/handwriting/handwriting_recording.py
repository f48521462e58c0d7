# SPDX-License-Identifier: Apache-2.0
"""Reads recorded handwriting: joint positions or positions of a pen, with times.

| source | holds |
|---|---|
| CSV or TSV file | columns for the time [s], optionally the episode, and either seven joints [rad], optionally with two fingers [m], or ``x`` and ``y`` of the pen [m], optionally with its height ``z``; see `recorded_names` for their names |
| JSON file | ``{"episodes": [{"time": [...], "joints": [[7 or 9 positions], ...]}, ...]}``, or ``"pen": [[x, y], ...]`` instead |
| JSON lines | such an episode in each line, or a sample ``{"time": 0.1, "x": 0.5, "y": 0.1}`` with the columns of a CSV file |
| SVC or JSON file of a tablet | x, y, time and pen status of each sample; see `recorded_tablet` |
| MATLAB file | LASA's ``demos`` or the Panda symbols' ``symbol_data``; see `recorded_matlab` |
| zip file, folder or text file of Omniglot | drawings of a character; see `recorded_omniglot` |
| folder of a LeRobotDataset | actions of 7 joints, or of 7 joints and 2 fingers, as absolute positions, in any order if they have names |

Joint angles are those of the model in `lerobot_pf2mp.envs.handwriting.panda`. Its sixth and seventh joint are at 0 where those of a
real Panda are at pi/2 and pi/4. Positions of the pen are in the frame of the arm's base, except those of tablets, of MATLAB
files and of Omniglot, which come from another sheet. Times may have any unit, because a demonstration has no duration.

A demonstration is one stroke. Where the pen's height or state was recorded, the samples before it is put down and after it is
lifted for the last time are left out. An episode in which it is lifted in between is left out, because the way through the air
would become ink, or its strokes become demonstrations; see `StrokeChoice`.
"""  # noqa: E501

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lerobot_pf2mp.dataset_tools.handwriting.recorded_episode import (
    LeftOutError,
    RecordedEpisode,
    Recording,
)
from lerobot_pf2mp.dataset_tools.handwriting.recording_formats import read_recording
from lerobot_pf2mp.dataset_tools.handwriting.recording_frame import RecordingFrame
from lerobot_pf2mp.dataset_tools.handwriting.written_strokes import StrokeChoice
from lerobot_pf2mp.envs.handwriting.ink import INK_HEIGHT
from lerobot_pf2mp.envs.handwriting.panda import N_ARM_JOINTS

_MIN_SAMPLES = 3


@dataclass(frozen=True)
class HandwritingRecording:
    """One recorded episode.

    Args:
        times: ``(N,)``, increasing, in any unit.
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
            raise LeftOutError(
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
            raise LeftOutError(
                "whose times do not increase",
                f"times must increase, got {then:g} after {before:g} in row {row} of {self.name}",
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
    scale: float | None = None,
    place: Sequence[float] | None = None,
    strokes: str = "one",
    character: str | None = None,
    left_out: Counter[str] | None = None,
    tell: Callable[[str], None] = lambda line: None,
) -> list[HandwritingRecording]:
    """Reads the recorded episodes.

    Args:
        path: One of the sources in the docstring of this module.
        joint_offsets: As for `RecordingFrame`.
        scale: As for `RecordingFrame`; None is what the format says.
        place: As for `RecordingFrame`; None puts what was recorded on another sheet in the middle of the arm's.
        strokes: As for `StrokeChoice`.
        character: As for `read_recording`.
        left_out: Counts the episodes that are left out, by reason: their times do not increase, they are too short, or the
            pen is lifted.
        tell: Gets a line for each unit and place that was not given but follows from the recording.

    Raises:
        FileNotFoundError: If there is no such file or folder.
        ValueError: If it has another layout, or no episode is usable.
    """
    path = path.expanduser()
    if not path.exists():
        raise FileNotFoundError(f"source.path must be a file or folder, got {path}, which does not exist")
    frame, choice = RecordingFrame(joint_offsets, scale, place), StrokeChoice(strokes)
    recorded = read_recording(path, character)
    are_joints = [each.values.shape[1] >= N_ARM_JOINTS for each in recorded.episodes]
    if recorded.episodes:
        frame.check_used(any(are_joints), not all(are_joints), path)
    if scale is None and recorded.scale is not None:
        frame = replace(frame, scale=recorded.scale)
        tell(f"{path} is read in {recorded.unit}: --source.scale={recorded.scale:.6g}")
    recordings: list[HandwritingRecording] = []
    faults = list(_read(recorded, frame, choice, path, recordings))
    if not recordings:
        raise ValueError(
            f"{path} must hold at least one episode, got none{' that is usable' if faults else ''}{_why(faults)}"
        )
    if place is None and recorded.is_of_another_sheet:
        frame = frame.centred(np.concatenate([each.values for each in recordings]))
        tell(
            f"{path} is put in the middle of the sheet: --source.place={list(frame.place or ())}".replace(
                ", ", ","
            )
        )
    if left_out is not None:
        left_out.update(fault.reason for fault in faults)
    return [_in_frame(each, frame) for each in recordings]


def _why(faults: Sequence[LeftOutError]) -> str:
    """What is wrong with the first episode, and if there are several, how many are left out for which reason."""
    if len(faults) < 2:
        return f": {faults[0]}" if faults else ""
    reasons = Counter(fault.reason for fault in faults)
    return f" ({', '.join(f'{number} {reason}' for reason, number in reasons.items())}): {faults[0]}"


def _read(
    recorded: Recording,
    frame: RecordingFrame,
    choice: StrokeChoice,
    path: Path,
    found: list[HandwritingRecording],
) -> Iterator[LeftOutError]:
    """Appends the chosen strokes to those found, in the unit of the recording; yields why others are left out."""
    for episode in recorded.episodes:
        name = f"{episode.name} of {path}"
        try:
            whole = HandwritingRecording(episode.times, episode.values, name)
            strokes = choice.of(*_pen_states(episode, frame), name)
        except LeftOutError as fault:
            yield fault
            continue
        for stroke, rows in strokes:
            try:
                found.append(HandwritingRecording(whole.times[rows], whole.values[rows], stroke))
            except LeftOutError as fault:
                yield fault


def _pen_states(episode: RecordedEpisode, frame: RecordingFrame) -> tuple[np.ndarray, np.ndarray]:
    """``(N,)`` whether the pen is down, and whether a new stroke begins without a sample in the air before it."""
    is_down = np.ones(len(episode.values), bool)
    if episode.heights is not None:
        is_down &= frame.metres(episode.heights) <= INK_HEIGHT
    if episode.is_down is not None:
        is_down &= episode.is_down
    is_new = np.zeros(len(episode.values), bool)
    is_new[list(episode.new_strokes)] = True
    return is_down, is_new


def _in_frame(recording: HandwritingRecording, frame: RecordingFrame) -> HandwritingRecording:
    is_of_joints = recording.values.shape[1] >= N_ARM_JOINTS
    to_frame = frame.of_joints if is_of_joints else frame.of_pen
    return replace(recording, values=to_frame(recording.values))
