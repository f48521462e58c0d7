# SPDX-License-Identifier: Apache-2.0
"""Strokes on a plane: lengths, even spacing, distances."""

from __future__ import annotations

import numpy as np
import shapely
from shapely import LineString, Point


def line_of(points: np.ndarray) -> LineString | Point:
    """The line through ``(N, 2)`` points; a single point if all of them are equal."""
    return Point(points[0]) if (points == points[0]).all() else LineString(points)


def evenly_spaced(points: np.ndarray, spacing: float) -> np.ndarray:
    """Points ``(N, 2)`` on a line, about `spacing` apart, including both ends.

    Args:
        points: ``(N, 2)`` corners of the line.
        spacing: Distance between neighbours, in the unit of the points.
    """
    line = line_of(points)
    if isinstance(line, Point):
        return points[:1]
    n = max(1, round(line.length / spacing))
    return shapely.get_coordinates(line.interpolate(np.linspace(0.0, 1.0, n + 1), normalized=True))


def distances(points: np.ndarray, stroke: np.ndarray) -> np.ndarray:
    """Distances ``(N,)`` of ``(N, 2)`` points to the line through the points ``(M, 2)`` of a stroke."""
    return shapely.distance(shapely.points(points), line_of(stroke))
