# SPDX-License-Identifier: Apache-2.0
import itertools

import numpy as np
import pytest

from lerobot_pf2mp.envs.box import Box

BOX = Box.between((-1.0, -0.5, 0.0), (1.0, 0.5, 3.0))
MIDDLE = (0.0, 0.0, 1.5)


def random_box(rng: np.random.Generator) -> Box:
    low = rng.uniform(-1, 1, size=3)
    return Box.between(low, low + rng.uniform(0.05, 1.5, size=3))


def overlap(a: Box, b: Box) -> bool:
    return all(max(a.low[axis], b.low[axis]) < min(a.high[axis], b.high[axis]) for axis in range(3))


def moved(box: Box, by: np.ndarray) -> Box:
    return Box.between(box.low + by, box.high + by)


def blocked_by_sampling(box: Box, start: np.ndarray, end: np.ndarray, n: int = 5_001) -> bool:
    shares = np.linspace(0, 1, n)[:, None]
    return bool(box.contains(start + shares * (end - start)).any())


def test_a_box_lies_between_its_corners() -> None:
    box = Box((1.0, 2.0, 3.0), (0.2, 0.4, 0.6))
    np.testing.assert_allclose(box.low, [0.9, 1.8, 2.7])
    np.testing.assert_allclose(box.high, [1.1, 2.2, 3.3])
    again = Box.between(box.low, box.high)
    np.testing.assert_allclose(again.centre, box.centre)
    np.testing.assert_allclose(again.size, box.size)


def test_a_box_contains_its_inside_without_its_faces() -> None:
    assert BOX.contains(np.array(MIDDLE))
    for axis, (corner, inwards) in itertools.product(range(3), ((BOX.low, 1), (BOX.high, -1))):
        for gap, inside in ((1e-9, True), (0.0, False), (-1e-9, False)):
            point = np.array(MIDDLE)
            point[axis] = corner[axis] + inwards * gap
            assert BOX.contains(point) == inside


def test_points_are_looked_up_in_any_shape() -> None:
    points = np.random.default_rng(0).uniform(-2, 4, size=(4, 50, 3))
    inside = BOX.contains(points)
    assert inside.shape == (4, 50)
    assert inside.any()
    assert not inside.all()
    for index in np.ndindex(4, 50):
        assert inside[index] == BOX.contains(points[index])


def test_the_origin_of_a_moving_box_is_in_the_grown_box_just_when_the_two_overlap() -> None:
    rng = np.random.default_rng(0)
    answers = []
    for _ in range(1000):
        box, moving = random_box(rng), random_box(rng)  # the origin of `moving` is rarely in its middle
        origin = rng.uniform(-1.5, 1.5, size=3)
        answers.append(overlap(box, moved(moving, origin)))
        assert box.grown_by(moving).contains(origin) == answers[-1]
    assert 50 < sum(answers) < 950


def test_a_grown_box_has_the_sides_of_both() -> None:
    grown = BOX.grown_by(Box((5.0, 6.0, 7.0), (0.1, 0.2, 0.3)))
    np.testing.assert_allclose(grown.size, np.add(BOX.size, (0.1, 0.2, 0.3)))
    np.testing.assert_allclose(grown.centre, np.subtract(BOX.centre, (5.0, 6.0, 7.0)))


def test_a_box_grown_by_a_point_stays_as_it_is() -> None:
    grown = BOX.grown_by(Box((0, 0, 0), (0, 0, 0)))
    np.testing.assert_allclose(grown.low, BOX.low)
    np.testing.assert_allclose(grown.high, BOX.high)


