# SPDX-License-Identifier: Apache-2.0
import itertools
import re
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import closing
from functools import cache

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from lerobot.configs import FeatureType
from lerobot.envs.factory import make_env, make_env_config
from lerobot.envs.utils import env_to_policy_features
from lerobot.scripts.lerobot_eval import rollout
from torch import nn

from lerobot_pf2mp import PF2MPMazeEnv
from lerobot_pf2mp.dataset_tools.maze.maze_expert import MazeExpert
from lerobot_pf2mp.dataset_tools.writing.episodes import resample
from lerobot_pf2mp.envs.maze.maze_env import MazeEnv
from lerobot_pf2mp.envs.maze.point_maze import BALL_RADIUS, MAZE_MAPS, make_point_maze, parse_maze_map
from lerobot_pf2mp.envs.maze.swept_ball import SweptBall
from lerobot_pf2mp.envs.tasks import MAZE_TASKS
from lerobot_pf2mp.errors import ConfigError

CONTROLS = ("exact", "pd")
RING = "11111/10001/10101/10001/11111"  # one block, [-0.5, 0.5] m on both axes, in the middle
CORRIDOR = "1111111/1000001/1111111"  # free for 2.5 m to both sides of the origin and 0.5 m up and down
DIAGONAL = "1111111/1000001/1001001/1011001/1000001/1111111"


