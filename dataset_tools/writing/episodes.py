# SPDX-License-Identifier: Apache-2.0
"""Episodes of positions, resampled to a fixed number of steps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

MIN_STEPS = 2
PICTURES = "observation.image"


@dataclass(frozen=True)
class Trajectory:
    """A demonstrated way.

    Args:
        positions: ``(N + 1, D)`` positions at equal time intervals [m], joints [rad].
        goal: ``(D,)`` where it was meant to end [m]; None where that is always the same.
        objects: ``(N + 1, E)`` what else moved, for example the positions of a block [m]; None for nothing.
        pictures: ``(N + 1, H, W, 3)`` uint8 what a camera saw; None without a camera.
    """

    positions: np.ndarray
    goal: np.ndarray | None = None
    objects: np.ndarray | None = None
    pictures: np.ndarray | None = None

    @property
    def n_steps(self) -> int:
        """The number N of steps."""
        return len(self.positions) - 1


def resample(positions: np.ndarray, n_steps: int) -> np.ndarray:
    """The same way in another number of steps, by linear interpolation in time.

    Args:
        positions: ``(N + 1, D)`` positions at equal time intervals.
        n_steps: The wanted number of steps T.

    Returns:
        ``(T + 1, D)`` positions; the first and the last are the given ones.
    """
    at = np.linspace(0, len(positions) - 1, n_steps + 1)
    before = np.minimum(at.astype(int), len(positions) - 2)
    share = (at - before)[:, None]
    return (1 - share) * positions[before] + share * positions[before + 1]


def prepare(
    trajectories: Iterable[Trajectory],
    n_steps: int,
    collides: Callable[[np.ndarray], bool],
    dropped: Counter[str],
) -> Iterator[dict[str, np.ndarray]]:
    """The frames of all usable trajectories: position and goal observed, next position as action.

    Args:
        trajectories: Recorded trajectories.
        n_steps: Steps that each is resampled to.
        collides: Whether a ``(T + 1, D)`` way touches an obstacle.
        dropped: Counts the trajectories left out, by reason.

    Yields:
        For each trajectory ``{"observation.state", "observation.environment_state", "action"}``, float32 [m]: positions
        ``(T, D)``, objects and goal ``(T, E + D)`` as far as there are any, next positions ``(T, D)``; and the last pictures
        taken before them, `PICTURES` ``(T, H, W, 3)``, if there are any.

    Raises:
        ValueError: If a trajectory is not finite.
    """
    for number, trajectory in enumerate(trajectories):
        parts = trajectory.positions, trajectory.goal, trajectory.objects
        if not all(part is None or np.isfinite(part).all() for part in parts):
            raise ValueError(f"positions and goals must be finite, got NaN or infinity in episode {number}")
        if trajectory.n_steps < MIN_STEPS:
            dropped[f"shorter than {MIN_STEPS} steps"] += 1
            continue
        way = resample(trajectory.positions, n_steps)
        if collides(way):
            dropped["in collision"] += 1
            continue
        frames = {
            "observation.state": way[:-1].astype(np.float32),
            "action": way[1:].astype(np.float32),
        }
        surroundings = []
        if trajectory.objects is not None:
            surroundings.append(resample(trajectory.objects, n_steps)[:-1])
        if trajectory.goal is not None:
            surroundings.append(np.tile(trajectory.goal, (n_steps, 1)))
        if surroundings:
            frames["observation.environment_state"] = np.concatenate(surroundings, axis=1).astype(np.float32)
        if trajectory.pictures is not None:
            frames[PICTURES] = trajectory.pictures[np.arange(n_steps) * trajectory.n_steps // n_steps]
        yield frames
