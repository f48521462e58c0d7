# SPDX-License-Identifier: Apache-2.0
"""Short paths of a gripper around boxes: above them, or beside them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from lerobot_pf2mp.envs.box import Box


def routes(start: np.ndarray, goal: np.ndarray, boxes: Sequence[Box]) -> list[np.ndarray]:
    """The paths from start to goal that pass through no box, the shortest first.

    There are these candidates: the straight line; the shortest path above all boxes that it crosses, in the vertical plane
    through both ends; and for each box the paths around its two sides, in the inclined plane through both ends.

    Args:
        start: ``(3,)`` start [m].
        goal: ``(3,)`` goal [m].
        boxes: Boxes that the gripper's position must not enter.

    Returns:
        Paths as ``(N, 3)`` corners [m], including both ends.
    """
    candidates = [np.array([start, goal]), _above(start, goal, boxes)]
    for box in boxes:
        candidates += [_beside(start, goal, box, side) for side in (-1, 1)]
    # Paths touch the edges of boxes; the boxes are shrunk so that rounding does not put a path inside.
    shrunk = [Box.between(box.low + 1e-9, box.high - 1e-9) for box in boxes]
    free = [path for path in candidates if not _is_blocked(path, shrunk)]
    return sorted(free, key=length)


def length(path: np.ndarray) -> float:
    """The length of a path with ``(N, D)`` corners [m]."""
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def walk(path: np.ndarray, step: float) -> np.ndarray:
    """Equally spaced points ``(M, D)`` on a path, without its first point.

    Args:
        path: ``(N, D)`` corners [m].
        step: Largest distance between two points [m].
    """
    at_corner = np.concatenate([[0.0], np.linalg.norm(np.diff(path, axis=0), axis=1).cumsum()])
    at = np.linspace(0, at_corner[-1], max(2, int(np.ceil(at_corner[-1] / step)) + 1))[1:]
    return np.stack([np.interp(at, at_corner, column) for column in path.T], axis=-1)


def _is_blocked(path: np.ndarray, boxes: Sequence[Box]) -> bool:
    return any(box.blocks(a, b) for box in boxes for a, b in itertools.pairwise(path))


def _above(start: np.ndarray, goal: np.ndarray, boxes: Sequence[Box]) -> np.ndarray:
    """The path above the boxes: the upper convex hull of both ends and the boxes' upper edges between them."""
    edges = []
    for box in boxes:
        shares = _crossing(start, goal, box) or ()
        edges += [(share, box.high[2]) for share in shares if 0 < share < 1]
    hull: list[tuple[float, float]] = []
    for point in [(0.0, start[2]), *sorted(edges), (1.0, goal[2])]:
        while len(hull) > 1 and _turns_left(hull[-2], hull[-1], point):
            hull.pop()
        hull.append(point)
    return np.array([[*(start[:2] + share * (goal[:2] - start[:2])), height] for share, height in hull])


def _turns_left(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> bool:
    return (b[0] - a[0]) * (c[1] - a[1]) >= (b[1] - a[1]) * (c[0] - a[0])


def _crossing(start: np.ndarray, goal: np.ndarray, box: Box) -> tuple[float, float] | None:
    """The first and last fraction of the straight line that is above, in or below the box; None if no part is."""
    offset = goal[:2] - start[:2]
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.sort([(box.low[:2] - start[:2]) / offset, (box.high[:2] - start[:2]) / offset], axis=0)
    first, last = max(0.0, np.nanmax(ends[0])), min(1.0, np.nanmin(ends[1]))
    return (float(first), float(last)) if first < last else None


def _beside(start: np.ndarray, goal: np.ndarray, box: Box, side: int) -> np.ndarray:
    """The path around the two corners of a box on one side of it (-1 for smaller x). Heights change linearly."""
    x = box.low[0] if side < 0 else box.high[0]
    ys = sorted((box.low[1], box.high[1]), key=lambda y: abs(y - start[1]))
    flat = np.array([start[:2], *((x, y) for y in ys), goal[:2]])
    # A corner that is not outside the line between its neighbours is left out.
    for corner in (2, 1):
        before, here, after = flat[corner - 1], flat[corner], flat[corner + 1]
        share = (here[1] - before[1]) / (after[1] - before[1]) if after[1] != before[1] else 0.5
        if side * (here[0] - (before[0] + share * (after[0] - before[0]))) <= 0:
            flat = np.delete(flat, corner, axis=0)
    walked = np.concatenate([[0.0], np.linalg.norm(np.diff(flat, axis=0), axis=1).cumsum()])
    heights = start[2] + walked / walked[-1] * (goal[2] - start[2])
    return np.column_stack([flat, heights])
