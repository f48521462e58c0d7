# SPDX-License-Identifier: Apache-2.0
"""The MuJoCo model of an arm at a table with a sheet of paper."""

from __future__ import annotations

import mujoco
import numpy as np

from lerobot_pf2mp.envs.handwriting.arm import Arm
from lerobot_pf2mp.envs.handwriting.pen import ARM_BIT, PEN_BIT
from lerobot_pf2mp.envs.handwriting.sheet import SHEET_CENTRE, SHEET_SIDE

TABLE = "table"
ARM_GROUP, SCENE_GROUP = 0, 1  # MuJoCo's groups of visible geoms

TABLE_SIZE = (0.66, 0.80, 0.04)  # [m]
TABLE_CENTRE = (SHEET_CENTRE[0] + 0.03, SHEET_CENTRE[1])  # x, y [m]
_FLOOR = -0.44  # [m]
_WHITE, _GREY = (0.80, 0.80, 0.79, 1.0), (0.32, 0.34, 0.37, 1.0)


def make_writing_model(
    arm: Arm, sheet: np.ndarray, image_size: tuple[int, int] = (480, 640)
) -> mujoco.MjModel:
    """Makes the model of an arm, its pen and the table. Joints and controllers are in the order of ``arm.joint_names``.

    The frame is that of the table: x points from the arm to the sheet, y to the left, z up; the table's top is at z = 0.

    Args:
        arm: The arm.
        sheet: ``(H, W, 3)`` uint8 image on the sheet of paper, its top row at the largest y.
        image_size: Height and width of the largest image that will be rendered [pixels].
    """
    spec = arm.read()
    spec.body(arm.base).pos = arm.position
    _add_table(spec, sheet, arm)
    for body in spec.bodies:
        body.gravcomp = 1.0
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.visual.global_.offheight, spec.visual.global_.offwidth = image_size
    return spec.compile()


def movers(arm: Arm, model: mujoco.MjModel) -> list[int]:
    """The geoms of the arm and the pen that can touch the table."""
    base = model.body(arm.base).id
    return [
        geom
        for geom in range(model.ngeom)
        if model.geom_bodyid[geom] > base and (model.geom_contype[geom] or model.geom_conaffinity[geom])
    ]


def _add_table(spec: mujoco.MjSpec, sheet: np.ndarray, arm: Arm) -> None:
    world, box = spec.worldbody, mujoco.mjtGeom.mjGEOM_BOX
    spec.default.geom.group = SCENE_GROUP
    length, width, height = TABLE_SIZE
    half = [length / 2, width / 2, height / 2]
    both = ARM_BIT | PEN_BIT
    world.add_geom(
        name=TABLE,
        type=box,
        pos=[*TABLE_CENTRE, -height / 2],
        size=half,
        rgba=_WHITE,
        contype=both,
        conaffinity=both,
    )
    (x, side), top = arm.stand, arm.position[2]
    under_the_arm = [x, 0.0, (_FLOOR + top) / 2], [side, side, (top - _FLOOR) / 2]
    for pos, size in (([*TABLE_CENTRE, -0.24], [0.25, 0.3, 0.2]), under_the_arm):
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
        pos=[0.0, 0.0, _FLOOR],
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
