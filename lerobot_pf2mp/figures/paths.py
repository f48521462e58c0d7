# SPDX-License-Identifier: Apache-2.0
"""Ways through a scene, in the plane or in space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_pf2mp.figures.theme import COLLISION, GOAL, START

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class Path2D:
    """A way through a scene.

    Args:
        positions: ``(N + 1, D)`` positions [m]; D >= 2, of which three are drawn.
        collisions: ``(N,)`` true for the steps that collide.
    """

    positions: np.ndarray
    collisions: np.ndarray


@dataclass(frozen=True)
class PathPair:
    """The same episode, from the same noise, without and with guidance.

    Args:
        episode: Its number.
        unguided: The way without guidance.
        guided: The way with guidance.
        goal: ``(D,)`` the goal [m]; None if the environment has none.
        n_side_by_side: Episodes that ran side by side with it, on which their noise depends.
    """

    episode: int
    unguided: Path2D
    guided: Path2D
    goal: np.ndarray | None
    n_side_by_side: int = 1


def draw_path(axis: Axes, path: Path2D, colour: str, label: str | None = None) -> None:
    """Draws a way, with a cross after each step that collides.

    Args:
        axis: Where to draw.
        path: The way.
        colour: Its colour.
        label: Its name in the legend; None for none.
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
    """Marks where a way starts and where it should end.

    Args:
        axis: Where to draw.
        start: ``(D,)`` the start [m].
        goal: ``(D,)`` the goal [m]; None if there is none.
        size: Of the marks [points].
    """
    style: dict[str, Any] = {"linestyle": "none", "markersize": size, "markeredgecolor": "white", "zorder": 6}
    axis.plot(*_coordinates(start), marker="*", color=START, label="start", **style)
    if goal is not None:
        axis.plot(*_coordinates(goal), marker="X", color=GOAL, label="goal", **style)


def _coordinates(positions: np.ndarray) -> list[np.ndarray]:
    """At most three coordinates of ``(..., D)`` positions, as matplotlib wants them."""
    positions = np.atleast_2d(positions)
    return [positions[:, i] for i in range(min(3, positions.shape[1]))]
