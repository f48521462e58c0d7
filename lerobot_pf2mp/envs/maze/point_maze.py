# SPDX-License-Identifier: Apache-2.0
"""gymnasium-robotics' PointMaze: its maps, its MuJoCo model, and one controlled physics step."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from numbers import Integral
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

with contextlib.redirect_stderr(io.StringIO()):  # the import prints a notice about other environments
    from gymnasium_robotics.envs.maze.maps import LARGE_MAZE, MEDIUM_MAZE, U_MAZE
    from gymnasium_robotics.envs.maze.point_maze import PointMazeEnv

BALL_RADIUS = 0.1  # [m], of PointMaze's particle_geom
MAZE_MAPS = {"umaze": U_MAZE, "medium": MEDIUM_MAZE, "large": LARGE_MAZE}

# The controller of D4RL's maze2d generator: force = clip(10 (target - position) - velocity, -1, 1), times 100 N.
POSITION_GAIN = 10.0
VELOCITY_GAIN = 1.0
MAX_SPEED = 5.0  # [m/s] for each axis, PointMaze's own limit


def parse_maze_map(text: str | Sequence[Sequence[int]]) -> list[list[int]]:
    """The rows of a maze map, 1 for a wall and 0 for a free cell.

    Args:
        text: The name of one of `MAZE_MAPS`, or rows of 0 and 1 separated by "/", for example ``11111/10001/11111``, or
            the same as lists of numbers, as gymnasium-robotics has them.

    Returns:
        The rows, north first.

    Raises:
        ValueError: If the map is not a closed rectangle of 0 and 1 whose free cells, two at least, are connected.
    """
    if not isinstance(text, str):
        text = "/".join("".join(map(str, row)) for row in _rows_of(text))
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


def _rows_of(cells: Any) -> list[list[int]]:
    try:
        rows = [list(row) for row in cells]
    except TypeError:
        rows = [[None]]
    # gymnasium-robotics marks cells for the start and the goal by r, g and c.
    if not all(isinstance(cell, Integral) and cell in (0, 1) for row in rows for cell in row):
        raise ValueError(
            f"maze_map as lists must hold rows of 0 (free) and 1 (wall), got {cells!r}; reset(options={{'reset_cell': ..., "
            "'goal_cell': ...}) chooses the cells of start and goal"
        )
    return rows


def make_point_maze(maze_map: str | Sequence[Sequence[int]]) -> tuple[PointMazeEnv, mujoco.MjSpec]:
    """Makes the PointMaze of a map, and the specification of its MuJoCo model.

    Args:
        maze_map: As for `parse_maze_map`.

    Returns:
        The environment, and the specification, which the caller may extend.
    """
    env = PointMazeEnv(maze_map=parse_maze_map(maze_map), continuing_task=True, reset_target=False)
    xml = Path(env.tmp_xml_file_path)
    spec = mujoco.MjSpec.from_file(str(xml))
    xml.unlink()  # PointMaze does not delete it
    return env, spec


def step_physics(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    target: Sequence[float] | np.ndarray,
    target_velocity: Sequence[float] | np.ndarray = (0.0, 0.0),
    force_noise: Sequence[float] | np.ndarray = (0.0, 0.0),
) -> None:
    """Runs one physics step of PointMaze with the PD controller of D4RL's generator.

    Args:
        model: PointMaze's model.
        data: Its state.
        target: Position x, y to drive to [m].
        target_velocity: Wanted velocity at that position [m/s]; D4RL's controller uses zero.
        force_noise: Added to the normalised force before it is clipped to [-1, 1].
    """
    # Python floats: for two coordinates they are several times faster than arrays.
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
