# SPDX-License-Identifier: Apache-2.0
"""A Franka Panda with a pen at a table. The model of the arm comes with gymnasium-robotics."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np

from lerobot_pf2mp.envs.handwriting.sheet import SHEET_CENTRE, SHEET_SIDE

N_ARM_JOINTS = 7
JOINT_NAMES = (*(f"joint_{i}" for i in range(1, N_ARM_JOINTS + 1)), "finger_1", "finger_2")
TABLE, PEN_TIP = "table", "pen_tip"
GRIP = 0.007  # opening of each finger around the pen [m]
# A posture with the pen nearly upright at the middle of the sheet, with its tip 5 mm too low. Among all postures for a
# position of the pen, the arm takes the one nearest to this.
HOME = np.array([0.0, 0.3125, 0.0, -2.3932, 0.0, 1.135, 0.7854, GRIP, GRIP])  # [rad], fingers [m]
ARM_GROUP, SCENE_GROUP = 0, 1  # MuJoCo's groups of visible geoms
PEN_TRAVEL = 0.01  # how deep the soft tip can sink before the pen's barrel touches the table [m]

_TOLERANCE = 1e-4  # by which positions may exceed their limits [rad; m]
_ASSETS = "envs/assets/kitchen_franka/franka_assets"
_PEN_LENGTH = 0.30  # from the last joint's frame to the tip, along its axis [m]
_PEN_RADIUS = 0.006  # [m]
_TABLE_SIZE = (0.66, 0.80, 0.04)  # [m]
# Stiffness of the position controllers by joint [N m/rad], and the lag of the arm that their damping causes. With the
# model's own gains the arm lags by 0.1 s, in some joints more than in others, which bends the stroke.
_STIFFNESS = (4500.0, 4500.0, 3500.0, 3500.0, 2000.0, 2000.0, 2000.0)
_LAG = 0.03  # [s]
_FORCES = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)  # largest torques [N m]
# The sheet collides with nothing. The table collides with arm and pen. The pen does not collide with the fingers.
_ARM_BIT, _PEN_BIT = 1, 2
_WHITE, _GREY, _PEN_COLOUR = (0.80, 0.80, 0.79, 1.0), (0.32, 0.34, 0.37, 1.0), (0.10, 0.22, 0.55, 1.0)


def make_panda(sheet: np.ndarray, image_size: tuple[int, int] = (480, 640)) -> mujoco.MjModel:
    """Makes the model of the arm, its pen and the table. Joints and controllers are in the order of `JOINT_NAMES`.

    The frame is that of the arm's base: x forward, y to its left, z up; the table's top is at z = 0.

    Args:
        sheet: ``(H, W, 3)`` uint8 image on the sheet of paper, its top row at the largest y.
        image_size: Height and width of the largest image that will be rendered [pixels].
    """
    spec = _read_arm()
    _add_pen(spec)
    _add_table(spec, sheet)
    for body in spec.bodies:
        body.gravcomp = 1.0
    for actuator, stiffness, force in zip(spec.actuators, _STIFFNESS, _FORCES, strict=False):
        actuator.gainprm[0] = stiffness
        actuator.biasprm[1:3] = -stiffness, -stiffness * _LAG
        actuator.forcerange[:] = -force, force
        spec.joint(actuator.target).damping[:] = 1.0
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.visual.global_.offheight, spec.visual.global_.offwidth = image_size
    return spec.compile()


def check_joints(model: mujoco.MjModel, joints: np.ndarray, name: str) -> None:
    """Checks that ``(..., 9)`` positions of joints [rad] and fingers [m] are within the arm's limits.

    Raises:
        ValueError: If they are not.
    """
    if joints.shape[-1:] != (len(JOINT_NAMES),) or not np.isfinite(joints).all():
        raise ValueError(
            f"{name} must be {len(JOINT_NAMES)} finite positions, those of {', '.join(JOINT_NAMES)}, got an array of "
            f"shape {joints.shape}{'' if np.isfinite(joints).all() else ' with NaN or infinity'}"
        )
    if np.abs(joints[..., :N_ARM_JOINTS]).max() > 2 * np.pi:
        largest = np.abs(joints[..., :N_ARM_JOINTS]).max()
        raise ValueError(f"{name} must be in radians, got {largest:g}, which looks like degrees")
    low, high = model.jnt_range.T
    beyond = (joints < low - _TOLERANCE) | (joints > high + _TOLERANCE)
    if beyond.any():
        row, joint = np.argwhere(beyond.reshape(-1, len(JOINT_NAMES)))[0]
        value = joints.reshape(-1, len(JOINT_NAMES))[row, joint]
        raise ValueError(
            f"{name} must be within the arm's limits, {JOINT_NAMES[joint]} in [{low[joint]:g}, {high[joint]:g}], got "
            f"{value:g}" + (f" in row {row}" if joints.ndim > 1 else "")
        )


def _read_arm() -> mujoco.MjSpec:
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
    return spec


def _add_pen(spec: mujoco.MjSpec) -> None:
    hand = spec.body("panda0_link7")
    hand.add_site(name=PEN_TIP, pos=[0.0, 0.0, _PEN_LENGTH])
    barrel, tip = _PEN_LENGTH - PEN_TRAVEL - _PEN_RADIUS, _PEN_LENGTH - 0.0015
    hand.add_geom(
        name="pen",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[0.0, 0.0, 0.16, 0.0, 0.0, barrel],
        size=[_PEN_RADIUS, 0.0, 0.0],
        rgba=_PEN_COLOUR,
        contype=_PEN_BIT,
        conaffinity=_PEN_BIT,
        mass=0.02,
        group=0,
    )
    hand.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[0.0, 0.0, barrel, 0.0, 0.0, tip],
        size=[0.0015, 0.0, 0.0],
        rgba=_GREY,
        contype=0,
        conaffinity=0,
        mass=0.0,
        group=0,
    )


def _add_table(spec: mujoco.MjSpec, sheet: np.ndarray) -> None:
    world, box = spec.worldbody, mujoco.mjtGeom.mjGEOM_BOX
    spec.default.geom.group = SCENE_GROUP
    length, width, height = _TABLE_SIZE
    centre = (SHEET_CENTRE[0] + 0.03, SHEET_CENTRE[1])
    half = [length / 2, width / 2, height / 2]
    both = _ARM_BIT | _PEN_BIT
    world.add_geom(
        name=TABLE,
        type=box,
        pos=[*centre, -height / 2],
        size=half,
        rgba=_WHITE,
        contype=both,
        conaffinity=both,
    )
    for pos, size in (([*centre, -0.24], [0.25, 0.3, 0.2]), ([-0.05, 0.0, -0.22], [0.13, 0.13, 0.22])):
        world.add_geom(type=box, pos=pos, size=size, rgba=_GREY, contype=0, conaffinity=0)
    texture = spec.add_texture(
        name="sheet",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        width=sheet.shape[1],
        height=sheet.shape[0],
        nchannel=3,
    )
    texture.data = sheet.tobytes()
    material = spec.add_material(name="sheet")
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "sheet"
    world.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        pos=[*SHEET_CENTRE, 0.0005],
        size=[SHEET_SIDE / 2, SHEET_SIDE / 2, 1.0],
        material="sheet",
        contype=0,
        conaffinity=0,
    )
    world.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        pos=[0.0, 0.0, -0.44],
        size=[4.0, 4.0, 1.0],
        rgba=[0.9, 0.92, 0.95, 1.0],
        contype=0,
        conaffinity=0,
    )
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.82, 0.86, 0.90],
        rgb2=[0.62, 0.66, 0.70],
        width=64,
        height=64,
    )
    spec.visual.headlight.diffuse[:], spec.visual.headlight.ambient[:] = 0.2, 0.3
    world.add_light(pos=[0.9, -0.9, 1.8], dir=[-0.3, 0.5, -1.0], diffuse=[0.45, 0.45, 0.45], castshadow=True)
    world.add_light(pos=[0.2, 1.0, 1.8], dir=[0.2, -0.5, -1.0], diffuse=[0.2, 0.2, 0.2], castshadow=False)
