# SPDX-License-Identifier: Apache-2.0
"""An SO-101 arm that carries a cube over a wall, moved through so101-nexus' LeRobot robot, with collision reports."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from lerobot_pf2mp.envs.so101.fence_scene import SO101_FPS
from lerobot_pf2mp.envs.so101.needs import check_so101
from lerobot_pf2mp.envs.tasks import OBS_TYPES

SIMULATION_ID = "lerobot_pf2mp/SO101FenceSimulation-v0"
# The robot's action and state: LeRobot's names and units of an SO-101, as `lerobot-record` writes them.
JOINTS = tuple(
    f"{name}.pos"
    for name in ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
)

TASK_DESCRIPTION = "Carry the cube over the wall to the blue disc without touching the wall."


class SO101FenceEnv(gym.Env):
    """An SO-101 arm that must carry a cube over a wall to a disc on the table, without touching the wall.

    ## Description
    The arm, its controllers and its physics are those of so101-nexus (200 Hz), and every action and state passes through
    that package's LeRobot robot ``sim_so_follower``, as on a real SO-101: units and resolution are those of the motors.

    ## Action space
    ``Box(6)``: targets of the five joints [degrees] and opening of the gripper [0 to 100], 20 in a second.

    ## Observation space
    ``Dict``: ``agent_pos`` ``(6,)``, the same of where the joints are; with ``obs_type="state"`` ``environment_state``
    ``(5,)``, x, y, z of the cube and x, y of the goal [m]; with ``obs_type="pixels_agent_pos"`` ``pixels`` with the image
    ``front`` ``(H, W, 3)`` uint8.

    ## Rewards
    -1.0 on the first step with a collision in an episode, 0.0 otherwise.

    ## Information
    ``is_success``: the cube's centre lies within 0.03 m of the goal, on the table, and the gripper does not hold it.
    ``is_collision``: the arm or the cube has touched the wall in this episode, in any physics step. ``is_table_contact``:
    the same for the arm and the table. ``clearance``: distance from the wall to arm and cube [m], negative inside.
    ``path_length``: length of the path of the tool centre point in this episode [m].

    ## Starting state
    Drawn from the ranges of the scene. ``reset(options={"cube": (x, y), "goal": (x, y)})`` sets them [m].

    ## Episode end
    After the registered number of steps; at success too with `terminate_on_success`. A collision does not end it.

    Args:
        obs_type: state or pixels_agent_pos.
        wall_position: x, y of the wall's centre [m]. For this and the next three, None is the task's own value, see
            `FenceScene`.
        wall_size: Lengths of its sides [m].
        cube_range: Two opposite corners of the rectangle of the cube's positions [m].
        goal_range: The same for the goal [m].
        terminate_on_success: Whether an episode ends when the cube lies at the goal.
        render_mode: ``rgb_array`` or None.
        image_size: Height and width of the observed image [pixels]. It shows the shapes that collisions are computed with.
        render_size: Height and width of the images of `render` [pixels].
        detail: What those show: shapes (fast) or meshes (0.2 s an image without a graphics card).

    Raises:
        ImportError: If so101-nexus is missing.
        ValueError: If an argument breaks its rule.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": SO101_FPS}  # noqa: RUF012

    def __init__(
        self,
        obs_type: str = "state",
        wall_position: tuple[float, float] | None = None,
        wall_size: tuple[float, float, float] | None = None,
        cube_range: Any = None,
        goal_range: Any = None,
        terminate_on_success: bool = False,
        render_mode: str | None = None,
        image_size: int = 96,
        render_size: int = 480,
        detail: str = "shapes",
    ) -> None:
        if obs_type not in OBS_TYPES:
            raise ValueError(f"obs_type must be one of {list(OBS_TYPES)}, got {obs_type!r}")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(
                f"render_mode must be None or one of {self.metadata['render_modes']}, got {render_mode!r}"
            )
        self._has_camera = obs_type == "pixels_agent_pos"
        self._robot = connected_robot(
            {
                "wall_position": wall_position,
                "wall_size": wall_size,
                "cube_range": cube_range,
                "goal_range": goal_range,
                "has_camera": self._has_camera,
                "image_size": image_size,
                "render_size": render_size,
                "detail": detail,
            }
        )
        self._simulation: Any = self._robot._env.unwrapped
        self.render_mode = render_mode
        self.scene = self._simulation.scene
        self.task = "so101-fence"
        self.task_description = TASK_DESCRIPTION
        self._terminate_on_success = terminate_on_success
        low, high = self._limits()
        self.action_space: spaces.Box = spaces.Box(low, high, dtype=np.float32)
        observations: dict[str, spaces.Space] = {
            "agent_pos": spaces.Box(-np.inf, np.inf, (len(JOINTS),), dtype=np.float32)
        }
        if self._has_camera:
            image = spaces.Box(0, 255, (image_size, image_size, 3), dtype=np.uint8)
            observations["pixels"] = spaces.Dict({"front": image})
        else:
            observations["environment_state"] = spaces.Box(-np.inf, np.inf, (5,), dtype=np.float32)
        self.observation_space = spaces.Dict(observations)
        self._is_running = self._is_collision = self._is_table_contact = False
        self._path_length = 0.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Starts an episode. The options are described in the class docstring.

        Raises:
            ValueError: If a position in `options` is out of reach or too near the wall.
        """
        super().reset(seed=seed)
        chosen = {name: (options or {}).get(name) for name in ("cube", "goal")}
        self._simulation.reset(seed=int(self.np_random.integers(2**31)), options=chosen)
        self._is_running = True
        self._is_collision = self._is_table_contact = False
        self._path_length = 0.0
        return self._observation(), self._info({"success": False}, self._simulation.wall.clearance())

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Sends joint targets ``(6,)`` [degrees, percent] to the robot.

        Raises:
            ValueError: If the action is not six finite numbers.
        """
        if not self._is_running:
            raise gym.error.ResetNeeded("call reset() before step()")
        targets = np.asarray(action, dtype=np.float64)
        if targets.shape != (len(JOINTS),) or not np.isfinite(targets).all():
            raise ValueError(
                f"an action must be {len(JOINTS)} finite joint targets [degrees, percent], got {action}"
            )
        targets = targets.clip(self.action_space.low, self.action_space.high)
        before = self._simulation.tcp
        self._robot.send_action(dict(zip(JOINTS, targets.tolist(), strict=True)))
        contacts = self._robot.last_step_info().info
        self._path_length += float(np.linalg.norm(self._simulation.tcp - before))
        depth = contacts["wall_depth"]
        is_first = depth > 0 and not self._is_collision
        self._is_collision |= depth > 0
        self._is_table_contact |= contacts["table_depth"] > 0
        clearance = min(self._simulation.wall.clearance(), -depth if depth > 0 else np.inf)
        info = self._info(contacts, clearance)
        terminated = self._terminate_on_success and info["is_success"]
        return self._observation(), -1.0 if is_first else 0.0, terminated, False, info

    def render(self) -> np.ndarray | None:
        """An image ``(H, W, 3)`` uint8.

        Raises:
            RuntimeError: If this machine cannot render; the message says what to install.
        """
        if self.render_mode is None:
            return None
        if not self._is_running:
            raise gym.error.ResetNeeded("call reset() before render()")
        return self._simulation.render()

    def close(self) -> None:
        """Frees the simulation."""
        if self._robot.is_connected:
            self._robot.disconnect()

    def _limits(self) -> tuple[np.ndarray, np.ndarray]:
        from so101_nexus import sim_qpos_to_dataset_row

        space = self._simulation.action_space
        return tuple(
            sim_qpos_to_dataset_row(bound.astype(float)).astype(np.float32)
            for bound in (space.low, space.high)
        )  # type: ignore[return-value]

    def _observation(self) -> dict[str, Any]:
        seen = self._robot.get_observation()
        observation: dict[str, Any] = {
            "agent_pos": np.array([seen[name] for name in JOINTS], dtype=np.float32)
        }
        if self._has_camera:
            observation["pixels"] = {"front": seen["front"]}
        else:
            positions = [*self._simulation.cube, *self._simulation.layout.goal]
            observation["environment_state"] = np.array(positions, dtype=np.float32)
        return observation

    def _info(self, contacts: dict[str, Any], clearance: float) -> dict[str, Any]:
        return {
            "is_success": bool(contacts["success"]),
            "is_collision": self._is_collision,
            "is_table_contact": self._is_table_contact,
            "clearance": clearance,
            "path_length": self._path_length,
        }


def connected_robot(env_kwargs: dict[str, Any]) -> Any:
    """so101-nexus' robot ``sim_so_follower``, connected to a `FenceSimulation`.

    Args:
        env_kwargs: Arguments of `FenceSimulation`; its camera is the robot's, if it has one.

    Raises:
        ImportError: If so101-nexus is missing.
    """
    check_so101()
    from so101_nexus.lerobot_adapter import SimCameraConfig, SimSOFollower, SimSOFollowerConfig
    from so101_nexus.lerobot_adapter.synthetic_calibration import build_synthetic_calibration

    cameras = {}
    if env_kwargs["has_camera"]:
        size = env_kwargs["image_size"]
        cameras["front"] = SimCameraConfig(source="front", height=size, width=size, fps=SO101_FPS)
    config = SimSOFollowerConfig(id="fence", env_id=SIMULATION_ID, env_kwargs=env_kwargs, cameras=cameras)
    robot = SimSOFollower(config)
    robot.calibration = build_synthetic_calibration()
    robot.connect()
    return robot
