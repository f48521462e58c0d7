# SPDX-License-Identifier: Apache-2.0
"""Episodes of positions, resampled to a fixed number of steps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

MIN_STEPS = 2
_MOST_STEPS = 10**5  # of an episode; more is a slip of the keyboard, and would need more memory than there is
IMAGE_KEY = "observation.image"


@dataclass(frozen=True)
class Trajectory:
    """A demonstrated trajectory.

    Args:
        positions: ``(N + 1, D)`` positions at equal time intervals [m], joints [rad].
        goal: ``(D,)`` its goal [m]; None if the goal is always the same.
        objects: ``(N + 1, E)`` positions of moving objects, for example of a block [m]; None without objects.
        images: ``(N + 1, H, W, 3)`` uint8 camera images; None without a camera.
    """

    positions: np.ndarray
    goal: np.ndarray | None = None
    objects: np.ndarray | None = None
    images: np.ndarray | None = None

    @property
    def n_steps(self) -> int:
        """The number N of steps."""
        return len(self.positions) - 1


def check_n_steps(n_steps: int) -> None:
    """Checks the number of steps that episodes are to have.

    Raises:
        ValueError: If it is below 2 or above 100 000.
    """
    if n_steps < MIN_STEPS:
        raise ValueError(f"n_steps must be at least {MIN_STEPS}, got {n_steps}")
    if n_steps > _MOST_STEPS:
        raise ValueError(f"n_steps must be at most {_MOST_STEPS}, got {n_steps}")


def resample(positions: np.ndarray, n_steps: int) -> np.ndarray:
    """The same trajectory in another number of steps, by linear interpolation in time.

    Args:
        positions: ``(N + 1, D)`` positions at equal time intervals.
        n_steps: The wanted number of steps T.

    Returns:
        ``(T + 1, D)`` positions; the first and the last are unchanged.
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
    """The frames of all usable trajectories. Observations are position and goal; the action is the next position.

    Args:
        trajectories: Recorded trajectories.
        n_steps: Steps that each is resampled to.
        collides: Whether a ``(T + 1, D)`` trajectory touches an obstacle.
        dropped: Counts the trajectories left out, by reason.

    Yields:
        For each trajectory ``{"observation.state", "observation.environment_state", "action"}``, float32 [m]: positions
        ``(T, D)``; objects and goal ``(T, E + D)`` if there are any; next positions ``(T, D)``. If there are images, also
        `IMAGE_KEY` ``(T, H, W, 3)``, the latest image at each step.

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
        positions = resample(trajectory.positions, n_steps)
        if collides(positions):
            dropped["in collision"] += 1
            continue
        frames = {
            "observation.state": positions[:-1].astype(np.float32),
            "action": positions[1:].astype(np.float32),
        }
        environment_state = []
        if trajectory.objects is not None:
            environment_state.append(resample(trajectory.objects, n_steps)[:-1])
        if trajectory.goal is not None:
            environment_state.append(np.tile(trajectory.goal, (n_steps, 1)))
        if environment_state:
            frames["observation.environment_state"] = np.concatenate(environment_state, axis=1).astype(
                np.float32
            )
        if trajectory.images is not None:
            frames[IMAGE_KEY] = trajectory.images[np.arange(n_steps) * trajectory.n_steps // n_steps]
        yield frames