@pytest.mark.parametrize("length", [0.05, 0.5, 3.0])
def test_a_path_is_blocked_where_a_point_of_it_is_inside(length: float) -> None:
    rng = np.random.default_rng(0)
    answers, n_undecided = [], 0
    for _ in range(200):
        box = random_box(rng)
        start = rng.uniform(box.low - 0.3, box.high + 0.3)
        end = start + length * rng.normal(size=3)
        answers.append(box.blocks(start, end))
        spacing = np.linalg.norm(end - start) / 5_000
        if blocked_by_sampling(box, start, end):
            assert answers[-1], (box, start, end)
        elif answers[-1]:  # an edge is cut between two samples
            n_undecided += 1
            near = Box.between(box.low - spacing, box.high + spacing)
            assert blocked_by_sampling(near, start, end), (box, start, end)
        assert box.blocks(end, start) == answers[-1]
    assert 10 < sum(answers) < 190
    assert n_undecided <= 1


@pytest.mark.parametrize("n_flat", [1, 2])
def test_paths_along_the_axes_are_blocked_where_a_point_of_them_is_inside(n_flat: int) -> None:
    rng = np.random.default_rng(0)
    answers = []
    for _ in range(200):
        box = random_box(rng)
        start, end = rng.uniform(box.low - 0.3, box.high + 0.3, size=(2, 3))
        flat = rng.permutation(3)[:n_flat]
        end[flat] = start[flat]
        answers.append(box.blocks(start, end))
        assert answers[-1] == blocked_by_sampling(box, start, end), (box, start, end)
    assert 10 < sum(answers) < 190


@pytest.mark.parametrize("axis", range(3))
def test_a_path_through_the_middle_is_blocked_and_one_that_ends_before_the_box_is_not(axis: int) -> None:
    before, inside, behind = (np.array(MIDDLE) for _ in range(3))
    before[axis], behind[axis] = BOX.low[axis] - 1, BOX.high[axis] + 1
    assert BOX.blocks(before, behind)
    assert BOX.blocks(before, inside)
    assert BOX.blocks(inside, behind)
    assert not BOX.blocks(before - (behind - before), before)
    assert not BOX.blocks(behind, behind + (behind - before))


def test_a_path_of_length_zero_is_blocked_inside_only() -> None:
    for point, blocked in [(MIDDLE, True), ((0.0, 0.0, 3.1), False), ((1.0, 0.0, 1.5), False)]:
        assert BOX.blocks(np.array(point), np.array(point)) == blocked
    rng = np.random.default_rng(0)
    points = rng.uniform(-2, 4, size=(300, 3))
    inside = BOX.contains(points)
    assert inside.any()
    assert [BOX.blocks(point, point) for point in points] == inside.tolist()


@pytest.mark.parametrize(
    ("start", "end"),
    [
        ((-2.0, 0.5, 1.5), (2.0, 0.5, 1.5)),  # on a face
        ((-2.0, -0.5, 1.5), (2.0, -0.5, 1.5)),
        ((-2.0, 0.1, 0.0), (2.0, 0.1, 0.0)),
        ((1.0, -2.0, 1.5), (1.0, 2.0, 1.5)),
        ((-2.0, 0.0, 3.0), (2.0, 0.1, 3.0)),
        ((-2.0, 0.5, 3.0), (2.0, 0.5, 3.0)),  # on an edge
        ((0.0, 0.5, 4.0), (0.0, 1.5, 3.0)),  # beside an edge
        ((0.5, 1.0, 1.0), (1.5, 0.0, 2.0)),  # through a single point of an edge
        ((1.0, 0.0, 1.0), (2.0, 0.0, 1.0)),  # away from a face
        ((2.0, 0.0, 1.0), (1.0, 0.0, 1.0)),  # up to it
    ],
)
def test_touching_a_face_or_an_edge_is_not_passing_through(start: tuple, end: tuple) -> None:
    assert not BOX.blocks(np.array(start), np.array(end))


def test_leaving_a_face_inwards_is_passing_through() -> None:
    assert BOX.blocks(np.array([1.0, 0.0, 1.0]), np.array([0.9, 0.0, 1.0]))
    assert BOX.blocks(np.array([1.0, 0.5, 3.0]), np.array([-1.0, -0.5, 0.0]))  # from corner to corner
