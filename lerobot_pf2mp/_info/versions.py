# SPDX-License-Identifier: Apache-2.0
"""The installed versions, and the versions that this package and LeRobot require."""

from __future__ import annotations

import platform
import re
from importlib.metadata import PackageNotFoundError, metadata, requires, version
from typing import TYPE_CHECKING

from .line import OPTIONAL, PROBLEM, Line
from .probes import DISTRIBUTION

if TYPE_CHECKING:
    from packaging.specifiers import SpecifierSet

LEROBOT = "lerobot"
PACKAGES = (
    DISTRIBUTION,
    LEROBOT,
    "torch",
    "mujoco",
    "gymnasium",
    "gymnasium-robotics",
    "numpy",
    "mink",
    "shapely",
    "minari",
    "accelerate",
)
# purpose: (package, the distribution that requires it, the extra with which it requires it)
EXTRAS = {
    "experts": ("stable-baselines3", DISTRIBUTION, "experts"),
    "metaworld": ("metaworld", DISTRIBUTION, "metaworld"),
    "async (grpc)": ("grpcio", DISTRIBUTION, "async"),
    "so101": ("so101-nexus", DISTRIBUTION, "so101"),
    "peft": ("peft", LEROBOT, "peft"),
    "wandb": ("wandb", LEROBOT, "training"),
}


def ranges() -> dict[str, SpecifierSet]:
    """The versions that this package and LeRobot require, by name. "python" is one of the names.

    Raises:
        ImportError: If packaging, which reads them, is missing.
    """
    from packaging.requirements import Requirement
    from packaging.specifiers import SpecifierSet

    found: dict[str, SpecifierSet] = {}

    def add(name: str, wanted: SpecifierSet) -> None:
        found[name] = found.get(name, SpecifierSet()) & wanted

    done: set[tuple[str, str]] = set()
    todo = [(DISTRIBUTION, ""), *((distribution, extra) for _, distribution, extra in EXTRAS.values())]
    while todo:
        distribution, extra = todo.pop()
        if (distribution, extra) in done or _version(distribution) is None:
            continue
        done.add((distribution, extra))
        add("python", SpecifierSet(metadata(distribution).get("Requires-Python") or ""))
        for requirement in map(Requirement, requires(distribution) or []):
            if requirement.marker is None or requirement.marker.evaluate({"extra": extra}):
                add(_normalised(requirement.name), requirement.specifier)
                if requirement.name == LEROBOT:
                    todo += [(LEROBOT, wanted) for wanted in ("", *requirement.extras)]
    return found


def python_line(wanted: SpecifierSet | None) -> Line:
    """The Python version, and whether this package runs with it."""
    found = platform.python_version()
    value = f"{found}, {platform.system()} {platform.machine()}"
    if _is_in(wanted, found):
        return Line("python", value)
    return Line("python", value, PROBLEM, f"must be {wanted}: install into an environment of such a Python")


def package_line(name: str, wanted: SpecifierSet | None) -> Line:
    """A required package: its version, and whether it is in range."""
    found = _version(name)
    remedy = f'pip install "{name}{wanted or ""}"' if name != DISTRIBUTION else "pip install . in its folder"
    if found is None:
        return Line(name, "not installed", PROBLEM, remedy)
    return Line(name, found) if _is_in(wanted, found) else Line(name, found, PROBLEM, remedy)


def extra_line(purpose: str, wanted: SpecifierSet | None) -> Line:
    """One of `EXTRAS`."""
    name, distribution, extra = EXTRAS[purpose]
    found = _version(name)
    remedy = f'pip install "{distribution}[{extra}]"'
    if found is None:
        return Line(purpose, f"no {name}", OPTIONAL, remedy)
    value = f"{name} {found}"
    return Line(purpose, value) if _is_in(wanted, found) else Line(purpose, value, OPTIONAL, remedy)


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _is_in(wanted: SpecifierSet | None, found: str) -> bool:
    return wanted is None or wanted.contains(found, prereleases=True)


def _normalised(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()
