# SPDX-License-Identifier: Apache-2.0
"""An episode as it was recorded, before it is checked and converted."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class RecordedEpisode(NamedTuple):
    """The samples of an episode, in the unit and the frame of the recording."""

    name: str
    """Name for error messages."""
    times: np.ndarray
    """``(N,)`` times of the samples."""
    values: np.ndarray
    """``(N, 7)`` joints, ``(N, 9)`` joints and fingers, or ``(N, 2)`` positions x, y of a pen."""
    heights: np.ndarray | None = None
    """``(N,)`` height z of the pen above the table, if it was recorded."""
    is_down: np.ndarray | None = None
    """``(N,)`` whether the pen writes, if that was recorded."""
