# SPDX-License-Identifier: Apache-2.0
"""LeRobot's configuration of the SO-101 environment (``--env.type=pf2mp_so101``)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from lerobot_pf2mp.envs.configs.collision_env import CollisionEnvConfig
from lerobot_pf2mp.envs.so101.fence_scene import SO101_FPS, FenceScene, make_scene
from lerobot_pf2mp.envs.tasks import SO101_STEPS
from lerobot_pf2mp.errors import ConfigError, reported_on_the_command_line


@EnvConfig.register_subclass("pf2mp_so101")
@dataclass
class PF2MPSO101Env(CollisionEnvConfig):
    """The SO-101 arm behind a wall, `SO101FenceEnv`. Needs: pip install "lerobot_policy_pf2mp[so101]".

    Args:
        task: SO101Fence-v0.
        fps: Control frequency [Hz], always 20.
        episode_length: Number of steps after which an episode ends.
        wall_position: x, y of the wall's centre [m]. None is the task's own value, also for the next three options.
        wall_size: Lengths of the wall's sides [m].
        cube_range: Two opposite corners x, y of the rectangle of the cube's positions [m].
        goal_range: The same for the goal [m].
        terminate_on_success: Whether an episode ends when the cube lies at the goal.
        image_size: Height and width of the observed image [pixels], with obs_type pixels_agent_pos.
        render_size: Height and width of the images of videos [pixels].
        detail: What those show: shapes (those that collisions are computed with, fast) or meshes (0.2 s an image).
    """

    features_map: dict[str, str] = field(
        default_factory=lambda: {
            ACTION: ACTION,
            "agent_pos": OBS_STATE,
            "environment_state": OBS_ENV_STATE,
            "pixels/front": f"{OBS_IMAGES}.front",
        }
    )
    task: str | None = "SO101Fence-v0"
    fps: int = SO101_FPS
    episode_length: int = SO101_STEPS
    wall_position: tuple[float, float] | None = None
    wall_size: tuple[float, float, float] | None = None
    cube_range: tuple[tuple[float, float], tuple[float, float]] | None = None
    goal_range: tuple[tuple[float, float], tuple[float, float]] | None = None
    terminate_on_success: bool = False
    image_size: int = 96
    render_size: int = 480
    detail: str = "shapes"

    def __post_init__(self) -> None:
        """Validates the task and its scene.

        Raises:
            ConfigError: If the task does not exist, or its scene is not possible.
        """
        if self.task != "SO101Fence-v0":
            raise ConfigError(f"task must be SO101Fence-v0, got {self.task!r}")
        if self.fps != SO101_FPS:
            raise ConfigError(f"fps must be {SO101_FPS}, got {self.fps}")
        with reported_on_the_command_line():
            _ = self.scene
            self._describe(6, 5, lambda: (self.image_size, self.image_size))
        if "pixels" in self.features:
            pixels = self.features.pop("pixels")
            self.features["pixels/front"] = PolicyFeature(FeatureType.VISUAL, pixels.shape)

    @property
    def scene(self) -> FenceScene:
        """The wall, and the ranges of positions [m]."""
        return make_scene(**self._scene_changes)

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments for ``gymnasium.make``."""
        return {
            **self._scene_changes,
            "max_episode_steps": self.episode_length,
            "terminate_on_success": self.terminate_on_success,
            "render_mode": "rgb_array",
            "image_size": self.image_size,
            "render_size": self.render_size,
            "detail": self.detail,
        }

    @property
    def _scene_changes(self) -> dict[str, Any]:
        names = ("wall_position", "wall_size", "cube_range", "goal_range")
        return {name: getattr(self, name) for name in names}
