# SPDX-License-Identifier: Apache-2.0
import math
from functools import cache

import numpy as np
import pytest

from lerobot_pf2mp.envs.box import Box
from lerobot_pf2mp.envs.fetch.fetch_scene import (
    BLOCK_HEIGHT,
    BLOCK_SIZE,
    FETCH_SCENES,
    FINGERS,
    HAND,
    TABLE,
    WORKSPACE,
    FetchScene,
    Layout,
    make_scene,
)

TASKS = ("reach", "push")
NAN = float("nan")
HAND_AND_FINGERS = (HAND, FINGERS)


def gripper_touches(wall: Box, positions: np.ndarray, margin: float = 0.0) -> bool:
    """Whether hand or fingers at one of ``(N, 3)`` positions overlap the wall: their sides do so on each axis."""
    return any(
        bool(
            np.all(
                (positions + part.low - margin < wall.high) & (positions + part.high + margin > wall.low),
                axis=1,
            ).any()
        )
        for part in HAND_AND_FINGERS
    )


def points_between(start: np.ndarray, end: np.ndarray, n: int = 801) -> np.ndarray:
    return start + np.linspace(0, 1, n)[:, None] * (end - start)


def sample(task: str, n: int, seed: int = 0) -> list[Layout]:
    rng = np.random.default_rng(seed)
    return [FETCH_SCENES[task].sample(rng) for _ in range(n)]


@cache
def layouts(task: str) -> list[Layout]:
    return sample(task, 700)


def in_workspace(position: np.ndarray) -> bool:
    return bool(np.all((position >= WORKSPACE.low) & (position <= WORKSPACE.high)))


# Defaults


@pytest.mark.parametrize("task", TASKS)
def test_the_wall_stands_on_the_table_between_starts_and_goals(task: str) -> None:
    scene = FETCH_SCENES[task]
    wall = scene.wall
    assert wall.low[2] == pytest.approx(TABLE.high[2])
    np.testing.assert_allclose(wall.size, scene.wall_size)
    np.testing.assert_allclose(wall.centre[:2], scene.wall_position)
    assert np.all(wall.low[:2] > TABLE.low[:2])
    assert np.all(wall.high[:2] < TABLE.high[:2])
    assert scene.start_range[1][1] < wall.low[1]  # the robot's right
    beyond = scene.block_range if scene.has_block else scene.goal_range
    assert beyond[0][1] > wall.high[1]  # its left


def test_only_push_has_a_block_and_its_wall_is_lower() -> None:
    reach, push = FETCH_SCENES["reach"], FETCH_SCENES["push"]
    assert not reach.has_block
    assert push.has_block
    assert push.wall_size[2] < reach.wall_size[2]
    assert reach.sample(np.random.default_rng(0)).block is None


@pytest.mark.slow
@pytest.mark.parametrize(("task", "share"), [("reach", 0.86), ("push", 0.91)])
def test_most_straight_lines_are_blocked(task: str, share: float) -> None:
    scene = FETCH_SCENES[task]
    blocked = [scene.is_blocked(layout) for layout in layouts(task)]
    assert np.mean(blocked) == pytest.approx(share, abs=0.04)


# Layouts


@pytest.mark.parametrize("task", TASKS)
def test_the_same_generator_gives_the_same_layouts(task: str) -> None:
    for first, again, other in zip(sample(task, 5), sample(task, 5), sample(task, 5, seed=1), strict=True):
        np.testing.assert_array_equal(first.start, again.start)
        np.testing.assert_array_equal(first.goal, again.goal)
        np.testing.assert_array_equal(first.block, again.block)
        assert not np.array_equal(first.start, other.start)
        assert not np.array_equal(first.goal, other.goal)


@pytest.mark.parametrize("task", TASKS)
def test_positions_fill_their_ranges(task: str) -> None:
    scene = FETCH_SCENES[task]
    drawn = layouts(task)
    ranges = {"start": scene.start_range, "goal": scene.goal_range, "block": scene.block_range}
    for name, corners in ranges.items():
        if corners is None:
            continue
        low, high = np.array(corners)
        places = np.array([getattr(layout, name) for layout in drawn])
        if len(low) == 2:  # on the table
            np.testing.assert_array_equal(places[:, 2], BLOCK_HEIGHT)
            places = places[:, :2]
        assert np.all((places >= low) & (places <= high))
        np.testing.assert_allclose(places.min(axis=0), low, atol=0.02)
        np.testing.assert_allclose(places.max(axis=0), high, atol=0.02)


@pytest.mark.parametrize("task", TASKS)
def test_starts_are_in_reach_and_clear_of_the_wall(task: str) -> None:
    wall = FETCH_SCENES[task].wall
    for layout in layouts(task)[:200]:
        assert in_workspace(layout.start)
        assert not gripper_touches(wall, layout.start[None], margin=0.0099)


def test_goals_of_reach_are_in_reach_and_clear_of_the_wall() -> None:
    wall = FETCH_SCENES["reach"].wall
    for layout in layouts("reach")[:200]:
        assert in_workspace(layout.goal)
        assert not gripper_touches(wall, layout.goal[None], margin=0.0099)


