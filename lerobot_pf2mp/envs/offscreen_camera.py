# SPDX-License-Identifier: Apache-2.0
"""A camera that renders a MuJoCo model, without a screen if there is none."""

from __future__ import annotations

import atexit
import weakref
from collections.abc import Callable

import mujoco
import numpy as np
from gymnasium.envs.mujoco.mujoco_rendering import OffScreenViewer

from lerobot_pf2mp.envs.headless import rendering

# lookat [m], distance [m], azimuth and elevation [degrees].
View = tuple[tuple[float, float, float], float, float, float]


class OffscreenCamera:
    """Renders a model from one point of view. The renderer is made with the first image.

    Args:
        model: The MuJoCo model.
        view: The point of view.
        image_size: Height and width [pixels].
        prepare: Changes the new renderer, for example what it shows.
        max_geom: Largest number of geoms and markers in an image.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        view: View,
        image_size: tuple[int, int],
        prepare: Callable[[OffScreenViewer], None] | None = None,
        max_geom: int = 1000,
    ) -> None:
        self._model, self._view, self._image_size = model, view, image_size
        self._prepare, self._max_geom = prepare, max_geom
        self._viewer: OffScreenViewer | None = None

    def render(
        self, data: mujoco.MjData, mark: Callable[[OffScreenViewer], None] | None = None
    ) -> np.ndarray:
        """An image ``(H, W, 3)`` uint8.

        Args:
            data: A state of the model. Environments that share their model can share their camera.
            mark: Adds markers to the image.

        Raises:
            RuntimeError: If this machine cannot render; the message says what to install.
        """
        with rendering():
            if self._viewer is None:
                self._viewer = self._make_viewer(data)
            self._viewer.data = data
            self._viewer.make_context_current()
            if mark is not None:
                mark(self._viewer)
            return self._viewer.render("rgb_array")

    def close(self) -> None:
        """Frees the renderer."""
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None

    def _make_viewer(self, data: mujoco.MjData) -> OffScreenViewer:
        height, width = self._image_size
        buffer = self._model.vis.global_
        buffer.offheight, buffer.offwidth = max(buffer.offheight, height), max(buffer.offwidth, width)
        # Not MuJoCo's own renderer, because that chooses its OpenGL backend when MuJoCo is imported.
        viewer = OffScreenViewer(self._model, data, width, height, max_geom=self._max_geom)
        camera = viewer.cam
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = self._view
        viewer.vopt.sitegroup[:] = 0
        if self._prepare is not None:
            self._prepare(viewer)
        # Without this, a renderer that is not closed prints an error when Python exits.
        atexit.register(_close, weakref.ref(viewer))
        return viewer


def _close(viewer: weakref.ref[OffScreenViewer]) -> None:
    alive = viewer()
    if alive is not None:
        alive.close()
