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
    if (points == points[0]).all():
        return points[:1]
    lengths = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    at = np.linspace(0.0, lengths[-1], max(1, round(lengths[-1] / spacing)) + 1)
    return np.stack([np.interp(at, lengths, column) for column in points.T], axis=1)


def distances(points: np.ndarray, stroke: np.ndarray) -> np.ndarray:
    """Distances ``(N,)`` of ``(N, 2)`` points to the line through the points ``(M, 2)`` of a stroke."""
    return shapely.distance(shapely.points(points), line_of(stroke))
