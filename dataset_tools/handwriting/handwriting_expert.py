# SPDX-License-Identifier: Apache-2.0
"""A scripted expert for handwriting: it draws a letter as people do, every time a little differently."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d

from lerobot_pf2mp.dataset_tools.writing.episodes import Trajectory
from lerobot_pf2mp.envs.handwriting.handwriting_env import START_SPREAD, HandwritingEnv
from lerobot_pf2mp.envs.handwriting.stroke import evenly_spaced
from lerobot_pf2mp.envs.handwriting.writing_scene import is_on_sheet

_SPACING = 0.001  # of the places on a stroke [m]
# Standard deviations, except where said otherwise.
_SCALE = 0.03  # relative, on each axis
_SLANT = 0.04  # [rad]
_WAVES = (
    0.003,
    0.0015,
    0.001,
)  # of the stroke's slow deviations, for half, one and one and a half periods [m]
_ROUNDING = 0.002  # of corners [m]
_ENDS = 0.25  # share of the stroke over which its ends are moved to where it begins and stops
_TEMPO = 0.15  # of the logarithm of the speed
# The pen slows down where the stroke is curved, with the power of 1/3 of the radius (the two-thirds power law; Lacquaniti,
# Terzuolo and Viviani, 1983), which counts up to this radius.
_LARGEST_RADIUS = 0.08  # [m]
_SLOWEST = 0.25  # at the ends, relative
_RAMP = 0.08  # share of the stroke
# Of the places to the regions [m]: between two actions the pen leaves the straight line by up to 0.03 mm.
_CLEARANCE = 0.0001


class ScriptedScribe:
    """Draws the letter of an environment.

    Args:
        env: The environment.
        n_steps: Steps T of a demonstration.
        seed: Seed of all demonstrations; each has its own, so that they do not depend on each other.
    """

    def __init__(self, env: HandwritingEnv, n_steps: int, seed: int = 0) -> None:
        self._env, self._n_steps, self._seed = env, n_steps, seed

    def demonstrate(self, number: int) -> Trajectory | str:
        """One episode, or why it failed; `number` seeds it."""
        env = self._env
        rng = np.random.default_rng([self._seed, number])
        places = vary(env.scene.stroke, self._n_steps, rng)
        if not is_on_sheet(places):
            return "off the sheet"
        # In full physics the arm cuts corners; the actions themselves must be clear, too.
        if env.scene.clearance(places) < _CLEARANCE:
            return "in collision"
        joints = env.kinematics.way(places)
        way = joints if env.action_space.shape == joints.shape[1:] else places
        env.reset(options={"joints": joints[0]})
        info: dict[str, Any] = {}
        pictures = [env.render()]
        for target in way[1:]:
            _, _, _, _, info = env.step(target)
            pictures.append(env.render())
        if info["is_collision"]:
            return "in collision"
        if not info["is_success"]:
            return "without success"
        return Trajectory(way, pictures=None if env.render_mode is None else np.array(pictures))


def vary(stroke: np.ndarray, n_steps: int, rng: np.random.Generator) -> np.ndarray:
    """A stroke as a person would draw it: moved, scaled, slanted, a little wavy, slower in curves.

    Args:
        stroke: ``(N, 2)`` places [m].
        n_steps: Steps T.
        rng: Random numbers.

    Returns:
        ``(T + 1, 2)`` places of the pen at equal time intervals [m]. The first and the last are within `START_SPREAD` of the
        stroke's ends on both axes.
    """
    places = evenly_spaced(stroke, _SPACING)
    ends = places[[0, -1]] + rng.uniform(-START_SPREAD, START_SPREAD, (2, 2))
    share = np.linspace(0.0, 1.0, len(places))[:, None]
    middle = places.mean(axis=0)
    slanted = (places - middle) * rng.normal(1.0, _SCALE, 2)
    slanted[:, 0] += rng.normal(0.0, _SLANT) * slanted[:, 1]
    for number, size in enumerate(_WAVES, start=1):
        slanted += rng.normal(0.0, size, 2) * np.sin(np.pi * number * share + rng.uniform(0.0, 2 * np.pi, 2))
    places = gaussian_filter1d(middle + slanted, _ROUNDING / _SPACING, axis=0, mode="nearest")
    for end, near in ((0, 1 - share / _ENDS), (-1, 1 - (1 - share) / _ENDS)):
        places += near.clip(0.0) ** 2 * (ends[end] - places[end])
    return _in_time(places, n_steps, rng)


def _in_time(places: np.ndarray, n_steps: int, rng: np.random.Generator) -> np.ndarray:
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(steps)])
    ahead = np.gradient(places, length, axis=0)
    bend = np.linalg.norm(np.gradient(ahead, length, axis=0), axis=1)  # 1 / radius
    share = length / length[-1]
    speed = (bend + 1 / _LARGEST_RADIUS) ** (-1 / 3)
    speed *= np.interp(np.minimum(share, 1 - share), [0.0, _RAMP], [_SLOWEST, 1.0])
    speed *= np.exp(rng.normal(0.0, _TEMPO) * np.sin(2 * np.pi * share + rng.uniform(0.0, 2 * np.pi)))
    speed = gaussian_filter1d(speed, 0.005 / _SPACING, mode="nearest")
    times = np.concatenate([[0.0], np.cumsum(2 * steps / (speed[1:] + speed[:-1]))])
    at = np.interp(np.linspace(0.0, times[-1], n_steps + 1), times, length)
    return np.stack([np.interp(at, length, places[:, axis]) for axis in range(2)], axis=1)
