# SPDX-License-Identifier: Apache-2.0
"""What the environments need to know of an arm that holds a pen. Each arm has a file of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module

import mujoco
import numpy as np

from lerobot_pf2mp.envs.offscreen_camera import View
from lerobot_pf2mp.envs.tasks import ROBOTS

_TOLERANCE = 1e-4  # by which positions may exceed their limits [rad; m]


@dataclass(frozen=True, eq=False)
class Arm:
    """An arm that holds a pen, at its place beside the table.

    Args:
        robot: Its name as ``robot_type`` of datasets.
        title: Its name in sentences.
        joints: Its joints in words, with their units.
        joint_names: Names of its J joints, in the order of the model's joints and controllers; those of the hand come last.
        n_arm_joints: How many of them are the arm's, and turn [rad].
        home: ``(J,)`` a posture with the pen nearly upright at the middle of the sheet. Among all postures for a position of
            the pen, the arm takes the one nearest to this [rad; m].
        read: Reads the model of the arm alone: with the site `pen.PEN_TIP`, whose z-axis points out of the pen, and a
            position controller for each joint.
        base: Name of its body that stands on the stand. It does not move.
        position: Where the base stands: x, y, z in the frame of the table [m].
        stand: x and half of the side of the stand below it [m].
        upright: ``(3, 3)`` rotation of the site when the pen is upright: its z-axis points down.
        turning_cost: Costs, in the inverse kinematics, of a pen that is tilted, about the site's x- and y-axis, and of one
            that is turned about itself.
        view: The camera of ``--env.camera=arm``.
    """

    robot: str
    title: str
    joints: str
    joint_names: tuple[str, ...]
    n_arm_joints: int
    home: np.ndarray
    read: Callable[[], mujoco.MjSpec]
    base: str
    position: tuple[float, float, float]
    stand: tuple[float, float]
    upright: np.ndarray
    turning_cost: tuple[float, float, float]
    view: View

    def check_joints(self, model: mujoco.MjModel, joints: np.ndarray, name: str) -> None:
        """Checks that ``(..., J)`` positions of joints [rad] and fingers [m] are within the arm's limits.

        Args:
            model: A model with this arm.
            joints: The positions.
            name: Their name in messages.

        Raises:
            ValueError: If they are not.
        """
        names, n = self.joint_names, len(self.joint_names)
        if joints.shape[-1:] != (n,) or not np.isfinite(joints).all():
            raise ValueError(
                f"{name} must be {n} finite positions, those of {', '.join(names)}, got an array of "
                f"shape {joints.shape}{'' if np.isfinite(joints).all() else ' with NaN or infinity'}"
            )
        if np.abs(joints[..., : self.n_arm_joints]).max() > 2 * np.pi:
            largest = np.abs(joints[..., : self.n_arm_joints]).max()
            raise ValueError(f"{name} must be in radians, got {largest:g}, which looks like degrees")
        low, high = model.jnt_range.T
        beyond = (joints < low - _TOLERANCE) | (joints > high + _TOLERANCE)
        if beyond.any():
            row, joint = np.argwhere(beyond.reshape(-1, n))[0]
            value = joints.reshape(-1, n)[row, joint]
            raise ValueError(
                f"{name} must be within the arm's limits, {names[joint]} in [{low[joint]:g}, {high[joint]:g}], got "
                f"{value:g}" + (f" in row {row}" if joints.ndim > 1 else "")
            )


def find_arm(robot: str) -> Arm:
    """The arm with a name.

    Args:
        robot: One of `tasks.ROBOTS`. Its module has this name and calls its arm ``ARM``.

    Raises:
        ValueError: If there is no such arm.
        ImportError: If the package with its model is missing; the message says what to install.
    """
    if robot not in ROBOTS:
        raise ValueError(f"robot must be one of {list(ROBOTS)}, got {robot!r}")
    return import_module(f"lerobot_pf2mp.envs.handwriting.{robot}").ARM
