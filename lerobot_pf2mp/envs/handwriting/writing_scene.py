# SPDX-License-Identifier: Apache-2.0
"""The stroke to write on the sheet, and the regions that the pen must not enter."""

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
_SPACING = 0.001  # between the letter's points [m]
_RADII = (0.006, 0.045)  # smallest and largest of a letter's regions [m]
_GRID = 0.002  # spacing of the candidate centres of regions [m]
_LENGTHS = (0.02, 100.0)  # smallest and largest length of a stroke [m]


@dataclass(frozen=True)
class WritingScene:
    """A stroke to draw, and regions that the pen must not enter.

    Args:
        name: Name of the letter or the scene file, for titles and file names.
        stroke: ``(N, 2)`` positions x, y of the pen in the table's frame [m], in the order of writing.
        regions: The restricted regions.

    Raises:
        ValueError: If the stroke leaves the sheet or a region blocks it.
    """

    name: str
    stroke: np.ndarray
    regions: tuple[Region, ...]

    def __post_init__(self) -> None:
        check_on_sheet(self.stroke, f"the stroke of {self.name}")
        _check_length(self.stroke, self.name)
        for region in self.regions:
            if region.clearance(self.stroke) <= 0:
                raise ValueError(
                    f"regions must leave the stroke free, got one that blocks {self.name}: {region}"
                )

    def clearance(self, path: np.ndarray) -> float:
        """Smallest distance of the line through ``(N, 2)`` points to a region [m], negative inside; inf without regions."""
        return min((region.clearance(path) for region in self.regions), default=math.inf)


def is_on_sheet(positions: np.ndarray) -> bool:
    """Whether all of ``(..., 2)`` positions x, y [m] are on the sheet."""
    low, high = SHEET_CORNERS
    return bool((positions >= low).all() and (positions <= high).all())


def check_on_sheet(positions: np.ndarray, name: str) -> None:
    """Checks that the pen reaches all of ``(..., 2)`` positions x, y [m].

    Raises:
        ValueError: If one is not finite or not on the sheet.
    """
    if positions.ndim < 1 or positions.shape[-1] != 2 or not np.isfinite(positions).all():
        raise ValueError(f"{name} must be finite positions x, y [m], got {_first_not_finite(positions)}")
    low, high = SHEET_CORNERS
    is_outside = ((positions < low) | (positions > high)).any(axis=-1)
    if is_outside.any():
        row = int(is_outside.argmax())
        outside = positions.reshape(-1, 2)[row]
        raise ValueError(
            f"{name} must lie on the sheet, where the arm reaches with an upright pen, x in [{low[0]:g}, {high[0]:g}] "
            f"and y in [{low[1]:g}, {high[1]:g}] m of the table's frame; got {np.round(outside, 4).tolist()}"
            f"{f' in row {row}' if positions.ndim > 1 else ''}"
        )


def _check_length(stroke: np.ndarray, name: str) -> None:
    length = line_of(stroke).length
    if length < _LENGTHS[0]:
        raise ValueError(f"a stroke must be at least {_LENGTHS[0]} m long, got that of {name}")
    if length > _LENGTHS[1]:
        raise ValueError(f"a stroke must be at most {_LENGTHS[1]:g} m long, got {length:g} m, that of {name}")


def _first_not_finite(positions: np.ndarray) -> str:
    if positions.ndim < 1 or positions.shape[-1] != 2:
        return f"an array of shape {positions.shape}"
    row = int((~np.isfinite(positions)).any(axis=-1).argmax())
    return f"{positions.reshape(-1, 2)[row].tolist()}{f' in row {row}' if positions.ndim > 1 else ''}"


def make_writing_scene(
    letter: str = "S",
    *,
    letter_height: float = LETTER_HEIGHT,
    region_gap: float = REGION_GAP,
    n_regions: int = N_REGIONS,
    scene_file: str | Path | None = None,
) -> WritingScene:
    """Makes a letter in the middle of the sheet with regions in its concave parts, or the scene of a file.

    The regions of a letter are discs. Each is the largest one whose centre is in the convex hull of the letter and that
    keeps a distance of `region_gap` to the stroke and to the discs before it.

    Args:
        letter: One of `letters.LETTERS`.
        letter_height: Height of the letter [m].
        region_gap: Distance between the stroke and the regions [m].
        n_regions: Largest number of regions; there are fewer if there is no room for them.
        scene_file: A JSON file with a stroke and regions instead of a letter, see `read_writing_scene`.

    Raises:
        ValueError: If an argument breaks its rule, or the stroke leaves the sheet or is blocked by a region.
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
    return WritingScene(letter, stroke, _regions_in_concave_parts(stroke, region_gap, n_regions))


def read_writing_scene(path: Path) -> WritingScene:
    """Reads the scene that a JSON file describes.

    Args:
        path: A file ``{"stroke": [[x, y], ...], "regions": [...]}``, with positions in the table's frame [m] and
            regions as for `region_of`.

    Raises:
        ValueError: If the file does not describe a scene, or the stroke leaves the sheet or is blocked by a region.
        FileNotFoundError: If there is no such file.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} must be a JSON file, got {error}") from error
    if not isinstance(content, dict) or set(content) - {"regions"} != {"stroke"}:
        found = list(content) if isinstance(content, dict) else type(content).__name__
        raise ValueError(f'{path} must hold {{"stroke": [...], "regions": [...]}}, got {found}')
    regions = content.get("regions", [])
    if not isinstance(regions, list):
        raise ValueError(f"the regions in {path} must be a list, got {regions}")
    positions = _stroke_of(content["stroke"], path)
    check_on_sheet(positions, f"the stroke of {path.stem}")
    _check_length(positions, path.stem)  # before it is divided into millimetres
    stroke = evenly_spaced(positions, _SPACING)
    return WritingScene(path.stem, stroke, tuple(region_of(region) for region in regions))


def _stroke_of(content: Any, path: Path) -> np.ndarray:
    try:
        positions = np.array(content, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        positions = np.empty(0)
    if (
        positions.ndim != 2
        or positions.shape[1] != 2
        or len(positions) < 2
        or not np.isfinite(positions).all()
    ):
        raise ValueError(f"the stroke in {path} must be two or more finite positions [x, y] in metres")
    return positions


def _regions_in_concave_parts(stroke: np.ndarray, gap: float, n_regions: int) -> tuple[Region, ...]:
    hull = MultiPoint(stroke).convex_hull
    if not isinstance(hull, Polygon):
        return ()
    left, bottom, right, top = hull.bounds
    x, y = np.meshgrid(np.arange(left, right, _GRID), np.arange(bottom, top, _GRID))
    centres = np.stack([x.ravel(), y.ravel()], axis=1)
    centres = centres[shapely.contains_xy(hull, centres)]
    room = distances(centres, stroke) - gap
    regions: list[Disc] = []
    while len(regions) < n_regions and room.size and room.max() >= _RADII[0]:
        best = int(room.argmax())
        disc = Disc((float(centres[best, 0]), float(centres[best, 1])), float(min(room[best], _RADII[1])))
        regions.append(disc)
        room = np.minimum(room, np.linalg.norm(centres - centres[best], axis=1) - disc.radius - gap)
    return tuple(regions)
