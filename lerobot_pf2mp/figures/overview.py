# SPDX-License-Identifier: Apache-2.0
"""Figure 3 of the paper."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_pf2mp.figures.field import draw_arrows, draw_density, planar_field
from lerobot_pf2mp.figures.paths import PathPair, draw_path, mark_ends
from lerobot_pf2mp.figures.scene import Scene, draw_scene
from lerobot_pf2mp.figures.theme import GUIDED, THEMES, Theme, themed_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def plot_maze_overview(output: Path, *, scene: Scene, pair: PathPair, background: str = "light") -> None:
    """Draws Figure 3 of the paper: maze, density, potential field, and an episode without and with guidance.

    Both have the same start and noise.

    Args:
        output: The PNG file to write.
        scene: A maze with a field.
        pair: An episode.
        background: One of `THEMES`.
    """
    theme = THEMES[background]
    field = planar_field(scene)
    if scene.maze_map is None:
        raise ValueError("the overview needs a maze, got another environment")
    aspect = len(scene.maze_map) / len(scene.maze_map[0])
    # Three panels above, two below: five in a row would be too small at the width of a README.
    width = 12.0
    with themed_figure(output, theme, (width, width / 3 * 2 * aspect + 0.9)) as figure:
        axes = _panels(figure)
        for axis in axes:
            draw_scene(axis, scene, theme)
        axes[0].set_title("(a) start and goal")
        mark_ends(axes[0], pair.unguided.positions[0], pair.goal)
        axes[0].legend(
            loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=2, frameon=False, labelcolor=theme.text
        )
        axes[1].set_title(f"(b) density, {len(field.anchors)} demonstrated points")
        draw_density(axes[1], scene)
        axes[2].set_title("(c) potential field")
        draw_arrows(axes[2], scene, theme)
        _draw_paths(axes[3:], pair, theme)


def _panels(figure: Figure) -> list[Axes]:
    grid = figure.add_gridspec(2, 6, hspace=0.17, wspace=0.12, left=0.01, right=0.99, top=0.94, bottom=0.02)
    corners = ((0, 0), (0, 2), (0, 4), (1, 1), (1, 3))
    return [figure.add_subplot(grid[row, column : column + 2]) for row, column in corners]


def _draw_paths(axes: list[Axes], pair: PathPair, theme: Theme) -> None:
    for axis, path, colour, name in (
        (axes[0], pair.unguided, theme.unguided, "(d) FMP, no guidance"),
        (axes[1], pair.guided, GUIDED, "(e) PF2MP, same start and noise"),
    ):
        axis.set_title(f"{name}: {'collides' if path.collisions.any() else 'clear'}")
        draw_path(axis, path, colour)
        mark_ends(axis, path.positions[0], pair.goal)
