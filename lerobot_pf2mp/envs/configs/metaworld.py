# SPDX-License-Identifier: Apache-2.0
"""LeRobot's configuration of Meta-World's tasks with a wall (``--env.type=pf2mp_metaworld``)."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

from lerobot.envs.configs import EnvConfig

from lerobot_pf2mp.envs.box import Box
from lerobot_pf2mp.envs.configs.collision_env import CollisionEnvConfig
from lerobot_pf2mp.envs.image_size import image_size_of
from lerobot_pf2mp.envs.tasks import (
    METAWORLD_FPS,
    METAWORLD_MISSING,
    METAWORLD_MOST_STEPS,
    METAWORLD_STEPS,
    METAWORLD_TASKS,
)
from lerobot_pf2mp.errors import ConfigError, reported_on_the_command_line


@EnvConfig.register_subclass("pf2mp_metaworld")
@dataclass
class PF2MPMetaWorldEnv(CollisionEnvConfig):
    """Meta-World's tasks with a wall, `MetaWorldEnv`. They need the extra ``metaworld``.

    Args:
        task: reach-wall-v3, push-wall-v3 or pick-place-wall-v3.
        fps: Control frequency [Hz], Meta-World's own.
        episode_length: Number of steps after which an episode ends, at most 500.
        terminate_on_success: Whether an episode ends with success and not only after `episode_length` steps.
        render_size: Width of the rendered image [pixels].
    """

    task: str | None = "reach-wall-v3"
    fps: int = METAWORLD_FPS
    episode_length: int = METAWORLD_STEPS
    terminate_on_success: bool = False
    render_size: int = 480

    def __post_init__(self) -> None:
        """Validates the task.

        Raises:
            ConfigError: If the task does not exist, a value breaks its rule, or Meta-World is not installed.
        """
        if self.task not in METAWORLD_TASKS:
            raise ConfigError(f"task must be one of {list(METAWORLD_TASKS)}, got {self.task!r}")
        if not 1 <= self.episode_length <= METAWORLD_MOST_STEPS:
            raise ConfigError(
                f"episode_length must lie in 1 to {METAWORLD_MOST_STEPS}, got {self.episode_length}"
            )
        if find_spec("metaworld") is None:
            raise ConfigError(METAWORLD_MISSING)
        with reported_on_the_command_line():
            self._describe(4, 6, lambda: image_size_of(self.render_size))
        self.fps = METAWORLD_FPS

    @property
    def wall(self) -> Box:
        """The wall [m], the same in all of these tasks."""
        return Box((0.1, 0.75, 0.06), (0.24, 0.02, 0.12))

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments for ``gymnasium.make``."""
        return {
            "max_episode_steps": self.episode_length,
            "terminate_on_success": self.terminate_on_success,
            "render_mode": "rgb_array",
            "render_size": self.render_size,
        }
