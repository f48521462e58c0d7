# SPDX-License-Identifier: Apache-2.0
"""The line that the pen has drawn, compared with the letter."""

from __future__ import annotations

import math

import numpy as np

from lerobot_pf2mp.envs.handwriting.stroke import distances, evenly_spaced, line_of
from lerobot_pf2mp.envs.handwriting.writing_scene import WritingScene

INK_HEIGHT = 0.007  # height of the tip up to which the pen draws [m]
COVERED = 0.015  # a point of the letter counts as drawn if the ink is at most this far away [m]
LARGEST_ERROR = 0.01  # mean distance of the ink to the letter [m]

_SPACING = 0.001  # between the points of the ink at which its distance to the letter is measured [m]


class Ink:
    """The strokes drawn in an episode.

    Args:
        scene: The letter and the regions.
    """

    def __init__(self, scene: WritingScene) -> None:
        self._scene = scene
        self.strokes: list[np.ndarray] = []  # each (N, 2) positions [m]
        self.length = 0.0  # total length of all strokes [m]
        self._is_covered = np.zeros(len(scene.stroke), dtype=bool)
        self._integral = 0.0  # distance of the ink to the letter, integrated over the ink's length [m^2]
        self._is_down = False

    def draw(self, tips: np.ndarray) -> float:
        """Draws the parts of a trajectory where the pen is on the table.

        Args:
            tips: ``(N, 3)`` positions of the pen's tip in order of time [m]. The first is the last of the previous call.

        Returns:
            Smallest distance of the newly drawn line to a region [m], negative inside; inf if nothing was drawn.
        """
        is_down = tips[:, 2] <= INK_HEIGHT
        clearance = math.inf
        ends = np.flatnonzero(np.diff(is_down.astype(int))) + 1
        for part in np.split(np.arange(len(tips)), ends):
            if is_down[part[0]]:
                clearance = min(clearance, self._draw_part(tips[part, :2], goes_on=self._is_down))
            self._is_down = bool(is_down[part[0]])
        return clearance

    @property
    def error(self) -> float:
        """Mean distance of the ink to the letter [m]; inf before anything is drawn."""
        return self._integral / self.length if self.length else math.inf

    @property
    def is_success(self) -> bool:
        """Whether the whole letter is covered and the ink is near it."""
        return bool(self._is_covered.all()) and self.error <= LARGEST_ERROR

    def _draw_part(self, positions: np.ndarray, goes_on: bool) -> float:
        if goes_on:
            self.strokes[-1] = np.concatenate([self.strokes[-1], positions[1:]])
        else:
            self.strokes.append(positions)
        line = line_of(positions)
        self.length += line.length
        self._is_covered |= distances(self._scene.stroke, positions) <= COVERED
        errors = distances(evenly_spaced(positions, _SPACING)[1:], self._scene.stroke)
        if len(errors):
            self._integral += float(errors.mean()) * line.length
        return self._scene.clearance(positions)
