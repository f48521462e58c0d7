# SPDX-License-Identifier: Apache-2.0
"""An episode, and a whole recording, as they were recorded, before they are checked and converted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class LeftOutError(ValueError):
    """An episode is left out, for a short reason; the message says more."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class RecordedEpisode(NamedTuple):
    """The samples of an episode, in the unit and the frame of the recording."""

    name: str
    """Name for error messages."""
    times: np.ndarray
    """``(N,)`` times of the samples, in any unit: only their proportions are used."""
    values: np.ndarray
    """``(N, 7)`` joints, ``(N, 9)`` joints and fingers, or ``(N, 2)`` positions x, y of a pen."""
    heights: np.ndarray | None = None
    """``(N,)`` height z of the pen above the table, if it was recorded."""
    is_down: np.ndarray | None = None
    """``(N,)`` whether the pen writes, if that was recorded."""
    new_strokes: Sequence[int] = ()
    """Samples before which the pen was lifted although no sample was recorded in the air."""


class Recording(NamedTuple):
    """The episodes of a file or folder, and what its format says about the unit and the frame of the pen's positions."""

    episodes: list[RecordedEpisode]
    scale: float | None = None
    """Length of the unit [m]; None if the format leaves it open."""
    unit: str = ""
    """What the unit is, and how that is known, for the user."""
    is_of_another_sheet: bool = False
    """Whether the positions are those of a sheet that lay elsewhere than the arm's."""
