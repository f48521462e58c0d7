# SPDX-License-Identifier: Apache-2.0
"""A follower arm for LeRobot's robot commands: the Panda of the handwriting environment, in full physics."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from lerobot.robots import Robot, RobotConfig

from lerobot_pf2mp.envs.handwriting.handwriting_env import HandwritingEnv
from lerobot_pf2mp.envs.handwriting.panda import JOINT_NAMES

KEYS = [f"{name}.pos" for name in JOINT_NAMES]


@RobotConfig.register_subclass("simulated_panda")
@dataclass
class SimulatedPandaConfig(RobotConfig):
    log: str = ""  # file to which each action is added as a line of JSON


class SimulatedPanda(Robot):
    config_class = SimulatedPandaConfig
    name = "simulated_panda"

    def __init__(self, config: SimulatedPandaConfig) -> None:
        super().__init__(config)
        self._log = Path(config.log)
        self._env = HandwritingEnv("joint")
        self._seen: np.ndarray | None = None

    @property
    def observation_features(self) -> dict[str, type]:
        return dict.fromkeys(KEYS, float)

    @property
    def action_features(self) -> dict[str, type]:
        return dict.fromkeys(KEYS, float)

    @property
    def is_connected(self) -> bool:
        return self._seen is not None

    @property
    def is_calibrated(self) -> bool:
        return True

    def connect(self, calibrate: bool = True) -> None:
        observation, _ = self._env.reset(seed=0)
        self._seen = observation["agent_pos"]

    def calibrate(self) -> None:
        pass

    def configure(self) -> None:
        pass

    def get_observation(self) -> dict[str, float]:
        return dict(zip(KEYS, map(float, self._seen), strict=True))

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        observation, *_ = self._env.step(np.array([action[key] for key in KEYS]))
        self._seen = observation["agent_pos"]
        with self._log.open("a") as log:
            print(json.dumps([action[key] for key in KEYS]), file=log)
        return action

    def disconnect(self) -> None:
        self._env.close()
        self._seen = None
