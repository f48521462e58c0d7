# SPDX-License-Identifier: Apache-2.0
"""A small font of letters and digits. Each is one stroke of splines."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

_POINTS_BETWEEN = 24  # points on the spline between two of the points below

# Each letter is a list of pieces that meet in corners; the curve of a piece passes through its points. x points right, y
# up; a letter is 1 high.
# fmt: off
_PIECES: dict[str, list[list[tuple[float, float]]]] = {
    "C": [
        [(0.62, 0.82), (0.5, 0.95), (0.33, 1), (0.13, 0.88), (0.03, 0.68), (0, 0.5), (0.03, 0.32),
         (0.13, 0.12), (0.33, 0), (0.5, 0.05), (0.62, 0.18)],
    ],
    "G": [
        [(0.62, 0.82), (0.5, 0.95), (0.33, 1), (0.13, 0.88), (0.03, 0.68), (0, 0.5), (0.03, 0.32),
         (0.13, 0.12), (0.33, 0), (0.5, 0.05), (0.62, 0.18)],
        [(0.62, 0.18), (0.62, 0.45)],
        [(0.62, 0.45), (0.36, 0.45)],
    ],
    "J": [
        [(0.45, 1), (0.45, 0.65), (0.45, 0.32), (0.4, 0.11), (0.25, 0), (0.08, 0.06), (0, 0.22)],
    ],
    "L": [
        [(0, 1), (0, 0)],
        [(0, 0), (0.55, 0)],
    ],
    "M": [
        [(0, 0), (0.1, 1)],
        [(0.1, 1), (0.4, 0.3)],
        [(0.4, 0.3), (0.7, 1)],
        [(0.7, 1), (0.8, 0)],
    ],
    "N": [
        [(0, 0), (0, 1)],
        [(0, 1), (0.6, 0)],
        [(0.6, 0), (0.6, 1)],
    ],
    "O": [
        [(0.33, 1), (0.11, 0.88), (0.01, 0.66), (0, 0.5), (0.01, 0.34), (0.11, 0.12), (0.33, 0),
         (0.55, 0.12), (0.65, 0.34), (0.66, 0.5), (0.65, 0.66), (0.55, 0.88), (0.33, 1)],
    ],
    "S": [
        [(0.6, 0.84), (0.5, 0.95), (0.31, 1), (0.11, 0.91), (0.05, 0.74), (0.15, 0.59), (0.33, 0.5),
         (0.51, 0.41), (0.61, 0.25), (0.54, 0.08), (0.33, 0), (0.12, 0.05), (0.02, 0.17)],
    ],
    "U": [
        [(0, 1), (0, 0.7), (0.01, 0.35), (0.1, 0.09), (0.3, 0), (0.5, 0.09), (0.59, 0.35), (0.6, 0.7),
         (0.6, 1)],
    ],
    "V": [
        [(0, 1), (0.32, 0)],
        [(0.32, 0), (0.64, 1)],
    ],
    "W": [
        [(0, 1), (0.21, 0)],
        [(0.21, 0), (0.42, 0.75)],
        [(0.42, 0.75), (0.63, 0)],
        [(0.63, 0), (0.84, 1)],
    ],
    "Z": [
        [(0.02, 1), (0.6, 1)],
        [(0.6, 1), (0, 0)],
        [(0, 0), (0.62, 0)],
    ],
    "1": [
        [(0.05, 0.78), (0.3, 1)],
        [(0.3, 1), (0.3, 0)],
    ],
    "2": [
        [(0.04, 0.78), (0.12, 0.94), (0.3, 1), (0.49, 0.92), (0.56, 0.74), (0.47, 0.51), (0.27, 0.27),
         (0, 0)],
        [(0, 0), (0.6, 0)],
    ],
    "3": [
        [(0.03, 0.85), (0.14, 0.97), (0.3, 1), (0.48, 0.93), (0.54, 0.77), (0.46, 0.6), (0.24, 0.53)],
        [(0.24, 0.53), (0.49, 0.46), (0.58, 0.27), (0.5, 0.07), (0.28, 0), (0.1, 0.04), (0, 0.16)],
    ],
    "6": [
        [(0.48, 1), (0.26, 0.84), (0.09, 0.6), (0.02, 0.32), (0.11, 0.09), (0.3, 0), (0.5, 0.08),
         (0.58, 0.28), (0.49, 0.48), (0.3, 0.56), (0.12, 0.47), (0.04, 0.3)],
    ],
    "7": [
        [(0, 1), (0.58, 1)],
        [(0.58, 1), (0.2, 0)],
    ],
    "8": [
        [(0.3, 0.52), (0.13, 0.64), (0.07, 0.78), (0.14, 0.93), (0.3, 1), (0.46, 0.93), (0.53, 0.78),
         (0.47, 0.64), (0.3, 0.52), (0.1, 0.4), (0.02, 0.25), (0.1, 0.07), (0.3, 0), (0.5, 0.07),
         (0.58, 0.25), (0.5, 0.4), (0.3, 0.52)],
    ],
    "9": [
        [(0.54, 0.7), (0.46, 0.53), (0.28, 0.44), (0.09, 0.52), (0, 0.72), (0.08, 0.92), (0.28, 1),
         (0.47, 0.91), (0.56, 0.68), (0.49, 0.4), (0.32, 0.16), (0.1, 0)],
    ],
}
# fmt: on
LETTERS = tuple(_PIECES)


def letter_stroke(letter: str) -> np.ndarray:
    """The stroke of a letter: ``(N, 2)`` points in the order of writing. Its height is 1, its centre the origin.

    Args:
        letter: One of `LETTERS`.

    Raises:
        ValueError: If there is no such letter.
    """
    if letter not in _PIECES:
        raise ValueError(f"letter must be one of {list(LETTERS)}, got {letter!r}")
    pieces = [_curve(np.array(piece)) for piece in _PIECES[letter]]
    points = np.concatenate([pieces[0], *(piece[1:] for piece in pieces[1:])])
    low, high = points.min(axis=0), points.max(axis=0)
    return (points - (low + high) / 2) / (high - low)[1]


def _curve(through: np.ndarray) -> np.ndarray:
    """A natural cubic spline through ``(N, 2)`` points, parametrised by the square root of their distances."""
    # Centripetal parameters prevent overshoots of the curve between points at uneven distances (Lee, 1989).
    knots = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(through, axis=0), axis=1) ** 0.5)])
    times = np.interp(
        np.arange((len(knots) - 1) * _POINTS_BETWEEN + 1) / _POINTS_BETWEEN, range(len(knots)), knots
    )
    is_closed = len(through) > 2 and np.array_equal(through[0], through[-1])
    return CubicSpline(knots, through, bc_type="periodic" if is_closed else "natural")(times)
