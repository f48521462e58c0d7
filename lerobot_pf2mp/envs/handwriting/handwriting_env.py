# SPDX-License-Identifier: Apache-2.0
"""Handwriting with an arm: a pen draws a letter and must keep out of restricted regions."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces

from lerobot_pf2mp.envs.handwriting.arm import find_arm
from lerobot_pf2mp.envs.handwriting.arm_camera import CAMERAS, ArmCamera
from lerobot_pf2mp.envs.handwriting.ink import Ink
from lerobot_pf2mp.envs.handwriting.pen import PEN_TIP
from lerobot_pf2mp.envs.handwriting.pen_kinematics import PenKinematics
from lerobot_pf2mp.envs.handwriting.sheet import (
    HANDWRITING_FPS,
    LETTER_HEIGHT,
    N_REGIONS,
    REGION_GAP,
)
from lerobot_pf2mp.envs.handwriting.sheet_image import draw_sheet
from lerobot_pf2mp.envs.handwriting.writing_episode import WritingEpisode, first_position
from lerobot_pf2mp.envs.handwriting.writing_model import TABLE, make_writing_model, movers
from lerobot_pf2mp.envs.handwriting.writing_scene import SHEET_CORNERS, make_writing_scene
from lerobot_pf2mp.envs.image_size import image_size_of
from lerobot_pf2mp.envs.obstacle import Obstacle

SPACES = ("joint", "pen")
CONTROLS = ("physics", "exact")

_LARGEST_SWEEP = 0.02  # largest motion of a joint between two checks for contact [rad]
_MAX_SWEEPS = 200
_STEPS_BETWEEN_TIPS = 5  # physics steps


class HandwritingEnv(gym.Env):
    """An arm that must draw a letter without entering restricted regions.

    ## Description
    The Franka Panda of gymnasium-robotics, or the Unitree Z1 of example-robot-data, holds a pen over a white table, as in
    Sections V-D and V-E of the paper. The letter, grey, and the regions, red, are on a sheet in front of it. The pen draws
    where its tip is at most 7 mm above the table. The frame is that of the table: x forward from the arm, y to its left [m].
    Its origin is the Panda's base; the Z1 stands nearer to the sheet. So positions mean the same for every arm.

    ## Action space
    ``space="joint"``: ``Box(J)``, the next positions of the joints, for the Panda seven [rad] and two fingers [m].
    ``space="pen"``: ``Box(2)``, the next position x, y of the pen's tip [m], which inverse kinematics turns into joint
    positions with the pen upright on the table. Values outside the limits are clipped to them. A position that the arm does
    not reach is followed as near as its joints allow, and ``beyond_reach`` says by how much it was missed.

    ## Observation space
    ``Dict``: ``agent_pos``, the positions of the joints and fingers ``(J,)``, or of the pen's tip ``(2,)``, measured.

    ## Rewards
    -1.0 on the first step with a collision in an episode, 0.0 otherwise. So the return of an episode is -1 with a collision
    and 0 without.

    ## Information
    ``is_success``: every point of the letter is within 0.015 m of the drawn line, and the mean distance of the drawn line to
    the letter is at most 0.01 m. ``is_collision``: in this episode the drawn line has entered a region, or the arm or the
    pen's barrel has touched the table. ``clearance``: the smallest distance during this step between pen and regions, or
    between arm and table [m], negative inside. ``stroke_error``: mean distance of the drawn line to the letter [m].
    ``path_length``: length of the drawn line [m]. ``beyond_reach``: in the space ``pen``, the distance of the position that
    was asked for to the nearest one in reach [m]; both arms reach the whole sheet.

    ## Starting state
    The pen on the table, up to 5 mm from the beginning of the letter on each axis, the arm at rest. ``reset(options=
    {"start": (x, y)})`` sets the pen's position [m], ``reset(options={"joints": (J positions)})`` the joints' [rad; m].

    ## Episode end
    After the registered number of steps. Neither a collision nor success ends it.

    Args:
        space: ``joint``, observations and actions are joint positions; or ``pen``, they are positions of the pen's tip.
        letter: One of `letters.LETTERS`.
        letter_height: Height of the letter [m].
        region_gap: Distance between the letter and the restricted regions [m].
        n_regions: Largest number of regions in the concave parts of the letter.
        scene_file: A JSON file with your own stroke and regions instead of a letter, see
            `writing_scene.read_writing_scene`.
        control: ``physics``: position controllers with gravity compensation drive the arm, 500 Hz. ``exact``: the arm
            reaches every action. With both, the path between two actions is checked for collisions.
        fps: Control frequency [Hz], a divisor of the physics' 500 Hz.
        render_mode: ``rgb_array`` or None.
        render_size: Width of the image [pixels]; its height is three quarters of that.
        camera: ``arm``, a view of the arm from the side; or ``top``, a view of the sheet from above.
        robot: The arm, one of `tasks.ROBOTS`. Its joints J are those of ``arm.joint_names``.

    Raises:
        ValueError: If an argument breaks its rule.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": HANDWRITING_FPS}  # noqa: RUF012

    def __init__(
        self,
        space: str = "joint",
        letter: str = "S",
        letter_height: float = LETTER_HEIGHT,
        region_gap: float = REGION_GAP,
        n_regions: int = N_REGIONS,
        scene_file: str | Path | None = None,
        control: str = "physics",
        fps: int = HANDWRITING_FPS,
        render_mode: str | None = None,
        render_size: int = 640,
        camera: str = "arm",
        robot: str = "panda",
    ) -> None:
        for name, value, choices in (
            ("space", space, SPACES),
            ("control", control, CONTROLS),
            ("camera", camera, CAMERAS),
            ("render_mode", render_mode, (None, *self.metadata["render_modes"])),
        ):
            if value not in choices:
                raise ValueError(f"{name} must be one of {choices}, got {value!r}")
        self.scene = make_writing_scene(
            letter,
            letter_height=letter_height,
            region_gap=region_gap,
            n_regions=n_regions,
            scene_file=scene_file,
        )
        self.render_mode = render_mode
        self.task = f"handwriting-{space}"
        self.task_description = f"Write {self.scene.name} without entering a red region."
        self._space, self._control = space, control
        image_size = image_size_of(render_size)
        self.arm = find_arm(robot)
        self._model = make_writing_model(self.arm, draw_sheet(self.scene), image_size)
        self._data = mujoco.MjData(self._model)
        self._camera = ArmCamera(self.arm, self._model, camera, image_size)
        self._table = Obstacle(self._model, self._data, TABLE, movers(self.arm, self._model))
        self._tip = self._data.site(PEN_TIP).xpos  # a view
        self.kinematics = PenKinematics(self.arm, self._model)
        self._n_substeps = physics_steps(fps, self._model.opt.timestep)
        self.metadata = {**self.metadata, "render_fps": fps}
        self.action_space: spaces.Box = _action_space(space, self._model)
        # In full physics a joint may be pressed a little beyond its limit, and the pen may leave the sheet.
        self.observation_space = spaces.Dict(
            {"agent_pos": spaces.Box(-np.inf, np.inf, self.action_space.shape, dtype=np.float32)}
        )
        self._target = self.arm.home.copy()
        self._episode: WritingEpisode | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Starts an episode. The options are described in the class docstring.

        Raises:
            ValueError: If the start in `options` is not on the sheet, or the joints in it are beyond their limits.
        """
        super().reset(seed=seed)
        self._target = self._first_joints(options or {})
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:] = self._data.ctrl[:] = self._target
        mujoco.mj_forward(self._model, self._data)
        self._episode = WritingEpisode(self.scene, self._tip, self._table.clearance())
        return self._observation(), self._episode.info

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Moves the arm to joint positions ``(J,)`` [rad; m], or to a position ``(2,)`` of the pen [m].

        With ``control="physics"`` it moves towards them.

        Raises:
            ValueError: If the action has another shape or is not finite.
        """
        if self._episode is None:
            raise gym.error.ResetNeeded("call reset() before step()")
        target = np.asarray(action, dtype=np.float64)
        if target.shape != self.action_space.shape or not np.isfinite(target).all():
            raise ValueError(
                f"an action must be {self.action_space.shape[0]} finite positions, got {np.asarray(action).tolist()}"
            )
        target = target.clip(self.action_space.low, self.action_space.high)
        joints, beyond_reach = target, 0.0
        if self._space == "pen":
            joints, beyond_reach = self.kinematics.nearest_joints(target)
        move = self._move_exactly if self._control == "exact" else self._drive
        tips, table_clearance = move(joints)
        self._target = joints
        reward = self._episode.record(tips, table_clearance, beyond_reach)
        return self._observation(), reward, False, False, self._episode.info

    def render(self) -> np.ndarray | None:
        """An image ``(H, W, 3)`` uint8 of the arm, the sheet and the drawn line.

        Raises:
            RuntimeError: If this machine cannot render; the message says what to install.
        """
        if self.render_mode is None:
            return None
        if self._episode is None:
            raise gym.error.ResetNeeded("call reset() before render()")
        return self._camera.render(self._data, self._episode.ink)

    @property
    def ink(self) -> Ink:
        """The line drawn in this episode."""
        return Ink(self.scene) if self._episode is None else self._episode.ink

    @property
    def pen(self) -> np.ndarray:
        """Position ``(3,)`` of the pen's tip [m]."""
        return self._tip.copy()

    def check_joints(self, joints: np.ndarray, name: str) -> None:
        """Checks that ``(..., J)`` positions of joints [rad] and fingers [m] are within the arm's limits.

        Raises:
            ValueError: If they are not.
        """
        self.arm.check_joints(self._model, joints, name)

    def table_clearance(self, joints: np.ndarray) -> float:
        """Distance between the arm and the table at joint positions ``(J,)`` [m], negative if they touch."""
        self._show(joints)
        return self._table_clearance()

    def draw(self, joints: np.ndarray, ink: Ink) -> np.ndarray:
        """An image ``(H, W, 3)`` uint8 of the arm at joint positions ``(J,)`` [rad; m], and of a line.

        Raises:
            RuntimeError: If this machine cannot render; the message says what to install.
        """
        self._show(joints)
        return self._camera.render(self._data, ink)

    def close(self) -> None:
        """Frees the camera."""
        self._camera.close()

    def _first_joints(self, options: dict[str, Any]) -> np.ndarray:
        if options.get("joints") is not None:
            joints = np.asarray(options["joints"], dtype=np.float64)
            if joints.ndim != 1:
                raise ValueError(
                    f"joints must be {len(self.arm.home)} finite positions, got an array of shape {joints.shape}"
                )
            self.check_joints(joints, "joints")
            return joints
        return self.kinematics.joints(first_position(self.scene, options.get("start"), self.np_random))

    def _move_exactly(self, target: np.ndarray) -> tuple[np.ndarray, float]:
        """Moves the arm exactly to the target.

        Returns:
            ``(N, 3)`` the positions of the tip during the motion [m], and the smallest distance of the arm to the table [m].
        """
        start = self._data.qpos.copy()
        n = int(np.clip(math.ceil(np.abs(target - start).max() / _LARGEST_SWEEP), 1, _MAX_SWEEPS))
        tips, clearance = [self._tip.copy()], math.inf
        for share in np.arange(1, n + 1) / n:
            self._data.qpos[:] = start + share * (target - start)
            mujoco.mj_fwdPosition(self._model, self._data)
            clearance = min(clearance, self._table_clearance())
            tips.append(self._tip.copy())
        return np.array(tips), clearance

    def _drive(self, target: np.ndarray) -> tuple[np.ndarray, float]:
        """Drives the arm to the target in full physics; the set points of the controllers move there at constant speed.

        Returns:
            The same as `_move_exactly`.
        """
        before = self._target
        tips, clearance = [self._tip.copy()], math.inf
        for substep in range(1, self._n_substeps + 1):
            self._data.ctrl[:] = before + substep / self._n_substeps * (target - before)
            mujoco.mj_step(self._model, self._data)
            if substep % _STEPS_BETWEEN_TIPS == 0:
                tips.append(self._tip.copy())
                clearance = min(clearance, self._table_clearance())
            elif self._table.contact_depth() > 0:
                clearance = min(clearance, -self._table.contact_depth())
        # A physics step updates contacts and the position of the pen before it moves.
        mujoco.mj_fwdPosition(self._model, self._data)
        tips.append(self._tip.copy())
        return np.array(tips), min(clearance, self._table_clearance())

    def _show(self, joints: np.ndarray) -> None:
        self._data.qpos[:] = joints
        mujoco.mj_fwdPosition(self._model, self._data)

    def _table_clearance(self) -> float:
        depth = self._table.contact_depth()
        return -depth if depth > 0 else self._table.clearance()

    def _observation(self) -> dict[str, np.ndarray]:
        measured = self._data.qpos if self._space == "joint" else self._tip[:2]
        return {"agent_pos": measured.astype(np.float32)}


def physics_steps(fps: int, timestep: float) -> int:
    """Physics steps for each control step.

    Args:
        fps: Control frequency [Hz].
        timestep: Duration of a physics step [s].

    Raises:
        ValueError: If they are not a whole number.
    """
    physics_fps = round(1 / timestep)
    if fps < 1 or physics_fps % fps:
        raise ValueError(f"fps must divide the physics' {physics_fps} Hz, got {fps}")
    return physics_fps // fps


def _action_space(space: str, model: mujoco.MjModel) -> spaces.Box:
    if space == "joint":
        low, high = model.jnt_range.T
    else:
        low, high = SHEET_CORNERS
    return spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
