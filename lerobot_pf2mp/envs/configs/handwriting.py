# SPDX-License-Identifier: Apache-2.0
"""LeRobot's configuration of the handwriting environments (``--env.type=pf2mp_handwriting``)."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import gymnasium as gym
from lerobot.envs.configs import EnvConfig

from lerobot_pf2mp.envs.configs.collision_env import CollisionEnvConfig
from lerobot_pf2mp.envs.handwriting.sheet import HANDWRITING_FPS, LETTER_HEIGHT, N_REGIONS, REGION_GAP
from lerobot_pf2mp.envs.image_size import image_size_of
from lerobot_pf2mp.envs.tasks import HANDWRITING_STEPS, HANDWRITING_TASKS, SIMULATORS
from lerobot_pf2mp.errors import ConfigError, reported_on_the_command_line

if TYPE_CHECKING:
    from lerobot_pf2mp.envs.handwriting.writing_scene import WritingScene


@EnvConfig.register_subclass("pf2mp_handwriting")
@dataclass
class PF2MPHandwritingEnv(CollisionEnvConfig):
    """The handwriting environments, `HandwritingEnv`.

    Args:
        task: HandwritingJoint-v0 (joint positions) or HandwritingPen-v0 (positions of the pen's tip).
        fps: Control frequency [Hz], a divisor of 500.
        episode_length: Number of steps after which an episode ends.
        letter: Letter to write, one of `letters.LETTERS`.
        letter_height: Height of the letter [m].
        region_gap: Distance between the letter and the restricted regions [m].
        n_regions: Largest number of restricted regions in the concave parts of the letter.
        scene_file: A JSON file with your own stroke and regions instead of a letter.
        control: physics (position controllers in full physics) or exact (the arm reaches every action).
        render_size: Width of the rendered image [pixels].
        camera: arm (from the side) or top (the sheet alone).
        simulator: What moves the arm: mujoco; or genesis, many arms at once, which needs the extra genesis.
        robot: The arm: panda, or unitree_z1, which needs the extra z1.
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
    robot: str = "panda"
    simulator: str = "mujoco"

    def __post_init__(self) -> None:
        """Validates the task and its scene.

        Raises:
            ConfigError: If the task, the robot or the simulator does not exist, its package is missing, or the scene is not
                possible.
        """
        if self.task not in HANDWRITING_TASKS:
            raise ConfigError(f"task must be one of {list(HANDWRITING_TASKS)}, got {self.task!r}")
        # Imported here because LeRobot imports this file for every command.
        from lerobot_pf2mp.envs.handwriting.arm import find_arm

        self._check_simulator()
        with reported_on_the_command_line():
            arm = find_arm(self.robot)
            _ = self.scene
            dim = len(arm.joint_names) if HANDWRITING_TASKS[self.task] == "joint" else 2
            self._describe(dim, 0, lambda: image_size_of(self.render_size))

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """The vectorised environment, ``{type: {0: env}}``. With Genesis all arms are in one scene of this process."""
        if self.simulator == "mujoco":
            return super().create_envs(n_envs, use_async_envs)
        from lerobot_pf2mp.envs.handwriting.genesis_panda import GenesisPandas
        from lerobot_pf2mp.envs.handwriting.many_arms_env import ManyArmsEnv

        space = HANDWRITING_TASKS[str(self.task)]
        return {self.type: {0: ManyArmsEnv(GenesisPandas(n_envs), n_envs, space=space, **self.gym_kwargs)}}

    def _check_simulator(self) -> None:
        if self.simulator not in SIMULATORS:
            raise ConfigError(f"simulator must be one of {list(SIMULATORS)}, got {self.simulator!r}")
        if self.simulator == "mujoco":
            return
        if find_spec("genesis") is None:
            raise ConfigError('the simulator genesis needs: pip install "lerobot_policy_pf2mp[genesis]"')
        needed = {"robot": "panda", "control": "physics", "obs_type": "state"}
        for name, value in needed.items():
            if getattr(self, name) != value:
                raise ConfigError(
                    f"{name} must be {value} with the simulator genesis, got {getattr(self, name)!r}"
                )

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
            "robot": self.robot,
        }

    @property
    def _scene_options(self) -> dict[str, Any]:
        names = ("letter", "letter_height", "region_gap", "n_regions", "scene_file")
        return {name: getattr(self, name) for name in names}
