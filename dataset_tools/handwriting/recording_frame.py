# SPDX-License-Identifier: Apache-2.0
"""How the numbers of a recording become joint angles of the model, and positions in the frame of the arm's base."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from numbers import Real
from pathlib import Path

import numpy as np

from lerobot_pf2mp.envs.handwriting.panda import GRIP, N_ARM_JOINTS
from lerobot_pf2mp.envs.handwriting.sheet import SHEET_CENTRE


@dataclass(frozen=True)
class RecordingFrame:
    """How the numbers of a recording become joint angles of the model and positions in the frame of the arm's base.

    Args:
        joint_offsets: Added to the seven joints of the recording [rad]; an empty sequence adds nothing.
        scale: Length of the unit in which positions of the pen were recorded [m]; None is 1 m.
        place: Where x = y = 0 of these positions lies in the frame of the arm's base, x, y [m]; None leaves it there.

    Raises:
        ValueError: If an argument breaks its rule.
    """

    joint_offsets: Sequence[float] = ()
    scale: float | None = None
    place: Sequence[float] | None = None

    def __post_init__(self) -> None:
        if len(self.joint_offsets) not in (0, N_ARM_JOINTS) or not _are_finite(self.joint_offsets):
            raise ValueError(
                f"joint_offsets must be {N_ARM_JOINTS} finite angles [rad], got {list(self.joint_offsets)}"
            )
        if self.scale is not None and (not _are_finite([self.scale]) or self.scale <= 0):
            raise ValueError(f"scale must be a finite length above 0 m, got {self.scale}")
        if self.place is not None and (len(self.place) != 2 or not _are_finite(self.place)):
            raise ValueError(f"place must be two finite positions x, y [m], got {list(self.place)}")

    def of_joints(self, values: np.ndarray) -> np.ndarray:
        """``(N, 9)`` joints [rad] and fingers [m] for the recorded ``(N, 7 or 9)``."""
        if values.shape[1] == N_ARM_JOINTS:
            values = np.column_stack([values, np.full((len(values), 2), GRIP)])
        if not len(self.joint_offsets):
            return values
        return values + np.array([*self.joint_offsets, 0.0, 0.0])

    def of_pen(self, values: np.ndarray) -> np.ndarray:
        """``(N, 2)`` positions of the pen [m] for the recorded ones."""
        return self.metres(values) + np.array([0.0, 0.0] if self.place is None else self.place)

    def metres(self, lengths: np.ndarray) -> np.ndarray:
        """Recorded lengths in metres, in the shape of `lengths`."""
        return (1.0 if self.scale is None else self.scale) * lengths

    def centred(self, values: np.ndarray) -> RecordingFrame:
        """The frame in which the middle of ``(N, 2)`` recorded positions lies in the middle of the sheet, to 0.1 mm."""
        middle = self.metres((values.min(axis=0) + values.max(axis=0)) / 2)
        return replace(self, place=np.round(np.array(SHEET_CENTRE) - middle, 4).tolist())

    def check_used(self, with_joints: bool, with_pen: bool, path: Path) -> None:
        """Refuses settings that apply to nothing in a recording."""
        if len(self.joint_offsets) and not with_joints:
            raise ValueError(f"joint_offsets are for recordings of joints, got one of the pen: {path}")
        if (self.scale is not None or self.place is not None) and not with_pen:
            raise ValueError(f"scale and place are for recordings of the pen, got one of joints: {path}")


def _are_finite(numbers: Sequence[float]) -> bool:
    return all(isinstance(number, Real) and math.isfinite(number) for number in numbers)
