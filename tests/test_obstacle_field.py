# SPDX-License-Identifier: Apache-2.0
"""Obstacles as rounded boxes, and ways that pass them."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from lerobot_pf2mp.obstacle_field import Obstacles, Passing, n_features, obstacles_of
from lerobot_pf2mp.obstacle_field.bulges import bulges_past

STILL = torch.zeros(1, dtype=torch.float64)


def random_obstacles(dim: int, n_robots: int = 3, n_each: int = 4, seed: int = 0) -> Obstacles:
    """Balls, capsules and boxes of any direction, moving, and an absent one in the last row."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    half_sides = draw(n_robots, n_each, dim)
    half_sides[:, 0] = 0.0
    half_sides[:, 1, 1:] = 0.0
    axis = torch.nn.functional.normalize(draw(n_robots, n_each, dim) - 0.5, dim=-1)
    is_present = torch.ones(n_robots, n_each, dtype=torch.bool)
    is_present[-1, -1] = False
    return Obstacles(
        2 * draw(n_robots, n_each, dim) - 1,
        half_sides,
        axis,
        draw(n_robots, n_each, dim) - 0.5,
        0.1 + 0.3 * draw(n_robots, n_each),
        is_present,
    )


def random_points(dim: int, n_robots: int = 3, n_points: int = 200, seed: int = 1) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 4 * torch.rand(n_robots, n_points, dim, generator=generator, dtype=torch.float64) - 2


