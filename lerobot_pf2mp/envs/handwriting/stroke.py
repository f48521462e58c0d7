# SPDX-License-Identifier: Apache-2.0
"""Strokes on a plane: lengths, even spacing, distances."""

from __future__ import annotations

import numpy as np
import shapely
from shapely import LineString, Point


def line_of(points: np.ndarray) -> LineString | Point:
    """The line through ``(N, 2)`` points; a single place where it would have no length."""
    return Point(points[0]) if (points == points[0]).all() else LineString(points)


def evenly_spaced(points: np.ndarray, spacing: float) -> np.ndarray:
    """Points on the same line ``(N, 2)``, about `spacing` apart, with both ends.

    Args:
        points: ``(N, 2)`` corners of the line.
        spacing: In the unit of the points.
    """
    line = line_of(points)
    if isinstance(line, Point):
        return points[:1]
    n = max(1, round(line.length / spacing))
    return shapely.get_coordinates(line.interpolate(np.linspace(0.0, 1.0, n + 1), normalized=True))


def distances(points: np.ndarray, stroke: np.ndarray) -> np.ndarray:
    """Distance of each of ``(N, 2)`` points to the line through others ``(M, 2)``."""
    return shapely.distance(shapely.points(points), line_of(stroke))
