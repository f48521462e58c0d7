# SPDX-License-Identifier: Apache-2.0
"""The SO-101 arm behind a wall as an environment of so101-nexus, for its LeRobot robot ``sim_so_follower``."""

from __future__ import annotations

from functools import cache
from typing import Any

import mujoco
import numpy as np
from gymnasium import spaces
from so101_nexus.config import EnvironmentConfig, PhysicsConfig, RobotConfig
from so101_nexus.constants import COLOR_MAP
from so101_nexus.mujoco.base_env import SO101NexusMuJoCoBaseEnv
from so101_nexus.object_slots import ObjectSlot, compile_object_scene
from so101_nexus.objects import CubeObject
from so101_nexus.scene import MUJOCO_SCENE_OPTION_XML

from lerobot_pf2mp.envs.obstacle import Obstacle
from lerobot_pf2mp.envs.so101.fence_camera import CAMERA, fence_camera
from lerobot_pf2mp.envs.so101.fence_scene import (
    CUBE_SIZE,
    GOAL_RADIUS,
    SO101_FPS,
    FenceLayout,
    cylindrical,
    make_scene,
)

# Joints at the start, above the cube's side of the wall, the gripper half open [degrees].
_HOME = (-34.5, -10.4, -1.9, 95.0, 2.7, 28.5)
_PHYSICS = PhysicsConfig(control_period_s=1 / SO101_FPS, integrator="implicitfast")
_LIFTED = 0.01  # above this height over the table the cube does not lie on it [m]


