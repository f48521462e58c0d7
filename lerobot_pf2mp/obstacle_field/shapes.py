# SPDX-License-Identifier: Apache-2.0
"""Obstacles as people write them down."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from lerobot_pf2mp.obstacle_field.obstacles import DIMS, Obstacles

# The values that each kind of obstacle must have.
SHAPES = {
    "ball": ("centre", "radius"),
    "capsule": ("start", "end", "radius"),
    "box": ("centre", "half_sides"),
}
_OPTIONAL = {"ball": ("velocity",), "capsule": ("velocity",), "box": ("velocity", "radius")}


def obstacles_of(descriptions: Sequence[Mapping[str, Any]]) -> Obstacles:
    """The obstacles of one robot (B = 1).

    Args:
        descriptions: One mapping for each obstacle, in the units of the actions: ``{"type": "ball", "centre": [x, y],
            "radius": r}``, ``{"type": "capsule", "start": [x, y], "end": [x, y], "radius": r}`` or ``{"type": "box",
            "centre": [x, y], "half_sides": [a, b]}``, a box along the axes, with the ``radius`` of its edges if they are
            round. All may have a ``velocity`` [1/s]. Points have two or three coordinates.

    Raises:
        ValueError: If there is none, a value is missing, unknown or wrong, or they have different dimensions.
    """
    rows = [_row_of(i, description) for i, description in enumerate(descriptions)]
    if len({len(row) for row in rows}) != 1:
        raise ValueError(
            "obstacles must be one at least, all in two or all in three dimensions, got "
            f"{[dict(d) if isinstance(d, Mapping) else d for d in descriptions]}"
        )
    return Obstacles.from_rows(torch.tensor(rows, dtype=torch.float32).unsqueeze(0))


def _row_of(i: int, description: Mapping[str, Any]) -> list[float]:
    kind = description.get("type") if isinstance(description, Mapping) else None
    if kind not in SHAPES:
        raise ValueError(f"obstacle {i} must have a type of {tuple(SHAPES)}, got {description!r}")
    given = set(description) - {"type"}
    required, optional = set(SHAPES[kind]), set(_OPTIONAL[kind])
    if not required <= given or given - required - optional:
        raise ValueError(
            f"obstacle {i}, a {kind}, must have {', '.join(SHAPES[kind])}, and may have {', '.join(_OPTIONAL[kind])}, got "
            f"{', '.join(sorted(given)) or 'nothing'}"
        )
    points = {name: _numbers(i, name, description[name]) for name in given - {"radius"}}
    if len({len(point) for point in points.values()}) != 1 or len(next(iter(points.values()))) not in DIMS:
        raise ValueError(
            f"obstacle {i} must have points of {' or '.join(map(str, DIMS))} coordinates, got {points}"
        )
    dim = len(next(iter(points.values())))
    radius = description.get("radius", 0.0)
    sizes = [radius, *points.get("half_sides", [])]
    if not all(_is_number(size) and size >= 0 for size in sizes):
        raise ValueError(f"obstacle {i} must have sizes of at least 0, got {sizes}")
    axis = [1.0] + [0.0] * (dim - 1)
    half_sides = points.get("half_sides", [0.0] * dim)
    centre = points.get("centre", [])
    if kind == "capsule":
        start, end = points["start"], points["end"]
        length = math.dist(start, end)
        centre = [(a + b) / 2 for a, b in zip(start, end, strict=True)]
        half_sides = [length / 2] + [0.0] * (dim - 1)
        if length > 0:
            axis = [(b - a) / length for a, b in zip(start, end, strict=True)]
    return [1.0, *centre, *half_sides, *axis, *points.get("velocity", [0.0] * dim), float(radius)]


def _numbers(i: int, name: str, values: Any) -> list[float]:
    if (
        isinstance(values, str)
        or not isinstance(values, Sequence)
        or not all(_is_number(value) for value in values)
    ):
        raise ValueError(f"{name} of obstacle {i} must be finite numbers, got {values!r}")
    return [float(value) for value in values]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