def walls_of(maze_map: str) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corners of the wall cells, from the map alone."""
    rows = parse_maze_map(maze_map)
    n_rows, n_columns = len(rows), len(rows[0])
    centres = np.array(
        [
            (j + 0.5 - n_columns / 2, n_rows / 2 - (i + 0.5))
            for i, row in enumerate(rows)
            for j, cell in enumerate(row)
            if cell
        ]
    )
    return centres - 0.5, centres + 0.5


def passes_through(start: np.ndarray, end: np.ndarray, low: np.ndarray, high: np.ndarray) -> bool:
    """Whether a segment meets a box: the intervals in which it is between its sides on each axis overlap."""
    enter, leave = 0.0, 1.0
    for axis in (0, 1):
        step = end[axis] - start[axis]
        if step == 0:
            if not low[axis] <= start[axis] <= high[axis]:
                return False
            continue
        first, last = sorted(((low[axis] - start[axis]) / step, (high[axis] - start[axis]) / step))
        enter, leave = max(enter, first), min(leave, last)
    return enter <= leave


def distance_to_walls(start: np.ndarray, end: np.ndarray, walls: tuple[np.ndarray, np.ndarray]) -> float:
    """The exact distance of a segment to the nearest wall, 0 if it meets one."""
    smallest = np.inf
    step = end - start
    for low, high in zip(*walls, strict=True):
        if passes_through(start, end, low, high):
            return 0.0
        corners = np.array([low, high, (low[0], high[1]), (high[0], low[1])])
        share = np.clip((corners - start) @ step / max(step @ step, 1e-300), 0, 1)
        to_corners = np.linalg.norm(start + share[:, None] * step - corners, axis=1)
        to_ends = [
            np.linalg.norm(np.maximum(0, np.maximum(low - end_, end_ - high))) for end_ in (start, end)
        ]
        smallest = min(smallest, *to_corners, *to_ends)
    return smallest


@cache
def swept_ball(maze_map: str, radius: float = BALL_RADIUS) -> SweptBall:
    return SweptBall(make_point_maze(maze_map)[1], radius)


def segments(maze_map: str, length: float, n: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    rng = np.random.default_rng(0)
    rows = parse_maze_map(maze_map)
    border = np.array([len(rows[0]), len(rows)]) / 2
    for _ in range(n):
        start = rng.uniform(-border, border)
        yield start, np.clip(start + length * rng.normal(size=2), -border, border)


def assert_agrees_with_the_distance(
    ball: SweptBall, radius: float, maze_map: str, pairs: Iterator[tuple[np.ndarray, np.ndarray]]
) -> None:
    walls = walls_of(maze_map)
    n_outside = n_inside = 0
    for start, end in pairs:
        expected = distance_to_walls(start, end, walls) - radius
        clearance = ball.clearance(start, end)
        if expected > 0:
            n_outside += 1
            # 1e-5 for the shortest capsule there is, 1e-6 for the smallest radius
            assert clearance == pytest.approx(expected, abs=1.2e-5), (start, end)
        if abs(expected) > 1e-4 or distance_to_walls(start, end, (walls[0] + 1e-3, walls[1] - 1e-3)) == 0:
            n_inside += expected <= 0
            assert (clearance < 0) == (expected <= 0), (start, end)
    assert n_outside > 0
    assert n_inside > 0


@pytest.mark.parametrize("radius", [0.1, 0.0])
@pytest.mark.parametrize("maze_map", ["large", DIAGONAL])
@pytest.mark.parametrize("length", [0.0, 1e-6, 0.1, 0.5])
def test_the_clearance_of_a_step_is_the_exact_distance_to_the_walls(
    maze_map: str, radius: float, length: float
) -> None:
    pairs = segments(maze_map, length, 80)
    assert_agrees_with_the_distance(swept_ball(maze_map, radius), radius, maze_map, pairs)


@pytest.mark.slow
@pytest.mark.parametrize("radius", [0.1, 0.0])
def test_the_clearance_of_a_jump_over_whole_walls_is_negative(radius: float) -> None:
    # Both ends are free, and a whole block lies between them.
    for start, end in [([0.7, 0.0], [-0.7, 0.0]), ([0.3, 0.61], [0.3, -1.0]), ([0.67, 0.34], [-0.62, 0.27])]:
        assert swept_ball(RING, radius).clearance(np.array(start), np.array(end)) < 0
    for length in (1.0, 2.5):
        pairs = segments("large", length, 150)
        assert_agrees_with_the_distance(swept_ball("large", radius), radius, "large", pairs)


@pytest.mark.parametrize("radius", [0.1, 0.0])
def test_positions_at_rest_near_a_corner_are_measured_to_the_corner(radius: float) -> None:
    ball = swept_ball(RING, radius)
    rng = np.random.default_rng(0)
    for angle in rng.uniform(0, np.pi / 2, size=50):
        for gap in (1e-4, 0.01, 0.1, 0.3):
            position = 0.5 + (radius + gap) * np.array([np.cos(angle), np.sin(angle)])
            assert ball.clearance(position, position) == pytest.approx(gap, abs=1.2e-5)
    assert ball.clearance(np.array([0.5 - 1e-3, 0.5 - 1e-3]), np.array([0.5 - 1e-3, 0.5 - 1e-3])) < -radius


def test_a_step_from_free_space_to_free_space_over_a_thin_corner_is_caught() -> None:
    start, end = np.array([0.495, 0.5 + 0.1 + 1e-3]), np.array([0.5 + 0.1 + 1e-3, 0.495])
    for radius in (0.1, 0.0):
        ball = swept_ball(RING, radius)
        assert ball.clearance(start, start) > 0
        assert ball.clearance(end, end) > 0
    assert swept_ball(RING, 0.1).clearance(start, end) < 0
    # 0.548 is as far from the corner as the middle of that step; the centre alone passes it.
    assert swept_ball(RING, 0.0).clearance(start, end) == pytest.approx(0.096 / np.sqrt(2), abs=1e-5)
    start, end = np.array([0.49, 0.501]), np.array([0.501, 0.49])
    assert swept_ball(RING, 0.0).clearance(start, end) < 0


def test_clearances_in_a_wide_room_are_distances_too() -> None:
    room = "/".join(["1" * 9, *["1" + "0" * 7 + "1"] * 7, "1" * 9])
    assert swept_ball(room).clearance(np.zeros(2), np.zeros(2)) == pytest.approx(3.5 - 0.1, abs=1.2e-5)


def test_a_step_is_as_clear_backwards() -> None:
    ball = swept_ball("medium")
    for start, end in segments("medium", 0.5, 50):
        there, back = ball.clearance(start, end), ball.clearance(end, start)
        assert max(there, 0) == pytest.approx(max(back, 0), abs=1e-9)
        assert (there < 0) == (back < 0)


@pytest.mark.parametrize("maze_map", ["medium", DIAGONAL])
def test_a_path_collides_where_its_clearance_is_negative(maze_map: str) -> None:
    ball = swept_ball(maze_map)
    rng = np.random.default_rng(0)
    border = np.array([len(parse_maze_map(maze_map)[0]), len(parse_maze_map(maze_map))]) / 2 - 1
    answers = set()
    for _ in range(150):
        path = rng.uniform(-border, border) + np.cumsum(0.05 * rng.normal(size=(8, 2)), axis=0)
        answers.add(ball.collides(path))
        assert ball.collides(path) == (ball.path_clearance(path) < 0)
    assert answers == {True, False}


def test_the_clearance_of_a_path_is_that_of_its_worst_step() -> None:
    ball = swept_ball(RING)
    path = np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, 1.2], [1.2, 1.2]])
    steps = [ball.clearance(start, end) for start, end in itertools.pairwise(path)]
    assert ball.path_clearance(path) == min(steps)
    assert min(steps) == pytest.approx(1.5 - 1.2 - 0.1)


@pytest.mark.parametrize("maze_map", ["umaze", "large", DIAGONAL])
def test_clearances_agree_with_the_contacts_of_mujoco(maze_map: str) -> None:
    env, spec = make_point_maze(maze_map)
    ball = SweptBall(spec, BALL_RADIUS)
    model, data = env.model, env.data
    n_touching = n_free = 0
    for position, _ in segments(maze_map, 0.0, 600):
        clearance = ball.clearance(position, position)
        if abs(clearance) < 1e-3:
            continue
        data.qpos[:] = position
        mujoco.mj_forward(model, data)
        names = [{model.geom(i).name for i in pair} for pair in data.contact.geom[: data.ncon]]
        touching = any(
            distance < 0 and "particle_geom" in pair and any(name.startswith("block_") for name in pair)
            for distance, pair in zip(data.contact.dist[: data.ncon], names, strict=True)
        )
        assert touching == (clearance < 0), position
        n_touching += touching
        n_free += not touching
    assert n_touching > 50
    assert n_free > 50


# Maps


@pytest.mark.parametrize("name", MAZE_MAPS)
def test_the_maps_of_the_tasks_are_found_by_their_names(name: str) -> None:
    rows = parse_maze_map(name)
    assert rows == MAZE_MAPS[name]
    rows[0][0] = 7
    assert MAZE_MAPS[name][0][0] == 1  # a copy


@pytest.mark.parametrize("text", ["1111/1001/1111", "1111\n1001\n1111\n", "1 1 1 1 / 1 0 0 1 / 1 1 1 1"])
def test_maps_are_rows_of_zeros_and_ones(text: str) -> None:
    assert parse_maze_map(text) == [[1, 1, 1, 1], [1, 0, 0, 1], [1, 1, 1, 1]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1111/1000/1111", "must be closed"),
        ("1011/1001/1111", "must be closed"),
        ("00/00", "must be closed"),
        ("111/111/111", "at least two free cells .* got 0"),
        ("111/101/111", "at least two free cells .* got 1"),
        ("11111/10101/11111", "must be connected, got 1 free cells"),
        ("1111/1011/1101/1111", "must be connected"),  # corners do not connect
        ("1111/1001/111", "equally long rows"),
        ("1111/1g01/1111", "rows of 0 and 1"),
        ("", "must be one of"),
        ("/", "must be one of"),
        ("huge", "must be one of .*'umaze', 'medium', 'large'"),
    ],
)
def test_bad_maps_are_refused_with_the_rule(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=f"maze_map .*{message}"):
        parse_maze_map(text)
    with pytest.raises(ValueError, match=f"maze_map .*{message}"):
        MazeEnv(text)


def test_the_first_row_of_a_map_is_its_north() -> None:
    env = MazeEnv("1111/1001/1011/1111", collision_radius=0)
    free, blocked = (-0.5, -0.5), (0.5, -0.5)
    assert env.reset(seed=0, options={"start": free})[1]["clearance"] > 0
    with pytest.raises(ValueError, match="clear of the walls"):
        env.reset(options={"start": blocked})


# Gymnasium


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("task", [*MAZE_TASKS, "a map of one's own"])
def test_gymnasium_finds_nothing_to_complain_about(task: str, control: str) -> None:
    kwargs = {} if task in MAZE_TASKS else {"maze_map": DIAGONAL}
    task = task if task in MAZE_TASKS else "MazeLarge-v0"
    env = gym.make(f"lerobot_pf2mp/{task}", control=control, render_mode="rgb_array", **kwargs)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Positions in metres cannot follow it.
        warnings.filterwarnings("ignore", message=".*we recommend using a symmetric and normalized space")
        check_env(env.unwrapped)
    env.close()


@pytest.mark.parametrize("task", MAZE_TASKS)
def test_every_task_is_its_map_for_80_steps(task: str) -> None:
    env = gym.make(f"lerobot_pf2mp/{task}")
    rows = MAZE_MAPS[MAZE_TASKS[task]]
    assert env.spec.max_episode_steps == 80
    np.testing.assert_array_equal(env.action_space.high, [len(rows[0]) / 2, len(rows) / 2])
    assert env.unwrapped.task == f"maze-{MAZE_TASKS[task]}"


def rolled_out(env: MazeEnv, seed: int) -> list[tuple]:
    observation, info = env.reset(seed=seed)
    env.action_space.seed(seed)
    steps = [(*observation.values(), info["clearance"])]
    for _ in range(20):
        near = observation["agent_pos"] + 0.1 * env.action_space.sample()
        observation, reward, terminated, truncated, info = env.step(near)
        steps.append((*observation.values(), reward, terminated, truncated, *info.values()))
    return steps


@pytest.mark.parametrize("control", CONTROLS)
def test_the_same_seed_gives_the_same_rollout_and_another_seed_another(control: str) -> None:
    env, other = MazeEnv(control=control), MazeEnv(control=control)
    first = rolled_out(env, 3)
    for again in (rolled_out(other, 3), rolled_out(env, 3)):
        for left, right in zip(first, again, strict=True):
            for a, b in zip(left, right, strict=True):
                np.testing.assert_array_equal(a, b)
    third = rolled_out(env, 4)
    assert not np.array_equal(first[0][0], third[0][0])
    assert not np.array_equal(first[0][1], third[0][1])


def test_starts_and_goals_are_clear_of_the_walls_and_in_different_cells() -> None:
    env = MazeEnv("umaze")
    walls = walls_of("umaze")
    for seed in range(100):
        observation, info = env.reset(seed=seed)
        start, goal = (np.float64(observation[key]) for key in ("agent_pos", "environment_state"))
        assert info["clearance"] >= 0.25 - BALL_RADIUS - 1e-6
        assert distance_to_walls(goal, goal, walls) >= 0.25 - 1e-6
        assert not np.array_equal(np.floor(start + 0.5), np.floor(goal + 0.5))
        assert not info["is_collision"]


@pytest.mark.parametrize("control", CONTROLS)
def test_reset_puts_start_and_goal_where_the_options_say(control: str) -> None:
    env = MazeEnv("large", control=control)
    env.reset(seed=0)
    env.step(np.array([0.0, 0.0]))
    start, goal = np.array([-4.6, 3.35]), np.array([4.4, -3.1])
    observation, info = env.reset(options={"start": start, "goal": goal})
    np.testing.assert_allclose(observation["agent_pos"], start, atol=1e-6)
    np.testing.assert_allclose(observation["environment_state"], goal, atol=1e-6)
    assert not info["is_collision"]
    assert not info["is_success"]
    # At rest: a ball told to stay where it is stays there.
    observation, *_ = env.step(start)
    np.testing.assert_allclose(observation["agent_pos"], start, atol=1e-6)
    np.testing.assert_allclose(observation["environment_state"], goal, atol=1e-6)


def test_reset_draws_anew_what_the_options_leave_out() -> None:
    env = MazeEnv("large")
    drawn, _ = env.reset(seed=5)
    observation, _ = env.reset(seed=5, options={"goal": (4.5, -3.0)})
    np.testing.assert_array_equal(observation["agent_pos"], drawn["agent_pos"])
    np.testing.assert_allclose(observation["environment_state"], [4.5, -3.0])
    observation, _ = env.reset(seed=5)
    np.testing.assert_array_equal(observation["environment_state"], drawn["environment_state"])


@pytest.mark.parametrize("name", ["start", "goal"])
@pytest.mark.parametrize(
    "position", [(0.0, 0.0), (0.55, 0.0), (50.0, 0.0), (np.nan, 1.0), (1.0, 1.0, 1.0)], ids=str
)
def test_starts_and_goals_in_a_wall_or_off_the_map_are_refused(name: str, position: tuple) -> None:
    env = MazeEnv(RING)
    with pytest.raises(ValueError, match=f"{name} must be a position .* clear of the walls"):
        env.reset(options={name: position})


def test_a_step_before_the_first_reset_is_refused() -> None:
    with pytest.raises(gym.error.ResetNeeded, match="reset"):
        MazeEnv("umaze").step(np.zeros(2))


# Control


def test_exact_control_reaches_every_position() -> None:
    env = MazeEnv("large", collision_radius=0)
    env.reset(seed=0)
    for _ in range(50):
        action = env.action_space.sample()
        observation, *_ = env.step(action)
        np.testing.assert_array_equal(observation["agent_pos"], action)


@pytest.mark.parametrize("fps", [10, 20])
def test_a_pd_ball_follows_a_path_it_can_follow(fps: int) -> None:
    trajectories = MazeExpert("large", 0.0, 0).trajectories()
    env = MazeEnv("large", control="pd", fps=fps)
    ball = swept_ball("large")
    n_followed = 0
    for trajectory, _ in zip(trajectories, range(4), strict=False):
        # The expert needs 0.01 s for each of its steps; leave the ball half as much time again.
        way = resample(trajectory.positions, max(2, int(trajectory.n_steps * 0.015 * fps)))
        if ball.path_clearance(way) < 0.15:
            continue
        n_followed += 1
        env.reset(seed=0, options={"start": way[0], "goal": trajectory.goal})
        for position in way[1:]:
            observation, *_, info = env.step(position)
            assert np.linalg.norm(observation["agent_pos"] - position) < 0.15
        assert info["is_success"]
        assert not info["is_collision"]
    assert n_followed >= 2


def test_a_pd_ball_cannot_enter_a_wall() -> None:
    env = MazeEnv(RING, control="pd")
    env.reset(seed=0, options={"start": (1.0, 0.0), "goal": (-1.0, 0.0)})
    walls = walls_of(RING)
    for target in [(-1.0, 0.0)] * 10 + [(1.5, 1.5)] * 10 + [(0.0, 0.0)] * 10:
        observation, _, _, _, info = env.step(np.array(target))
        position = np.float64(observation["agent_pos"])
        # MuJoCo's contacts are soft: 100 N push the ball 4 cm into the wall.
        assert distance_to_walls(position, position, walls) > BALL_RADIUS - 0.05
        assert info["clearance"] > -0.05
    assert info["is_collision"]


def test_a_wall_touched_and_left_again_within_one_step_is_a_collision() -> None:
    env = MazeEnv(CORRIDOR, control="pd", fps=1)
    env.reset(seed=0, options={"start": (-2.0, 0.0), "goal": (2.0, 0.0)})
    before, _, _, _, info = env.step(np.array([2.2, 0.0]))  # 0.2 m before the wall at 4 m/s
    assert not info["is_collision"]
    after, reward, _, _, info = env.step(np.array([0.0, 0.0]))
    straight_way = np.array([before["agent_pos"], after["agent_pos"]], dtype=np.float64)
    assert swept_ball(CORRIDOR).path_clearance(straight_way) > 0.05
    assert info["is_collision"]
    assert reward == -1


@pytest.mark.parametrize("control", CONTROLS)
def test_the_clearance_of_a_step_is_that_of_its_path_in_metres(control: str) -> None:
    env = MazeEnv(CORRIDOR, control=control)
    env.reset(seed=0, options={"start": (-1.0, 0.0), "goal": (2.0, 0.0)})
    *_, info = env.step(np.array([-0.9, 0.0]))
    assert info["clearance"] == pytest.approx(0.4, abs=1e-6)
    *_, info = env.step(np.array([-0.9, 0.0]))
    *_, info = env.step(np.array([-0.9, 0.1]))
    assert info["clearance"] == pytest.approx(0.3, abs=1e-6 if control == "exact" else 0.05)


# Collisions, rewards, success


def test_the_reward_is_minus_one_once_for_each_episode_with_a_collision() -> None:
    env = MazeEnv(CORRIDOR)
    free, wall = np.array([0.0, 0.0]), np.array([0.0, 0.45])
    for actions, expected in [
        ([free, free], [0, 0]),
        ([free, wall, free, wall, wall, free], [0, -1, 0, 0, 0, 0]),
        ([wall, free], [-1, 0]),
        ([free, free, wall], [0, 0, -1]),
    ]:
        _, info = env.reset(seed=0, options={"start": (-1.0, 0.0), "goal": (2.0, 0.0)})
        assert not info["is_collision"]
        rewards = []
        for action in actions:
            _, reward, terminated, truncated, info = env.step(action)
            rewards.append(reward)
            assert not terminated  # a collision does not end the episode
            assert not truncated
            assert sum(rewards) == -info["is_collision"]
        assert rewards == expected


def test_random_episodes_earn_minus_their_collision() -> None:
    env = gym.make("lerobot_pf2mp/MazeMedium-v0")
    env.action_space.seed(0)
    sums = []
    for seed in range(30):
        observation, _ = env.reset(seed=seed)
        total, truncated, n_steps = 0.0, False, 0
        while not truncated:
            action = observation["agent_pos"] + 0.012 * env.action_space.sample()
            observation, reward, terminated, truncated, info = env.step(action)
            total += reward
            n_steps += 1
            assert not terminated
        assert n_steps == 80
        assert total == -info["is_collision"]
        sums.append(total)
    assert set(sums) == {0.0, -1.0}


def test_a_path_through_a_wall_collides_though_both_its_ends_are_free() -> None:
    env = MazeEnv(RING)
    env.reset(seed=0, options={"start": (0.7, 0.0), "goal": (-1.0, 1.0)})
    _, reward, _, _, info = env.step(np.array([-0.7, 0.0]))
    assert reward == -1
    assert info["is_collision"]
    assert info["clearance"] < 0


def test_a_centre_may_pass_where_a_ball_collides() -> None:
    for radius, collides in ((0.1, True), (0.0, False)):
        env = MazeEnv(CORRIDOR, collision_radius=radius)
        env.reset(seed=0, options={"start": (0.0, 0.0), "goal": (2.0, 0.0)})
        *_, info = env.step(np.array([0.0, 0.45]))
        assert info["is_collision"] == collides
        assert info["clearance"] == pytest.approx(0.05 - radius, abs=1e-5)


def test_the_path_length_is_that_of_the_path_so_far_in_this_episode() -> None:
    env = MazeEnv(CORRIDOR)
    way = np.array([(-2.0, 0.0), (-1.7, 0.4), (-1.7, 0.4), (-1.7, -0.2), (1.0, 0.0), (1.0, 0.45), (1.2, 0.3)])
    for _ in range(2):  # a second episode begins at zero again
        _, info = env.reset(seed=0, options={"start": way[0], "goal": (2.0, 0.0)})
        assert info["path_length"] == 0.0
        for n_steps, position in enumerate(way[1:], start=1):
            *_, info = env.step(position)
            polyline = np.linalg.norm(np.diff(way[: n_steps + 1], axis=0), axis=1).sum()
            assert info["path_length"] == pytest.approx(polyline, abs=1e-6)
        assert info["is_collision"]  # which does not stop the count


def test_the_path_length_of_a_pd_ball_is_that_of_the_path_it_takes() -> None:
    env = MazeEnv(CORRIDOR, control="pd")
    observation, info = env.reset(seed=0, options={"start": (-2.0, 0.0), "goal": (2.0, 0.0)})
    straight = 0.0
    for x, y in [(-1.8, 0.0), (-1.6, 0.1), (-1.4, 0.0), (-1.6, 0.0), (-1.8, 0.0)]:
        before, length = observation["agent_pos"], info["path_length"]
        observation, *_, info = env.step(np.array([x, y]))
        straight += np.linalg.norm(observation["agent_pos"] - before)
        assert info["path_length"] > length
    # Between the ends of its steps it swings, most of all where it turns round.
    assert 1.001 * straight < info["path_length"] < 1.2 * straight
    assert env.reset(seed=0)[1]["path_length"] == 0.0


@pytest.mark.parametrize("terminate_on_success", [False, True])
def test_success_is_being_within_45_centimetres_of_the_goal(terminate_on_success: bool) -> None:
    env = MazeEnv(CORRIDOR, terminate_on_success=terminate_on_success)
    _, info = env.reset(seed=0, options={"start": (0.0, 0.0), "goal": (1.0, 0.0)})
    assert not info["is_success"]
    for x, success in ((0.54, False), (0.56, True), (1.0, True), (1.44, True), (1.46, False)):
        _, _, terminated, truncated, info = env.step(np.array([x, 0.0]))
        assert info["is_success"] == success
        assert terminated == (success and terminate_on_success)
        assert not truncated


def test_positions_outside_the_map_are_moved_to_its_border_and_collide() -> None:
    env = MazeEnv(CORRIDOR)
    for action, reached in (((100.0, 0.0), (3.5, 0.0)), ((-4.0, -1e9), (-3.5, -1.5))):
        env.reset(seed=0, options={"start": (0.0, 0.0), "goal": (2.0, 0.0)})
        observation, reward, _, _, info = env.step(np.array(action))
        np.testing.assert_allclose(observation["agent_pos"], reached)
        assert observation["agent_pos"] in env.observation_space["agent_pos"]
        assert reward == -1
        assert info["is_collision"]


@pytest.mark.parametrize(
    "action", [(np.nan, 0.0), (0.0, np.inf), (0.0, 0.0, 0.0), ((0.0, 0.0),), (0.0,)], ids=str
)
def test_actions_that_are_not_two_finite_coordinates_are_refused(action: tuple) -> None:
    env = MazeEnv("umaze")
    env.reset(seed=0)
    with pytest.raises(ValueError, match="two finite coordinates"):
        env.step(np.array(action, dtype=np.float32))


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"control": "force"}, "control must be one of .*exact.*pd.* got 'force'"),
        ({"collision_radius": -0.1}, "collision_radius must lie in .* got -0.1"),
        ({"collision_radius": 0.2}, "collision_radius must lie in .* got 0.2"),
        ({"collision_radius": float("nan")}, "collision_radius must lie in .* got nan"),
        ({"fps": 0}, "fps must divide .* got 0"),
        ({"fps": -10}, "fps must divide .* got -10"),
        ({"fps": 30}, "fps must divide the physics' 100 Hz, got 30"),
        ({"fps": 200}, "fps must divide .* got 200"),
        ({"render_size": 16}, "render_size must be at least 32 pixels, got 16"),
        ({"render_mode": "human"}, "render_mode must be None or one of .* got 'human'"),
    ],
)
def test_bad_arguments_are_refused_with_the_rule(kwargs: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MazeEnv("umaze", **kwargs)


# Pictures


def n_pixels_like(picture: np.ndarray, colour: tuple[int, int, int]) -> int:
    return int((np.abs(picture.astype(int) - colour).max(axis=-1) < 40).sum())


@pytest.mark.parametrize("maze_map", ["umaze", "medium", "large", CORRIDOR])
@pytest.mark.parametrize("size", [32, 127, 480])
def test_images_have_even_sides(maze_map: str, size: int) -> None:
    env = MazeEnv(maze_map, render_mode="rgb_array", render_size=size)
    env.reset(seed=0)
    picture = env.render()
    rows = parse_maze_map(maze_map)
    assert picture.dtype == np.uint8
    height, width, channels = picture.shape
    assert channels == 3
    assert height % 2 == width % 2 == 0
    assert abs(max(height, width) - size) <= 1
    assert width / height == pytest.approx(len(rows[0]) / len(rows), rel=0.1)


def test_images_show_the_path_and_the_collisions() -> None:
    env = MazeEnv(CORRIDOR, render_mode="rgb_array")
    blue, dark_red = (31, 119, 180), (200, 20, 20)
    env.reset(seed=0, options={"start": (-2.0, 0.0), "goal": (2.0, 0.0)})
    at_rest = env.render()
    assert n_pixels_like(at_rest, blue) == 0
    env.step(np.array([0.0, 0.0]))
    after_a_way = env.render()
    assert n_pixels_like(after_a_way, blue) > 100
    env.step(np.array([0.0, 0.9]))
    assert n_pixels_like(env.render(), dark_red) > n_pixels_like(after_a_way, dark_red) + 50
    env.reset(seed=0, options={"start": (-2.0, 0.0), "goal": (2.0, 0.0)})
    np.testing.assert_array_equal(env.render(), at_rest)


def test_images_show_ball_and_goal_where_they_are() -> None:
    env = MazeEnv("1111/1001/1001/1001/1111", render_mode="rgb_array", render_size=500)
    env.reset(seed=0, options={"start": (-0.5, 1.0), "goal": (0.5, -1.0)})
    picture = env.render()
    assert picture.shape == (500, 400, 3)
    np.testing.assert_array_equal(picture[150, 150], (46, 139, 87))
    np.testing.assert_array_equal(picture[350, 250], (214, 39, 40))
    np.testing.assert_array_equal(picture[50, 150], (166, 123, 91))
    np.testing.assert_array_equal(picture[250, 250], (250, 247, 242))


def test_without_a_render_mode_there_is_no_image() -> None:
    env = MazeEnv("umaze")
    env.reset(seed=0)
    assert env.render() is None


@pytest.mark.parametrize("fps", [10, 50])
def test_videos_play_at_the_control_frequency(fps: int) -> None:
    assert MazeEnv("umaze", fps=fps).metadata["render_fps"] == fps


# LeRobot


def vector_env(config: PF2MPMazeEnv, n_envs: int, use_async_envs: bool = False) -> gym.vector.VectorEnv:
    return make_env(config, n_envs=n_envs, use_async_envs=use_async_envs)["pf2mp_maze"][0]


@pytest.mark.slow
def test_lerobot_makes_vectorised_environments_of_the_configuration() -> None:
    config = make_env_config("pf2mp_maze", task="MazeMedium-v0", episode_length=7, fps=20, render_size=64)
    env = vector_env(config, n_envs=3)
    assert isinstance(env, gym.vector.SyncVectorEnv)
    assert env.num_envs == 3
    observation, _ = env.reset(seed=[0, 1, 2])
    assert {key: value.shape for key, value in observation.items()} == {
        "agent_pos": (3, 2),
        "environment_state": (3, 2),
    }
    assert env.call("_max_episode_steps") == (7, 7, 7)
    assert env.call("task_description") == ("Move the ball to the red goal without touching a wall.",) * 3
    assert env.call("task") == ("maze-medium",) * 3
    assert [picture.shape for picture in env.call("render")] == [(64, 64, 3)] * 3
    assert env.unwrapped.metadata["render_fps"] == 20
    for step in range(7):
        *_, truncated, _ = env.step(observation["agent_pos"])
        assert truncated.all() == (step == 6)
    env.close()


def test_the_configuration_hands_on_every_option() -> None:
    config = PF2MPMazeEnv(
        maze_map=CORRIDOR, control="pd", collision_radius=0.0, terminate_on_success=True, episode_length=9
    )
    env = vector_env(config, n_envs=1).envs[0].unwrapped
    assert env.spec.kwargs == {
        "env_class": "maze.maze_env:MazeEnv",
        "obs_type": "state",
        "maze_map": CORRIDOR,
        "control": "pd",
        "fps": 10,
        "collision_radius": 0.0,
        "terminate_on_success": True,
        "render_mode": "rgb_array",
        "render_size": 480,
    }
    np.testing.assert_array_equal(env.action_space.high, [3.5, 1.5])


def test_the_features_of_a_policy_are_state_goal_and_action() -> None:
    features = env_to_policy_features(PF2MPMazeEnv())
    assert {key: (feature.type, feature.shape) for key, feature in features.items()} == {
        "action": (FeatureType.ACTION, (2,)),
        "observation.state": (FeatureType.STATE, (2,)),
        "observation.environment_state": (FeatureType.ENV, (2,)),
    }


@pytest.mark.parametrize("task", ["MazeHuge-v0", "maze_large", None, ""])
def test_a_task_that_does_not_exist_is_refused(task: str | None) -> None:
    with pytest.raises(
        ConfigError, match=f"task must be one of .*MazeUMaze-v0.* got {re.escape(repr(task))}"
    ):
        PF2MPMazeEnv(task=task)


@pytest.mark.slow
def test_environments_in_worker_processes_do_the_same() -> None:
    config = PF2MPMazeEnv(task="MazeUMaze-v0", episode_length=5)
    sync, workers = vector_env(config, 2), vector_env(config, 2, use_async_envs=True)
    assert isinstance(workers, gym.vector.AsyncVectorEnv)
    try:
        for env in (sync, workers):
            env.action_space.seed(0)
        left, right = sync.reset(seed=[3, 4])[0], workers.reset(seed=[3, 4])[0]
        for _ in range(7):
            for key in left:
                np.testing.assert_array_equal(left[key], right[key])
            action = sync.action_space.sample()
            left, *left_outcome = sync.step(action)
            right, *right_outcome = workers.step(action)
            for a, b in zip(left_outcome[:3], right_outcome[:3], strict=True):
                np.testing.assert_array_equal(a, b)
    finally:
        workers.close()
        sync.close()


class Script(nn.Module):
    """Plays back positions, ``(B, T, 2)``; some relative to the goal."""

    def __init__(self, script: list[list[str]]) -> None:
        super().__init__()
        self._script = script

    def reset(self) -> None:
        self._step = 0

    def select_action(self, batch: dict[str, torch.Tensor]) -> torch.Tensor:
        goals, positions = batch["observation.environment_state"], batch["observation.state"]
        choices = {
            "stay": positions,
            "goal": goals,
            "wall": torch.stack([positions[:, 0], torch.ones(len(goals))], dim=1),
            "leave": torch.stack([-goals[:, 0].sign() * 2.4, torch.zeros(len(goals))], dim=1),
        }
        action = torch.stack([choices[line[self._step]][i] for i, line in enumerate(self._script)])
        self._step += 1
        return action


def test_episodes_that_end_at_different_times_sum_to_minus_their_own_collisions() -> None:
    # A seed for which all three start away from their goals, in a corridor without corners.
    env = vector_env(PF2MPMazeEnv(maze_map=CORRIDOR, terminate_on_success=True, episode_length=8), n_envs=3)
    script = Script(
        [
            ["stay", "wall", "goal", "wall", "wall", "wall", "wall", "wall"],  # collides, ends at step 3
            ["stay", "stay", "stay", "stay", "goal", "wall", "leave", "wall"],  # ends at step 5, clean
            ["leave", "wall", "stay", "leave", "wall", "leave", "wall", "leave"],  # collides, never arrives
        ]
    )

    def same(batch: dict) -> dict:
        return batch

    for _ in range(2):  # a second rollout of the same environments is not stuck
        result = rollout(env, script, same, same, same, same, seeds=[0, 1, 3])
        assert result["reward"].shape == (3, 8)
        np.testing.assert_array_equal(result["reward"].sum(dim=1), [-1, 0, -1])
        done = result["done"].numpy()
        first_done = done.argmax(axis=1)
        np.testing.assert_array_equal(first_done, [2, 4, 7])
        # What LeRobot's eval_policy sums: everything up to one step after the end.
        mask = np.arange(8) <= (first_done + 1)[:, None]
        np.testing.assert_array_equal((result["reward"].numpy() * mask).sum(axis=1), [-1, 0, -1])
        np.testing.assert_array_equal((result["success"].numpy() & mask).any(axis=1), [True, True, False])
    env.close()


# Cleanliness


def test_nothing_is_left_behind_in_the_folder_of_temporary_files(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    env = MazeEnv(CORRIDOR, render_mode="rgb_array")
    env.reset(seed=0)
    env.render()
    env.close()
    MazeExpert(CORRIDOR, 0.0, 0)
    vector_env(PF2MPMazeEnv(), 2).close()
    assert list(tmp_path.iterdir()) == []


def test_environments_can_be_closed_twice() -> None:
    env = MazeEnv("umaze")
    env.reset(seed=0)
    env.close()
    env.close()


def test_a_map_of_lists_is_that_of_its_text() -> None:
    rows = [[1, 1, 1, 1, 1], [1, 0, 0, 0, 1], [1, 1, 1, 1, 1]]
    assert parse_maze_map(rows) == parse_maze_map("11111/10001/11111")
    assert parse_maze_map(np.array(rows)) == rows
    env = gym.make("lerobot_pf2mp/MazeLarge-v0", maze_map=rows)
    env.reset(seed=0)
    env.close()


@pytest.mark.parametrize("cells", [[[1, "g"]], [[1, 2]], [1, 0], 3, None, [[1, None]], [[1.5]]])
def test_a_map_of_other_cells_is_refused(cells: object) -> None:
    with pytest.raises(
        ValueError, match=r"maze_map as lists must hold rows of 0 \(free\) and 1 \(wall\), got"
    ):
        parse_maze_map(cells)  # type: ignore[arg-type]


def test_cells_choose_start_and_goal_as_in_gymnasium_robotics() -> None:
    with closing(MazeEnv("large")) as env:
        theirs = env._maze.maze
        for cells in (
            {"goal_cell": (1, 1)},
            {"reset_cell": [7, 10]},
            {"goal_cell": (1, 1), "reset_cell": (7, 10)},
        ):
            observation, _ = env.reset(seed=0, options=cells)
            for name, key in (("goal_cell", "environment_state"), ("reset_cell", "agent_pos")):
                if name in cells:
                    centre = theirs.cell_rowcol_to_xy(np.array(cells[name]))
                    assert (np.abs(observation[key] - centre) <= 0.25).all()


@pytest.mark.parametrize("cell", [(0, 0), (-1, 1), (99, 1), (1, 1, 1), "ab", (1.0, 1.0), 3])
@pytest.mark.parametrize("name", ["goal_cell", "reset_cell"])
def test_a_cell_that_is_not_free_is_refused(name: str, cell: object) -> None:
    with (
        closing(MazeEnv("large")) as env,
        pytest.raises(ValueError, match=f"{name} must be the row and column"),
    ):
        env.reset(options={name: cell})


def test_gymnasium_makes_what_lerobots_configuration_makes() -> None:
    env = gym.make("lerobot_pf2mp/MazeUMaze-v0", obs_type="pixels_agent_pos", render_size=64)
    observation, _ = env.reset(seed=3)
    config = PF2MPMazeEnv(task="MazeUMaze-v0", obs_type="pixels_agent_pos", render_size=64)
    (vector_env,) = next(iter(config.create_envs(1).values())).values()
    expected, _ = vector_env.reset(seed=[3])
    assert set(observation) == {"agent_pos", "pixels"}
    for key, value in observation.items():
        assert np.array_equal(value, expected[key][0])
    for one in (env, vector_env):
        one.close()
    with pytest.raises(
        ValueError, match=r"obs_type must be one of \['state', 'pixels_agent_pos'\], got 'pixels'"
    ):
        gym.make("lerobot_pf2mp/MazeUMaze-v0", obs_type="pixels")
