# SPDX-License-Identifier: Apache-2.0
"""What is written on the sheet, and the regions that the pen must not enter."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely import MultiPoint, Polygon

from lerobot_pf2mp.envs.handwriting.letters import letter_stroke
from lerobot_pf2mp.envs.handwriting.regions import Disc, Region, region_of
from lerobot_pf2mp.envs.handwriting.sheet import (
    LETTER_HEIGHT,
    N_REGIONS,
    REGION_GAP,
    SHEET_CENTRE,
    SHEET_SIDE,
)
from lerobot_pf2mp.envs.handwriting.stroke import distances, evenly_spaced, line_of

SHEET_CORNERS = np.array(SHEET_CENTRE) - SHEET_SIDE / 2, np.array(SHEET_CENTRE) + SHEET_SIDE / 2
_SPACING = 0.001  # of the letter's points [m]
_RADII = (0.006, 0.045)  # smallest and largest of a letter's regions [m]
_GRID = 0.002  # of the places where a region may be put [m]
_MIN_LENGTH = 0.02  # of a stroke [m]


@dataclass(frozen=True)
class WritingScene:
    """A stroke to draw, and regions to keep out of.

    Args:
        name: What is written, for titles and file names.
        stroke: ``(N, 2)`` places x, y of the pen in the frame of the robot's base [m], in the order of writing.
        regions: The restricted regions.

    Raises:
        ValueError: If the stroke leaves the sheet or a region blocks it.
    """

    name: str
    stroke: np.ndarray
    regions: tuple[Region, ...]

    def __post_init__(self) -> None:
        check_on_sheet(self.stroke, f"the stroke of {self.name}")
        if line_of(self.stroke).length < _MIN_LENGTH:
            raise ValueError(f"a stroke must be at least {_MIN_LENGTH} m long, got that of {self.name}")
        for region in self.regions:
            if region.clearance(self.stroke) <= 0:
                raise ValueError(
                    f"regions must leave the stroke free, got one that blocks {self.name}: {region}"
                )

    def clearance(self, way: np.ndarray) -> float:
        """Smallest distance of the line through ``(N, 2)`` points to a region [m], negative inside; inf without regions."""
        return min((region.clearance(way) for region in self.regions), default=math.inf)


def is_on_sheet(places: np.ndarray) -> bool:
    """Whether all of ``(..., 2)`` places x, y [m] are on the sheet."""
    low, high = SHEET_CORNERS
    return bool((places >= low).all() and (places <= high).all())


def check_on_sheet(places: np.ndarray, name: str) -> None:
    """Checks that the pen reaches all of ``(..., 2)`` places x, y [m].

    Raises:
        ValueError: If one is not finite or not on the sheet.
    """
    if places.ndim < 1 or places.shape[-1] != 2 or not np.isfinite(places).all():
        raise ValueError(f"{name} must be finite places x, y [m], got {places.tolist()}")
    if not is_on_sheet(places):
        low, high = SHEET_CORNERS
        outside = next(place for place in places.reshape(-1, 2) if not is_on_sheet(place))
        raise ValueError(
            f"{name} must lie on the sheet, where the arm reaches with an upright pen, x in [{low[0]:g}, {high[0]:g}] "
            f"and y in [{low[1]:g}, {high[1]:g}] m of its base; got {np.round(outside, 4).tolist()}"
        )


def make_writing_scene(
    letter: str = "S",
    *,
    letter_height: float = LETTER_HEIGHT,
    region_gap: float = REGION_GAP,
    n_regions: int = N_REGIONS,
    scene_file: str | Path | None = None,
) -> WritingScene:
    """A letter in the middle of the sheet with regions in its bays, or what a file describes.

    The regions of a letter are the largest discs, one after the other, whose centre is in the letter's convex hull and
    that keep `region_gap` from its stroke.

    Args:
        letter: One of `letters.LETTERS`.
        letter_height: [m].
        region_gap: Between the stroke and the regions [m].
        n_regions: Most regions; there are fewer where they find no room.
        scene_file: A JSON file with a stroke and regions instead of a letter, see `read_writing_scene`.

    Raises:
        ValueError: If an argument breaks its rule, or the stroke is out of reach or blocked.
        FileNotFoundError: If there is no such file.
    """
    if scene_file is not None:
        return read_writing_scene(Path(scene_file).expanduser())
    if not (math.isfinite(letter_height) and letter_height > 0):
        raise ValueError(f"letter_height must be above 0 m, got {letter_height}")
    if not (math.isfinite(region_gap) and region_gap > 0):
        raise ValueError(f"region_gap must be above 0 m, got {region_gap}")
    if n_regions < 0:
        raise ValueError(f"n_regions must be at least 0, got {n_regions}")
    whole = np.array(SHEET_CENTRE) + letter_height * letter_stroke(letter)
    check_on_sheet(whole, f"the stroke of {letter}")  # before it is divided into millimetres
    stroke = evenly_spaced(whole, _SPACING)
    return WritingScene(letter, stroke, _regions_in_the_bays(stroke, region_gap, n_regions))


def read_writing_scene(path: Path) -> WritingScene:
    """The scene that a JSON file describes.

    Args:
        path: Of a file ``{"stroke": [[x, y], ...], "regions": [...]}``, places in the frame of the robot's base [m], regions
            as for `region_of`.

    Raises:
        ValueError: If the file does not describe one, or the stroke is out of reach or blocked.
        FileNotFoundError: If there is no such file.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} must be a JSON file, got {error}") from error
    if not isinstance(content, dict) or set(content) - {"regions"} != {"stroke"}:
        found = list(content) if isinstance(content, dict) else type(content).__name__
        raise ValueError(f'{path} must hold {{"stroke": [...], "regions": [...]}}, got {found}')
    regions = content.get("regions", [])
    if not isinstance(regions, list):
        raise ValueError(f"the regions in {path} must be a list, got {regions}")
    places = _places(content["stroke"], path)
    check_on_sheet(places, f"the stroke of {path.stem}")
    stroke = evenly_spaced(places, _SPACING)
    return WritingScene(path.stem, stroke, tuple(region_of(region) for region in regions))


def _places(content: Any, path: Path) -> np.ndarray:
    try:
        places = np.array(content, dtype=np.float64)
    except (TypeError, ValueError):
        places = np.empty(0)
    if places.ndim != 2 or places.shape[1] != 2 or len(places) < 2 or not np.isfinite(places).all():
        raise ValueError(f"the stroke in {path} must be two or more finite places [x, y] in metres")
    return places


def _regions_in_the_bays(stroke: np.ndarray, gap: float, n_regions: int) -> tuple[Region, ...]:
    hull = MultiPoint(stroke).convex_hull
    if not isinstance(hull, Polygon):
        return ()
    left, bottom, right, top = hull.bounds
    x, y = np.meshgrid(np.arange(left, right, _GRID), np.arange(bottom, top, _GRID))
    places = np.stack([x.ravel(), y.ravel()], axis=1)
    places = places[shapely.contains_xy(hull, places)]
    room = distances(places, stroke) - gap
    regions: list[Disc] = []
    while len(regions) < n_regions and room.size and room.max() >= _RADII[0]:
        best = int(room.argmax())
        disc = Disc((float(places[best, 0]), float(places[best, 1])), float(min(room[best], _RADII[1])))
        regions.append(disc)
        room = np.minimum(room, np.linalg.norm(places - places[best], axis=1) - disc.radius - gap)
    return tuple(regions)
