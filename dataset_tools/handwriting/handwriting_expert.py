# SPDX-License-Identifier: Apache-2.0
"""A scripted expert for handwriting. It draws a letter as people do, each time a little differently."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d

from lerobot_pf2mp.dataset_tools.writing.episodes import Trajectory
from lerobot_pf2mp.envs.handwriting.handwriting_env import HandwritingEnv
from lerobot_pf2mp.envs.handwriting.stroke import evenly_spaced
from lerobot_pf2mp.envs.handwriting.writing_episode import START_SPREAD
from lerobot_pf2mp.envs.handwriting.writing_scene import is_on_sheet

_SPACING = 0.001  # between the positions on a stroke [m]
# Standard deviations of a drawn stroke.
_SIZE_SPREAD = 0.03  # of its size on each axis, relative
_SLANT = 0.04  # of its slant [rad]
_WAVES = (0.003, 0.0015, 0.001)  # of its slow deviations, with half, one, and one and a half periods [m]
_TEMPO = 0.15  # of the logarithm of the speed
# Other properties of a drawn stroke.
_ROUNDING = 0.002  # width of the smoothing filter that rounds corners [m]
_ENDS = 0.25  # share of the stroke, at each end, that is bent towards the drawn start or end position
# The speed is proportional to the radius of curvature to the power of 1/3 (the two-thirds power law; Lacquaniti, Terzuolo
# and Viviani, 1983), up to about this radius.
_LARGEST_RADIUS = 0.08  # [m]
_SLOWEST = 0.25  # speed at the ends, relative
_RAMP = 0.08  # share of the stroke over which the speed rises from there
# Smallest distance of the positions to the regions [m]. Between two actions the pen leaves the straight line by up to
# 0.03 mm.
_CLEARANCE = 0.0001


class ScriptedHandwritingExpert:
    """Draws the letter of an environment.

    Args:
        env: The environment.
        n_steps: Steps T of a demonstration.
        seed: Seed of all demonstrations. Each demonstration has its own random numbers, so they do not depend on each
            other.
    """

    def __init__(self, env: HandwritingEnv, n_steps: int, seed: int = 0) -> None:
        self._env, self._n_steps, self._seed = env, n_steps, seed

    def demonstrate(self, number: int) -> Trajectory | str:
        """Demonstrates one episode.

        Args:
            number: Number of the episode, part of its seed.

        Returns:
            The trajectory, or the reason for the failure.
        """
        env = self._env
        rng = np.random.default_rng([self._seed, number])
        positions = vary(env.scene.stroke, self._n_steps, rng)
        if not is_on_sheet(positions):
            return "off the sheet"
        # In full physics the arm cuts corners. The actions themselves must be clear of the regions, too.
        if env.scene.clearance(positions) < _CLEARANCE:
            return "in collision"
        joints = env.kinematics.joint_trajectory(positions)
        actions = joints if env.action_space.shape == joints.shape[1:] else positions
        env.reset(options={"joints": joints[0]})
        info: dict[str, Any] = {}
        images = [env.render()]
        for target in actions[1:]:
            _, _, _, _, info = env.step(target)
            images.append(env.render())
        if info["is_collision"]:
            return "in collision"
        if not info["is_success"]:
            return "without success"
        return Trajectory(actions, images=None if env.render_mode is None else np.array(images))


def vary(stroke: np.ndarray, n_steps: int, rng: np.random.Generator) -> np.ndarray:
    """A random variation of a stroke, as a person would draw it: moved, scaled, slanted, a little wavy, slower in curves.

    Args:
        stroke: ``(N, 2)`` positions [m].
        n_steps: Steps T of the result.
        rng: Source of randomness.

    Returns:
        ``(T + 1, 2)`` positions of the pen at equal time intervals [m]. The first and the last are within `START_SPREAD` of
        the stroke's ends on each axis.
    """
    positions = evenly_spaced(stroke, _SPACING)
    ends = positions[[0, -1]] + rng.uniform(-START_SPREAD, START_SPREAD, (2, 2))
    share = np.linspace(0.0, 1.0, len(positions))[:, None]
    middle = positions.mean(axis=0)
    slanted = (positions - middle) * rng.normal(1.0, _SIZE_SPREAD, 2)
    slanted[:, 0] += rng.normal(0.0, _SLANT) * slanted[:, 1]
    for number, size in enumerate(_WAVES, start=1):
        slanted += rng.normal(0.0, size, 2) * np.sin(np.pi * number * share + rng.uniform(0.0, 2 * np.pi, 2))
    positions = gaussian_filter1d(middle + slanted, _ROUNDING / _SPACING, axis=0, mode="nearest")
    for end, near in ((0, 1 - share / _ENDS), (-1, 1 - (1 - share) / _ENDS)):
        positions += near.clip(0.0) ** 2 * (ends[end] - positions[end])
    return _in_time(positions, n_steps, rng)


def _in_time(positions: np.ndarray, n_steps: int, rng: np.random.Generator) -> np.ndarray:
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(steps)])
    ahead = np.gradient(positions, length, axis=0)
    bend = np.linalg.norm(np.gradient(ahead, length, axis=0), axis=1)  # 1 / radius
    share = length / length[-1]
    speed = (bend + 1 / _LARGEST_RADIUS) ** (-1 / 3)
    speed *= np.interp(np.minimum(share, 1 - share), [0.0, _RAMP], [_SLOWEST, 1.0])
    speed *= np.exp(rng.normal(0.0, _TEMPO) * np.sin(2 * np.pi * share + rng.uniform(0.0, 2 * np.pi)))
    speed = gaussian_filter1d(speed, 0.005 / _SPACING, mode="nearest")
    times = np.concatenate([[0.0], np.cumsum(2 * steps / (speed[1:] + speed[:-1]))])
    at = np.interp(np.linspace(0.0, times[-1], n_steps + 1), times, length)
    return np.stack([np.interp(at, length, positions[:, axis]) for axis in range(2)], axis=1)
