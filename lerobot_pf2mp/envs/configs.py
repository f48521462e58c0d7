# SPDX-License-Identifier: Apache-2.0
"""LeRobot's configurations of the environments (``--env.type=...``)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import gymnasium as gym
from gymnasium.wrappers import AddRenderObservation, FilterObservation
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGE, OBS_STATE

from lerobot_pf2mp.envs.box import Box
from lerobot_pf2mp.envs.fetch.fetch_scene import FETCH_FPS, check_inner_steps, make_scene
from lerobot_pf2mp.envs.handwriting.sheet import (
    HANDWRITING_FPS,
    HANDWRITING_STEPS,
    LETTER_HEIGHT,
    N_REGIONS,
    REGION_GAP,
)
from lerobot_pf2mp.envs.image_size import picture_size_of
from lerobot_pf2mp.errors import ConfigError, reported_on_the_command_line

if TYPE_CHECKING:
    from lerobot_pf2mp.envs.handwriting.writing_scene import WritingScene

MAZE_TASKS = {"MazeUMaze-v0": "umaze", "MazeMedium-v0": "medium", "MazeLarge-v0": "large"}
FETCH_TASKS = {"FetchReachWall-v0": "reach", "FetchPushWall-v0": "push"}
OBS_TYPES = ("state", "pixels_agent_pos")
HANDWRITING_TASKS = {"HandwritingJoint-v0": "joint", "HandwritingPen-v0": "pen"}


@dataclass
class _CollisionEnv(EnvConfig):
    """What the configurations of this package have in common.

    Args:
        features_map: What LeRobot calls each feature; an environment need not have all of them.
        obs_type: state, or pixels_agent_pos: rendered pictures instead of the environment's state, beside the robot's.
    """

    features_map: dict[str, str] = field(
        default_factory=lambda: {
            ACTION: ACTION,
            "agent_pos": OBS_STATE,
            "environment_state": OBS_ENV_STATE,
            "pixels": OBS_IMAGE,
        }
    )
    obs_type: str = "state"

    @property
    def package_name(self) -> str:
        """The package that registers the environments with Gymnasium."""
        return "lerobot_pf2mp"

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """The vectorised environment, ``{type: {0: env}}``.

        Finished sub-environments are frozen until the next rollout. LeRobot's default resets them at once and then
        counts the first reward of the next episode, here a collision, into the finished one.
        """
        # The prefix makes a worker process import the module that registers the environment.
        make_env = partial(
            gym.make,
            f"lerobot_pf2mp:{self.gym_id}",
            disable_env_checker=self.disable_env_checker,
            **self.gym_kwargs,
        )
        if self.obs_type == "pixels_agent_pos":
            make_env = partial(_with_pixels, make_env)
        env_fns = [freeze_after_episode_end(make_env)] * n_envs
        env: gym.vector.VectorEnv
        autoreset_mode = gym.vector.AutoresetMode.NEXT_STEP
        if use_async_envs and n_envs > 1:
            env = gym.vector.AsyncVectorEnv(env_fns, context="forkserver", autoreset_mode=autoreset_mode)
        else:
            env = gym.vector.SyncVectorEnv(env_fns, autoreset_mode=autoreset_mode)
        return {self.type: {0: env}}

    def _describe(
        self, action_dim: int, environment_dim: int, picture_size: Callable[[], tuple[int, int]]
    ) -> None:
        """Sets `features`.

        Args:
            action_dim: Of the action and, as actions are positions, of the robot's state.
            environment_dim: Of the environment's state; 0 without one.
            picture_size: Height and width of rendered pictures [pixels].

        Raises:
            ConfigError: If there is no such `obs_type`.
        """
        if self.obs_type not in OBS_TYPES:
            raise ConfigError(f"obs_type must be one of {list(OBS_TYPES)}, got {self.obs_type!r}")
        self.features = {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(action_dim,)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(action_dim,)),
        }
        if self.obs_type == "pixels_agent_pos":
            pixels = PolicyFeature(type=FeatureType.VISUAL, shape=(*picture_size(), 3))
            self.features["pixels"] = pixels
        elif environment_dim:
            shape = (environment_dim,)
            self.features["environment_state"] = PolicyFeature(type=FeatureType.ENV, shape=shape)


def _with_pixels(make_env: Callable[[], gym.Env]) -> gym.Env:
    return FilterObservation(AddRenderObservation(make_env(), render_only=False), ["agent_pos", "pixels"])


@EnvConfig.register_subclass("pf2mp_maze")
@dataclass
class PF2MPMazeEnv(_CollisionEnv):
    """The maze environments, `lerobot_pf2mp.envs.maze.maze_env.MazeEnv`.

    Args:
        task: MazeUMaze-v0, MazeMedium-v0 or MazeLarge-v0.
        fps: Control frequency [Hz].
        episode_length: Steps after which an episode ends.
        maze_map: A map of your own instead of the task's: rows of 0 (free) and 1 (wall) separated by "/", for example
            11111/10001/11111.
        control: exact (the ball reaches each action) or pd (a PD controller drives it in full physics).
        collision_radius: What must not touch a wall [m]: 0.1 is the ball, 0 its centre.
        terminate_on_success: Whether an episode ends at the goal rather than after `episode_length` steps.
        render_size: Longer side of the rendered picture [pixels].
    """

    task: str | None = "MazeLarge-v0"
    fps: int = 10
    episode_length: int = 80
    maze_map: str | None = None
    control: str = "exact"
    collision_radius: float = 0.1
    terminate_on_success: bool = False
    render_size: int = 480

    def __post_init__(self) -> None:
        """Validates the task.

        Raises:
            ConfigError: If there is no such task.
        """
        if self.task not in MAZE_TASKS:
            raise ConfigError(f"task must be one of {list(MAZE_TASKS)}, got {self.task!r}")
        self._describe(2, 2, self._picture_size)

    def _picture_size(self) -> tuple[int, int]:
        # Imported here because LeRobot imports this file for every command.
        from lerobot_pf2mp.envs.maze.maze_image import MazePicture
        from lerobot_pf2mp.envs.maze.point_maze import parse_maze_map

        with reported_on_the_command_line():
            maze_map = parse_maze_map(self.maze_map or MAZE_TASKS[str(self.task)])
            return MazePicture(maze_map, self.render_size).size

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
        if self.maze_map is not None:
            kwargs["maze_map"] = self.maze_map
        return kwargs


@EnvConfig.register_subclass("pf2mp_fetch")
@dataclass
class PF2MPFetchEnv(_CollisionEnv):
    """The Fetch environments with a wall, `lerobot_pf2mp.envs.fetch.fetch_env.FetchEnv`.

    Args:
        task: FetchReachWall-v0 or FetchPushWall-v0.
        fps: Control frequency [Hz]; follows from `n_inner_steps`.
        episode_length: Steps after which an episode ends.
        wall_position: x, y of the wall's centre [m]; by default, as below, the task's.
        wall_size: Its sides [m].
        start_range: Two opposite corners x, y, z of where the gripper starts [m].
        goal_range: The same of the goal [m]; for FetchPushWall-v0 x and y only.
        block_range: The same of the block, x and y [m].
        n_inner_steps: Steps of the inner loop for each action, 0.04 s each.
        terminate_on_success: Whether an episode ends at the goal rather than after `episode_length` steps.
        render_size: Width of the rendered picture [pixels].
    """

    task: str | None = "FetchReachWall-v0"
    fps: int = FETCH_FPS
    episode_length: int = 48
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
            ConfigError: If there is no such task, or the scene does not work.
        """
        if self.task not in FETCH_TASKS:
            raise ConfigError(f"task must be one of {list(FETCH_TASKS)}, got {self.task!r}")
        with reported_on_the_command_line():
            check_inner_steps(self.n_inner_steps)
            scene = make_scene(FETCH_TASKS[self.task], **self._scene_changes)
            self._describe(3, 6 if scene.has_block else 3, lambda: picture_size_of(self.render_size))
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


