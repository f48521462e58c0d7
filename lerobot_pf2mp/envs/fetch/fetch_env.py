# SPDX-License-Identifier: Apache-2.0
"""Fetch with a wall: gymnasium-robotics' Reach and Push with positions as actions, and with collision reports."""

from __future__ import annotations

import atexit
import math
import weakref
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces

from lerobot_pf2mp.envs.fetch.fetch_model import make_fetch
from lerobot_pf2mp.envs.fetch.fetch_scene import (
    SUCCESS_RADIUS,
    WORKSPACE,
    Corners,
    check_inner_steps,
    make_scene,
)
from lerobot_pf2mp.envs.headless import rendering
from lerobot_pf2mp.envs.image_size import image_size_of

# Fetch moves the hand's target by at most 0.05 m times its action. In one step the hand covers about two thirds of that
# distance. With this gain and steps of at most `MAX_STEP` it stays within 2 mm of the action, 4 mm in the first step.
_GAIN = 30.0
MAX_STEP = 0.03  # [m]
_SETTLED = 0.001  # [m]
_MAX_SETTLING_STEPS = 60
# Position of the block while the gripper moves to its start, on the floor behind the table [m].
_PARKED = (2.0, 2.0, 0.025)
_CAMERA = {"lookat": np.array([1.3, 0.75, 0.48]), "distance": 1.35, "azimuth": 150.0, "elevation": -28.0}


