# SPDX-License-Identifier: Apache-2.0
import itertools
import json
import math
import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shapely import LineString, MultiPoint, Point

from lerobot_pf2mp.envs.handwriting import letters
from lerobot_pf2mp.envs.handwriting.letters import LETTERS, letter_stroke
from lerobot_pf2mp.envs.handwriting.regions import Area, Disc, Region, region_of
from lerobot_pf2mp.envs.handwriting.sheet import (
    LETTER_HEIGHT,
    N_REGIONS,
    REGION_GAP,
    SHEET_CENTRE,
    SHEET_SIDE,
)
from lerobot_pf2mp.envs.handwriting.stroke import distances, evenly_spaced, line_of
from lerobot_pf2mp.envs.handwriting.writing_scene import WritingScene, check_on_sheet, make_writing_scene

SPACING = 0.001  # of a scene's stroke [m]
GRID = 0.002  # of the candidate centres of regions [m]
RADII = (0.006, 0.045)  # of the regions of a letter [m]
NAN, INFINITE = float("nan"), float("inf")
BAR = [[0.42, -0.1], [0.42, 0.1]]  # a stroke, straight to the left
SQUARE = Area(((0.45, -0.05), (0.55, -0.05), (0.55, 0.05), (0.45, 0.05)))
DISC = Disc((0.5, 0.01), 0.04)
# Half of it is empty: an L whose corner is cut out.
HOOK = Area(((0.45, -0.05), (0.55, -0.05), (0.55, -0.02), (0.48, -0.02), (0.48, 0.06), (0.45, 0.06)))
REGIONS = (DISC, SQUARE, HOOK)


@cache
def scene_of(letter: str, **options: Any) -> WritingScene:
    return make_writing_scene(letter, **options)


def steps_of(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.diff(points, axis=0), axis=1)


def bends_of(points: np.ndarray) -> np.ndarray:
    """By how much the line turns at each of its inner points [rad]."""
    ahead = np.diff(points, axis=0)
    angles = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    return np.abs((np.diff(angles) + np.pi) % (2 * np.pi) - np.pi)


def densely(way: np.ndarray, spacing: float = 0.0001) -> np.ndarray:
    """``(M, 2)`` points on the line through others ``(N, 2)``, without Shapely."""
    parts = [
        start
        + np.linspace(0, 1, max(2, math.ceil(math.dist(start, end) / spacing) + 1))[:, None] * (end - start)
        for start, end in itertools.pairwise(way)
    ]
    return np.concatenate(parts) if parts else way


