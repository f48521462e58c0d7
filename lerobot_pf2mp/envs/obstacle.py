# SPDX-License-Identifier: Apache-2.0
"""Contact with an obstacle, and the distance to it, in a MuJoCo model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import mujoco
import numpy as np

_FARTHEST = 2.0  # [m]; distances beyond are not told apart


class Obstacle:
    """A geom that others must not touch.

    Args:
        model: The MuJoCo model.
        data: Its state.
        geom: Name of the obstacle's geom.
        movers: Ids of the geoms that must not touch it.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, geom: str, movers: Sequence[int]) -> None:
        self._model, self._data = model, data
        self._geom = model.geom(geom).id
        self._movers = list(movers)
        self._is_mover = np.zeros(model.ngeom, dtype=bool)
        self._is_mover[self._movers] = True
        self._segment = np.zeros(6)

    @contextmanager
    def passable(self) -> Iterator[None]:
        """Within the block nothing is stopped by it."""
        model, geom = self._model, self._geom
        contype, conaffinity = model.geom_contype[geom], model.geom_conaffinity[geom]
        model.geom_contype[geom] = model.geom_conaffinity[geom] = 0
        try:
            yield
        finally:
            model.geom_contype[geom], model.geom_conaffinity[geom] = contype, conaffinity

    def contact_depth(self) -> float:
        """How deep something has pressed into the obstacle in the last physics step [m]; at most 0 without contact."""
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
        # MuJoCo's own collision code returns exactly 0 for about one pair in a hundred that is well apart (seen in 3.11);
        # libccd, which it used before, does not.
        flags = model.opt.disableflags
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)
        distance = mujoco.mj_geomDistance(model, data, self._geom, mover, _FARTHEST, self._segment)
        model.opt.disableflags = flags
        return distance
