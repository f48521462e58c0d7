# SPDX-License-Identifier: Apache-2.0
"""A ball in a maze: gymnasium-robotics' PointMaze with positions as actions and collisions reported."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces
from gymnasium_robotics.envs.maze.maps import LARGE_MAZE, MEDIUM_MAZE, U_MAZE
from gymnasium_robotics.envs.maze.point_maze import PointMazeEnv

from lerobot_pf2mp.envs.maze_picture import MazePicture

BALL_RADIUS = 0.1  # [m], of PointMaze's particle_geom
SUCCESS_RADIUS = 0.45  # [m], PointMaze's own
CONTROLS = ("exact", "pd")
MAZE_MAPS = {"umaze": U_MAZE, "medium": MEDIUM_MAZE, "large": LARGE_MAZE}

# The controller of D4RL's maze2d generator: force = clip(10 (target - position) - velocity, -1, 1), times 100 N.
POSITION_GAIN = 10.0
VELOCITY_GAIN = 1.0
MAX_SPEED = 5.0  # [m/s] for each axis, PointMaze's own limit

# What a clearance is looked for within [m]; nothing in a maze of unit cells is farther from a wall.
_CLEARANCE_RANGE = 2.0
_TALL_WALL = 10.0  # half height [m]
# MuJoCo's distance between a capsule and a box looks at the capsule's ends: where the whole of a long one crosses the box
# in the middle, it finds none. Short pieces are measured to within 1e-6 m.
_LONGEST_PIECE = 0.25  # [m]
# MuJoCo's distance to a box is wrong for capsules of no length at all.
_SHORTEST_HALF_LENGTH = 1e-5


def parse_maze_map(text: str) -> list[list[int]]:
    """The rows of a maze map, 1 for a wall and 0 for a free cell.

    Args:
        text: The name of one of `MAZE_MAPS`, or rows of 0 and 1 separated by "/", for example ``11111/10001/11111``.

    Returns:
        The rows, north first.

    Raises:
        ValueError: If the map is not a closed rectangle of 0 and 1 whose free cells, two at least, are connected.
    """
    if text in MAZE_MAPS:
        return [list(row) for row in MAZE_MAPS[text]]
    lines = [line for line in str(text).replace("\n", "/").replace(" ", "").split("/") if line]
    if not lines or set("".join(lines)) - {"0", "1"} or len({len(line) for line in lines}) != 1:
        raise ValueError(
            f"maze_map must be one of {list(MAZE_MAPS)} or equally long rows of 0 and 1 separated by '/', got {text!r}"
        )
    rows = [[int(cell) for cell in line] for line in lines]
    border = rows[0] + rows[-1] + [row[0] for row in rows] + [row[-1] for row in rows]
    if 0 in border:
        raise ValueError(f"maze_map must be closed: every cell of its border a wall (1), got {text!r}")
    free = {(i, j) for i, row in enumerate(rows) for j, cell in enumerate(row) if cell == 0}
    if len(free) < 2:
        raise ValueError(
            f"maze_map must have at least two free cells (0), a start and a goal, got {len(free)} in {text!r}"
        )
    reached, frontier = set(), {min(free)}
    while frontier:
        reached |= frontier
        frontier = {
            cell for i, j in frontier for cell in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1))
        } & free - reached
    if reached != free:
        raise ValueError(
            f"maze_map must be connected, got {len(free - reached)} free cells that {min(free)} cannot reach"
        )
    return rows


def make_point_maze(maze_map: str) -> tuple[PointMazeEnv, mujoco.MjSpec]:
    """PointMaze for a map, and the specification of its MuJoCo model.

    Args:
        maze_map: As for `parse_maze_map`.

    Returns:
        The environment, and the specification, free to be extended.
    """
    env = PointMazeEnv(maze_map=parse_maze_map(maze_map), continuing_task=True, reset_target=False)
    xml = Path(env.tmp_xml_file_path)
    spec = mujoco.MjSpec.from_file(str(xml))
    xml.unlink()  # PointMaze leaves it behind
    return env, spec


class SweptBall:
    """The clearance of a ball moved along a straight line, which is a capsule, measured by MuJoCo.

    Args:
        spec: Specification of a PointMaze model; its walls are the geoms ``block_*``.
        radius: Radius of the ball [m]; 0 for a point.
    """

    def __init__(self, spec: mujoco.MjSpec, radius: float) -> None:
        for geom in spec.geoms:
            if geom.name.startswith("block_"):
                geom.size[2] = _TALL_WALL  # so that the way out of a wall is sideways, never over the top
        body = spec.worldbody.add_body(name="swept_ball")
        body.add_geom(
            name="swept_ball",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=[BALL_RADIUS, BALL_RADIUS, 0],
            contype=0,
            conaffinity=0,
        )
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._data)
        self._geom = self._model.geom("swept_ball").id
        self._walls = np.array(
            [i for i in range(self._model.ngeom) if self._model.geom(i).name.startswith("block_")]
        )
        self._centres = self._model.geom_pos[self._walls, :2].copy()
        self._half_sizes = self._model.geom_size[self._walls, :2].copy()
        self._height = float(
            self._model.geom_pos[self._walls[0], 2]
        )  # the walls are prisms: any height will do
        self._radius = radius

    def clearance(self, start: np.ndarray, end: np.ndarray) -> float:
        """The smallest distance between the moving ball and a wall [m]; negative by the depth where it enters one.

        Args:
            start: ``(2,)`` position of its centre before [m].
            end: ``(2,)`` position after [m].
        """
        n_pieces = max(1, math.ceil(math.dist(start, end) / _LONGEST_PIECE))
        return min(
            self._clearance_of_piece(*piece) for piece in pairwise(np.linspace(start, end, n_pieces + 1))
        )

    def _clearance_of_piece(self, start: np.ndarray, end: np.ndarray) -> float:
        low, high = np.minimum(start, end), np.maximum(start, end)
        # The gap between bounding boxes bounds the distance from below: measure the walls in that order.
        gaps = np.maximum(self._centres - self._half_sizes - high, low - self._centres - self._half_sizes)
        bounds = np.linalg.norm(gaps.clip(min=0), axis=1) - self._radius
        self._place(start, end)
        smallest = _CLEARANCE_RANGE
        for wall in np.argsort(bounds):
            if bounds[wall] >= smallest:
                break
            distance = mujoco.mj_geomDistance(
                self._model, self._data, self._geom, self._walls[wall], _CLEARANCE_RANGE, None
            )
            smallest = min(smallest, distance)
        return smallest

    def collides(self, path: np.ndarray) -> bool:
        """Whether the ball touches a wall along a polyline ``(N, 2)`` of positions [m], N >= 2."""
        low, high = np.minimum(path[:-1], path[1:]), np.maximum(path[:-1], path[1:])  # (N - 1, 2)
        gaps = np.maximum(
            (self._centres - self._half_sizes)[:, None] - high,
            low - (self._centres + self._half_sizes)[:, None],
        ).max(axis=-1)  # (walls, N - 1), a lower bound of the distance to the centre's way
        close = np.flatnonzero((gaps < self._radius).any(axis=0))
        return any(self.clearance(path[i], path[i + 1]) < 0 for i in close)

    def path_clearance(self, path: np.ndarray) -> float:
        """The smallest clearance along a polyline ``(N, 2)`` of positions [m], N >= 2."""
        return min(self.clearance(start, end) for start, end in pairwise(path))

    def _place(self, start: np.ndarray, end: np.ndarray) -> None:
        step = end - start
        length = float(np.hypot(*step))
        x, y = step / length if length > 0 else (1.0, 0.0)
        half_length = max(length / 2, _SHORTEST_HALF_LENGTH)
        self._model.geom_size[self._geom, :2] = max(self._radius, 1e-6), half_length
        self._model.geom_rbound[self._geom] = self._radius + half_length
        self._data.geom_xpos[self._geom] = *(start + end) / 2, self._height
        # A capsule lies along its z axis: the columns are its x, y and z axes in the world.
        self._data.geom_xmat[self._geom] = (y, 0.0, x, -x, 0.0, y, 0.0, -1.0, 0.0)


class MazeEnv(gym.Env):
    """A ball that must reach a goal in a maze without touching a wall.

    ## Description
    gymnasium-robotics' PointMaze: unit cells, walls of 0.4 m, a ball of 0.1 m radius, MuJoCo at 100 Hz. Instead of
    forces, actions are the ball's next positions, as in Section V-B of the paper.

    ## Action space
    ``Box(2)``: the next position x, y of the ball [m]. Positions outside the map are moved to its border, which is wall.

    ## Observation space
    ``Dict``: ``agent_pos`` ``(2,)``, the ball's position [m], and ``environment_state`` ``(2,)``, the goal's [m].

    ## Rewards
    -1.0 on the first step in collision of an episode, 0.0 otherwise; the sum over an episode is minus its collision.

    ## Information
    ``is_success``: the ball is within 0.45 m of the goal. ``is_collision``: it has touched a wall in this episode.
    ``clearance``: the smallest distance to a wall on the way of this step [m], negative inside one.

    ## Starting state
    PointMaze's: start and goal in different free cells, each up to 0.25 m off the centre on both axes. ``reset(options=
    {"start": (x, y), "goal": (x, y)})`` sets them [m].

    ## Episode end
    After the registered number of steps; at the goal too with `terminate_on_success`. A collision does not end it.

    Args:
        maze_map: As for `parse_maze_map`.
        control: ``exact``, the ball reaches every action, as the paper assumes of its low-level controller; or ``pd``, a
            PD controller drives it there in full physics. In both the way between two positions is swept for contact.
        collision_radius: Distance of the ball's centre to a wall below which it collides [m]: 0.1, the ball's radius, or 0.
        fps: Control frequency [Hz], a divisor of the physics' 100 Hz.
        terminate_on_success: Whether an episode ends at the goal.
        render_mode: ``rgb_array`` or None.
        render_size: Longer side of the picture [pixels].

    Raises:
        ValueError: If an argument breaks its rule.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    task_description = "Move the ball to the red goal without touching a wall."

    def __init__(
        self,
        maze_map: str = "large",
        control: str = "exact",
        collision_radius: float = BALL_RADIUS,
        fps: int = 10,
        terminate_on_success: bool = False,
        render_mode: str | None = None,
        render_size: int = 480,
    ) -> None:
        if control not in CONTROLS:
            raise ValueError(f"control must be one of {CONTROLS}, got {control!r}")
        if not 0 <= collision_radius <= BALL_RADIUS:
            raise ValueError(f"collision_radius must lie in [0, {BALL_RADIUS}] m, got {collision_radius}")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(
                f"render_mode must be None or one of {self.metadata['render_modes']}, got {render_mode!r}"
            )
        self.render_mode = render_mode
        self.task = f"maze-{maze_map}" if maze_map in MAZE_MAPS else "maze"
        self._control = control
        self._collision_radius = collision_radius
        self._terminate_on_success = terminate_on_success
        self._maze, spec = make_point_maze(maze_map)
        physics_fps = round(1 / self._maze.model.opt.timestep)
        if fps < 1 or physics_fps % fps:
            raise ValueError(f"fps must divide the physics' {physics_fps} Hz, got {fps}")
        self.metadata = {**self.metadata, "render_fps": fps}
        self._n_substeps = physics_fps // fps
        self._swept_ball = SweptBall(spec, collision_radius)
        self._picture = MazePicture(self._maze.maze.maze_map, render_size)
        border = np.array([self._maze.maze.x_map_center, self._maze.maze.y_map_center], dtype=np.float32)
        self.action_space: spaces.Box = spaces.Box(-border, border, dtype=np.float32)
        self.observation_space = spaces.Dict(
            {
                "agent_pos": spaces.Box(-border, border, dtype=np.float32),
                "environment_state": spaces.Box(-border, border, dtype=np.float32),
            }
        )
        self._path: list[np.ndarray] = []
        self._collisions: list[np.ndarray] = []

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Starts an episode; see the class for the options.

        Raises:
            ValueError: If a start or goal asked for is in a wall or outside the map.
        """
        super().reset(seed=seed)
        self._maze.reset(seed=seed)
        options = options or {}
        if options.get("goal") is not None:
            self._maze.goal = self._free_position(options["goal"], "goal")
        if options.get("start") is not None:
            start = self._free_position(options["start"], "start")
            self._maze.point_env.set_state(start, np.zeros(2))
        self._path = [self._position]
        self._collisions = []
        clearance = self._swept_ball.clearance(self._position, self._position)
        return self._observation(), self._info(clearance)

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Moves the ball to, or towards, ``(2,)`` a position [m].

        Raises:
            ValueError: If the action is not finite.
        """
        if not self._path:
            raise gym.error.ResetNeeded("call reset() before step()")
        target = np.asarray(action, dtype=np.float64)
        if target.shape != (2,) or not np.isfinite(target).all():
            raise ValueError(f"an action must be two finite coordinates [m], got {action}")
        target = target.clip(self.action_space.low, self.action_space.high)
        way = self._move_exactly(target) if self._control == "exact" else self._drive(target)
        clearance = self._swept_ball.path_clearance(np.array(way))
        first_collision = clearance < 0 and not self._collisions
        if clearance < 0:
            self._collisions.append(way[-1])
        self._path.extend(way[1:])
        info = self._info(clearance)
        terminated = self._terminate_on_success and info["is_success"]
        return self._observation(), -1.0 if first_collision else 0.0, terminated, False, info

    def render(self) -> np.ndarray | None:
        """A top view ``(H, W, 3)`` uint8: walls, goal, ball, its way so far, and crosses where it collided."""
        if self.render_mode is None:
            return None
        return self._picture.draw(
            ball=self._position, goal=self._maze.goal, path=self._path, collisions=self._collisions
        )

    def close(self) -> None:
        """Frees the simulation."""
        self._maze.close()

    @property
    def _position(self) -> np.ndarray:
        return self._maze.data.qpos[:2].copy()

    def _move_exactly(self, target: np.ndarray) -> list[np.ndarray]:
        start = self._position
        self._maze.point_env.set_state(target, np.zeros(2))
        return [start, target]

    def _drive(self, target: np.ndarray) -> list[np.ndarray]:
        """The ball's positions at every physics step while it tracks the straight line to the target."""
        start = self._position
        dt = self._maze.model.opt.timestep
        line_velocity = (target - start) / (self._n_substeps * dt)
        way = [start]
        for substep in range(1, self._n_substeps + 1):
            reference = start + line_velocity * (substep * dt)
            step_physics(self._maze.model, self._maze.data, reference, line_velocity)
            way.append(self._position)
        return way

    def _free_position(self, position: Any, name: str) -> np.ndarray:
        position = np.asarray(position, dtype=np.float64)
        inside = position.shape == (2,) and bool(np.all(np.abs(position) <= self.action_space.high))
        if not inside or self._swept_ball.clearance(position, position) < 0:
            raise ValueError(
                f"{name} must be a position x, y [m] clear of the walls, got {position.tolist()}"
            )
        return position

    def _observation(self) -> dict[str, np.ndarray]:
        bounds = self.action_space.low, self.action_space.high
        return {
            "agent_pos": self._position.astype(np.float32).clip(*bounds),
            "environment_state": self._maze.goal.astype(np.float32).clip(*bounds),
        }

    def _info(self, clearance: float) -> dict[str, Any]:
        return {
            "is_success": bool(np.linalg.norm(self._position - self._maze.goal) <= SUCCESS_RADIUS),
            "is_collision": bool(self._collisions),
            "clearance": clearance,
        }


def step_physics(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    target: Sequence[float] | np.ndarray,
    target_velocity: Sequence[float] | np.ndarray = (0.0, 0.0),
    force_noise: Sequence[float] | np.ndarray = (0.0, 0.0),
) -> None:
    """One physics step of PointMaze under the PD controller of D4RL's generator.

    Args:
        model: PointMaze's model.
        data: Its state.
        target: Position x, y to drive to [m].
        target_velocity: Velocity to have there [m/s]; D4RL's controller uses zero.
        force_noise: Added to the normalised force before it is clipped to [-1, 1].
    """
    # Plain numbers: for two coordinates they are several times faster than arrays.
    position, velocity = data.qpos.tolist(), data.qvel.tolist()
    for axis in (0, 1):
        speed = min(max(velocity[axis], -MAX_SPEED), MAX_SPEED)
        force = (
            POSITION_GAIN * (target[axis] - position[axis])
            + VELOCITY_GAIN * (target_velocity[axis] - speed)
            + force_noise[axis]
        )
        data.qvel[axis] = speed
        data.ctrl[axis] = min(max(force, -1.0), 1.0)
    mujoco.mj_step(model, data)
