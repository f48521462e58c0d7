# SPDX-License-Identifier: Apache-2.0
"""The figure of the recordings of a real arm: demonstrations, the one left out, plans without and with guidance."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from lerobot_pf2mp.figures import PathPair, Scene
from lerobot_pf2mp.figures.scene import draw_scene
from lerobot_pf2mp.figures.theme import COLLISION, GOAL, GUIDED, REGION, THEMES, WIDTH, themed_figure


def plot_recordings(
    output: Path,
    *,
    scene: Scene,
    ways: Sequence[np.ndarray],
    left_out: int,
    pairs: Sequence[PathPair],
    background: str,
) -> None:
    """Draws the recordings, and what a policy trained on all but one writes.

    Args:
        output: The PNG file to write.
        scene: The regions.
        ways: ``(T + 1, 2)`` the recordings [m].
        left_out: The number of the one that the policy does not know.
        pairs: Episodes without and with guidance.
        background: One of `THEMES`.
    """
    theme = THEMES[background]
    left, right, bottom, top = scene.extent
    height = WIDTH / 3 * (top - bottom) / (right - left)
    with themed_figure(output, theme, (WIDTH, height + 0.7), layout="constrained") as figure:
        axes = figure.subplots(1, 3)
        for axis in axes:
            draw_scene(axis, scene, theme)
            axis.lines[0].remove()  # the stroke to write is one of the recordings
            for patch in axis.patches:
                patch.set_linewidth(0)  # the regions are parts of one
        axes[0].set_title(f"{len(ways)} recordings of a real Panda", fontsize=11)
        for number, way in enumerate(ways):
            is_left_out = number == left_out
            axes[0].plot(
                *way.T,
                color=GOAL if is_left_out else theme.arrow,
                linewidth=1.8 if is_left_out else 1.0,
                zorder=5 if is_left_out else 4,
            )
        for axis, paths, name, colour in (
            (axes[1], [pair.unguided for pair in pairs], "without guidance", theme.unguided),
            (axes[2], [pair.guided for pair in pairs], "with guidance", GUIDED),
        ):
            hits = [bool(path.collisions.any()) for path in paths]
            axis.set_title(f"{name}: {sum(hits)} of {len(paths)} collide", fontsize=11)
            for path, is_hit in sorted(zip(paths, hits, strict=True), key=lambda each: each[1]):
                axis.plot(
                    *path.positions.T,
                    color=COLLISION if is_hit else colour,
                    linewidth=0.9,
                    alpha=0.6,
                    zorder=4,
                )
        handles = [
            Line2D([], [], color=theme.arrow, linewidth=1.2, label="demonstrations"),
            Line2D([], [], color=GOAL, linewidth=1.8, label="left out"),
            Line2D([], [], color=COLLISION, linewidth=1.2, label="enters a region"),
            Patch(facecolor=REGION, alpha=0.55, label="region, where no recording comes near"),
        ]
        figure.legend(
            handles=handles,
            loc="outside lower center",
            ncols=4,
            frameon=False,
            labelcolor=theme.text,
            fontsize=9.5,
        )
