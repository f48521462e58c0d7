# SPDX-License-Identifier: Apache-2.0
"""Episodes without and with guidance, one panel each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lerobot_pf2mp.figures.paths import PathPair, draw_path, mark_ends
from lerobot_pf2mp.figures.scene import Scene, draw_scene
from lerobot_pf2mp.figures.space import draw_space
from lerobot_pf2mp.figures.theme import COLLISION, GUIDED, THEMES, WIDTH, Theme, themed_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def plot_trajectories(
    output: Path, *, scene: Scene, pairs: Sequence[PathPair], background: str = "light"
) -> None:
    """Draws episodes without and with guidance, from the same start and the same noise.

    Args:
        output: The PNG file to write.
        scene: The scene of the episodes.
        pairs: The episodes, one panel each. Positions with three coordinates are drawn in three dimensions.
        background: One of `THEMES`.
    """
    theme = THEMES[background]
    is_3d = pairs[0].unguided.positions.shape[1] >= 3
    columns = min(len(pairs), 3)
    rows = -(-len(pairs) // columns)
    left, right, bottom, top = (0.0, 1.0, 0.0, 1.0) if is_3d else scene.extent
    panel = WIDTH / columns
    size = (WIDTH, rows * (panel * (0.92 if is_3d else (top - bottom) / (right - left)) + 0.3) + 0.5)
    # 3D axes do not report the size of their labels to the constrained layout.
    with themed_figure(output, theme, size, layout=None if is_3d else "constrained") as figure:
        axes = _panels(figure, rows, columns, is_3d)
        for axis in axes.flat[len(pairs) :]:
            axis.set_axis_off()
        for axis, pair in zip(axes.flat, pairs, strict=False):
            if is_3d:
                draw_space(axis, scene, pair, theme)
            else:
                draw_scene(axis, scene, theme)
            _draw_pair(axis, pair, theme)
        _add_legend(figure, axes.flat[0], theme, is_3d)


def _panels(figure: Figure, rows: int, columns: int, is_3d: bool) -> np.ndarray:
    """``(rows, columns)`` axes."""
    if is_3d:
        border = 0.55 / figure.get_size_inches()[1]
        figure.subplots_adjust(0.0, border, 0.94, 1 - border, wspace=0.05, hspace=0.28)
    return figure.subplots(rows, columns, squeeze=False, subplot_kw={"projection": "3d"} if is_3d else {})


def _draw_pair(axis: Axes, pair: PathPair, theme: Theme) -> None:
    draw_path(axis, pair.unguided, theme.unguided, label="without guidance")
    draw_path(axis, pair.guided, GUIDED, label="with guidance")
    mark_ends(axis, pair.unguided.positions[0], pair.goal)
    axis.set_title(f"episode {pair.episode}", fontsize=11)


def _add_legend(figure: Figure, axis: Axes, theme: Theme, is_3d: bool) -> None:
    handles, labels = axis.get_legend_handles_labels()
    # The mark of a collision is in the legend even if the first episode has none.
    cross = axis.plot(
        [], [], linestyle="none", marker="x", color=COLLISION, markersize=8, markeredgewidth=2.2
    )
    figure.legend(
        [*handles, *cross],
        [*labels, "collision"],
        loc="lower center" if is_3d else "outside lower center",
        ncols=5,
        frameon=False,
        labelcolor=theme.text,
    )
