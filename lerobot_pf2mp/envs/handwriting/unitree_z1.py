# SPDX-License-Identifier: Apache-2.0
"""A Unitree Z1 with a pen, the arm of the paper's real robot. Its model comes with the package example-robot-data."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import mujoco
import numpy as np

from lerobot_pf2mp.envs.handwriting.arm import Arm
from lerobot_pf2mp.envs.handwriting.pen import add_pen

try:
    _PACKAGE = distribution("example-robot-data")
except PackageNotFoundError as error:
    raise ImportError('the robot unitree_z1 needs: pip install "lerobot_policy_pf2mp[z1]"') from error

_N_ARM_JOINTS = 6
_FOLDER = "cmeel.prefix/share/example-robot-data/robots/z1_description"
_MESHES = {  # by body
    **{f"link0{i}": f"z1_Link0{i}" for i in range(7)},
    "gripperStator": "z1_GripperStator",
    "gripperMover": "z1_GripperMover",
}
_PEN = (0.06, 0.26)  # its blunt end and its tip, in the frame of the gripper along its axis [m]
_GRIP = -0.10  # angle of the gripper's moving finger around the pen [rad]
# Stiffness of the position controllers by joint [N m/rad], and the lag that their damping causes. The torques are the
# URDF's.
_STIFFNESS = (2000.0, 2000.0, 2000.0, 1000.0, 1000.0, 500.0, 100.0)
_LAG = 0.03  # [s]
_ARMATURE = 0.01  # of each joint, which the URDF leaves out [kg m^2]
_LIGHT, _DARK = (0.80, 0.82, 0.85, 1.0), (0.36, 0.40, 0.47, 1.0)


def _read() -> mujoco.MjSpec:
    folder = Path(str(_PACKAGE.locate_file(_FOLDER)))
    urdf = (folder / "urdf" / "z1.urdf").read_text(encoding="utf-8")
    spec = mujoco.MjSpec.from_string(
        urdf.replace("package://example-robot-data/robots/z1_description", str(folder))
    )
    # The base and the gripper stay bodies of their own. What only looks is kept; the URDF's own looks are of a kind of file
    # that MuJoCo does not read.
    spec.compiler.fusestatic = spec.compiler.discardvisual = False
    for geom in spec.geoms:  # simple shapes, which MuJoCo reads for collisions
        geom.group = 3
    for body, mesh in _MESHES.items():
        _add_looks(spec, body, folder / "meshes" / "collision" / f"{mesh}.STL")
    add_pen(spec.body("gripperStator"), "x", *_PEN)
    for joint, stiffness in zip(spec.joints, _STIFFNESS, strict=True):
        joint.armature = _ARMATURE
        actuator = spec.add_actuator(
            name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT, ctrlrange=joint.range
        )
        actuator.set_to_position(kp=stiffness, kv=stiffness * _LAG)
        actuator.forcerange = joint.actfrcrange
    return spec


def _add_looks(spec: mujoco.MjSpec, body: str, file: Path) -> None:
    name = f"looks_of_{body}"
    spec.add_mesh(name=name, file=str(file))
    spec.body(body).add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=name,
        rgba=_DARK if body.startswith("gripper") else _LIGHT,
        contype=0,
        conaffinity=0,
        mass=0.0,
        group=0,
    )


ARM = Arm(
    robot="unitree_z1",
    title="Unitree Z1",
    joints="the six joints and the gripper [rad]",
    joint_names=(*(f"joint_{i}" for i in range(1, _N_ARM_JOINTS + 1)), "gripper"),
    n_arm_joints=_N_ARM_JOINTS,
    home=np.array([0.0, 1.8236, -1.0210, 0.7682, 0.0, 0.0, _GRIP]),
    read=_read,
    base="link00",
    # The sheet lies where the arm reaches all of it with an upright pen, and keeps away from the limits of its joints.
    position=(0.22, 0.0, 0.10),
    stand=(0.20, 0.08),
    upright=np.array([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]),
    turning_cost=(1.0, 1.0, 0.0),
    view=((0.40, 0.0, 0.20), 1.15, 130.0, -30.0),
)
