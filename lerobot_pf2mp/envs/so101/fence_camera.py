# SPDX-License-Identifier: Apache-2.0
"""Images of the arm, the wall and the cube: what the policy sees, and what people are shown."""

from __future__ import annotations

from functools import cache

import mujoco
from gymnasium.envs.mujoco.mujoco_rendering import OffScreenViewer

from lerobot_pf2mp.envs.offscreen_camera import OffscreenCamera, View

CAMERA = "front"  # the camera's name: LeRobot's observation.images.front
# What images show, and the groups of geoms that the model puts that in. The arm's meshes have 350 000 triangles: without a
# graphics card an image of them takes 0.2 s, one of the shapes that collisions are computed with 5 ms.
DETAILS = {"shapes": (3, 4), "meshes": (2,)}
# The camera in front of the table, and one that shows heights.
VIEWS: dict[str, View] = {
    CAMERA: ((0.19, 0.0, 0.03), 0.62, 180.0, -48.0),
    "side": ((0.20, 0.0, 0.06), 0.72, 152.0, -24.0),
}


@cache
def fence_camera(model: mujoco.MjModel, view: str, detail: str, image_size: int) -> OffscreenCamera:
    """A camera of the SO-101 task. All environments of a process share it: each renderer would hold the meshes, 0.25 GB.

    Args:
        model: The MuJoCo model.
        view: One of `VIEWS`.
        detail: One of `DETAILS`.
        image_size: Height and width [pixels].

    Raises:
        ValueError: If the detail does not exist, or the image is too small.
    """
    if detail not in DETAILS:
        raise ValueError(f"detail must be one of {list(DETAILS)}, got {detail!r}")
    if image_size < 32:
        raise ValueError(f"images must be at least 32 pixels wide, got {image_size}")

    def prepare(viewer: OffScreenViewer) -> None:
        viewer.scn.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = detail == "meshes"
        viewer.vopt.geomgroup[:] = 0
        viewer.vopt.geomgroup[[0, *DETAILS[detail]]] = 1

    return OffscreenCamera(model, VIEWS[view], (image_size, image_size), prepare)
