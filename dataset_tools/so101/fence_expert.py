# SPDX-License-Identifier: Apache-2.0
"""A scripted expert for the SO-101 arm. It grasps the cube, carries it over the wall and lays it onto the goal."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
from so101_nexus import sim_qpos_to_dataset_row
from so101_nexus.config import SO101_ARM_JOINT_COUNT, SO101_TCP_SITE_NAME
from so101_nexus.kinematics import ee_ik_delta_q

from lerobot_pf2mp.envs.so101.fence_env import SO101FenceEnv
from lerobot_pf2mp.envs.so101.fence_scene import CUBE_SIZE, PAN_AXIS, cylindrical

# Range of the height at which the cube's underside passes above the wall [m]. It is drawn for each demonstration.
STYLES = {"clear": (0.015, 0.035), "hug": (0.004, 0.012)}

_OPEN, _CLOSED = 35.0, 0.0  # of the gripper [percent]
_ABOVE = (0.055, 0.070)  # height of the tool centre point before it goes down to the cube [m]
_GRASP_HEIGHT = CUBE_SIZE / 2
_RELEASE_HEIGHT = _GRASP_HEIGHT + 0.004
_SETTLED = 1e-4  # of a joint [rad]
_MAX_ITERATIONS = 8  # from the joints of the step before
# The tool's axes when it points down with the first joint at 0: so101-nexus' convention, z from the wrist to the tips.
_DOWN = np.diag([-1.0, 1.0, -1.0])


@dataclass
class FenceRecording:
    """What is recorded in one episode, as LeRobot's recorder does: what was seen before each action, and the action.

    Args:
        states: ``(6,)`` joints [degrees], opening of the gripper [percent].
        actions: The same of the targets.
        environment_states: ``(5,)`` x, y, z of the cube and x, y of the goal [m]; empty with a camera.
        images: ``(H, W, 3)`` uint8; empty without a camera.
        info: The last information of the environment.
    """

    states: list[np.ndarray] = field(default_factory=list)
    actions: list[np.ndarray] = field(default_factory=list)
    environment_states: list[np.ndarray] = field(default_factory=list)
    images: list[np.ndarray] = field(default_factory=list)
    info: dict[str, Any] = field(default_factory=dict)

    def note(self, observation: dict[str, Any], action: np.ndarray) -> None:
        """Adds an observation and the action that follows it."""
        self.states.append(observation["agent_pos"])
        self.actions.append(action)
        if "pixels" in observation:
            self.images.append(observation["pixels"]["front"])
        else:
            self.environment_states.append(observation["environment_state"])


class ScriptedFenceExpert:
    """Moves the tool from station to station with the inverse kinematics of so101-nexus.

    Args:
        env: The environment.
        style: A key of `STYLES`, how high the cube passes above the wall.
        seed: Seed of all demonstrations. Each has its own random numbers, so they do not depend on each other.

    Raises:
        ValueError: If there is no such style.
    """

    def __init__(self, env: SO101FenceEnv, style: str = "clear", seed: int = 0) -> None:
        if style not in STYLES:
            raise ValueError(f"style must be one of {list(STYLES)}, got {style!r}")
        self._env, self._style, self._seed = env, style, seed
        self._simulation = env._simulation
        self._model = self._simulation.model
        self._data = mujoco.MjData(self._model)
        self._tcp = self._model.site(SO101_TCP_SITE_NAME).id

    def demonstrate(self, number: int) -> FenceRecording:
        """Demonstrates one episode; `number` is part of its seed."""
        rng = np.random.default_rng([self._seed, number])
        observation, info = self._env.reset(seed=int(rng.integers(2**31)))
        recording = FenceRecording(info=info)
        for action in self._actions(rng):
            recording.note(observation, action)
            observation, _, _, _, recording.info = self._env.step(action)
            if recording.info["is_collision"]:
                break
        return recording

    def _actions(self, rng: np.random.Generator) -> Iterator[np.ndarray]:
        """``(6,)`` joint targets [degrees, percent]."""
        joints = self._simulation._get_current_qpos()[:SO101_ARM_JOINT_COUNT].copy()
        start = np.array([*cylindrical(self._simulation.tcp), self._simulation.tcp[2]])
        for (before, after), (closing, n_steps) in self._moves(start, rng):
            for step in range(1, n_steps + 1):
                share = step / n_steps
                share = share * share * (3 - 2 * share)  # starts and ends at rest
                place = before + share * (after - before)
                opening = closing[0] + share * (closing[1] - closing[0])
                joints = self._joints_for(place, joints)
                action = sim_qpos_to_dataset_row(np.array([*joints, 0.0]))
                action[-1] = opening
                yield action.astype(np.float32)

    def _moves(
        self, start: np.ndarray, rng: np.random.Generator
    ) -> Iterator[tuple[tuple[np.ndarray, np.ndarray], tuple[tuple[float, float], int]]]:
        """Start and end of each move ``(3,)`` (distance, angle, height), openings of the gripper, number of steps."""
        layout = self._simulation.layout
        cube, goal = (np.array(cylindrical(place)) for place in (layout.cube, layout.goal))
        above = rng.uniform(*_ABOVE)
        # The tool centre point is at the height of the cube's centre.
        over = self._simulation.scene.wall_size[2] + CUBE_SIZE / 2 + rng.uniform(*STYLES[self._style])
        stations = [
            (start, _OPEN, 0),
            (np.array([*cube, above]), _OPEN, 14),
            (np.array([*cube, _GRASP_HEIGHT]), _OPEN, 10),
            (np.array([*cube, _GRASP_HEIGHT]), _CLOSED, 8),
            (np.array([*cube, over]), _CLOSED, 10),
            (np.array([*goal, over]), _CLOSED, 24),
            (np.array([*goal, _RELEASE_HEIGHT]), _CLOSED, 12),
            (np.array([*goal, _RELEASE_HEIGHT]), _OPEN, 8),
            (np.array([*goal, above]), _OPEN, 10),
        ]
        for (before, opened, _), (after, opens, n_steps) in pairwise(stations):
            yield (before, after), ((opened, opens), n_steps)

    def _joints_for(self, place: np.ndarray, joints: np.ndarray) -> np.ndarray:
        """``(5,)`` joints [rad] that bring the tool to a place, pointing down if possible.

        Args:
            place: Distance from the arm's axis [m], angle about it [rad], height [m].
            joints: ``(5,)`` joints from which the iteration starts [rad].
        """
        model, data = self._model, self._data
        distance, angle, height = place
        target = np.array([PAN_AXIS + distance * np.cos(angle), distance * np.sin(angle), height])
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        wanted, current = np.zeros(4), np.zeros(4)
        mujoco.mju_mat2Quat(wanted, (turn @ _DOWN).ravel())
        moved, turned = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        n = SO101_ARM_JOINT_COUNT
        for _ in range(_MAX_ITERATIONS):
            data.qpos[:n] = joints
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_jacSite(model, data, moved, turned, self._tcp)
            mujoco.mju_mat2Quat(current, data.site_xmat[self._tcp])
            jacobian = np.vstack([moved[:, :n], turned[:, :n]])
            step = ee_ik_delta_q(jacobian, data.site_xpos[self._tcp], current, target, wanted)
            before = joints
            joints = np.clip(joints + step, *model.jnt_range[:n].T)
            if np.abs(joints - before).max() < _SETTLED:
                break
        return joints
