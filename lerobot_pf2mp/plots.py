# SPDX-License-Identifier: Apache-2.0
"""Figures; the only user of matplotlib."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from lerobot_pf2mp.potential_field import PotentialField

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WALL = "#a67b5b"
FLOOR = "#faf7f2"
START = "#1f4e9c"
GOAL = "#ff7f0e"
UNGUIDED = "#7f7f7f"
GUIDED = "#2e8b57"
COLLISION = "#c81414"
ANCHOR = "#d62728"
ARROW = "#1f77b4"

# Nothing is drawn where the density is this far below its peak [nats]: there the field is all tail.
_DENSITY_RANGE = 12.0


@dataclass(frozen=True)
class MazePath:
    """The way of a ball through a maze.

    Args:
        positions: ``(N + 1, 2)`` positions [m].
        collisions: ``(N,)`` true for the steps that touch a wall.
    """

    positions: np.ndarray
    collisions: np.ndarray


def plot_maze_overview(
    output: Path,
    *,
    maze_map: list[list[int]],
    field: PotentialField,
    to_metres: Callable[[Tensor], Tensor],
    unguided: MazePath,
    guided: MazePath,
    goal: np.ndarray,
) -> None:
    """Draws Figure 3 of the paper: maze, density map, potential field, and the same start and noise without and with it.

    Args:
        output: The PNG file to write.
        maze_map: Rows of 0 (free) and 1 (wall), north first.
        field: The potential field [normalised].
        to_metres: Maps ``(..., 2)`` normalised actions to positions [m], each axis linearly.
        unguided: The way of FMP.
        guided: The way of PF2MP.
        goal: ``(2,)`` position of the goal [m].
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows, columns = len(maze_map), len(maze_map[0])
    # Three panels above, two below: at the width of a README five in a row would be too small to read.
    width = 12.0
    figure = plt.figure(figsize=(width, width / 3 * 2 * (rows / columns) + 0.9), facecolor="white")
    grid = figure.add_gridspec(2, 6, hspace=0.12, wspace=0.12, left=0.01, right=0.99, top=0.94, bottom=0.02)
    axes = [figure.add_subplot(grid[row, column : column + 2]) for row, column in ((0, 0), (0, 2), (0, 4))]
    axes += [figure.add_subplot(grid[1, column : column + 2]) for column in (1, 3)]
    for axis in axes:
        _draw_maze(axis, maze_map)
    axes[0].set_title("(a) start and goal")
    _mark_ends(axes[0], unguided.positions[0], goal)
    axes[0].legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=2, frameon=False)
    axes[1].set_title(f"(b) density, {len(field.anchors)} demonstrated points")
    _draw_density(axes[1], field, to_metres, maze_map)
    axes[2].set_title("(c) potential field")
    _draw_arrows(axes[2], field, to_metres, maze_map)
    for axis, path, colour, name in (
        (axes[3], unguided, UNGUIDED, "(d) FMP, no guidance"),
        (axes[4], guided, GUIDED, "(e) PF2MP, same start and noise"),
    ):
        n_hits = int(path.collisions.sum())
        axis.set_title(f"{name}: {'collides' if n_hits else 'clear'}")
        _draw_path(axis, path, colour)
        _mark_ends(axis, path.positions[0], goal)
    figure.savefig(output, dpi=100)
    plt.close(figure)


def _draw_maze(axis: Axes, maze_map: list[list[int]]) -> None:
    from matplotlib.patches import Rectangle

    rows, columns = len(maze_map), len(maze_map[0])
    axis.set_facecolor(FLOOR)
    for i, row in enumerate(maze_map):
        for j, cell in enumerate(row):
            if cell:
                corner = (j - columns / 2, rows / 2 - i - 1)
                axis.add_patch(Rectangle(corner, 1, 1, facecolor=WALL, edgecolor="#805a3e", linewidth=0.4))
    axis.set(
        xlim=(-columns / 2, columns / 2), ylim=(-rows / 2, rows / 2), aspect="equal", xticks=[], yticks=[]
    )


def _mark_ends(axis: Axes, start: np.ndarray, goal: np.ndarray) -> None:
    style: dict[str, Any] = {"linestyle": "none", "markersize": 11, "markeredgecolor": "white", "zorder": 6}
    axis.plot(*start, marker="*", color=START, label="start", **style)
    axis.plot(*goal, marker="X", color=GOAL, label="goal", **style)


def _draw_path(axis: Axes, path: MazePath, colour: str) -> None:
    axis.plot(*path.positions.T, color=colour, linewidth=2.2, solid_capstyle="round", zorder=4)
    hits = path.positions[1:][path.collisions]
    axis.plot(
        *hits.T, linestyle="none", marker="x", color=COLLISION, markersize=8, markeredgewidth=2.2, zorder=7
    )


def _grid_of_maze(
    to_metres: Callable[[Tensor], Tensor], maze_map: list[list[int]], per_cell: int
) -> tuple[np.ndarray, np.ndarray, Tensor, np.ndarray]:
    """A grid of positions over the maze: x and y [m], their normalised actions, and metres for one normalised unit."""
    rows, columns = len(maze_map), len(maze_map[0])
    x = (np.arange(columns * per_cell) + 0.5) / per_cell - columns / 2
    y = (np.arange(rows * per_cell) + 0.5) / per_cell - rows / 2
    zero = to_metres(torch.zeros(1, 2)).double().numpy()[0]
    scale = to_metres(torch.ones(1, 2)).double().numpy()[0] - zero
    positions = np.stack(np.meshgrid(x, y), axis=-1)
    return x, y, torch.from_numpy((positions - zero) / scale).float(), scale


def _draw_density(
    axis: Axes, field: PotentialField, to_metres: Callable[[Tensor], Tensor], maze_map: list[list[int]]
) -> None:
    x, y, actions, _ = _grid_of_maze(to_metres, maze_map, per_cell=20)
    log_density = field.log_density(actions).numpy()
    shown = np.ma.masked_less(log_density, log_density.max() - _DENSITY_RANGE)
    axis.pcolormesh(x, y, shown, cmap="viridis", shading="nearest", alpha=0.85, zorder=2, rasterized=True)
    anchors = to_metres(field.anchors).numpy()
    axis.plot(*anchors.T, linestyle="none", marker=".", markersize=0.9, color=ANCHOR, zorder=3)


def _draw_arrows(
    axis: Axes, field: PotentialField, to_metres: Callable[[Tensor], Tensor], maze_map: list[list[int]]
) -> None:
    x, y, actions, scale = _grid_of_maze(to_metres, maze_map, per_cell=3)
    log_density = field.log_density(actions).numpy()
    # Phi is a gradient in normalised units; as a step it points in the direction of Phi times metres for each unit.
    steps = field.potential_gradient(actions).numpy() * scale
    directions = steps / np.linalg.norm(steps, axis=-1, keepdims=True).clip(min=1e-9)
    shown = log_density > log_density.max() - 4 * _DENSITY_RANGE
    grid_x, grid_y = np.meshgrid(x, y)
    axis.quiver(
        grid_x[shown],
        grid_y[shown],
        *directions[shown].T,
        color=ARROW,
        angles="xy",
        scale_units="xy",
        scale=3.6,
        width=0.0032,
        headwidth=3,
        headlength=3.5,
        headaxislength=3,
        pivot="middle",
        zorder=4,
    )
