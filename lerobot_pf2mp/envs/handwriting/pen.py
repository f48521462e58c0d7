# SPDX-License-Identifier: Apache-2.0
"""The pen in the hand of an arm."""

from __future__ import annotations

import mujoco
import numpy as np

PEN_TIP = "pen_tip"  # the site at its tip
PEN_TRAVEL = 0.01  # how deep the soft tip can sink before the pen's barrel touches the table [m]
# The table collides with arm and pen. The pen does not collide with the fingers.
ARM_BIT, PEN_BIT = 1, 2

_RADIUS = 0.006  # [m]
_COLOUR, _GREY = (0.10, 0.22, 0.55, 1.0), (0.32, 0.34, 0.37, 1.0)


def add_pen(hand: mujoco.MjsBody, axis: str, end: float, tip: float) -> None:
    """Puts a pen into a hand.

    Args:
        hand: The body that holds it.
        axis: The axis of that body along which the pen points, ``x`` or ``z``.
        end: Where its blunt end is on this axis [m].
        tip: Where its tip is [m].
    """
    along = {"x": (1.0, 0.0, 0.0), "z": (0.0, 0.0, 1.0)}[axis]
    site = hand.add_site(name=PEN_TIP, pos=[tip * part for part in along])
    if axis == "x":
        site.quat = [np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0]  # turns z to x

    def between(start: float, stop: float) -> list[float]:
        return [*(start * part for part in along), *(stop * part for part in along)]

    barrel = tip - PEN_TRAVEL - _RADIUS
    hand.add_geom(
        name="pen",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=between(end, barrel),
        size=[_RADIUS, 0.0, 0.0],
        rgba=_COLOUR,
        contype=PEN_BIT,
        conaffinity=PEN_BIT,
        mass=0.02,
        group=0,
    )
    hand.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=between(barrel, tip - 0.0015),
        size=[0.0015, 0.0, 0.0],
        rgba=_GREY,
        contype=0,
        conaffinity=0,
        mass=0.0,
        group=0,
    )
