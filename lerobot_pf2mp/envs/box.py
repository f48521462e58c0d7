# SPDX-License-Identifier: Apache-2.0
"""Boxes with sides along the axes, and whether they block a line segment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Box:
    """A box with sides along the axes.

    Args:
        centre: ``(3,)`` its centre [m].
        size: ``(3,)`` its sides [m], positive.
    """

    centre: tuple[float, float, float]
    size: tuple[float, float, float]

    @property
    def low(self) -> np.ndarray:
        """``(3,)`` the corner with the smallest coordinates [m]."""
        return np.array(self.centre) - np.array(self.size) / 2

    @property
    def high(self) -> np.ndarray:
        """``(3,)`` the corner with the largest coordinates [m]."""
        return np.array(self.centre) + np.array(self.size) / 2

    @classmethod
    def between(cls, low: Sequence[float] | np.ndarray, high: Sequence[float] | np.ndarray) -> Box:
        """The box between two opposite corners [m]."""
        low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
        centre, size = (low + high) / 2, high - low
        return cls((*centre.tolist(),), (*size.tolist(),))

    def grown_by(self, moving: Box) -> Box:
        """The positions of the origin of `moving` at which it overlaps this box (Minkowski sum).

        Args:
            moving: A box, relative to its own origin.
        """
        return Box.between(self.low - moving.high, self.high - moving.low)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Whether ``(..., 3)`` points [m] lie inside, ``(...)``."""
        return np.all((points > self.low) & (points < self.high), axis=-1)

    def blocks(self, start: np.ndarray, end: np.ndarray) -> bool:
        """Whether the line segment between two ``(3,)`` points [m] passes through the inside.

        The slab test of Kay and Kajiya (1986).
        """
        offset = np.asarray(end, dtype=float) - start
        is_flat = offset == 0
        if np.any(is_flat & ((start <= self.low) | (start >= self.high))):
            return False
        step = np.where(is_flat, 1.0, offset)
        ends = np.stack([(self.low - start) / step, (self.high - start) / step])
        enters = np.where(is_flat, -np.inf, ends.min(axis=0)).max()
        leaves = np.where(is_flat, np.inf, ends.max(axis=0)).min()
        return bool(max(enters, 0.0) < min(leaves, 1.0))
