# SPDX-License-Identifier: Apache-2.0
"""All strokes of a policy on one sheet, without and with guidance."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lerobot_pf2mp.figures.paths import Path2D, PathPair
from lerobot_pf2mp.figures.scene import Scene, draw_scene
from lerobot_pf2mp.figures.theme import COLLISION, GUIDED, THEMES, WIDTH, themed_figure


def plot_strokes(output: Path, *, scene: Scene, pairs: Sequence[PathPair], background: str = "light") -> None:
    """Draws the strokes of several episodes, without and with guidance, from the same starts and noise.

    Args:
        output: The PNG file to write.
        scene: A sheet with a letter.
        pairs: The episodes.
        background: One of `THEMES`.

    Raises:
        ValueError: If the environment is not handwriting.
    """
    theme = THEMES[background]
    if scene.writing is None:
        raise ValueError("this figure needs a handwriting environment, got another one")
    left, right, bottom, top = scene.extent
    width = 0.72 * WIDTH
    with themed_figure(
        output, theme, (width, width / 2 * (top - bottom) / (right - left) + 0.55), layout="constrained"
    ) as figure:
        axes = figure.subplots(1, 2)
        for axis, paths, name, colour in (
            (axes[0], [pair.unguided for pair in pairs], "without guidance", theme.unguided),
            (axes[1], [pair.guided for pair in pairs], "with guidance", GUIDED),
        ):
            draw_scene(axis, scene, theme)
            n_collisions = sum(bool(path.collisions.any()) for path in paths)
            axis.set_title(f"{name}\n{n_collisions} of {len(paths)} collide", fontsize=11)
            # Strokes that collide are drawn last, so that they are not hidden.
            for path in sorted(paths, key=_collides):
                line = COLLISION if _collides(path) else colour
                axis.plot(*path.positions.T, color=line, linewidth=0.9, alpha=0.6, zorder=4)


def _collides(path: Path2D) -> bool:
    return bool(path.collisions.any())
