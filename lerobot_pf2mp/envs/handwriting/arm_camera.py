# SPDX-License-Identifier: Apache-2.0
"""Images of the arm and of the drawn line."""

from __future__ import annotations

import math
from itertools import pairwise

import mujoco
import numpy as np
from gymnasium.envs.mujoco.mujoco_rendering import OffScreenViewer

from lerobot_pf2mp.envs.handwriting.arm import Arm
from lerobot_pf2mp.envs.handwriting.ink import Ink
from lerobot_pf2mp.envs.handwriting.sheet import SHEET_CENTRE
from lerobot_pf2mp.envs.handwriting.stroke import evenly_spaced
from lerobot_pf2mp.envs.handwriting.writing_model import ARM_GROUP
from lerobot_pf2mp.envs.offscreen_camera import OffscreenCamera, View

CAMERAS = ("arm", "top")

_TOP: View = ((*SHEET_CENTRE, 0.0), 0.42, 90.0, -89.9)
_INK = np.array([0.05, 0.10, 0.45, 1.0], dtype=np.float32)
_INK_WIDTH = 0.003  # [m]
_INK_HEIGHT = 0.001  # above the table, so that it is visible on the sheet [m]
_SPACING, _MAX_LINES = 0.003, 1000  # smallest length [m] and largest number of the line segments of the ink


class ArmCamera:
    """Renders the arm, the sheet and the ink.

    Args:
        arm: The arm.
        model: A model from `make_writing_model`.
        view: One of `CAMERAS`: the arm from the side, or the sheet without the arm from above.
        image_size: Height and width [pixels].
    """

    def __init__(self, arm: Arm, model: mujoco.MjModel, view: str, image_size: tuple[int, int]) -> None:
        place, shows_arm = {"arm": (arm.view, True), "top": (_TOP, False)}[view]

        def prepare(viewer: OffScreenViewer) -> None:
            viewer.vopt.geomgroup[ARM_GROUP] = shows_arm

        self._camera = OffscreenCamera(model, place, image_size, prepare, max_geom=2 * _MAX_LINES)

    def render(self, data: mujoco.MjData, ink: Ink) -> np.ndarray:
        """Renders an image ``(H, W, 3)`` uint8.

        Args:
            data: The state of the model, always the same object.
            ink: The drawn line.

        Raises:
            RuntimeError: If this machine cannot render; the message says what to install.
        """

        def mark(viewer: OffScreenViewer) -> None:
            for stroke in ink.strokes:
                _add_ink(viewer, evenly_spaced(stroke, max(_SPACING, ink.length / _MAX_LINES)))

        return self._camera.render(data, mark)

    def close(self) -> None:
        """Frees the renderer."""
        self._camera.close()


def _add_ink(viewer: OffScreenViewer, positions: np.ndarray) -> None:
    for start, end in pairwise(positions):
        length = math.dist(start, end)
        ahead = np.array([*(end - start) / length, 0.0])
        up = np.array([0.0, 0.0, 1.0])
        viewer.add_marker(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=np.array([_INK_WIDTH / 2, length / 2, 0.0]),
            pos=np.array([*(start + end) / 2, _INK_HEIGHT]),
            mat=np.stack([up, np.cross(ahead, up), ahead], axis=1).ravel(),
            rgba=_INK,
        )
