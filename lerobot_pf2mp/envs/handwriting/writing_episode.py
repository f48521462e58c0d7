# SPDX-License-Identifier: Apache-2.0
"""What an episode of handwriting has come to: ink, collisions, reward and info. The same for every arm and simulator."""

from __future__ import annotations

from typing import Any

import numpy as np

from lerobot_pf2mp.envs.handwriting.ink import Ink
from lerobot_pf2mp.envs.handwriting.writing_scene import SHEET_CORNERS, WritingScene, check_on_sheet

START_SPREAD = 0.005  # largest distance between the pen's start and the stroke's beginning, on each axis [m]


class WritingEpisode:
    """An episode with one arm.

    Args:
        scene: The letter and the regions.
        tip: ``(3,)`` position of the pen's tip at the start [m].
        table_clearance: Distance between arm and table [m], negative if they touch.
    """

    def __init__(self, scene: WritingScene, tip: np.ndarray, table_clearance: float) -> None:
        self.ink = Ink(scene)
        self._is_collision = False
        self._clearance = min(self.ink.draw(tip[None].copy()), table_clearance)
        self._beyond_reach = 0.0

    def record(self, tips: np.ndarray, table_clearance: float, beyond_reach: float = 0.0) -> float:
        """Records a step.

        Args:
            tips: ``(N, 3)`` positions of the pen's tip during the step [m]. The first is the last of the step before.
            table_clearance: Smallest distance between arm and table during it [m], negative if they touched.
            beyond_reach: Distance of the position that was asked for to the nearest one in reach [m].

        Returns:
            The reward: -1.0 in the first step with a collision, else 0.0.
        """
        self._clearance, self._beyond_reach = min(self.ink.draw(tips), table_clearance), beyond_reach
        is_first = self._clearance < 0 and not self._is_collision
        self._is_collision |= self._clearance < 0
        return -1.0 if is_first else 0.0

    @property
    def info(self) -> dict[str, Any]:
        """The info after the last step, as `HandwritingEnv` describes it."""
        return {
            "is_success": self.ink.is_success,
            "is_collision": self._is_collision,
            "clearance": self._clearance,
            "stroke_error": self.ink.error,
            "path_length": self.ink.length,
            "beyond_reach": self._beyond_reach,
        }


def first_position(scene: WritingScene, start: Any, np_random: np.random.Generator) -> np.ndarray:
    """Where the pen starts: ``(2,)`` x, y [m].

    Args:
        scene: The letter.
        start: A position that is asked for [m], or None for one near the beginning of the letter.
        np_random: Source of randomness.

    Raises:
        ValueError: If the position is not on the sheet.
    """
    if start is None:
        start = scene.stroke[0] + np_random.uniform(-START_SPREAD, START_SPREAD, 2)
        start = start.clip(*SHEET_CORNERS)
    start = np.asarray(start, dtype=np.float64)
    if start.shape != (2,):
        raise ValueError(f"start must be finite positions x, y [m], got {start.tolist()}")
    check_on_sheet(start, "start")
    return start
