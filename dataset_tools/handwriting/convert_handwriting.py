# SPDX-License-Identifier: Apache-2.0
"""Turns recorded handwriting into demonstrations for the handwriting environments."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_pf2mp.dataset_tools.handwriting.handwriting_dataset import handwriting_spec
from lerobot_pf2mp.dataset_tools.handwriting.handwriting_recording import (
    HandwritingRecording,
    read_handwriting,
)
from lerobot_pf2mp.dataset_tools.writing.episodes import Trajectory, check_n_steps
from lerobot_pf2mp.dataset_tools.writing.write_trajectories import write_trajectories
from lerobot_pf2mp.envs.handwriting.handwriting_env import HandwritingEnv
from lerobot_pf2mp.envs.handwriting.ink import INK_HEIGHT
from lerobot_pf2mp.envs.handwriting.sheet import SHEET_SIDE
from lerobot_pf2mp.envs.handwriting.writing_scene import check_on_sheet

_MOST_FRAMES = 10**6


def convert_handwriting(
    path: Path,
    space: str,
    *,
    root: Path,
    repo_id: str,
    n_steps: int,
    scene_options: dict[str, Any],
    joint_offsets: Sequence[float] = (),
    scale: float | None = None,
    place: Sequence[float] | None = None,
    strokes: str = "one",
    character: str | None = None,
    tell: Callable[[str], None] = lambda line: None,
    n_episodes: int | None = None,
    overwrite: bool = False,
) -> tuple[int, Counter[str]]:
    """Writes the recorded episodes without collision as a LeRobotDataset.

    If the dataset is to hold positions of the pen and the recording holds joint positions, they are converted by forward
    kinematics. In the other direction inverse kinematics finds joint positions with the pen upright.

    Args:
        path: A recording, see `handwriting_recording`.
        space: ``joint`` or ``pen``: states and actions are joint positions or positions of the pen's tip.
        root: The dataset's folder.
        repo_id: Its name, ``user/name``.
        n_steps: Steps T that each episode is resampled to.
        scene_options: Arguments of `make_writing_scene`; its regions must not be entered.
        joint_offsets: As for `RecordingFrame`.
        scale: As for `read_handwriting`.
        place: As for `read_handwriting`.
        strokes: As for `StrokeChoice`.
        character: As for `read_recording`.
        tell: As for `read_handwriting`.
        n_episodes: Largest number of episodes to write; None writes all.
        overwrite: Whether an existing dataset is replaced.

    Returns:
        The number of episodes written, and the number of those left out, by reason.

    Raises:
        FileNotFoundError: If there is no such recording.
        FileExistsError: If `root` exists and `overwrite` is false.
        ValueError: If an argument breaks its rule, the recording has another layout or unit, or leaves the sheet or the
            arm's limits, or no episode is usable.
    """
    check_n_steps(n_steps)
    env = HandwritingEnv("joint", control="exact", **scene_options)
    left_out: Counter[str] = Counter()
    recordings = read_handwriting(
        path,
        joint_offsets,
        scale=scale,
        place=place,
        strokes=strokes,
        character=character,
        left_out=left_out,
        tell=tell,
    )
    _check_frames(n_steps, len(recordings) if n_episodes is None else min(n_episodes, len(recordings)))
    n_written, dropped = write_trajectories(
        _usable(path, recordings, env, space, n_steps, left_out),
        root=root,
        spec=handwriting_spec(
            space, env.arm, env.scene.name, repo_id, f"Converted from {path.name} (handwriting).", n_steps
        ),
        n_steps=n_steps,
        collides=lambda _: False,  # already checked by _usable
        n_episodes=n_episodes,
        n_expected=len(recordings),
        overwrite=overwrite,
    )
    return n_written, dropped + left_out


def _check_frames(n_steps: int, n_episodes: int) -> None:
    """Refuses what would take days: the inverse kinematics of a frame takes about a millisecond."""
    if n_steps * n_episodes > _MOST_FRAMES:
        raise ValueError(
            f"n_steps times the number of episodes must be at most {_MOST_FRAMES}, got {n_steps} x {n_episodes}: choose a "
            "smaller --n_steps or --n_episodes"
        )


def _usable(
    path: Path,
    recordings: Sequence[HandwritingRecording],
    env: HandwritingEnv,
    space: str,
    n_steps: int,
    left_out: Counter[str],
) -> Iterator[Trajectory]:
    n_usable = 0
    for recording in recordings:
        joints, positions, heights = _trajectories(recording, env, n_steps)
        if (heights > INK_HEIGHT).any():
            left_out["with the pen off the table"] += 1
        elif _collides(env, joints):
            left_out["in collision"] += 1
        else:
            if space == "pen":
                check_on_sheet(positions, f"the pen in {recording.name}")
            n_usable += 1
            yield Trajectory(joints if space == "joint" else positions)
    if not n_usable:
        reasons = ", ".join(f"{number} {reason}" for reason, number in left_out.items())
        raise ValueError(
            f"a dataset must hold at least one episode, got none that is usable in {path} (left out: {reasons})"
        )


def _trajectories(
    recording: HandwritingRecording, env: HandwritingEnv, n_steps: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Joint positions ``(T + 1, 9)`` [rad; m], and positions ``(T + 1, 2)`` and heights ``(T + 1,)`` of the pen [m]."""
    if recording.values.shape[1] == 2:
        _check_pen(recording)
        positions = recording.resampled(n_steps)
        return env.kinematics.joint_trajectory(positions), positions, np.zeros(n_steps + 1)
    env.check_joints(recording.values, f"the joints in {recording.name}")
    joints = recording.resampled(n_steps)
    tips = env.kinematics.tips(joints)
    return joints, tips[:, :2], tips[:, 2]


def _check_pen(recording: HandwritingRecording) -> None:
    """Refuses a recorded pen that leaves the sheet, and names the option that may help."""
    try:
        check_on_sheet(recording.values, f"the pen in {recording.name}")
    except ValueError as error:
        is_too_large = np.ptp(recording.values, axis=0).max() > SHEET_SIDE
        too_large = "larger than the sheet; millimetres need --source.scale=0.001"
        hint = f"it is {too_large}" if is_too_large else "--source.place moves the recording"
        raise ValueError(f"{error}; {hint}") from error


def _collides(env: HandwritingEnv, joints: np.ndarray) -> bool:
    env.reset(options={"joints": joints[0]})
    return any(env.step(target)[-1]["is_collision"] for target in joints[1:])
