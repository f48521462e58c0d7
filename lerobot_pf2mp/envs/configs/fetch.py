# SPDX-License-Identifier: Apache-2.0
"""LeRobot's configuration of the Fetch environments (``--env.type=pf2mp_fetch``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lerobot.envs.configs import EnvConfig

from lerobot_pf2mp.envs.box import Box
from lerobot_pf2mp.envs.configs.collision_env import CollisionEnvConfig
from lerobot_pf2mp.envs.fetch.fetch_scene import FETCH_FPS, check_inner_steps, make_scene
from lerobot_pf2mp.envs.image_size import image_size_of
from lerobot_pf2mp.envs.tasks import FETCH_STEPS, FETCH_TASKS
from lerobot_pf2mp.errors import ConfigError, reported_on_the_command_line


@EnvConfig.register_subclass("pf2mp_fetch")
@dataclass
class PF2MPFetchEnv(CollisionEnvConfig):
    """The Fetch environments with a wall, `FetchEnv`.

    Args:
        task: FetchReachWall-v0 or FetchPushWall-v0.
        fps: Control frequency [Hz]; follows from `n_inner_steps`.
        episode_length: Number of steps after which an episode ends.
        wall_position: x, y of the wall's centre [m]. None is the task's own value, also for the next four options.
        wall_size: Lengths of the wall's sides [m].
        start_range: Two opposite corners x, y, z of the box of start positions of the gripper [m].
        goal_range: The same for the goal [m]; for FetchPushWall-v0 x and y only.
        block_range: The same for the block, x and y [m]; for FetchPushWall-v0 only.
        n_inner_steps: Steps of the inner loop for each action, 0.04 s each.
        terminate_on_success: Whether an episode ends at the goal and not only after `episode_length` steps.
        render_size: Width of the rendered image [pixels].
    """

    task: str | None = "FetchReachWall-v0"
    fps: int = FETCH_FPS
    episode_length: int = FETCH_STEPS
    wall_position: tuple[float, float] | None = None
    wall_size: tuple[float, float, float] | None = None
    start_range: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    goal_range: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    block_range: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    n_inner_steps: int = 1
    terminate_on_success: bool = False
    render_size: int = 480

    def __post_init__(self) -> None:
        """Validates the task and its scene.

        Raises:
            ConfigError: If the task does not exist, or its scene is not possible.
        """
        if self.task not in FETCH_TASKS:
            raise ConfigError(f"task must be one of {list(FETCH_TASKS)}, got {self.task!r}")
        with reported_on_the_command_line():
            check_inner_steps(self.n_inner_steps)
            scene = make_scene(FETCH_TASKS[self.task], **self._scene_changes)
            self._describe(3, 6 if scene.has_block else 3, lambda: image_size_of(self.render_size))
        self.fps = round(FETCH_FPS / self.n_inner_steps)

    @property
    def wall(self) -> Box:
        """The wall [m]."""
        return make_scene(FETCH_TASKS[str(self.task)], **self._scene_changes).wall

    @property
    def _scene_changes(self) -> dict[str, Any]:
        names = ("wall_position", "wall_size", "start_range", "goal_range", "block_range")
        return {name: getattr(self, name) for name in names}

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments for ``gymnasium.make``."""
        return {
            **self._scene_changes,
            "max_episode_steps": self.episode_length,
            "n_inner_steps": self.n_inner_steps,
            "terminate_on_success": self.terminate_on_success,
            "render_mode": "rgb_array",
            "render_size": self.render_size,
        }
