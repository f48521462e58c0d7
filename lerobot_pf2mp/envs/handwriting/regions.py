# SPDX-License-Identifier: Apache-2.0
"""Restricted regions on the sheet: discs and polygons that a stroke must not enter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from shapely import Point, Polygon
from shapely.geometry.base import BaseGeometry

from lerobot_pf2mp.envs.handwriting.stroke import line_of

_CORNERS_OF_DISC = 64  # when a disc is drawn
_SMALLEST = 0.001  # [m]


@dataclass(frozen=True)
class Disc:
    """A circular region.

    Args:
        centre: x, y of its centre [m].
        radius: Its radius [m].

    Raises:
        ValueError: If the centre is not two finite coordinates, or the radius is below 1 mm.
    """

    centre: tuple[float, float]
    radius: float

    def __post_init__(self) -> None:
        if np.shape(self.centre) != (2,) or not np.isfinite(self.centre).all():
            raise ValueError(f"the centre of a disc must be two finite coordinates [m], got {self.centre}")
        if not (np.isfinite(self.radius) and self.radius >= _SMALLEST):
            raise ValueError(f"the radius of a disc must be at least {_SMALLEST} m, got {self.radius}")

    def clearance(self, path: np.ndarray) -> float:
        """Distance of the line through ``(N, 2)`` points to the region [m]; inside it minus the depth."""
        return float(line_of(path).distance(Point(self.centre))) - self.radius

    @property
    def outline(self) -> np.ndarray:
        """``(N, 2)`` corners of a polygon that approximates it [m]."""
        angles = np.linspace(0.0, 2 * np.pi, _CORNERS_OF_DISC, endpoint=False)
        return np.array(self.centre) + self.radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


@dataclass(frozen=True)
class Area:
    """A region with straight sides.

    Args:
        corners: x, y of each corner [m], in order.

    Raises:
        ValueError: If they are not at least three finite corners of a polygon that does not cross itself.
    """

    corners: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        shape = np.shape(self.corners)
        if len(shape) != 2 or shape[0] < 3 or shape[1] != 2 or not np.isfinite(self.corners).all():
            raise ValueError(
                f"the corners of a polygon must be at least three finite positions x, y [m], got {self.corners}"
            )
        if not self._polygon.is_valid or self._polygon.area < _SMALLEST**2:
            raise ValueError(f"a polygon must have an inside and not cross itself, got {self.corners}")

    def clearance(self, path: np.ndarray) -> float:
        """Distance of the line through ``(N, 2)`` points to the region [m]; inside it minus the depth."""
        polygon = self._polygon
        line = line_of(path)
        inside: BaseGeometry = line.intersection(polygon)
        if inside.is_empty:
            return float(line.distance(polygon))
        # The deepest point of a line need not be one of its corners.
        points = shapely.points(shapely.get_coordinates(inside.segmentize(_SMALLEST)))
        return -float(shapely.distance(points, polygon.exterior).max())

    @property
    def outline(self) -> np.ndarray:
        """``(N, 2)`` corners [m]."""
        return np.array(self.corners)

    @property
    def _polygon(self) -> Polygon:
        return Polygon(self.corners)


Region = Disc | Area


def region_of(content: Any) -> Region:
    """The region that a JSON file describes.

    Args:
        content: ``{"centre": [x, y], "radius": r}`` or ``{"corners": [[x, y], ...]}`` [m].

    Raises:
        ValueError: If it does not describe a region.
    """
    try:
        if set(content) == {"centre", "radius"}:
            return Disc(tuple(_numbers(content["centre"])), float(_numbers(content["radius"])))
        if set(content) == {"corners"}:
            return Area(tuple(tuple(corner) for corner in _numbers(content["corners"])))
    except TypeError:
        pass  # a value is not a number; the error is raised below
    raise ValueError(
        'a region must be {"centre": [x, y], "radius": r} or {"corners": [[x, y], ...]} in metres, '
        f"got {content}"
    )


def _numbers(content: Any) -> Any:
    """The content, if it consists of numbers in rows of equal length.

    Raises:
        TypeError: If it is not.
    """
    try:
        numbers = np.array(content)
    except ValueError as error:
        raise TypeError("rows of different lengths") from error
    if numbers.dtype.kind not in "iuf":
        raise TypeError("no numbers")
    return numbers.tolist()
