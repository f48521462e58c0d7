# SPDX-License-Identifier: Apache-2.0
"""The names of recorded columns, in the spellings of different recorders.

| meaning | some of the names, in upper or lower case |
|---|---|
| time | ``time``, ``timestamp``, ``%time``, ``t`` |
| episode | ``episode``, ``episode_index`` |
| joint 1 | ``joint_1``, ``joint1``, ``panda_joint1``, ``q1``, ``joint_1.pos`` |
| finger 1 | ``finger_1``, ``panda_finger_joint1`` |
| position of the pen | ``x``, ``y``, and its height above the table ``z``; ``pen_x`` |
| state of the pen | ``pen_down`` or ``pen_up``, true or false, or ``pressure``, above 0 where the pen writes |
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from lerobot_pf2mp.envs.handwriting.panda import JOINT_NAMES, N_ARM_JOINTS

ARM, ARM_AND_FINGERS, PEN = JOINT_NAMES[:N_ARM_JOINTS], JOINT_NAMES, ("x", "y")
PEN_STATES = ("pen_down", "pen_up", "pressure")

_TIMES = ("time", "timestamp", "%time", "t")  # the first of them that is there is taken
_SPELLINGS = {
    "episode": ("episode", "episode_index", "episode_id"),
    "pen_down": (
        "pen_down",
        "pendown",
        "pen_is_down",
        "is_down",
        "down",
        "pen",
        "pen_status",
        "pen_state",
        "contact",
    ),
    "pen_up": ("pen_up", "penup", "pen_is_up", "is_up", "up"),
    "pressure": ("pressure", "pen_pressure", "tip_pressure"),
    **{axis: (axis, *(f"{prefix}_{axis}" for prefix in ("pen", "tip", "pos"))) for axis in "xyz"},
}
_MEANING_OF = {spelling: meaning for meaning, spellings in _SPELLINGS.items() for spelling in spellings}
_FINGER = re.compile(r"(?:.*[_./])?finger(?:_joint)?[_ ]?(\d)(?:[._](?:pos|position))?")
_JOINT = re.compile(r"(?:.*[_./])?(?:joint|q|j)[_ ]?(\d)(?:[._](?:pos|position))?")
_UNIT = re.compile(r"\s*[\[(](s|ms|m|cm|mm|rad)[\])]$")
_LENGTHS = {"mm": (0.001, "millimetres"), "cm": (0.01, "centimetres")}
_DISPLACEMENT = re.compile(
    r"d[xyz]|delta|rel|relative|diff|displacement|vel|velocity|speed|acc|torque|effort"
)
_ROTATION = re.compile(
    r"q[wxyz]|r[xyz]|roll|pitch|yaw|quat(?:ernion)?|rot(?:ation)?|orientation|euler|rpy|ori"
)


def meanings(names: Sequence[str]) -> list[str | None]:
    """The meaning of each name: one of `JOINT_NAMES`, ``x``, ``y``, ``z``, ``time``, ``episode``, one of `PEN_STATES`, or None.

    If joints are counted from 0, all of joint 0 to joint 6 are there.
    """  # noqa: E501
    plain = [_UNIT.sub("", name.strip().lstrip("#").strip().lower()) for name in names]
    found = [_meaning(name) for name in plain]
    time = next((name for name in _TIMES if name in plain), None)
    found = ["time" if name == time else meaning for name, meaning in zip(plain, found, strict=True)]
    if {f"joint_{number}" for number in range(N_ARM_JOINTS)} <= set(found) and ARM[-1] not in found:
        found = [
            f"joint_{int(each[-1]) + 1}" if each and each.startswith("joint_") else each for each in found
        ]
    known = {*JOINT_NAMES, *_SPELLINGS, "time"}
    return [each if each in known else None for each in found]


def length_unit(names: Sequence[str]) -> tuple[float | None, str]:
    """The unit [m] in which positions of the pen were recorded, and its name, if names say one that is not the metre.

    Raises:
        ValueError: If they say several.
    """
    plain = [name.strip().lower() for name in names]
    of_pen = [
        name for name, meaning in zip(plain, meanings(names), strict=True) if meaning in ("x", "y", "z")
    ]
    units = {found[1] if (found := _UNIT.search(name)) else "m" for name in of_pen}
    if len(units) > 1:
        raise ValueError(f"positions of the pen must have one unit, got {', '.join(of_pen)}")
    scale, unit = _LENGTHS.get("".join(units), (None, ""))
    return scale, f"{unit}, as its columns say" if unit else ""


def other_data(names: Sequence[str]) -> str | None:
    """What names say about data that are no positions of joints or of a pen; None if they say nothing."""
    moved = [name for name in names if _is_displacement(name.strip().lower())]
    if moved:
        return f"displacements or rates ({', '.join(moved)})"
    return f"poses of an end effector ({', '.join(names)})" if are_poses(names) else None


def are_poses(names: Sequence[str]) -> bool:
    """Whether names are those of positions together with orientations, as of an end effector."""
    words = [_words(name.strip().lower()) for name in names]
    turns = [any(_ROTATION.fullmatch(word) for word in each) for each in words]
    places = {each[-1] for each, turn in zip(words, turns, strict=True) if not turn}
    return any(turns) and {"x", "y"} <= places


def _meaning(plain: str) -> str | None:
    if _is_displacement(plain):
        return None
    for kind, pattern in (("finger", _FINGER), ("joint", _JOINT)):
        if found := pattern.fullmatch(plain):
            return f"{kind}_{found[1]}"
    return _MEANING_OF.get(plain)


def _is_displacement(plain: str) -> bool:
    return any(_DISPLACEMENT.fullmatch(word) for word in _words(plain))


def _words(plain: str) -> list[str]:
    return re.split(r"[_./ ]", plain)
