# SPDX-License-Identifier: Apache-2.0
"""What the pen has drawn, compared with the letter."""

from __future__ import annotations

import math

import numpy as np

from lerobot_pf2mp.envs.handwriting.stroke import distances, evenly_spaced, line_of
from lerobot_pf2mp.envs.handwriting.writing_scene import WritingScene

INK_HEIGHT = 0.007  # height of the tip up to which the pen draws [m]
COVERED = 0.015  # distance of the letter to the ink within which it counts as drawn [m]
LARGEST_ERROR = 0.01  # mean distance of the ink to the letter [m]

_SPACING = 0.001  # of the ink's places whose distance is taken [m]


class Ink:
    """The strokes drawn in an episode.

    Args:
        scene: The letter and the regions.
    """

    def __init__(self, scene: WritingScene) -> None:
        self._scene = scene
        self.strokes: list[np.ndarray] = []  # each (N, 2) places [m]
        self.length = 0.0  # of all strokes [m]
        self._is_covered = np.zeros(len(scene.stroke), dtype=bool)
        self._integral = 0.0  # of the ink's distance to the letter over its length [m^2]
        self._is_down = False

    def draw(self, tips: np.ndarray) -> float:
        """Draws where the pen is on the table.

        Args:
            tips: ``(N, 3)`` positions of the pen's tip, one after the other, from the last one of the call before [m].

        Returns:
            Smallest distance of what was drawn now to a region [m], negative inside; inf if nothing was drawn.
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
        """Whether the whole letter is covered, and the ink near it."""
        return bool(self._is_covered.all()) and self.error <= LARGEST_ERROR

    def _draw_part(self, places: np.ndarray, goes_on: bool) -> float:
        if goes_on:
            self.strokes[-1] = np.concatenate([self.strokes[-1], places[1:]])
        else:
            self.strokes.append(places)
        line = line_of(places)
        self.length += line.length
        self._is_covered |= distances(self._scene.stroke, places) <= COVERED
        errors = distances(evenly_spaced(places, _SPACING)[1:], self._scene.stroke)
        if len(errors):
            self._integral += float(errors.mean()) * line.length
        return self._scene.clearance(places)