class FetchEnv(gym.Env):
    """A Fetch robot that must reach a goal, or push a block to it, without touching a wall.

    ## Description
    gymnasium-robotics' FetchReach-v4 and FetchPush-v4 with a red wall on the table, as in Section V-C of the paper.
    Instead of displacements, actions are the gripper's next positions; an inner loop moves it there in full physics,
    500 Hz.

    ## Action space
    ``Box(3)``: the position x, y, z of the gripper [m]. Positions outside the workspace are clipped to it.

    ## Observation space
    ``Dict``: ``agent_pos`` ``(3,)``, the gripper's position [m], and ``environment_state``, the goal's ``(3,)`` for Reach,
    the block's and the goal's ``(6,)`` for Push [m].

    ## Rewards
    -1.0 on the first step with a collision in an episode, 0.0 otherwise. So the return of an episode is -1 with a collision
    and 0 without.

    ## Information
    ``is_success``: gripper (Reach) or block (Push) is within 0.05 m of the goal. ``is_collision``: a link of the robot, or
    the block, has touched the wall in this episode, in any physics step. ``clearance``: the smallest distance from the
    wall to robot and block [m], negative inside it. ``is_plan_in_wall``: an action of this episode lay inside the wall,
    the measure of earlier work (Wang et al., Cold Diffusion on the Replay Buffer, 2023). ``path_length``: the length of
    the gripper's executed path in this episode [m].

    ## Starting state
    Drawn from the ranges of the scene. ``reset(options={"start": (x, y, z), "goal": (x, y, z), "block": (x, y)})`` sets
    them [m].

    ## Episode end
    After the registered number of steps; at the goal too with `terminate_on_success`. A collision does not end it.

    Args:
        task: ``reach`` or ``push``.
        wall_position: x, y of the wall's centre [m]. For this and the next four, None means the value of the task in
            `fetch_scene.FETCH_SCENES`.
        wall_size: Its sides [m]; it stands on the table.
        start_range: Two opposite corners of the box of start positions of the gripper [m].
        goal_range: The same for the goal [m]; for Push x and y only.
        block_range: The same for the block, x and y [m]; for Push only.
        n_inner_steps: Steps of the inner loop for each action, 0.04 s each.
        terminate_on_success: Whether an episode ends at the goal.
        render_mode: ``rgb_array`` or None.
        render_size: Width of the image [pixels]; its height is three quarters of that.

    Raises:
        ValueError: If an argument breaks its rule.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012

    def __init__(
        self,
        task: str = "reach",
        wall_position: tuple[float, float] | None = None,
        wall_size: tuple[float, float, float] | None = None,
        start_range: Corners | None = None,
        goal_range: Corners | None = None,
        block_range: Corners | None = None,
        n_inner_steps: int = 1,
        terminate_on_success: bool = False,
        render_mode: str | None = None,
        render_size: int = 480,
    ) -> None:
        check_inner_steps(n_inner_steps)
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(
                f"render_mode must be None or one of {self.metadata['render_modes']}, got {render_mode!r}"
            )
        height, width = image_size_of(render_size)
        self.scene = make_scene(
            task,
            wall_position=wall_position,
            wall_size=wall_size,
            start_range=start_range,
            goal_range=goal_range,
            block_range=block_range,
        )
        self.render_mode = render_mode
        self.task = f"fetch-{task}"
        self.task_description = (
            "Push the block to the red goal without touching the wall."
            if self.scene.has_block
            else "Move the gripper to the red goal without touching the wall."
        )
        self._n_inner_steps = n_inner_steps
        self._terminate_on_success = terminate_on_success
        self._fetch = make_fetch(
            self.scene.wall,
            self.scene.has_block,
            default_camera_config=_CAMERA,
            width=width,
            height=height,
            render_mode="rgb_array",
        )
        self.metadata = {**self.metadata, "render_fps": round(1 / (self._fetch.dt * n_inner_steps))}
        low, high = WORKSPACE.low.astype(np.float32), WORKSPACE.high.astype(np.float32)
        self.action_space: spaces.Box = spaces.Box(low, high, dtype=np.float32)
        # Robot and block may be knocked out of the workspace.
        n_objects = 2 if self.scene.has_block else 1
        self.observation_space = spaces.Dict(
            {
                "agent_pos": spaces.Box(-np.inf, np.inf, (3,), dtype=np.float32),
                "environment_state": spaces.Box(-np.inf, np.inf, (3 * n_objects,), dtype=np.float32),
            }
        )
        self._grip = self._fetch.data.site("robot0:grip").xpos  # a view
        self._block: np.ndarray | None = (
            self._fetch.data.site("object0").xpos if self.scene.has_block else None
        )
        self._goal = np.zeros(3)
        self._is_running = self._has_rendered = False
        self._is_collision = self._is_plan_in_wall = False
        self._path_length = 0.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Starts an episode. The options are described in the class docstring.

        Raises:
            ValueError: If a position in `options` is outside the workspace or touches the wall, or the block cannot be
                pushed to the goal in a straight line.
        """
        super().reset(seed=seed)
        positions = {name: (options or {}).get(name) for name in ("start", "goal", "block")}
        layout = self.scene.sample(self.np_random, **positions)
        self._fetch.reset()
        self._fetch.goal = self._goal = layout.goal
        with self._fetch.obstacle.passable():
            if layout.block is not None:
                self._place_block(_PARKED)
            self._settle(layout.start)
        if layout.block is not None:
            self._place_block(layout.block)
        mujoco.mj_forward(self._fetch.model, self._fetch.data)
        self._is_running = True
        self._is_collision = self._is_plan_in_wall = False
        self._path_length = 0.0
        return self._observation(), self._info(self._fetch.obstacle.clearance())

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Moves the gripper towards a position ``(3,)`` [m].

        Raises:
            ValueError: If the action is not three finite coordinates.
        """
        if not self._is_running:
            raise gym.error.ResetNeeded("call reset() before step()")
        target = np.asarray(action, dtype=np.float64)
        if target.shape != (3,) or not np.isfinite(target).all():
            raise ValueError(f"an action must be three finite coordinates [m], got {action}")
        target = target.clip(self.action_space.low, self.action_space.high)
        self._is_plan_in_wall |= bool(self.scene.wall.contains(target))
        depth = 0.0
        for _ in range(self._n_inner_steps):
            before = self._grip.copy()
            depth = max(depth, self._move(target))
            self._path_length += math.dist(before, self._grip)
        is_first = depth > 0 and not self._is_collision
        self._is_collision |= depth > 0
        info = self._info(min(self._fetch.obstacle.clearance(), -depth if depth > 0 else math.inf))
        terminated = self._terminate_on_success and info["is_success"]
        return self._observation(), -1.0 if is_first else 0.0, terminated, False, info

    def render(self) -> np.ndarray | None:
        """An image ``(H, W, 3)`` uint8 of robot, wall, block and goal.

        Raises:
            RuntimeError: If this machine cannot render; the message says what to install.
        """
        if self.render_mode is None:
            return None
        if not self._is_running:
            raise gym.error.ResetNeeded("call reset() before render()")
        with rendering():
            image = self._fetch.render()
        if not self._has_rendered:
            # Without this, the renderer of an environment that is not closed prints an error when Python exits. It is
            # registered after the first rendering: then it is called before the exit handler of MuJoCo, which ends OpenGL.
            atexit.register(_close, weakref.ref(self._fetch))
            self._has_rendered = True
        return image

    def close(self) -> None:
        """Frees the simulation."""
        self._fetch.close()

    def _settle(self, start: np.ndarray) -> None:
        for _ in range(_MAX_SETTLING_STEPS):
            self._move(start)
            if math.dist(self._grip, start) < _SETTLED:
                return

    def _move(self, target: np.ndarray) -> float:
        """Takes one step of Fetch towards the target.

        Returns:
            The largest depth of the robot or the block in the wall during the step [m]; at most 0 without contact.
        """
        fetch = self._fetch
        displacement = ((target - self._grip) * _GAIN).clip(-1, 1)
        fetch._set_action(np.array([*displacement, 0.0]))
        depth = 0.0
        for _ in range(fetch.n_substeps):
            mujoco.mj_step(fetch.model, fetch.data)
            depth = max(depth, fetch.obstacle.contact_depth())
        fetch._step_callback()
        # A physics step detects contacts before it moves; the callback has detected them again.
        return max(depth, fetch.obstacle.contact_depth())

    def _place_block(self, position: np.ndarray | tuple[float, float, float]) -> None:
        joint = self._fetch.data.joint("object0:joint")
        joint.qpos[:] = [*position, 1.0, 0.0, 0.0, 0.0]
        joint.qvel[:] = 0.0

    def _observation(self) -> dict[str, np.ndarray]:
        positions = [self._goal] if self._block is None else [self._block, self._goal]
        return {
            "agent_pos": self._grip.astype(np.float32),
            "environment_state": np.concatenate(positions).astype(np.float32),
        }

    def _info(self, clearance: float) -> dict[str, Any]:
        moved = self._grip if self._block is None else self._block
        return {
            "is_success": math.dist(moved, self._goal) < SUCCESS_RADIUS,
            "is_collision": self._is_collision,
            "is_plan_in_wall": self._is_plan_in_wall,
            "clearance": clearance,
            "path_length": self._path_length,
        }


def _close(env: weakref.ref[gym.Env]) -> None:
    alive = env()
    if alive is not None:
        alive.close()