def to_segments(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Distance of each of ``(M, 2)`` points to the line through ``(N, 2)`` corners."""
    start, step = corners[:-1], np.diff(corners, axis=0)
    share = ((points[:, None] - start) * step).sum(axis=-1) / np.maximum((step * step).sum(axis=-1), 1e-300)
    feet = start + share.clip(0, 1)[..., None] * step
    return np.linalg.norm(points[:, None] - feet, axis=-1).min(axis=1)


def depth_in(region: Region, points: np.ndarray) -> np.ndarray:
    """How deep each of ``(M, 2)`` points is in a region [m], negative outside; for a polygon by the even-odd rule."""
    if isinstance(region, Disc):
        return region.radius - np.linalg.norm(points - region.centre, axis=1)
    corners = np.array([*region.corners, region.corners[0]])
    x, y = points[:, None].transpose(2, 0, 1)
    (x0, y0), (x1, y1) = corners[:-1].T, corners[1:].T
    with np.errstate(divide="ignore", invalid="ignore"):
        crosses = ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) / (y1 - y0) * (x1 - x0))
    inside = crosses.sum(axis=1) % 2 == 1
    return np.where(inside, 1, -1) * to_segments(points, corners)


# Letters


@pytest.mark.parametrize("letter", LETTERS)
def test_a_letter_is_one_high_and_its_middle_is_the_origin(letter: str) -> None:
    stroke = letter_stroke(letter)
    low, high = stroke.min(axis=0), stroke.max(axis=0)
    assert high[1] - low[1] == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(low + high, 0, atol=1e-12)
    assert high[0] - low[0] < 1  # higher than wide


@pytest.mark.parametrize("letter", LETTERS)
def test_a_letter_is_one_stroke_without_jumps(letter: str) -> None:
    steps = steps_of(letter_stroke(letter))
    assert steps.max() < 0.05
    assert steps.min() > 0


@pytest.mark.parametrize("letter", LETTERS)
def test_a_letter_passes_the_points_of_the_font_in_their_order(letter: str) -> None:
    pieces = letters._PIECES[letter]
    points = np.array([pieces[0][0], *(point for piece in pieces for point in piece[1:])])
    passed = letter_stroke(letter)[:: letters._POINTS_BETWEEN]
    assert passed.shape == points.shape
    offsets, passed = points - points.mean(axis=0), passed - passed.mean(axis=0)
    size = (offsets * passed).sum() / (offsets * offsets).sum()
    np.testing.assert_allclose(passed, size * offsets, atol=1e-12)
    assert 0.99 < size <= 1 + 1e-12  # the curve swings out by at most 1%


@pytest.mark.parametrize("letter", LETTERS)
def test_a_letter_turns_sharply_where_its_pieces_meet_and_nowhere_else(letter: str) -> None:
    bends = bends_of(letter_stroke(letter))
    corners = [len(piece) - 1 for piece in letters._PIECES[letter]]
    corners = np.cumsum(corners[:-1], dtype=int) * letters._POINTS_BETWEEN - 1
    assert (bends[corners] > 0.5).all()
    assert np.delete(bends, corners).max() < 0.2


def test_a_closed_letter_is_smooth_where_it_closes() -> None:
    for letter in ("O", "8"):
        stroke = letter_stroke(letter)
        np.testing.assert_array_equal(stroke[0], stroke[-1])
        assert bends_of(np.concatenate([stroke[-2:], stroke[1:2]])).max() < 0.2


@pytest.mark.parametrize("letter", ["s", "SO", "", "A", None, 1])
def test_a_letter_that_does_not_exist_is_refused_with_the_choices(letter: Any) -> None:
    message = f"letter must be one of .*'C', .*'S', .*'9'.* got {re.escape(repr(letter))}"
    with pytest.raises(ValueError, match=message):
        letter_stroke(letter)
    with pytest.raises(ValueError, match=message):
        make_writing_scene(letter)


# Strokes


def test_evenly_spaced_points_keep_the_ends_and_stay_on_the_line() -> None:
    rng = np.random.default_rng(0)
    for n, spacing in itertools.product((2, 3, 8), (0.001, 0.013, 0.3)):
        # x grows, so the line never crosses itself.
        corners = np.cumsum(rng.uniform((0.01, -0.1), 0.1, size=(n, 2)), axis=0)
        points = evenly_spaced(corners, spacing)
        np.testing.assert_allclose(points[[0, -1]], corners[[0, -1]], atol=1e-12)
        assert to_segments(points, corners).max() < 1e-12
        places = np.array([LineString(corners).project(Point(point)) for point in points])
        np.testing.assert_allclose(np.diff(places), places[-1] / (len(places) - 1), atol=1e-9)
        if places[-1] > spacing:
            assert 2 / 3 <= places[-1] / (len(places) - 1) / spacing <= 1.5


def test_evenly_spaced_points_of_a_single_position_are_that_position() -> None:
    place = np.array([0.5, 0.1])
    np.testing.assert_array_equal(evenly_spaced(place[None], 0.01), [place])
    np.testing.assert_array_equal(evenly_spaced(np.array([place] * 4), 0.01), [place])
    assert line_of(np.array([place] * 4)).length == 0


def test_evenly_spaced_points_of_a_short_line_are_its_ends() -> None:
    ends = np.array([[0.5, 0.1], [0.5, 0.1004]])
    np.testing.assert_allclose(evenly_spaced(ends, 0.01), ends)


def test_distances_are_those_to_the_nearest_position_on_the_line_not_to_its_corners() -> None:
    rng = np.random.default_rng(0)
    stroke = np.cumsum(rng.normal(0, 0.1, size=(6, 2)), axis=0)
    points = rng.uniform(-0.3, 0.3, size=(50, 2))
    nearest = np.linalg.norm(points[:, None] - densely(stroke), axis=-1).min(axis=1)
    np.testing.assert_allclose(distances(points, stroke), nearest, atol=1e-4)
    assert (distances(points, stroke) <= nearest + 1e-12).all()
    to_corners = np.linalg.norm(points[:, None] - stroke, axis=-1).min(axis=1)
    assert (to_corners - nearest).max() > 0.03


def test_distances_to_a_single_position_are_straight() -> None:
    place = np.array([[0.1, 0.2]])
    points = np.array([[0.1, 0.2], [0.4, 0.6]])
    np.testing.assert_allclose(distances(points, place), [0, 0.5])
    np.testing.assert_allclose(distances(points, np.repeat(place, 3, axis=0)), [0, 0.5])


# Regions


def ways(n: int, length: float) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    starts = rng.uniform((0.4, -0.1), (0.6, 0.1), size=(n, 1, 2))
    return list(starts + np.cumsum(rng.normal(0, length, size=(n, 4, 2)), axis=1))


@pytest.mark.parametrize("region", REGIONS, ids=["disc", "square", "hook"])
@pytest.mark.parametrize("length", [0.0, 0.01, 0.05])
def test_the_clearance_of_a_path_is_that_of_its_nearest_or_deepest_position(
    region: Region, length: float
) -> None:
    n_inside = n_outside = 0
    for way in ways(100, length):
        depth = depth_in(region, densely(way)).max()
        assert region.clearance(way) == pytest.approx(-depth, abs=0.0006 if depth > 0 else 0.0001)
        n_inside += depth > 0
        n_outside += depth < 0
    assert n_inside > 4
    assert n_outside > 4


@pytest.mark.parametrize("region", REGIONS, ids=["disc", "square", "hook"])
def test_the_clearance_of_one_position_is_its_distance_or_minus_its_depth(region: Region) -> None:
    places = np.random.default_rng(0).uniform((0.4, -0.1), (0.6, 0.1), size=(200, 2))
    for place, depth in zip(places, depth_in(region, places), strict=True):
        for way in (place[None], np.array([place, place])):
            assert region.clearance(way) == pytest.approx(-depth, abs=1e-9)


@pytest.mark.parametrize("region", REGIONS, ids=["disc", "square", "hook"])
def test_a_path_that_crosses_a_region_between_two_positions_outside_is_inside(region: Region) -> None:
    way = np.array([[0.3, -0.022], [0.7, -0.022]])
    for place in way:
        assert region.clearance(place[None]) > 0.1
    assert region.clearance(way) < -0.005


def test_the_cut_out_corner_of_a_polygon_is_outside() -> None:
    place = np.array([[0.52, 0.02]])
    assert HOOK.clearance(place) == pytest.approx(0.04)
    assert SQUARE.clearance(place) == pytest.approx(-0.03)


def test_regions_are_drawn_as_what_they_are() -> None:
    np.testing.assert_allclose(depth_in(DISC, DISC.outline), 0, atol=1e-12)
    assert len(DISC.outline) >= 32
    np.testing.assert_allclose(DISC.outline.mean(axis=0), DISC.centre, atol=1e-12)
    np.testing.assert_array_equal(HOOK.outline, HOOK.corners)


def test_json_describes_discs_and_polygons() -> None:
    assert region_of({"centre": [0.5, 0.01], "radius": 0.04}) == DISC
    assert region_of({"corners": [list(corner) for corner in HOOK.corners]}) == HOOK
    assert region_of(json.loads('{"radius": 1, "centre": [1, 2]}')) == Disc((1, 2), 1.0)


@pytest.mark.parametrize(
    "content",
    [
        {},
        None,
        5,
        "disc",
        [0.5, 0.0, 0.02],
        {"centre": [0.5, 0.0]},
        {"center": [0.5, 0.0], "radius": 0.02},
        {"centre": [0.5, 0.0], "radius": 0.02, "corners": [[0, 0], [1, 0], [1, 1]]},
        {"centre": 0.5, "radius": 0.02},
        {"centre": ["0.5", "0.0"], "radius": 0.02},
        {"centre": [0.5, 0.0], "radius": None},
        {"centre": [0.5, 0.0], "radius": "2 cm"},
        {"centre": [0.5, 0.0], "radius": [0.02]},
        {"corners": 3},
        {"corners": [0.5, 0.0, 0.6]},
        {"corners": [["a", "b"], ["c", "d"], ["e", "f"]]},
        {"corners": [[0.4, 0.0], [0.5], [0.4, 0.1]]},
    ],
    ids=str,
)
def test_what_describes_no_region_is_refused_with_both_forms(content: Any) -> None:
    message = r'a region must be \{"centre": \[x, y\], "radius": r\} or \{"corners": .*\} in metres, got '
    with pytest.raises(ValueError, match=message + re.escape(str(content))):
        region_of(content)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            {"centre": [0.5], "radius": 0.02},
            r"centre of a disc must be two finite coordinates \[m\], got \(0.5,\)",
        ),
        (
            {"centre": [0.5, NAN], "radius": 0.02},
            r"centre of a disc must be two finite .* got \(0.5, nan\)",
        ),
        ({"centre": [0.5, 0.0], "radius": 0.0}, "radius of a disc must be at least 0.001 m, got 0.0"),
        ({"centre": [0.5, 0.0], "radius": -0.02}, "radius of a disc must be at least 0.001 m, got -0.02"),
        ({"centre": [0.5, 0.0], "radius": INFINITE}, "radius of a disc must be at least .* got inf"),
        (
            {"corners": [[0.4, 0.0], [0.5, 0.0]]},
            "corners of a polygon must be at least three finite positions",
        ),
        (
            {"corners": [[0.4, 0.0], [0.5, 0.0], [0.5, INFINITE]]},
            "at least three finite positions x, y .* got .*inf",
        ),
        ({"corners": [[0.4, 0.0, 0.0]] * 3}, "at least three finite positions x, y .* got"),
        ({"corners": []}, "at least three finite positions x, y .* got"),
        ({"corners": [[0.4, 0.0], [0.5, 0.1], [0.4, 0.1], [0.55, 0.0]]}, "not cross itself, got"),
        ({"corners": [[0.4, 0.0], [0.4005, 0.0], [0.4, 0.0005]]}, "must have an inside .* got"),
        ({"corners": [[0.4, 0.0], [0.5, 0.0], [0.6, 0.0]]}, "must have an inside .* got"),
    ],
    ids=str,
)
def test_regions_that_are_no_shapes_are_refused_with_the_rule(content: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        region_of(content)


# Scenes


@pytest.mark.parametrize("letter", LETTERS)
def test_a_letter_is_written_in_its_height_in_the_middle_of_the_sheet(letter: str) -> None:
    for height in (LETTER_HEIGHT, 0.12):
        scene = scene_of(letter, letter_height=height)
        assert scene.name == letter
        low, high = scene.stroke.min(axis=0), scene.stroke.max(axis=0)
        # Points 1 mm apart pass a corner by half of that at most.
        assert high[1] - low[1] == pytest.approx(height, abs=SPACING / 2)
        np.testing.assert_allclose((low + high) / 2, SHEET_CENTRE, atol=SPACING / 2)
        whole = np.array(SHEET_CENTRE) + height * letter_stroke(letter)
        np.testing.assert_allclose(scene.stroke[[0, -1]], whole[[0, -1]], atol=1e-12)
        assert distances(scene.stroke, whole).max() < 1e-12
        assert distances(whole, scene.stroke).max() < SPACING / 2
        assert steps_of(scene.stroke).max() < 1.02 * SPACING


@pytest.mark.parametrize("letter", LETTERS)
def test_the_regions_of_a_letter_keep_the_gap_from_its_stroke_and_from_each_other(letter: str) -> None:
    for gap in (REGION_GAP, 0.015):
        scene = scene_of(letter, region_gap=gap)
        hull = MultiPoint(scene.stroke).convex_hull
        placed: list[Region] = []
        for region in scene.regions:
            gaps = [region.clearance(scene.stroke)]
            gaps += [
                math.dist(region.centre, other.centre) - region.radius - other.radius for other in placed
            ]
            assert min(gaps) >= gap - 1e-9
            # It fills the room that it has.
            assert min(gaps) == pytest.approx(gap, abs=1e-9) or region.radius == RADII[1]
            assert RADII[0] <= region.radius <= RADII[1]
            assert hull.contains(Point(region.centre))
            placed.append(region)
    assert len(scene_of(letter).regions) == N_REGIONS  # every letter has something to keep out of
    assert scene_of(letter).clearance(scene_of(letter).stroke) >= REGION_GAP - 1e-9


@pytest.mark.parametrize("letter", ["S", "L", "8", "1"])
def test_each_region_is_the_largest_that_has_room(letter: str) -> None:
    scene = scene_of(letter, n_regions=9)
    hull = MultiPoint(scene.stroke).convex_hull
    places = np.random.default_rng(0).uniform(*np.array(hull.bounds).reshape(2, 2), size=(3000, 2))
    places = places[[hull.contains(Point(place)) for place in places]]
    room = to_segments(places, scene.stroke[::3]) - REGION_GAP
    for region in scene.regions:
        assert region.radius >= min(room.max(), RADII[1]) - GRID
        to_others = np.linalg.norm(places - region.centre, axis=1) - region.radius - REGION_GAP
        room = np.minimum(room, to_others)
    assert room.max() < RADII[0] + GRID  # none is left out


def test_fewer_regions_are_the_first_of_more() -> None:
    all_of_them = scene_of("S", n_regions=99).regions
    assert 2 < len(all_of_them) < 99
    for n in (0, 1, 2, 3):
        assert scene_of("S", n_regions=n).regions == all_of_them[:n]


def test_a_letter_without_room_has_no_regions() -> None:
    assert scene_of("S", region_gap=0.1).regions == ()
    assert scene_of("1", letter_height=0.025).regions == ()


def test_the_clearance_of_a_scene_is_that_of_its_nearest_region() -> None:
    scene = WritingScene("mine", np.array(BAR), (DISC, HOOK))
    for way in ways(30, 0.02):
        assert scene.clearance(way) == min(DISC.clearance(way), HOOK.clearance(way))
    assert WritingScene("mine", np.array(BAR), ()).clearance(np.array(BAR)) == math.inf


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"letter_height": 0.0}, "letter_height must be above 0 m, got 0.0"),
        ({"letter_height": -0.1}, "letter_height must be above 0 m, got -0.1"),
        ({"letter_height": NAN}, "letter_height must be above 0 m, got nan"),
        ({"letter_height": INFINITE}, "letter_height must be above 0 m, got inf"),
        ({"letter_height": 0.008}, "must be at least 0.02 m long"),
        (
            {"letter_height": 0.325},
            r"the stroke of S must lie on the sheet, .* x in \[0.34, 0.66\] .*; got \[0",
        ),
        ({"region_gap": 0.0}, "region_gap must be above 0 m, got 0.0"),
        ({"region_gap": -0.01}, "region_gap must be above 0 m, got -0.01"),
        ({"region_gap": NAN}, "region_gap must be above 0 m, got nan"),
        ({"n_regions": -1}, "n_regions must be at least 0, got -1"),
    ],
    ids=str,
)
def test_bad_options_are_refused_with_the_rule(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_writing_scene("S", **options)


def test_a_height_in_millimetres_is_refused_and_not_computed() -> None:
    # The regions of a letter as large as that would not fit into any memory.
    with pytest.raises(ValueError, match="must lie on the sheet"):
        make_writing_scene("S", letter_height=1800.0)


# Places on the sheet


def test_the_sheet_ends_at_its_border() -> None:
    for corner in itertools.product((-0.5, 0.5), repeat=2):
        border = np.array(SHEET_CENTRE) + SHEET_SIDE * np.array(corner)
        check_on_sheet(border, "start")
        for axis in (0, 1):
            outside = border.copy()
            outside[axis] += 1e-6 * np.sign(corner[axis])
            with pytest.raises(
                ValueError, match="start must lie on the sheet, where the arm reaches .*; got"
            ):
                check_on_sheet(outside, "start")


def test_the_first_position_off_the_sheet_is_named() -> None:
    places = np.array([[0.5, 0.0], [0.6, 0.17], [0.9, 0.0]])
    with pytest.raises(ValueError, match=r"y in \[-0.16, 0.16\] m of the table's frame; got \[0.6, 0.17\]"):
        check_on_sheet(places, "start")


@pytest.mark.parametrize("place", [0.5, [], [0.5], [0.5, 0.0, 0.0], [0.5, NAN], [INFINITE, 0.0]], ids=str)
def test_what_is_no_position_is_not_on_the_sheet(place: Any) -> None:
    with pytest.raises(ValueError, match=r"start must be finite positions x, y \[m\], got"):
        check_on_sheet(np.array(place), "start")


# Files


def written(tmp_path: Path, content: Any) -> Path:
    path = tmp_path / "mine.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


def test_a_file_describes_a_stroke_and_its_regions(tmp_path: Path) -> None:
    stroke = [[0.42, -0.1], [0.42, 0.1], [0.6, 0.1]]
    regions = [{"centre": [0.5, 0.01], "radius": 0.04}, {"corners": [[0.5, -0.1], [0.6, -0.1], [0.6, -0.05]]}]
    path = written(tmp_path, {"stroke": stroke, "regions": regions})
    for name in (path, str(path)):
        scene = make_writing_scene("a letter that is not asked for", scene_file=name)
        assert scene.name == "mine"
        assert scene.regions == (DISC, Area(((0.5, -0.1), (0.6, -0.1), (0.6, -0.05))))
        np.testing.assert_allclose(scene.stroke[[0, -1]], [[0.42, -0.1], [0.6, 0.1]], atol=1e-12)
        np.testing.assert_allclose(steps_of(scene.stroke), SPACING, atol=1e-9)
        np.testing.assert_allclose(scene.stroke[200], [0.42, 0.1], atol=1e-12)


def test_a_file_may_leave_out_the_regions(tmp_path: Path) -> None:
    assert make_writing_scene(scene_file=written(tmp_path, {"stroke": BAR})).regions == ()
    assert make_writing_scene(scene_file=written(tmp_path, {"stroke": BAR, "regions": []})).regions == ()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "mine.json must be a JSON file, got"),
        ("{'stroke': []}", "mine.json must be a JSON file, got"),
        ([BAR], r'mine.json must hold \{"stroke": .*, "regions": .*\}, got list'),
        ({}, r'mine.json must hold \{"stroke": .*, "regions": .*\}, got \[\]'),
        ({"regions": []}, r'must hold \{"stroke": .*\}, got \[.regions.\]'),
        ({"stroke": BAR, "region": []}, r'must hold \{"stroke": .*\}, got \[.stroke., .region.\]'),
        ({"stroke": BAR, "regions": {"centre": [0.5, 0]}}, "the regions in .*mine.json must be a list, got"),
        ({"stroke": BAR, "regions": None}, "the regions in .*mine.json must be a list, got None"),
        ({"stroke": BAR, "regions": [{"centre": [0.5, 0]}]}, "a region must be .* got"),
        ({"stroke": [], "regions": []}, "the stroke in .*mine.json must be two or more finite positions"),
        ({"stroke": [[0.5, 0.0]]}, "the stroke in .*mine.json must be two or more finite positions"),
        ({"stroke": [0.5, 0.0]}, "the stroke in .*mine.json must be two or more finite positions"),
        ({"stroke": "S"}, "the stroke in .*mine.json must be two or more finite positions"),
        ({"stroke": None}, "the stroke in .*mine.json must be two or more finite positions"),
        ({"stroke": [[0.5, 0.0], [0.5]]}, "the stroke in .*mine.json must be two or more finite positions"),
        (
            {"stroke": [[0.5, 0.0], [0.5, None]]},
            "the stroke in .*mine.json must be two or more finite positions",
        ),
        (
            {"stroke": [[0.5, 0.0], [NAN, 0.1]]},
            "the stroke in .*mine.json must be two or more finite positions",
        ),
        (
            {"stroke": [[0.5, 0, 0], [0.5, 0.1, 0]]},
            "the stroke in .*mine.json must be two or more finite positions",
        ),
        ({"stroke": [[0.5, 0.0], [0.5, 0.2]]}, "the stroke of mine must lie on the sheet"),
        ({"stroke": [[0.5, 0.0], [0.5, 0.019]]}, "a stroke must be at least 0.02 m long, got that of mine"),
        ({"stroke": [[0.5, 0.0], [0.5, 0.0]]}, "a stroke must be at least 0.02 m long, got that of mine"),
        (
            {"stroke": BAR, "regions": [{"centre": [0.46, 0.0], "radius": 0.041}]},
            r"regions must leave the stroke free, got one that blocks mine: Disc\(centre=\(0.46, 0.0\)",
        ),
        (
            {"stroke": BAR, "regions": [{"corners": [[0.4, 0.09], [0.5, 0.09], [0.5, 0.2]]}]},
            r"regions must leave the stroke free, got one that blocks mine: Area\(corners=",
        ),
    ],
    ids=str,
)
def test_files_that_describe_no_scene_are_refused_with_the_rule(
    tmp_path: Path, content: Any, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        make_writing_scene(scene_file=written(tmp_path, content))


def test_a_file_that_is_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "picture.json"
    path.write_bytes(bytes(range(128, 256)))
    with pytest.raises(ValueError, match="picture.json must be a JSON file, got .*can't decode"):
        make_writing_scene(scene_file=path)


def test_a_file_that_does_not_exist_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere.json"):
        make_writing_scene(scene_file=tmp_path / "nowhere.json")


def test_a_corner_off_the_sheet_is_refused_however_little_of_it_is_off(tmp_path: Path) -> None:
    for end in (0.1, 0.1002, 0.1004, 0.1006):  # whether or not a point is put on the corner
        stroke = [[0.45, 0.1], [0.5, 0.1601], [0.55, end]]
        with pytest.raises(ValueError, match=r"must lie on the sheet, .* got \[0.5, 0.1601\]"):
            make_writing_scene(scene_file=written(tmp_path, {"stroke": stroke}))