def test_blocks_can_be_pushed_to_their_goals_in_a_straight_line() -> None:
    wall = FETCH_SCENES["push"].wall
    # The block may turn: a circle around it, against the wall seen from above.
    radius = BLOCK_SIZE / math.sqrt(2)
    for layout in layouts("push")[:200]:
        length = math.dist(layout.goal, layout.block)
        assert length >= 0.1
        assert math.dist(layout.start[:2], layout.block[:2]) >= 0.1
        way = points_between(layout.block, layout.goal)
        outside = np.maximum(0, np.maximum(wall.low - way, way - wall.high))[:, :2]
        assert np.linalg.norm(outside, axis=1).min() > radius
        behind = layout.block - 2 * BLOCK_SIZE / length * (layout.goal - layout.block)
        assert in_workspace(behind)
        assert not gripper_touches(wall, points_between(behind, layout.goal))


@pytest.mark.parametrize("margin", [0.0, 0.02])
@pytest.mark.parametrize("task", TASKS)
def test_a_straight_line_hits_the_wall_where_hand_or_fingers_overlap_it(task: str, margin: float) -> None:
    scene = FETCH_SCENES[task]
    rng = np.random.default_rng(0)
    answers = []
    for _ in range(400):
        start, end = rng.uniform(WORKSPACE.low, WORKSPACE.high, size=(2, 3))
        hits = scene.hits_wall(start, end, margin)
        answers.append(hits)
        way = points_between(start, end)
        if gripper_touches(scene.wall, way, margin):
            assert hits
        elif hits:  # between two points of the path
            assert gripper_touches(scene.wall, way, margin + 0.001)
    assert 40 < sum(answers) < 360


def test_the_hand_hits_a_high_wall_that_the_fingers_pass_beside() -> None:
    scene = FETCH_SCENES["reach"]
    beside = scene.wall.high[0] + 0.03  # more than half the fingers' width, less than the hand's
    start, end = np.array([beside, 0.55, 0.45]), np.array([beside, 0.95, 0.45])
    assert scene.hits_wall(start, end)
    low = make_scene("reach", wall_size=(0.30, 0.04, 0.09))  # its top is below the hand
    assert not low.hits_wall(start, end)
    assert low.hits_wall(start - [0.02, 0, 0], end - [0.02, 0, 0])


def test_a_path_to_push_is_blocked_on_either_of_its_two_parts() -> None:
    scene = FETCH_SCENES["push"]
    here, there, far = (1.30, 0.55, 0.45), (1.30, 0.95, 0.425), (1.50, 0.95, 0.425)
    beside = (1.50, 0.55, 0.425)

    def is_blocked(*places: tuple[float, float, float]) -> bool:
        start, block, goal = (np.array(place) for place in places)
        return scene.is_blocked(Layout(start, goal, block))

    assert is_blocked(here, there, far)
    assert is_blocked(far, there, here)
    assert not is_blocked(here, beside, far)


# Options


def test_changes_replace_the_defaults_and_none_leaves_them() -> None:
    assert make_scene("push") == FETCH_SCENES["push"]
    assert make_scene("push", wall_size=None, block_range=None) == FETCH_SCENES["push"]
    scene = make_scene("reach", wall_position=(1.25, 0.7), wall_size=(0.2, 0.05, 0.1), goal_range=None)
    np.testing.assert_allclose(scene.wall.centre, [1.25, 0.7, 0.45])
    np.testing.assert_allclose(scene.wall.size, [0.2, 0.05, 0.1])
    assert scene.goal_range == FETCH_SCENES["reach"].goal_range


def test_a_range_may_be_a_single_position() -> None:
    place = (1.25, 0.55, 0.5)
    scene = make_scene("reach", start_range=(place, place))
    np.testing.assert_array_equal(scene.sample(np.random.default_rng(3)).start, place)


def test_positions_in_the_wall_are_left_out_of_a_range() -> None:
    scene = make_scene("reach", start_range=((1.10, 0.50, 0.45), (1.50, 1.00, 0.60)))
    rng = np.random.default_rng(0)
    starts = np.array([scene.sample(rng).start for _ in range(100)])
    assert starts[:, 1].min() < 0.6
    assert starts[:, 1].max() > 0.9
    assert not gripper_touches(scene.wall, starts)


