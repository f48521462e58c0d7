# SPDX-License-Identifier: Apache-2.0
"""Top-down images of a maze, drawn with Pillow, without OpenGL."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

FLOOR = (250, 247, 242)
WALL = (166, 123, 91)
WALL_EDGE = (128, 90, 62)
BALL = (46, 139, 87)
GOAL = (214, 39, 40)
PATH = (31, 119, 180)
COLLISION = (200, 20, 20)
DISC = (70, 70, 78)

_SUPERSAMPLING = 2  # because Pillow does not smooth lines


class MazeImage:
    """Draws the state of a maze of unit cells centred at the origin.

    Args:
        maze_map: Rows of 0 (free) and 1 (wall), north first.
        size: Longer side of the image [pixels].
    """

    def __init__(self, maze_map: Sequence[Sequence[int]], size: int) -> None:
        if size < 32:
            raise ValueError(f"render_size must be at least 32 pixels, got {size}")
        self._rows, self._columns = len(maze_map), len(maze_map[0])
        zoom = size / max(self._rows, self._columns)
        # Video encoders require even sides.
        self._size = (2 * round(self._columns * zoom / 2), 2 * round(self._rows * zoom / 2))
        self._zoom = _SUPERSAMPLING * zoom  # [pixels/m], before the image is reduced
        self._background = Image.new(
            "RGB", (_SUPERSAMPLING * self._size[0], _SUPERSAMPLING * self._size[1]), FLOOR
        )
        draw = ImageDraw.Draw(self._background)
        for i, row in enumerate(maze_map):
            for j, cell in enumerate(row):
                if cell == 1:
                    corners = [j * self._zoom, i * self._zoom, (j + 1) * self._zoom, (i + 1) * self._zoom]
                    draw.rectangle(corners, fill=WALL, outline=WALL_EDGE)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width [pixels]."""
        return self._size[1], self._size[0]

    def draw(
        self,
        ball: np.ndarray,
        goal: np.ndarray,
        path: Sequence[np.ndarray],
        collisions: Sequence[np.ndarray],
        discs: Sequence[np.ndarray] = (),
        disc_radius: float = 0.0,
    ) -> np.ndarray:
        """Draws the image, ``(H, W, 3)`` uint8.

        Args:
            ball: ``(2,)`` position of the ball [m].
            goal: ``(2,)`` position of the goal [m].
            path: Positions so far [m].
            collisions: Positions at which the ball collided [m].
            discs: Centres of obstacles in the corridors [m].
            disc_radius: Their radius [m].
        """
        image = self._background.copy()
        draw = ImageDraw.Draw(image)
        self._disc(draw, goal, 0.2, GOAL)
        for centre in discs:
            self._disc(draw, centre, disc_radius, DISC)
        if len(path) > 1:
            draw.line(
                [self._pixel(p) for p in path], fill=PATH, width=round(0.06 * self._zoom), joint="curve"
            )
        self._disc(draw, ball, 0.1, BALL)
        for position in collisions:
            x, y = self._pixel(position)
            arm, width = 0.13 * self._zoom, round(0.06 * self._zoom)
            draw.line([x - arm, y - arm, x + arm, y + arm], fill=COLLISION, width=width)
            draw.line([x - arm, y + arm, x + arm, y - arm], fill=COLLISION, width=width)
        return np.asarray(image.resize(self._size, Image.Resampling.BOX))

    def _pixel(self, position: np.ndarray) -> tuple[float, float]:
        x, y = position
        return (x + self._columns / 2) * self._zoom, (self._rows / 2 - y) * self._zoom

    def _disc(
        self, draw: ImageDraw.ImageDraw, position: np.ndarray, radius: float, colour: tuple[int, int, int]
    ) -> None:
        x, y = self._pixel(position)
        half_size = radius * self._zoom
        draw.ellipse([x - half_size, y - half_size, x + half_size, y + half_size], fill=colour)
