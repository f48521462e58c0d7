# SPDX-License-Identifier: Apache-2.0
"""Axes in three dimensions, with obstacles."""

from __future__ import annotations

from typing import Any

import numpy as np

from lerobot_pf2mp.envs.box import Box
from lerobot_pf2mp.figures.paths import PathPair
from lerobot_pf2mp.figures.scene import Scene
from lerobot_pf2mp.figures.theme import COLLISION, Theme


def draw_space(axis: Any, scene: Scene, pair: PathPair, theme: Theme) -> None:
    """Draws the obstacles, and sets equal units and limits around them and an episode on axes in three dimensions.

    Args:
        axis: Axes with the projection 3d.
        scene: The scene of the episode.
        pair: The episode, with three coordinates or more.
        theme: The colours.
    """
    from matplotlib.ticker import MaxNLocator
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    axis.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    axis.view_init(elev=22, azim=-35)
    corners = [pair.unguided.positions, pair.guided.positions]
    for box in scene.obstacles:
        corners += [box.low[None], box.high[None]]
        axis.add_collection3d(
            Poly3DCollection(faces(box), facecolor=COLLISION, edgecolor=COLLISION, linewidth=0.8, alpha=0.25)
        )
    extent = np.ptp(np.concatenate([part[:, :3] for part in corners]), axis=0)
    axis.set_box_aspect(extent.clip(min=0.2 * extent.max()), zoom=0.88)
    for side in (axis.xaxis, axis.yaxis, axis.zaxis):
        side.set_pane_color(theme.floor)
        side._axinfo["grid"]["color"] = theme.grid
        side.set_major_locator(MaxNLocator(4))
    axis.tick_params(labelsize=8)


def faces(box: Box) -> list[np.ndarray]:
    """The six sides of a box, each as ``(4, 3)`` corners [m] in their order around it."""
    sides = []
    for axis in range(3):
        for end in (box.low, box.high):
            side = np.tile(end, (4, 1))
            for corner, (first, second) in enumerate(((0, 0), (0, 1), (1, 1), (1, 0))):
                other = [i for i in range(3) if i != axis]
                side[corner, other[0]] = (box.low, box.high)[first][other[0]]
                side[corner, other[1]] = (box.low, box.high)[second][other[1]]
            sides.append(side)
    return sides