@pytest.mark.parametrize(
    ("task", "changes", "message"),
    [
        ("reach", {"wall_size": (0.3, 0.04, 0.33)}, "wall must be at most 0.32 m high .* got .*0.33"),
        ("push", {"wall_size": (0.3, 0.04, 5.0)}, "wall must be at most 0.32 m high .* got .*5.0"),
        ("reach", {"wall_size": (0.3, 0.0, 0.2)}, r"wall_size must be positive .* got \(0.3, 0.0, 0.2\)"),
        ("reach", {"wall_size": (-0.3, 0.04, 0.2)}, "wall_size must be positive .* got .*-0.3"),
        ("reach", {"wall_size": (0.3, NAN, 0.2)}, "wall_size must be 3 finite numbers .* got .*nan"),
        ("reach", {"wall_size": (0.3, 0.04, math.inf)}, "wall_size must be 3 finite numbers .* got .*inf"),
        ("reach", {"wall_size": (0.3, 0.04)}, r"wall_size must be 3 finite numbers .* got \(0.3, 0.04\)"),
        ("reach", {"wall_position": (1.7, 0.75)}, "a wall must stand on the table"),
        ("push", {"wall_position": (1.3, 0.3)}, "a wall must stand on the table"),
        ("push", {"wall_position": (NAN, 0.75)}, "wall_position must be 2 finite numbers .* got .*nan"),
        ("reach", {"wall_position": (1.3, 0.75, 0.4)}, "wall_position must be 2 finite numbers .* got"),
        ("reach", {"wall_position": 1.3}, "wall_position must be 2 finite numbers .* got 1.3"),
        ("lift", {}, "task must be one of .*'reach', 'push'.* got 'lift'"),
        ("Reach", {}, "task must be one of .*'reach', 'push'.* got 'Reach'"),
        (
            "reach",
            {"block_range": ((1.1, 0.84), (1.5, 0.94))},
            r"block_range is for push only, got \(\(1.1, 0.84\)",
        ),
    ],
    ids=str,
)
def test_bad_options_are_refused_with_the_rule(task: str, changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_scene(task, **changes)


@pytest.mark.parametrize(
    ("task", "name", "n"),
    [
        ("reach", "start_range", 3),
        ("reach", "goal_range", 3),
        ("push", "goal_range", 2),
        ("push", "block_range", 2),
    ],
)
def test_ranges_that_are_not_two_ordered_corners_in_reach_are_refused(task: str, name: str, n: int) -> None:
    low, high = (1.20, 0.56, 0.45)[:n], (1.40, 0.62, 0.55)[:n]
    swapped = (low[0], high[1], *low[2:]), (high[0], low[1], *high[2:])
    for corners in (
        swapped,
        (low, (NAN, *high[1:])),
        (low, (*high[:-1], math.inf)),
        (low,),
        (low, high, high),
        (low, high[:-1]),
        (low[:-1], high[:-1]),
        ((*low, 0.5), (*high, 0.5)),
    ):
        with pytest.raises(ValueError, match=f"{name} must be two corners of {n} coordinates each .* got"):
            make_scene(task, **{name: corners})
    for axis in range(n):
        for corner, outside in enumerate((WORKSPACE.low[axis] - 0.01, WORKSPACE.high[axis] + 0.01)):
            corners = np.array([low, high])
            corners[corner, axis] = outside
            with pytest.raises(ValueError, match=f"{name} must be in the gripper's workspace, from .* got"):
                make_scene(task, **{name: corners})


@pytest.mark.parametrize(
    ("task", "changes"),
    [
        ("reach", {"start_range": ((1.25, 0.74, 0.45), (1.35, 0.76, 0.55))}),
        ("reach", {"goal_range": ((1.25, 0.74, 0.45), (1.35, 0.76, 0.55))}),
        ("push", {"goal_range": ((1.25, 0.74), (1.35, 0.76))}),
        ("push", {"block_range": ((1.25, 0.74), (1.35, 0.76))}),
        # Everything is behind the wall and needs a turn.
        ("push", {"goal_range": ((1.30, 0.56), (1.30, 0.56)), "block_range": ((1.30, 0.90), (1.30, 0.90))}),
        # The goal is nearer than a push is long.
        ("push", {"goal_range": ((1.20, 0.90), (1.20, 0.90)), "block_range": ((1.20, 0.95), (1.20, 0.95))}),
        # There is no room for the gripper behind the block.
        ("push", {"goal_range": ((1.12, 0.60), (1.12, 0.60)), "block_range": ((1.12, 1.00), (1.12, 1.00))}),
        ("push", {"wall_size": (0.5, 0.7, 0.1)}),
    ],
    ids=str,
)
def test_scenes_without_a_free_layout_are_refused(task: str, changes: dict) -> None:
    with pytest.raises(
        ValueError, match="must leave positions clear of the wall.*none found in 1000 tries with"
    ):
        make_scene(task, **changes)


def test_a_scene_of_ones_own_is_checked_like_the_changes() -> None:
    with pytest.raises(ValueError, match="wall must be at most"):
        FetchScene((1.3, 0.75), (0.3, 0.04, 1.0), ((1.2, 0.5, 0.5),) * 2, ((1.2, 0.9, 0.5),) * 2)


def test_a_wall_may_be_as_high_as_the_rule_says() -> None:
    make_scene("reach", wall_size=(0.30, 0.04, 0.32))


@pytest.mark.parametrize("position", [(1.47, 0.75), (1.3, 1.08)])
def test_a_wall_may_stand_at_the_edge_that_the_rule_names(position: tuple[float, float]) -> None:
    make_scene("push", wall_position=position)
    with pytest.raises(ValueError, match="a wall must stand on the table"):
        make_scene("push", wall_position=(position[0] + 0.001, position[1] + 0.001))


def test_a_range_that_is_a_single_number_is_refused_with_the_rule() -> None:
    with pytest.raises(ValueError, match="start_range must be two corners"):
        make_scene("reach", start_range=1.3)
