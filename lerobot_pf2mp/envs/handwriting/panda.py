# SPDX-License-Identifier: Apache-2.0
"""A Franka Panda with a pen. The model of the arm comes with gymnasium-robotics."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np

from lerobot_pf2mp.envs.handwriting.arm import Arm
from lerobot_pf2mp.envs.handwriting.pen import add_pen

N_ARM_JOINTS = 7
JOINT_NAMES = (*(f"joint_{i}" for i in range(1, N_ARM_JOINTS + 1)), "finger_1", "finger_2")
GRIP = 0.007  # opening of each finger around the pen [m]
# The pen's tip is 5 mm too low.
HOME = np.array([0.0, 0.3125, 0.0, -2.3932, 0.0, 1.135, 0.7854, GRIP, GRIP])  # [rad], fingers [m]

_ASSETS = "envs/assets/kitchen_franka/franka_assets"
PEN = (0.16, 0.30)  # its blunt end and its tip, from the last joint's frame along its axis [m]
# Stiffness of the position controllers by joint [N m/rad], and the lag of the arm that their damping causes. With the
# model's own gains the arm lags by 0.1 s, in some joints more than in others, which bends the stroke.
STIFFNESS = (4500.0, 4500.0, 3500.0, 3500.0, 2000.0, 2000.0, 2000.0)
LAG = 0.03  # [s]
FORCES = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)  # largest torques [N m]


def _read() -> mujoco.MjSpec:
    found = find_spec("gymnasium_robotics")  # importing it would print a notice about other environments
    assert found is not None and found.origin is not None  # a dependency of this package
    folder = Path(found.origin).parent / _ASSETS
    files = {name: folder / f"{name}.xml" for name in ("assets", "actuator", "chain")}
    spec = mujoco.MjSpec.from_string(
        f'<mujoco model="panda"><include file="{files["assets"]}"/><include file="{files["actuator"]}"/>'
        f'<worldbody><include file="{files["chain"]}"/></worldbody></mujoco>'
    )
    for mesh in spec.meshes:  # their folder is given relative to another file
        path = Path(mesh.file)
        mesh.file = str(folder / "meshes" / path.parent.name / path.name)
    add_pen(spec.body("panda0_link7"), "z", *PEN)
    for actuator, stiffness, force in zip(spec.actuators, STIFFNESS, FORCES, strict=False):
        actuator.gainprm[0] = stiffness
        actuator.biasprm[1:3] = -stiffness, -stiffness * LAG
        actuator.forcerange[:] = -force, force
        spec.joint(actuator.target).damping[:] = 1.0
    return spec


ARM = Arm(
    robot="panda",
    title="Franka Panda",
    joints="the seven joints [rad] and the two fingers [m]",
    joint_names=JOINT_NAMES,
    n_arm_joints=N_ARM_JOINTS,
    home=HOME,
    read=_read,
    base="panda0_link0",
    position=(0.0, 0.0, 0.0),
    stand=(-0.05, 0.13),
    upright=np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    turning_cost=(0.2, 0.2, 0.2),
    view=((0.40, 0.0, 0.13), 1.02, 130.0, -34.0),
)
