# SPDX-License-Identifier: Apache-2.0
"""LeRobot's configuration of the maze environments (``--env.type=pf2mp_maze``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lerobot.envs.configs import EnvConfig

from lerobot_pf2mp.envs.configs.collision_env import CollisionEnvConfig
from lerobot_pf2mp.envs.tasks import MAZE_STEPS, MAZE_TASKS
from lerobot_pf2mp.errors import ConfigError, reported_on_the_command_line


@EnvConfig.register_subclass("pf2mp_maze")
@dataclass
class PF2MPMazeEnv(CollisionEnvConfig):
    """The maze environments, `MazeEnv`.

    Args:
        task: MazeUMaze-v0, MazeMedium-v0 or MazeLarge-v0.
        fps: Control frequency [Hz].
        episode_length: Number of steps after which an episode ends.
        maze_map: Your own map instead of the task's: rows of 0 (free) and 1 (wall) separated by "/", for example
            11111/10001/11111.
        control: exact (the ball reaches each action) or pd (a PD controller drives it in full physics).
        collision_radius: Radius around the ball's centre that must not touch a wall [m]: 0.1 is the whole ball, 0 only the
            centre.
        terminate_on_success: Whether an episode ends at the goal and not only after `episode_length` steps.
        n_obstacles: Discs on the way, which the demonstrations did not have; a policy sees them as observation.obstacles.
        obstacle_speed: Their speed across the corridor [m/s].
        render_size: Longer side of the rendered image [pixels].
    """

    task: str | None = "MazeLarge-v0"
    fps: int = 10
    episode_length: int = MAZE_STEPS
    maze_map: str | None = None
    control: str = "exact"
    collision_radius: float = 0.1
    terminate_on_success: bool = False
    n_obstacles: int = 0
    obstacle_speed: float = 0.0
    render_size: int = 480

    def __post_init__(self) -> None:
        """Validates the task.

        Raises:
            ConfigError: If the task does not exist, or its map or image is not possible.
        """
        if self.task not in MAZE_TASKS:
            raise ConfigError(f"task must be one of {list(MAZE_TASKS)}, got {self.task!r}")
        self._describe(2, 2, self._image_size)

    def _image_size(self) -> tuple[int, int]:
        # Imported here because LeRobot imports this file for every command.
        from lerobot_pf2mp.envs.maze.maze_image import MazeImage
        from lerobot_pf2mp.envs.maze.point_maze import parse_maze_map

        with reported_on_the_command_line():
            maze_map = parse_maze_map(self.maze_map or MAZE_TASKS[str(self.task)])
            return MazeImage(maze_map, self.render_size).size

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments for ``gymnasium.make``."""
        kwargs: dict[str, Any] = {
            "max_episode_steps": self.episode_length,
            "control": self.control,
            "fps": self.fps,
            "collision_radius": self.collision_radius,
            "terminate_on_success": self.terminate_on_success,
            "render_mode": "rgb_array",
            "render_size": self.render_size,
        }
        if self.n_obstacles:
            kwargs |= {"n_obstacles": self.n_obstacles, "obstacle_speed": self.obstacle_speed}
        if self.maze_map is not None:
            kwargs["maze_map"] = self.maze_map
        return kwargs
