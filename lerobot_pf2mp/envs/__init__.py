# SPDX-License-Identifier: Apache-2.0
"""Gymnasium environments that report collisions, and their LeRobot configurations.

Importing this module registers them under ``lerobot_pf2mp/<task>``; MuJoCo is imported when one is made.
"""

import gymnasium as gym

from lerobot_pf2mp.envs.configs import (
    FETCH_TASKS,
    HANDWRITING_TASKS,
    MAZE_TASKS,
    PF2MPFetchEnv,
    PF2MPHandwritingEnv,
    PF2MPMazeEnv,
)
from lerobot_pf2mp.envs.handwriting.sheet import HANDWRITING_STEPS

for _task, _maze in MAZE_TASKS.items():
    gym.register(
        id=f"lerobot_pf2mp/{_task}",
        entry_point="lerobot_pf2mp.envs.maze.maze_env:MazeEnv",
        max_episode_steps=80,
        kwargs={"maze_map": _maze},
    )

for _task, _name in FETCH_TASKS.items():
    gym.register(
        id=f"lerobot_pf2mp/{_task}",
        entry_point="lerobot_pf2mp.envs.fetch.fetch_env:FetchEnv",
        max_episode_steps=48,
        kwargs={"task": _name},
    )

for _task, _space in HANDWRITING_TASKS.items():
    gym.register(
        id=f"lerobot_pf2mp/{_task}",
        entry_point="lerobot_pf2mp.envs.handwriting.handwriting_env:HandwritingEnv",
        max_episode_steps=HANDWRITING_STEPS,
        kwargs={"space": _space},
    )

__all__ = [
    "FETCH_TASKS",
    "HANDWRITING_TASKS",
    "MAZE_TASKS",
    "PF2MPFetchEnv",
    "PF2MPHandwritingEnv",
    "PF2MPMazeEnv",
]
