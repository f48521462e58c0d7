# SPDX-License-Identifier: Apache-2.0
"""Contacts with an obstacle in a MuJoCo model, and the distance to it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import mujoco
import numpy as np

_FARTHEST = 2.0  # largest distance that is measured [m]
_SHIFTS = 1e-6 * np.array([(1, 2, 3), (0, 1, 0), (-2, 1, -1), (3, -1, 2), (-1, -3, 1), (2, 3, -2)])  # [m]


class Obstacle:
    """A geom that other geoms must not touch.

    Args:
        model: The MuJoCo model.
        data: Its state.
        geom: Name or id of the obstacle's geom.
        movers: Ids of the geoms that must not touch it.
    """

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, geom: str | int, movers: Sequence[int]
    ) -> None:
        self._model, self._data = model, data
        self._geom = model.geom(geom).id
        self._movers = list(movers)
        self._is_mover = np.zeros(model.ngeom, dtype=bool)
        self._is_mover[self._movers] = True
        self._segment = np.zeros(6)

    @contextmanager
    def passable(self) -> Iterator[None]:
        """Switches off all contacts with the obstacle inside a `with` block."""
        model, geom = self._model, self._geom
        contype, conaffinity = model.geom_contype[geom], model.geom_conaffinity[geom]
        model.geom_contype[geom] = model.geom_conaffinity[geom] = 0
        try:
            yield
        finally:
            model.geom_contype[geom], model.geom_conaffinity[geom] = contype, conaffinity

    def contact_depth(self) -> float:
        """The largest penetration of a mover into the obstacle in the last physics step [m]; at most 0 without contact."""
        if not self._data.ncon:
            return 0.0
        contact = self._data.contact
        pairs = contact.geom
        touches = ((pairs[:, 0] == self._geom) & self._is_mover[pairs[:, 1]]) | (
            (pairs[:, 1] == self._geom) & self._is_mover[pairs[:, 0]]
        )
        return float(-contact.dist[touches].min()) if touches.any() else 0.0

    def clearance(self) -> float:
        """The smallest distance to a mover [m], negative if one is inside."""
        return min(self._distance(mover) for mover in self._movers)

    def _distance(self, mover: int) -> float:
        model, data = self._model, self._data
        distance = mujoco.mj_geomDistance(model, data, self._geom, mover, _FARTHEST, self._segment)
        if distance != 0:
            return distance
        # MuJoCo 3.11 returns exactly 0 for about 1 % of the pairs that are well apart. A shift by micrometres avoids this.
        position = data.geom_xpos[self._geom]
        before = position.copy()
        for shift in _SHIFTS:
            position[:] = before + shift
            distance = mujoco.mj_geomDistance(model, data, self._geom, mover, _FARTHEST, self._segment)
            if distance != 0:
                break
        position[:] = before
        return distance
