# SPDX-License-Identifier: Apache-2.0
"""Executed trajectories through a scene, in the plane or in space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_pf2mp.figures.theme import COLLISION, GOAL, START

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class Path2D:
    """An executed trajectory through a scene.

    Args:
        positions: ``(N + 1, D)`` positions [m], D >= 2. At most three coordinates are drawn.
        collisions: ``(N,)`` true for the steps that collide.
    """

    positions: np.ndarray
    collisions: np.ndarray


@dataclass(frozen=True)
class PathPair:
    """The same episode, from the same noise, without and with guidance.

    Args:
        episode: Number of the episode.
        unguided: The trajectory without guidance.
        guided: The trajectory with guidance.
        goal: ``(D,)`` the goal [m]; None if the environment has none.
        n_side_by_side: Number of episodes that ran in parallel. The noise depends on it.
    """

    episode: int
    unguided: Path2D
    guided: Path2D
    goal: np.ndarray | None
    n_side_by_side: int = 1


def draw_path(axis: Axes, path: Path2D, colour: str, label: str | None = None) -> None:
    """Draws a trajectory, with a cross after each step that collides.

    Args:
        axis: Axes to draw on.
        path: The trajectory.
        colour: Its colour.
        label: Its name in the legend; None leaves it out.
    """
    axis.plot(
        *_coordinates(path.positions),
        color=colour,
        linewidth=2.2,
        solid_capstyle="round",
        zorder=4,
        label=label,
    )
    hits = path.positions[1:][path.collisions]
    style: dict[str, Any] = {"linestyle": "none", "marker": "x", "markersize": 8, "markeredgewidth": 2.2}
    axis.plot(*_coordinates(hits), color=COLLISION, zorder=7, **style)


def mark_ends(axis: Axes, start: np.ndarray, goal: np.ndarray | None, size: float = 11) -> None:
    """Marks the start and the goal of a trajectory.

    Args:
        axis: Axes to draw on.
        start: ``(D,)`` the start [m].
        goal: ``(D,)`` the goal [m]; None if there is none.
        size: Size of the marks [points].
    """
    style: dict[str, Any] = {"linestyle": "none", "markersize": size, "markeredgecolor": "white", "zorder": 6}
    axis.plot(*_coordinates(start), marker="*", color=START, label="start", **style)
    if goal is not None:
        axis.plot(*_coordinates(goal), marker="X", color=GOAL, label="goal", **style)


def _coordinates(positions: np.ndarray) -> list[np.ndarray]:
    """At most three coordinates of ``(..., D)`` positions, one array for each, for matplotlib."""
    positions = np.atleast_2d(positions)
    return [positions[:, i] for i in range(min(3, positions.shape[1]))]
