# SPDX-License-Identifier: Apache-2.0
"""The scene in which the actions of a policy are drawn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from lerobot_pf2mp.envs.box import Box
from lerobot_pf2mp.figures.theme import REGION, Theme
from lerobot_pf2mp.potential_field import PotentialField

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from lerobot_pf2mp.envs.handwriting.writing_scene import WritingScene


@dataclass(frozen=True)
class Scene:
    """The scene in which the actions of a policy are drawn.

    Args:
        to_metres: Maps ``(..., D)`` normalised actions to positions [m], each axis linearly.
        field: The potential field [normalised]; None for a policy without one.
        maze_map: Rows of 0 (free) and 1 (wall), north first; None if the environment is not a maze.
        obstacles: Boxes that must not be touched [m].
        writing: The letter and its restricted regions; None if the environment is not handwriting.
    """

    to_metres: Callable[[Tensor], Tensor]
    field: PotentialField | None = None
    maze_map: list[list[int]] | None = None
    obstacles: Sequence[Box] = ()
    writing: WritingScene | None = None

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """The limits of the drawing: left, right, bottom and top [m]."""
        if self.maze_map is not None:
            rows, columns = len(self.maze_map), len(self.maze_map[0])
            return -columns / 2, columns / 2, -rows / 2, rows / 2
        if self.writing is not None:
            outlines = [region.outline for region in self.writing.regions]
            return _around(np.concatenate([self.writing.stroke, *outlines]))
        if self.field is None:
            raise ValueError("a scene must have a map or a field, got neither")
        return _around(self.to_metres(self.field.anchors).numpy()[:, :2])


def _around(positions: np.ndarray) -> tuple[float, float, float, float]:
    margin = 0.1 * np.ptp(positions, axis=0)
    (left, bottom), (right, top) = positions.min(axis=0) - margin, positions.max(axis=0) + margin
    return float(left), float(right), float(bottom), float(top)


def draw_scene(axis: Axes, scene: Scene, theme: Theme, with_ticks: bool = False) -> None:
    """Draws the walls of a maze, or the letter and its regions, and sets the axes to the scene's extent.

    Args:
        axis: Axes to draw on.
        scene: The scene.
        theme: The colours.
        with_ticks: Whether the axes have ticks and labels [m].
    """
    from matplotlib.patches import Polygon, Rectangle

    left, right, bottom, top = scene.extent
    for i, row in enumerate(scene.maze_map or []):
        for j, cell in enumerate(row):
            if cell:
                corner = (left + j, top - i - 1)
                axis.add_patch(
                    Rectangle(corner, 1, 1, facecolor=theme.wall, edgecolor=theme.wall, linewidth=0.4)
                )
    if scene.writing is not None:
        for region in scene.writing.regions:
            axis.add_patch(Polygon(region.outline, facecolor=REGION, edgecolor=REGION, alpha=0.55))
        axis.plot(*scene.writing.stroke.T, color=theme.text, linewidth=1.2, linestyle=(0, (4, 3)), zorder=5)
    axis.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    if with_ticks:
        axis.set(xlabel="x [m]", ylabel="y [m]")
    else:
        axis.set(xticks=[], yticks=[])
