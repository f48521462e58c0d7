# SPDX-License-Identifier: Apache-2.0
"""A scripted expert for Fetch with a wall. It moves past the wall and pushes the block along a free line."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from lerobot_pf2mp.dataset_tools.experts.recording import Recording
from lerobot_pf2mp.dataset_tools.fetch.fetch_routes import routes, walk
from lerobot_pf2mp.envs.box import Box
from lerobot_pf2mp.envs.fetch.fetch_env import FetchEnv
from lerobot_pf2mp.envs.fetch.fetch_scene import BLOCK_SIZE, FINGERS, HAND, WORKSPACE

# Range of the distance that hand and fingers keep to the wall [m]. It is drawn for each demonstration.
STYLES = {"clear": (0.02, 0.05), "hug": (0.002, 0.010)}

_SPEED = (0.014, 0.022)  # range of the speed, drawn for each demonstration [m per step of 0.04 s]
_PUSH_SPEED = 0.012  # [m per step]
_BEHIND = 0.070  # distance of the gripper behind the block's centre before it pushes [m]
_PUSH_HEIGHT = 0.425  # height of the gripper when it pushes [m]
_BLOCK_MARGIN = 0.01  # distance between fingers and block while the gripper approaches [m]
_ARRIVED = 0.01  # within this distance a position counts as reached [m]
_MAX_STEPS = 120


class ScriptedFetchExpert:
    """Moves the gripper along the shortest path that keeps a margin to the wall; for Push it pushes the block to the goal.

    Args:
        env: The environment.
        style: A key of `STYLES`, the distance to the wall: ``clear`` keeps away from it, ``hug`` passes close to it.
        seed: Seed of all demonstrations. Each demonstration has its own random numbers, so they do not depend on each
            other.

    Raises:
        ValueError: If there is no such style.
    """

    def __init__(self, env: FetchEnv, style: str = "clear", seed: int = 0) -> None:
        if style not in STYLES:
            raise ValueError(f"style must be one of {list(STYLES)}, got {style!r}")
        self._env = env
        self._style = style
        self._seed = seed

    def demonstrate(self, number: int) -> Recording:
        """Demonstrates one episode; `number` is part of its seed."""
        rng = np.random.default_rng([self._seed, number])
        layout = self._env.scene.sample(rng)
        observation, info = self._env.reset(
            options={"start": layout.start, "goal": layout.goal, "block": layout.block}
        )
        recording = Recording(layout.goal)
        recording.note(observation, info, self._env.render())
        for target in self._targets(recording, rng):
            observation, _, _, _, info = self._env.step(target.clip(WORKSPACE.low, WORKSPACE.high))
            recording.note(observation, info, self._env.render())
            if len(recording.grips) > _MAX_STEPS or recording.is_collision:
                break
        return recording

    def _targets(self, seen: Recording, rng: np.random.Generator) -> Iterator[np.ndarray]:
        margin, speed = rng.uniform(*STYLES[self._style]), rng.uniform(*_SPEED)
        if not seen.blocks:
            yield from self._move_to(seen, seen.goal, margin, speed)
            return
        push = _direction(seen.blocks[-1], seen.goal)
        behind = seen.blocks[-1] - _BEHIND * push
        behind[2] = _PUSH_HEIGHT
        block = Box((*seen.blocks[-1].tolist(),), (BLOCK_SIZE,) * 3)
        yield from self._move_to(seen, behind, margin, speed, [block])
        if math.dist(seen.grips[-1], behind) > _ARRIVED:
            return
        line = push
        while (seen.goal - seen.blocks[-1]) @ line > _ARRIVED:
            push = _direction(seen.blocks[-1], seen.goal)
            target = seen.grips[-1] + _PUSH_SPEED * push
            target[2] = _PUSH_HEIGHT
            yield target

    def _move_to(
        self, seen: Recording, goal: np.ndarray, margin: float, speed: float, others: Sequence[Box] = ()
    ) -> Iterator[np.ndarray]:
        """Actions along the shortest path. The margin is smaller where start or goal is too near the wall for it."""
        start = seen.grips[-1]
        for share in (1.0, 0.5, 0.25, 0.0):
            boxes = _kept_clear_of(self._env.scene.wall, share * margin)
            for other in others:
                boxes += _kept_clear_of(other, share * _BLOCK_MARGIN)
            paths = routes(start, goal, boxes)
            if paths:
                yield from walk(paths[0], speed)
                return


def _kept_clear_of(box: Box, margin: float) -> list[Box]:
    """The boxes that the gripper's position must not enter, so that hand and fingers keep a margin to a box."""
    spread = Box((0, 0, 0), (2 * margin,) * 3)
    return [box.grown_by(part).grown_by(spread) for part in (HAND, FINGERS)]


def _direction(start: np.ndarray, goal: np.ndarray) -> np.ndarray:
    offset = np.array([*(goal[:2] - start[:2]), 0.0])
    return offset / max(float(np.linalg.norm(offset)), 1e-9)
