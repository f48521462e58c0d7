# SPDX-License-Identifier: Apache-2.0
"""Images of Meta-World's table. Its own cameras show it upside down, or from far away."""

from __future__ import annotations

import atexit
import weakref

import mujoco
import numpy as np
from gymnasium.envs.mujoco.mujoco_rendering import OffScreenViewer

from lerobot_pf2mp.envs.headless import rendering

_LOOKAT, _DISTANCE, _AZIMUTH, _ELEVATION = (0.05, 0.72, 0.12), 1.0, 155.0, -22.0


class TableCamera:
    """Renders images of wall, object and gripper.

    Args:
        model: The MuJoCo model.
        image_size: Height and width of the images [pixels].
    """

    def __init__(self, model: mujoco.MjModel, image_size: tuple[int, int]) -> None:
        self._model = model
        self._image_size = image_size
        self._viewer: OffScreenViewer | None = None

    def render(self, data: mujoco.MjData) -> np.ndarray:
        """An image ``(H, W, 3)`` uint8.

        Raises:
            RuntimeError: If this machine cannot render; the message says what to install.
        """
        with rendering():
            if self._viewer is None:
                self._viewer = self._make_viewer(data)
            return self._viewer.render("rgb_array")

    def close(self) -> None:
        """Frees the renderer."""
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None

    def _make_viewer(self, data: mujoco.MjData) -> OffScreenViewer:
        height, width = self._image_size
        self._model.vis.global_.offwidth = max(self._model.vis.global_.offwidth, width)
        self._model.vis.global_.offheight = max(self._model.vis.global_.offheight, height)
        viewer = OffScreenViewer(self._model, data, width, height)
        camera = viewer.cam
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat[:] = _LOOKAT
        camera.distance, camera.azimuth, camera.elevation = _DISTANCE, _AZIMUTH, _ELEVATION
        # Without this, a renderer that is not closed prints an error when Python exits.
        atexit.register(_close, weakref.ref(viewer))
        return viewer


def _close(viewer: weakref.ref[OffScreenViewer]) -> None:
    alive = viewer()
    if alive is not None:
        alive.close()
