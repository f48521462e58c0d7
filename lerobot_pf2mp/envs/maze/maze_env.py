# SPDX-License-Identifier: Apache-2.0
"""A ball in a maze: gymnasium-robotics' PointMaze with positions as actions, and with collision reports."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from lerobot_pf2mp.envs.maze.discs import DISC_RADIUS, N_FEATURES, Discs, discs_to_draw
from lerobot_pf2mp.envs.maze.maze_image import MazeImage
from lerobot_pf2mp.envs.maze.point_maze import BALL_RADIUS, MAZE_MAPS, make_point_maze, step_physics
from lerobot_pf2mp.envs.maze.swept_ball import SweptBall

SUCCESS_RADIUS = 0.45  # [m], PointMaze's own
CONTROLS = ("exact", "pd")


class MazeEnv(gym.Env):
    """A ball that must reach a goal in a maze without touching a wall.

    ## Description
    gymnasium-robotics' PointMaze: unit cells, walls of 0.4 m, a ball of 0.1 m radius, MuJoCo at 100 Hz. Instead of
    forces, actions are the ball's next positions, as in Section V-B of the paper.

    ## Action space
    ``Box(2)``: the next position x, y of the ball [m]. Positions outside the map are clipped to its border, which is wall.

    ## Observation space
    ``Dict``: ``agent_pos`` ``(2,)``, the ball's position [m], and ``environment_state`` ``(2,)``, the goal's [m]. With
    obstacles also ``obstacles`` ``(n_obstacles, 10)``: present or not, centre, half sides (0), axis, velocity and radius of
    each disc [m, m/s], as `obstacle_field.Obstacles.rows` has them.

    ## Rewards
    -1.0 on the first step with a collision, with a wall or a disc, in an episode, 0.0 otherwise. So the return of an episode
    is -1 with a collision and 0 without.

    ## Information
    ``is_success``: the ball is within 0.45 m of the goal. ``is_collision``: it has touched a wall in this episode.
    ``clearance``: the smallest distance to a wall during this step [m], negative inside one. ``path_length``: the length of
    the executed path in this episode [m]. With obstacles also ``is_obstacle_collision``: the ball has touched a disc in this
    episode, and ``obstacle_clearance``: the smallest distance to a disc during this step [m], inf without any.

    ## Starting state
    PointMaze's: start and goal in different free cells, each up to 0.25 m off the centre on both axes. ``reset(options=
    {"start": (x, y), "goal": (x, y)})`` sets them [m]; ``reset_cell`` and ``goal_cell``, row and column in the map,
    choose the cells, as in gymnasium-robotics.

    ## Episode end
    After the registered number of steps; at the goal too with `terminate_on_success`. A collision does not end it.

    Args:
        maze_map: As for `parse_maze_map`.
        control: ``exact``: the ball reaches every action, as the paper assumes of its low-level controller. ``pd``: a PD
            controller drives it there in full physics. With both, the path between two positions is checked for contact.
        collision_radius: Distance of the ball's centre to a wall below which it collides [m]: 0.1, the ball's radius, or 0.
        fps: Control frequency [Hz], a divisor of the physics' 100 Hz.
        terminate_on_success: Whether an episode ends at the goal.
        n_obstacles: Discs of 0.1 m radius on the shortest way from start to goal, which the demonstrations did not have and
            which leave a free way, see `Discs`.
        obstacle_speed: Their speed across the corridor [m/s].
        render_mode: ``rgb_array`` or None.
        render_size: Longer side of the image [pixels].

    Raises:
        ValueError: If an argument breaks its rule.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    task_description = "Move the ball to the red goal without touching a wall."

    def __init__(
        self,
        maze_map: str | Sequence[Sequence[int]] = "large",
        control: str = "exact",
        collision_radius: float = BALL_RADIUS,
        fps: int = 10,
        terminate_on_success: bool = False,
        n_obstacles: int = 0,
        obstacle_speed: float = 0.0,
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
        if n_obstacles < 0:
            raise ValueError(f"n_obstacles must be at least 0, got {n_obstacles}")
        if not (obstacle_speed >= 0 and math.isfinite(obstacle_speed)):
            raise ValueError(f"obstacle_speed must be finite and at least 0, got {obstacle_speed}")
        self.render_mode = render_mode
        self.task = f"maze-{maze_map}" if isinstance(maze_map, str) and maze_map in MAZE_MAPS else "maze"
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
        self._image = MazeImage(self._maze.maze.maze_map, render_size)
        border = np.array([self._maze.maze.x_map_center, self._maze.maze.y_map_center], dtype=np.float32)
        self.action_space: spaces.Box = spaces.Box(-border, border, dtype=np.float32)
        self.observation_space = spaces.Dict(
            {
                "agent_pos": spaces.Box(-border, border, dtype=np.float32),
                "environment_state": spaces.Box(-border, border, dtype=np.float32),
            }
        )
        self._fps = fps
        self._discs = Discs(self._maze.maze, n_obstacles, obstacle_speed) if n_obstacles else None
        if self._discs is not None:
            self.observation_space.spaces["obstacles"] = spaces.Box(
                -np.inf, np.inf, (n_obstacles, N_FEATURES), dtype=np.float32
            )
        self._path: list[np.ndarray] = []
        self._collisions: list[np.ndarray] = []
        self._disc_collisions: list[np.ndarray] = []
        self._path_length = 0.0
        self._n_steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Starts an episode. The options are described in the class docstring.

        Raises:
            ValueError: If the start or goal in `options` is in a wall or outside the map.
        """
        super().reset(seed=seed)
        options = options or {}
        cells = {name: self._free_cell(options, name) for name in ("reset_cell", "goal_cell")}
        self._maze.reset(seed=seed, options=cells if any(cells.values()) else None)
        if options.get("goal") is not None:
            self._maze.goal = self._free_position(options["goal"], "goal")
        if options.get("start") is not None:
            start = self._free_position(options["start"], "start")
            self._maze.point_env.set_state(start, np.zeros(2))
        self._path = [self._position]
        self._collisions, self._disc_collisions = [], []
        self._path_length, self._n_steps = 0.0, 0
        if self._discs is not None:
            self._discs.place(self._position, np.asarray(self._maze.goal), self.np_random)
        clearance = self._swept_ball.clearance(self._position, self._position)
        return self._observation(), self._info(
            clearance, self._disc_clearance([self._position] * 2, 0.0, 0.0)
        )

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Moves the ball to a position ``(2,)`` [m], or towards it with ``control="pd"``.

        Raises:
            ValueError: If the action is not finite.
        """
        if not self._path:
            raise gym.error.ResetNeeded("call reset() before step()")
        target = np.asarray(action, dtype=np.float64)
        if target.shape != (2,) or not np.isfinite(target).all():
            raise ValueError(f"an action must be two finite coordinates [m], got {action}")
        target = target.clip(self.action_space.low, self.action_space.high)
        path = self._move_exactly(target) if self._control == "exact" else self._drive(target)
        clearance = self._swept_ball.path_clearance(np.array(path))
        time, self._n_steps = self._time, self._n_steps + 1
        disc_clearance = self._disc_clearance(path, time, self._time)
        had_collision = bool(self._collisions or self._disc_collisions)
        if clearance < 0:
            self._collisions.append(path[-1])
        if disc_clearance < 0:
            self._disc_collisions.append(path[-1])
        first_collision = min(clearance, disc_clearance) < 0 and not had_collision
        self._path.extend(path[1:])
        self._path_length += sum(math.dist(*pair) for pair in pairwise(path))
        info = self._info(clearance, disc_clearance)
        terminated = self._terminate_on_success and info["is_success"]
        return self._observation(), -1.0 if first_collision else 0.0, terminated, False, info

    def render(self) -> np.ndarray | None:
        """A top view ``(H, W, 3)`` uint8: walls, discs, goal, ball, its path so far, and crosses at collisions."""
        if self.render_mode is None:
            return None
        return self._image.draw(
            ball=self._position,
            goal=self._maze.goal,
            path=self._path,
            collisions=[*self._collisions, *self._disc_collisions],
            discs=discs_to_draw(self._discs, self._time),
            disc_radius=DISC_RADIUS,
        )

    def close(self) -> None:
        """Frees the simulation."""
        self._maze.close()

    @property
    def _position(self) -> np.ndarray:
        return self._maze.data.qpos[:2].copy()

    @property
    def _time(self) -> float:
        return self._n_steps / self._fps

    def _disc_clearance(self, path: Sequence[np.ndarray], time: float, end_time: float) -> float:
        if self._discs is None:
            return math.inf
        return self._discs.clearance(np.array(path), self._collision_radius, time, end_time)

    def _move_exactly(self, target: np.ndarray) -> list[np.ndarray]:
        start = self._position
        self._maze.data.qpos[:2], self._maze.data.qvel[:2] = target, 0.0
        return [start, target]

    def _drive(self, target: np.ndarray) -> list[np.ndarray]:
        """The ball's positions at every physics step while it tracks the straight line to the target."""
        start = self._position
        dt = self._maze.model.opt.timestep
        line_velocity = (target - start) / (self._n_substeps * dt)
        path = [start]
        for substep in range(1, self._n_substeps + 1):
            reference = start + line_velocity * (substep * dt)
            step_physics(self._maze.model, self._maze.data, reference, line_velocity)
            path.append(self._position)
        return path

    def _free_cell(self, options: dict[str, Any], name: str) -> tuple[int, int] | None:
        cell = options.get(name)
        if cell is None:
            return None
        cells = np.array(self._maze.maze.maze_map)
        row_column = np.asarray(cell)
        is_inside = (
            row_column.shape == (2,)
            and np.issubdtype(row_column.dtype, np.integer)
            and bool(((row_column >= 0) & (row_column < cells.shape)).all())
        )
        if not is_inside or cells[tuple(row_column)] == 1:
            raise ValueError(
                f"{name} must be the row and column of a free cell in a map of {cells.shape}, got {cell!r}"
            )
        return int(row_column[0]), int(row_column[1])

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
        observation = {
            "agent_pos": self._position.astype(np.float32).clip(*bounds),
            "environment_state": self._maze.goal.astype(np.float32).clip(*bounds),
        }
        if self._discs is not None:
            observation["obstacles"] = self._discs.rows(self._time)
        return observation

    def _info(self, clearance: float, disc_clearance: float) -> dict[str, Any]:
        info = {
            "is_success": math.dist(self._position, self._maze.goal) <= SUCCESS_RADIUS,
            "is_collision": bool(self._collisions),
            "clearance": clearance,
            "path_length": self._path_length,
        }
        if self._discs is not None:
            info["is_obstacle_collision"] = bool(self._disc_collisions)
            info["obstacle_clearance"] = disc_clearance
        return info