class FenceSimulation(SO101NexusMuJoCoBaseEnv):
    """An SO-101 arm that must carry a cube over a wall to a disc on the table.

    What it is for, and the information that it returns: see `SO101FenceEnv`, which holds one. This one is what so101-nexus'
    robot drives: actions are the six joint targets [rad].

    Args:
        wall_position: x, y of the wall's centre [m]. For this and the next three, None is the task's own value.
        wall_size: Lengths of its sides [m].
        cube_range: Two opposite corners of the rectangle of the cube's positions [m].
        goal_range: The same for the goal [m].
        has_camera: Whether observations hold an image.
        image_size: Height and width of that image [pixels]. It shows shapes, see `fence_camera.DETAILS`.
        render_size: Height and width of the images of `render` [pixels].
        detail: What those show.
        render_mode: ``rgb_array`` or None.
        control_mode: so101-nexus' name of what actions are.

    Raises:
        ValueError: If an argument breaks its rule.
    """

    def __init__(
        self,
        wall_position: tuple[float, float] | None = None,
        wall_size: tuple[float, float, float] | None = None,
        cube_range: Any = None,
        goal_range: Any = None,
        has_camera: bool = True,
        image_size: int = 96,
        render_size: int = 96,
        detail: str = "shapes",
        render_mode: str | None = None,
        control_mode: Any = "pd_joint_pos",
    ) -> None:
        self.scene = make_scene(
            wall_position=wall_position, wall_size=wall_size, cube_range=cube_range, goal_range=goal_range
        )
        self._has_camera, self._image_shape = has_camera, (image_size, image_size, 3)
        config = EnvironmentConfig(
            robot=RobotConfig(rest_qpos_deg=_HOME),
            observations=[],
            physics=_PHYSICS,
            terminate_on_success=False,
            goal_thresh=GOAL_RADIUS,
        )
        self._init_common(
            config=config, render_mode=render_mode, control_mode=control_mode, robot_init_qpos_noise=0.02
        )
        self.model, self._cube = _compiled(self._bodies())
        self.data = mujoco.MjData(self.model)
        self._set_target_geoms(self._cube.geom_ids)
        self._camera = fence_camera(self.model, CAMERA, "shapes", image_size)
        self._film_camera = fence_camera(self.model, "side", detail, render_size)
        self._finish_model_setup()
        robot = self._robot_geoms()
        self.wall = Obstacle(self.model, self.data, "wall", [*robot, *self._cube.geom_ids])
        self._table = Obstacle(self.model, self.data, "floor", robot)
        self.layout = FenceLayout(np.zeros(2), np.zeros(2))
        self._wall_depth = self._table_depth = 0.0  # in the last step [m]

    @property
    def tcp(self) -> np.ndarray:
        """``(3,)`` position of the tool centre point, between the tips of the jaws [m]."""
        return self.data.site_xpos[self._tcp_site_id].copy()

    @property
    def cube(self) -> np.ndarray:
        """``(3,)`` position of the cube's centre [m]."""
        return self.data.qpos[self._cube.qpos_addr : self._cube.qpos_addr + 3].copy()

    def render(self) -> np.ndarray | None:
        """An image ``(H, W, 3)`` uint8 for people.

        Raises:
            RuntimeError: If this machine cannot render; the message says what to install.
        """
        return None if self.render_mode is None else self._film_camera.render(self.data)

    def _bodies(self) -> str:
        half = np.array(self.scene.wall_size) / 2
        wall = " ".join(str(length) for length in half)
        x, y = self.scene.wall_position
        return (
            f'<body name="wall" pos="{x} {y} {half[2]}">'
            f'<geom name="wall" type="box" size="{wall}" rgba="0.75 0.15 0.1 1"/></body>'
            f'<body name="goal" mocap="true" pos="0 0 0.001"><geom name="goal" type="cylinder" size="{GOAL_RADIUS} 0.001" '
            f'rgba="0.15 0.3 0.9 1" contype="0" conaffinity="0"/></body>'
        )

    def _robot_geoms(self) -> list[int]:
        """The geoms of the arm that can touch something."""
        model = self.model
        others = {
            self._cube.geom_id,
            *self._cube.geom_ids,
            *(model.geom(n).id for n in ("wall", "goal", "floor")),
        }
        can_touch = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        return [geom for geom in np.flatnonzero(can_touch).tolist() if geom not in others]

    def _task_reset(self) -> None:
        given = {name: self._reset_options.get(name) for name in ("cube", "goal")}
        self.layout = self.scene.sample(self.np_random, **given)
        yaw = cylindrical(self.layout.cube)[1] + self.layout.yaw
        start = self._cube.qpos_addr
        pose = [*self.layout.cube, CUBE_SIZE / 2, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
        self.data.qpos[start : start + 7] = pose
        self.data.mocap_pos[0, :2] = self.layout.goal
        self._wall_depth = self._table_depth = 0.0

    def _advance_physics(self) -> None:
        """Advances by one action; contacts are looked at in every physics step."""
        self._wall_depth = self._table_depth = 0.0
        for _ in range(self._N_SUBSTEPS):
            mujoco.mj_step(self.model, self.data)
            self._wall_depth = max(self._wall_depth, self.wall.contact_depth())
            self._table_depth = max(self._table_depth, self._table.contact_depth())
        mujoco.mj_forward(self.model, self.data)

    def _build_observation_space(self) -> spaces.Space:
        joints = spaces.Box(-np.inf, np.inf, (len(self._joint_ids),), np.float32)
        camera = {CAMERA: spaces.Box(0, 255, self._image_shape, np.uint8)}
        return spaces.Dict({"state": joints, **(camera if self._has_camera else {})})

    def _get_obs(self) -> Any:
        camera = {CAMERA: self._camera.render(self.data)} if self._has_camera else {}
        return {"state": self._get_current_qpos().astype(np.float32), **camera}

    def _get_info(self) -> dict[str, Any]:
        offset = self.cube - [*self.layout.goal, CUBE_SIZE / 2]
        lies = bool(np.hypot(*offset[:2]) < GOAL_RADIUS and abs(offset[2]) < _LIFTED)
        return {
            "success": lies and not self._is_grasping(),
            "wall_depth": self._wall_depth,
            "table_depth": self._table_depth,
        }

    def _compute_reward(self, info: dict[str, Any]) -> float:
        return 0.0


@cache
def _compiled(bodies: str) -> tuple[mujoco.MjModel, ObjectSlot]:
    """The model of arm, table and cube with further bodies, and where the cube is in it.

    All environments of a process share it: with the meshes of the arm it takes 0.2 GB, and compiling it a second. What
    changes from episode to episode is in the data.
    """
    model, slots = compile_object_scene(
        [CubeObject(color="green", half_size=CUBE_SIZE / 2)],
        ["cube"],
        COLOR_MAP["gray"],
        option_xml=MUJOCO_SCENE_OPTION_XML,
        model_name="fence",
        extra_bodies=bodies,
    )
    return model, slots[0]