@EnvConfig.register_subclass("pf2mp_handwriting")
@dataclass
class PF2MPHandwritingEnv(_CollisionEnv):
    """The handwriting environments, `lerobot_pf2mp.envs.handwriting.handwriting_env.HandwritingEnv`.

    Args:
        task: HandwritingJoint-v0 (joint positions) or HandwritingPen-v0 (places of the pen's tip).
        fps: Control frequency [Hz], a divisor of 500.
        episode_length: Steps after which an episode ends.
        letter: What to write, one of `letters.LETTERS`.
        letter_height: [m].
        region_gap: Between the letter and the restricted regions [m].
        n_regions: How many regions are put into the letter's bays.
        scene_file: A JSON file with a stroke and regions of your own instead of a letter.
        control: physics (position controllers in full physics) or exact (the arm reaches every action).
        render_size: Width of the rendered picture [pixels].
        camera: arm (from the side) or top (the sheet alone).
    """

    task: str | None = "HandwritingJoint-v0"
    fps: int = HANDWRITING_FPS
    episode_length: int = HANDWRITING_STEPS
    letter: str = "S"
    letter_height: float = LETTER_HEIGHT
    region_gap: float = REGION_GAP
    n_regions: int = N_REGIONS
    scene_file: str | None = None
    control: str = "physics"
    render_size: int = 640
    camera: str = "arm"

    def __post_init__(self) -> None:
        """Validates the task and its scene.

        Raises:
            ConfigError: If there is no such task, or the scene does not work.
        """
        if self.task not in HANDWRITING_TASKS:
            raise ConfigError(f"task must be one of {list(HANDWRITING_TASKS)}, got {self.task!r}")
        with reported_on_the_command_line():
            _ = self.scene
            dim = 9 if HANDWRITING_TASKS[self.task] == "joint" else 2
            self._describe(dim, 0, lambda: picture_size_of(self.render_size))

    @property
    def scene(self) -> WritingScene:
        """The letter and the regions [m]."""
        # Imported here because LeRobot imports this file for every command.
        from lerobot_pf2mp.envs.handwriting.writing_scene import make_writing_scene

        return make_writing_scene(**self._scene_options)

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments for ``gymnasium.make``."""
        return {
            **self._scene_options,
            "max_episode_steps": self.episode_length,
            "control": self.control,
            "fps": self.fps,
            "render_mode": "rgb_array",
            "render_size": self.render_size,
            "camera": self.camera,
        }

    @property
    def _scene_options(self) -> dict[str, Any]:
        names = ("letter", "letter_height", "region_gap", "n_regions", "scene_file")
        return {name: getattr(self, name) for name in names}
