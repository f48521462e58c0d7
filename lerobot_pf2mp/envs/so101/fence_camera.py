# SPDX-License-Identifier: Apache-2.0
"""Images of the arm, the wall and the cube: what the policy sees, and what people are shown."""

from __future__ import annotations

import atexit
import weakref

import mujoco
import numpy as np
from gymnasium.envs.mujoco.mujoco_rendering import OffScreenViewer

from lerobot_pf2mp.envs.headless import rendering

CAMERA = "front"  # the camera's name: LeRobot's observation.images.front
# What images show, and the groups of geoms that the model puts that in. The arm's meshes have 350 000 triangles: without a
# graphics card an image of them takes 0.2 s, one of the shapes that collisions are computed with 5 ms.
DETAILS = {"shapes": (3, 4), "meshes": (2,)}
# lookat [m], distance [m], azimuth and elevation [degrees]: the camera in front of the table, and one that shows heights.
VIEWS = {
    CAMERA: ((0.19, 0.0, 0.03), 0.62, 180.0, -48.0),
    "side": ((0.20, 0.0, 0.06), 0.72, 152.0, -24.0),
}


class FenceCamera:
    """Renders the scene.

    Args:
        model: The MuJoCo model.
        view: One of `VIEWS`.
        detail: One of `DETAILS`.
        image_size: Height and width [pixels].

    Raises:
        ValueError: If the detail does not exist, or the image is too small.
    """

    def __init__(self, model: mujoco.MjModel, view: str, detail: str, image_size: int) -> None:
        if detail not in DETAILS:
            raise ValueError(f"detail must be one of {list(DETAILS)}, got {detail!r}")
        if image_size < 32:
            raise ValueError(f"images must be at least 32 pixels wide, got {image_size}")
        self._model, self._view, self._detail = model, VIEWS[view], detail
        self.image_shape = (image_size, image_size, 3)
        self._viewer: OffScreenViewer | None = None

    def render(self, data: mujoco.MjData) -> np.ndarray:
        """An image ``(H, W, 3)`` uint8.

        Args:
            data: The state of the model, always the same object.

        Raises:
            RuntimeError: If this machine cannot render; the message says what to install.
        """
        with rendering():
            if self._viewer is None:
                self._viewer = self._make_viewer(data)
            self._viewer.make_context_current()
            return self._viewer.render("rgb_array")

    def close(self) -> None:
        """Frees the renderer."""
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None

    def _make_viewer(self, data: mujoco.MjData) -> OffScreenViewer:
        height, width, _ = self.image_shape
        # Not MuJoCo's own renderer, because that chooses its OpenGL backend when MuJoCo is imported.
        viewer = OffScreenViewer(self._model, data, width, height)
        viewer.scn.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self._detail == "meshes"
        viewer.vopt.sitegroup[:] = 0
        viewer.vopt.geomgroup[:] = 0
        viewer.vopt.geomgroup[[0, *DETAILS[self._detail]]] = 1
        viewer.cam.lookat[:], viewer.cam.distance, viewer.cam.azimuth, viewer.cam.elevation = self._view
        # Without this, a renderer that is not closed prints an error when Python exits.
        atexit.register(_close, weakref.ref(viewer))
        return viewer


def _close(viewer: weakref.ref[OffScreenViewer]) -> None:
    alive = viewer()
    if alive is not None:
        alive.close()