@pytest.mark.parametrize("dim", [2, 3])
def test_the_distance_of_a_ball_is_that_to_its_centre_minus_its_radius(dim: int) -> None:
    points = random_points(dim, 1)
    ball = {"type": "ball", "centre": [0.3] * dim, "radius": 0.25}
    distance = doubled(obstacles_of([ball])).distance(points, STILL)[0, 0]
    torch.testing.assert_close(distance, (points[0] - 0.3).norm(dim=-1) - 0.25, atol=1e-6, rtol=0)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_distance_of_a_capsule_is_that_to_the_nearest_of_many_balls(dim: int) -> None:
    points, start, end = random_points(dim, 1), [0.5, -0.7, 0.2][:dim], [-0.4, 0.9, 0.6][:dim]
    capsule = doubled(obstacles_of([{"type": "capsule", "start": start, "end": end, "radius": 0.2}]))
    a, b = torch.tensor(start, dtype=torch.float64), torch.tensor(end, dtype=torch.float64)
    balls = a + torch.linspace(0, 1, 4001, dtype=torch.float64).unsqueeze(1) * (b - a)
    expected = torch.cdist(points[0], balls).amin(dim=1) - 0.2
    torch.testing.assert_close(capsule.distance(points, STILL)[0, 0], expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_distance_of_a_box_is_that_to_the_nearest_point_of_its_surface(dim: int) -> None:
    points, centre = random_points(dim, 1, 100), torch.tensor([0.2, -0.1, 0.3][:dim], dtype=torch.float64)
    half_sides = torch.tensor([0.6, 0.3, 0.4][:dim], dtype=torch.float64)
    box = {"type": "box", "centre": centre.tolist(), "half_sides": half_sides.tolist()}
    distance = doubled(obstacles_of([box])).distance(points, STILL)[0, 0]
    grid = torch.linspace(-1, 1, 41, dtype=torch.float64)
    cube = torch.stack(torch.meshgrid(*[grid] * dim, indexing="ij"), dim=-1).reshape(-1, dim)
    surface = centre + half_sides * cube[(cube.abs() == 1).any(dim=1)]
    is_inside = ((points[0] - centre).abs() < half_sides).all(dim=1)
    expected = torch.cdist(points[0], surface).amin(dim=1) * torch.where(is_inside, -1, 1)
    assert is_inside.any() and not is_inside.all()
    torch.testing.assert_close(distance, expected, atol=0.02, rtol=0)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_gradient_is_that_of_finite_differences_and_has_length_one(dim: int) -> None:
    obstacles, points = random_obstacles(dim), random_points(dim)
    times = torch.linspace(0, 2, points.shape[1], dtype=torch.float64)
    gradient, step = obstacles.gradient(points, times), 1e-6
    for axis, offset in enumerate(step * torch.eye(dim, dtype=torch.float64)):
        above, below = (obstacles.distance(points + sign * offset, times) for sign in (1, -1))
        slope = ((above - below) / (2 * step)).nan_to_num(0.0)
        is_smooth = (slope - gradient[..., axis]).abs() < 1e-4
        assert is_smooth.float().mean() > 0.99  # a box has no gradient where two faces are equally near
    torch.testing.assert_close(
        gradient[:, :3].norm(dim=-1), torch.ones_like(gradient[:, :3, :, 0]), atol=1e-9, rtol=0
    )
    assert not gradient[-1, -1].any()


@pytest.mark.parametrize("dim", [2, 3])
def test_the_swept_distance_is_the_smallest_one_along_the_moves_of_robot_and_obstacle(dim: int) -> None:
    obstacles, ways = random_obstacles(dim), random_points(dim, n_points=30)
    times = torch.linspace(0, 3, 30, dtype=torch.float64)
    swept, share = obstacles.swept_distance(ways, times)
    shares = torch.linspace(0, 1, 2001, dtype=torch.float64).view(-1, 1, 1, 1)
    between = (ways[:, :-1] + shares * ways.diff(dim=1)).movedim(0, 1).flatten(1, 2)  # (B, S P, D)
    at = (times[:-1] + shares[..., 0] * times.diff()).expand(-1, 1, -1).reshape(-1)
    expected = obstacles.distance(between, at).unflatten(2, (2001, 29)).amin(dim=2)
    is_outside = expected > -obstacles.radius.unsqueeze(-1) + 1e-3
    assert is_outside[:-1, :, :].float().mean() > 0.5 and not is_outside.all()
    torch.testing.assert_close(swept[is_outside], expected[is_outside], atol=2e-3, rtol=0)
    assert (swept <= expected + 2e-3)[is_outside].all()
    assert (swept[~is_outside] <= -obstacles.radius.unsqueeze(-1).expand_as(swept)[~is_outside] + 1e-9).all()
    assert ((share >= 0) & (share <= 1)).all()
    assert swept[-1, -1].isinf().all()


def test_a_piece_that_crosses_a_box_without_rounding_is_inside() -> None:
    box = doubled(obstacles_of([{"type": "box", "centre": [0, 0], "half_sides": [0.2, 0.5]}]))
    way = torch.tensor([[[-1.0, 0.1], [1.0, 0.1]]], dtype=torch.float64)
    torch.testing.assert_close(box.swept_distance(way, torch.zeros(2))[0].item(), -0.2, atol=1e-6, rtol=0)


@pytest.mark.parametrize("dim", [2, 3])
def test_rows_of_features_are_read_as_they_are_written(dim: int) -> None:
    obstacles, points = random_obstacles(dim), random_points(dim)
    rows = obstacles.rows
    assert rows.shape == (3, 4, n_features(dim))
    rows[-1, -1, 1:] = math.nan  # of an absent one nothing is read
    read = Obstacles.from_rows(rows)
    times = torch.full((points.shape[1],), 0.7, dtype=torch.float64)
    torch.testing.assert_close(read.distance(points, times), obstacles.distance(points, times))


@pytest.mark.parametrize(
    ("change", "message"),
    [((1, math.nan), "finite"), ((3, -0.1), "sizes at least 0"), ((5, 0.0), "axis of length 1")],
)
def test_wrong_features_are_refused(change: tuple[int, float], message: str) -> None:
    rows = obstacles_of([{"type": "ball", "centre": [0, 0], "radius": 0.1}]).rows
    rows[..., change[0]] = change[1]
    with pytest.raises(ValueError, match=message):
        Obstacles.from_rows(rows)


def test_features_of_another_number_are_refused() -> None:
    with pytest.raises(ValueError, match=r"F = 10 \(in 2 dimensions\) or 14"):
        Obstacles.from_rows(torch.zeros(1, 2, 9))


@pytest.mark.parametrize(
    ("description", "message"),
    [
        ({"type": "cone"}, "type of"),
        ({"type": "ball", "centre": [0, 0]}, "must have centre, radius"),
        ({"type": "ball", "centre": [0, 0], "radius": 1, "colour": 3}, "colour"),
        ({"type": "ball", "centre": [0], "radius": 1}, "2 or 3 coordinates"),
        ({"type": "ball", "centre": [0, 0], "radius": -1}, "at least 0"),
        ({"type": "ball", "centre": [0, math.inf], "radius": 1}, "finite numbers"),
        ({"type": "box", "centre": [0, 0], "half_sides": [1, 1, 1]}, "coordinates"),
        ("ball", "type of"),
    ],
)
def test_wrong_descriptions_are_refused(description: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        obstacles_of([description])


def straight_ways(dim: int, n_ways: int = 16, seed: int = 3) -> Tensor:
    """Ways of 60 steps of 0.1 through the origin, up to 0.15 beside it, from all directions."""
    generator = torch.Generator().manual_seed(seed)
    direction = torch.nn.functional.normalize(torch.randn(n_ways, dim, generator=generator), dim=-1)
    offset = 0.3 * (torch.rand(n_ways, dim, generator=generator) - 0.5)
    along = torch.linspace(-3, 3, 61)
    return offset.unsqueeze(1) + along.view(1, -1, 1) * direction.unsqueeze(1)


SHAPES: list[dict[str, Any]] = [
    {"type": "ball", "centre": [0.0, 0.0, 0.0], "radius": 0.2},
    {"type": "capsule", "start": [-0.3, 0.1, 0.0], "end": [0.3, -0.2, 0.1], "radius": 0.1},
    {"type": "box", "centre": [0.0, 0.0, 0.0], "half_sides": [0.3, 0.15, 0.2]},
]


def in_dimensions(description: dict[str, Any], dim: int) -> dict[str, Any]:
    return {name: value[:dim] if isinstance(value, list) else value for name, value in description.items()}


@pytest.mark.parametrize("dim", [2, 3])
def test_each_side_of_a_ball_can_be_passed(dim: int) -> None:
    ways, times = straight_ways(dim), torch.zeros(61)
    ball = obstacles_of([in_dimensions(SHAPES[0], dim)])[torch.zeros(len(ways), dtype=torch.int64)]
    bulges = bulges_past(ball, ways, times, clearance=0.1)
    assert bulges.shifts.shape[1] == (2 if dim == 2 else 8)
    for side in range(bulges.shifts.shape[1]):
        distance, _ = ball.swept_distance(ways + bulges.shifts[:, side], times)
        assert distance.min() > 0.095
        assert distance.amin(dim=(1, 2)).median() < 0.15  # and no farther than it must
    is_moved = bulges.shifts.abs().amax(dim=(1, 3)) > 0
    assert (is_moved.sum(dim=1) < 45).all() and not is_moved[:, [0, -1]].any()


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: str(shape["type"]))
def test_the_rounds_clear_a_ball_a_capsule_and_a_box(dim: int, shape: dict[str, Any]) -> None:
    ways, times = straight_ways(dim), torch.zeros(61)
    obstacle = obstacles_of([in_dimensions(shape, dim)])[torch.zeros(len(ways), dtype=torch.int64)]
    passing = Passing(obstacle, 0.1)
    assert (passing.clearances(ways, times).amin(dim=1) < 0).all()
    bent = passing(ways, times)
    assert passing.clearances(bent, times).min() > -0.01
    assert (bent - ways).norm(dim=-1).max() < 1.2


def test_the_side_is_chosen_that_the_density_supports() -> None:
    ways, times = straight_ways(2), torch.zeros(61)
    obstacles = obstacles_of([in_dimensions(SHAPES[0], 2)])[torch.zeros(len(ways), dtype=torch.int64)]
    for favoured in (-1.0, 1.0):
        bent = Passing(obstacles, 0.1, lambda points, sign=favoured: sign * 50 * points[:, 1])(ways, times)
        crossing = (bent[:, 30, 1] * favoured > 0) | (ways.diff(dim=1)[:, 0, 1].abs() > 0.08)
        assert crossing.all()
        assert (Passing(obstacles, 0.1).clearances(bent, times) > -0.01).all()


def test_ways_that_are_clear_are_the_same_bit_for_bit() -> None:
    ways = straight_ways(2) + 5.0
    obstacles = obstacles_of([in_dimensions(SHAPES[0], 2)])[torch.zeros(len(ways), dtype=torch.int64)]
    assert Passing(obstacles, 0.1)(ways, torch.zeros(61)) is ways


def test_a_batch_is_bent_as_each_of_its_ways_alone() -> None:
    ways, times = straight_ways(2), torch.zeros(61)
    rows = torch.cat([obstacles_of([in_dimensions(SHAPES[0], 2)]).rows] * len(ways))
    rows[::2, :, 0] = 0  # absent
    rows[:, :, 1] = torch.linspace(-0.5, 0.5, len(ways)).unsqueeze(1)
    together = Passing(Obstacles.from_rows(rows), 0.1)(ways, times)
    for i in range(len(ways)):
        alone = Passing(Obstacles.from_rows(rows[i : i + 1]), 0.1)(ways[i : i + 1], times)
        torch.testing.assert_close(together[i : i + 1], alone)
    assert torch.equal(together[::2], ways[::2]) and not torch.equal(together, ways)


def test_three_obstacles_are_passed_also_against_a_pull() -> None:
    ways, times = straight_ways(2), torch.zeros(61)
    along = ways.diff(dim=1)[:, :1] / 0.1
    centres = ways[:, 30:31] + torch.tensor([-1.5, 0.0, 1.5]).view(1, 3, 1) * along
    row = obstacles_of([in_dimensions(SHAPES[0], 2)]).rows
    rows = row.repeat(len(ways), 3, 1)
    rows[:, :, 1:3] = centres
    obstacles = Obstacles.from_rows(rows)
    for i in range(len(ways)):
        place, direction = ways[i, 30], along[i, 0]

        def pull(points: Tensor, place: Tensor = place, direction: Tensor = direction) -> Tensor:
            offset = points - place  # half the way back to the straight way
            return 0.5 * ((offset * direction).sum(-1, keepdim=True) * direction - offset)

        passing = Passing(obstacles[i : i + 1], 0.1, pull=pull)
        assert passing.clearances(passing(ways[i : i + 1], times), times).min() > -0.01


def test_a_moving_obstacle_is_passed_where_it_will_be() -> None:
    way = torch.stack([torch.linspace(0, 6, 61), torch.zeros(61)], dim=1).unsqueeze(0)
    times = torch.arange(61) / 10  # 1 per second
    meeting = {"type": "ball", "centre": [3.0, -1.5], "radius": 0.2, "velocity": [0.0, 0.5]}  # at t = 3
    obstacles = obstacles_of([meeting])
    assert obstacles.moves()
    assert Passing(obstacles, 0.1).clearances(way, times).min() < -0.2
    bent = Passing(obstacles, 0.1)(way, times)
    assert Passing(obstacles, 0.1).clearances(bent, times).min() > -0.01
    late = obstacles_of([{**meeting, "centre": [3.0, 0.0]}])  # gone when the robot is there
    assert Passing(late, 0.1)(way, times) is way


def test_fixed_corners_stay_and_the_end_stays_unless_it_is_blocked() -> None:
    way = torch.stack([torch.linspace(0, 2, 21), torch.zeros(21)], dim=1).unsqueeze(0)
    times = torch.zeros(21)
    near_start = obstacles_of([{"type": "ball", "centre": [0.6, 0.01], "radius": 0.1}])
    bent = Passing(near_start, 0.1)(way, times, n_fixed=4)
    assert torch.equal(bent[:, :4], way[:, :4]) and not torch.equal(bent, way)
    near_end = obstacles_of([{"type": "ball", "centre": [1.7, 0.01], "radius": 0.1}])
    assert torch.equal(Passing(near_end, 0.1)(way, times)[:, -1], way[:, -1])
    at_end = obstacles_of([{"type": "ball", "centre": [2.0, 0.01], "radius": 0.1}])
    bent = Passing(at_end, 0.1)(way, times)
    assert at_end.distance(bent[:, -1:], times[:1]).item() > 0.09


def test_between_two_obstacles_without_room_the_rounds_end_and_the_distance_tells() -> None:
    way = torch.stack([torch.linspace(-2, 2, 41), torch.zeros(41)], dim=1).unsqueeze(0)
    ring = [
        {"type": "ball", "centre": [2 + math.cos(math.pi * i / 4), math.sin(math.pi * i / 4)], "radius": 0.1}
        for i in range(8)
    ]
    passing = Passing(obstacles_of(ring), 0.4)  # around the goal, with gaps of 0.57
    bent = passing(way, torch.zeros(41))
    assert bent.isfinite().all() and passing.clearances(bent, torch.zeros(41)).min() < -0.05


def doubled(obstacles: Obstacles) -> Obstacles:
    return Obstacles.from_rows(obstacles.rows.double())
