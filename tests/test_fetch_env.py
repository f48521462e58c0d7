# SPDX-License-Identifier: Apache-2.0
import gc
import itertools
import json
import math
import os
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import draccus
import gymnasium as gym
import mujoco
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from lerobot.configs import FeatureType
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env, make_env_config
from lerobot.envs.utils import env_to_policy_features
from lerobot.scripts.lerobot_eval import rollout
from scipy.optimize import nnls
from scipy.spatial import ConvexHull
from torch import nn

from lerobot_pf2mp import PF2MPFetchEnv
from lerobot_pf2mp.envs import headless
from lerobot_pf2mp.envs.fetch.fetch_env import FetchEnv
from lerobot_pf2mp.envs.fetch.fetch_scene import (
    BLOCK_SIZE,
    FETCH_SCENES,
    FINGERS,
    HAND,
    SUCCESS_RADIUS,
    TABLE,
    WORKSPACE,
)
from lerobot_pf2mp.envs.headless import rendering
from lerobot_pf2mp.envs.tasks import FETCH_TASKS
from lerobot_pf2mp.errors import ConfigError

TASKS = ("reach", "push")
# As near as a gripper may start [m].
NEAR_THE_WALL = (
    (1.226, 0.656, 0.457),
    (1.290, 0.656, 0.506),
    (1.386, 0.656, 0.453),
    (1.426, 0.656, 0.421),
    (1.210, 0.704, 0.560),
    (1.266, 0.704, 0.567),
)
LOW_WALL = (0.16, 0.04, 0.05)  # its top is below the hand of a gripper that pushes [m]
FREE = {"start": (1.30, 0.60, 0.50), "goal": (1.30, 0.90, 0.50)}
PAST_THE_WALL = {"start": (1.15, 1.01, 0.50), "block": (1.15, 0.90), "goal": (1.15, 0.60, 0.425)}
BESIDE_THE_WALL = {"start": (1.25, 0.98, 0.50), "block": (1.25, 0.87), "goal": (1.45, 0.87, 0.425)}


@pytest.fixture(scope="module")
def reach() -> Iterator[FetchEnv]:
    env = FetchEnv("reach")
    yield env
    env.close()


@pytest.fixture(scope="module")
def push() -> Iterator[FetchEnv]:
    env = FetchEnv("push")
    yield env
    env.close()


@pytest.fixture(scope="module")
def low_wall() -> Iterator[FetchEnv]:
    env = FetchEnv("push", wall_size=LOW_WALL)
    yield env
    env.close()


@pytest.fixture(scope="module")
def patient() -> Iterator[FetchEnv]:
    """Moves for 20 inner steps, long enough to arrive anywhere."""
    env = FetchEnv("reach", n_inner_steps=20)
    yield env
    env.close()


@pytest.fixture
def env(request: pytest.FixtureRequest, task: str) -> FetchEnv:
    return request.getfixturevalue(task)


def between(start: Sequence[float], end: Sequence[float], step: float) -> np.ndarray:
    """Targets at most a step apart, without the start."""
    n = math.ceil(math.dist(start, end) / step)
    return np.linspace(start, end, n + 1)[1:]


def drive(env: FetchEnv, targets: Sequence[Sequence[float]] | np.ndarray) -> list[tuple]:
    return [env.step(np.array(target)) for target in targets]


def rewards_of(steps: list[tuple]) -> list[float]:
    return [reward for _, reward, *_ in steps]


def corners_of(half: np.ndarray) -> np.ndarray:
    return np.array(list(itertools.product(*[(-side, side) for side in half])))


@cache
def local_vertices(env: FetchEnv, geom: int) -> np.ndarray:
    model = env._fetch.model
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        return corners_of(model.geom_size[geom])
    mesh = model.geom_dataid[geom]
    first = model.mesh_vertadr[mesh]
    points = model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(float)
    return points[ConvexHull(points).vertices]


def vertices(env: FetchEnv, geom: int) -> np.ndarray:
    """``(N, 3)`` corners of a geom [m], from model and state alone."""
    data = env._fetch.data
    return local_vertices(env, geom) @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]


def distance_to_wall(env: FetchEnv, geom: int) -> float:
    """The exact distance of a geom's convex hull to the wall, 0 if they overlap.

    The point of the Minkowski difference that is nearest to the origin, as in least distance programming (Lawson and
    Hanson, 1974): with the weights w >= 0 of its corners P, w / sum(w) minimises |P w| where w minimises
    |P w|^2 + (sum(w) - 1)^2.
    """
    differences = (vertices(env, geom)[:, None] - corners_of_wall(env)).reshape(-1, 3)
    weights, _ = nnls(np.vstack([differences.T, np.ones(len(differences))]), np.array([0.0, 0.0, 0.0, 1.0]))
    return float(np.linalg.norm(differences.T @ weights / weights.sum()))


def corners_of_wall(env: FetchEnv) -> np.ndarray:
    return env.scene.wall.centre + corners_of(np.array(env.scene.wall.size) / 2)


def movers(env: FetchEnv) -> list[int]:
    """The geoms of robot and block that can touch something."""
    model = env._fetch.model
    names = [model.body(body).name for body in model.geom_bodyid]
    solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    return [i for i, name in enumerate(names) if solid[i] and name.startswith(("robot0:", "object0"))]


def distance_of_everything_to_wall(env: FetchEnv) -> float:
    return min(distance_to_wall(env, geom) for geom in movers(env))


def touching_the_wall(env: FetchEnv) -> set[str]:
    model, data = env._fetch.model, env._fetch.data
    pairs = [{model.geom(geom).name for geom in pair} for pair in data.contact.geom[: data.ncon]]
    return set().union(*(pair for pair in pairs if "wall" in pair)) - {"wall"}


# The model


@pytest.mark.parametrize("task", TASKS)
def test_the_wall_of_the_model_is_that_of_the_scene(env: FetchEnv, task: str) -> None:
    env.reset(seed=0)
    model, data = env._fetch.model, env._fetch.data
    wall = model.geom("wall").id
    np.testing.assert_allclose(data.geom_xpos[wall], env.scene.wall.centre)
    np.testing.assert_allclose(2 * model.geom_size[wall], env.scene.wall.size)
    assert model.geom_contype[wall] == model.geom_conaffinity[wall] == 1  # solid again after the reset


def test_the_table_of_the_scenes_is_that_of_the_model(reach: FetchEnv) -> None:
    corners = vertices(reach, reach._fetch.model.body("table0").geomadr[0])
    np.testing.assert_allclose(corners.max(axis=0)[2], TABLE.high[2], atol=1e-3)
    np.testing.assert_allclose(corners.min(axis=0)[:2], TABLE.low[:2], atol=1e-3)
    np.testing.assert_allclose(corners.max(axis=0)[:2], TABLE.high[:2], atol=1e-3)


def test_hand_and_fingers_of_the_scenes_are_those_of_the_model(reach: FetchEnv) -> None:
    model = reach._fetch.model
    parts = ((HAND, ("gripper_link",)), (FINGERS, ("r_gripper_finger_link", "l_gripper_finger_link")))
    for seed in range(5):
        observation, _ = reach.reset(seed=seed)
        place = observation["agent_pos"]
        for _ in range(10):  # the hand comes to rest
            observation, *_ = reach.step(place)
        for part, names in parts:
            corners = np.concatenate([vertices(reach, model.geom(f"robot0:{name}").id) for name in names])
            corners -= observation["agent_pos"]
            np.testing.assert_allclose(corners.min(axis=0), part.low, atol=0.001)
            np.testing.assert_allclose(corners.max(axis=0), part.high, atol=0.001)


def test_the_block_of_the_scenes_is_that_of_the_model(push: FetchEnv) -> None:
    push.reset(seed=0)
    corners = vertices(push, push._fetch.model.geom("object0").id)
    np.testing.assert_allclose(np.ptp(corners, axis=0), BLOCK_SIZE, atol=1e-6)
    assert corners.min(axis=0)[2] == pytest.approx(TABLE.high[2], abs=1e-3)


# Gymnasium


@pytest.mark.slow
@pytest.mark.parametrize("task", FETCH_TASKS)
def test_gymnasium_finds_nothing_to_complain_about(task: str) -> None:
    env = gym.make(f"lerobot_pf2mp/{task}", render_mode="rgb_array", render_size=64)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Positions in metres cannot follow the first; robot and block may be knocked anywhere.
        warnings.filterwarnings("ignore", message=".*we recommend using a symmetric and normalized space")
        warnings.filterwarnings("ignore", message=".*A Box observation space (minimum|maximum) value is")
        check_env(env.unwrapped)
    env.close()


@pytest.mark.parametrize(("task", "name"), FETCH_TASKS.items())
def test_every_task_is_its_scene_for_48_steps(task: str, name: str) -> None:
    env = gym.make(f"lerobot_pf2mp/{task}")
    assert env.spec.max_episode_steps == 48
    assert env.unwrapped.scene == FETCH_SCENES[name]
    assert env.unwrapped.task == f"fetch-{name}"
    assert ("block" in env.unwrapped.task_description) == (name == "push")
    assert "without touching the wall" in env.unwrapped.task_description
    assert env.unwrapped.metadata["render_fps"] == 25
    np.testing.assert_allclose(env.action_space.low, WORKSPACE.low)
    np.testing.assert_allclose(env.action_space.high, WORKSPACE.high)
    observation, _ = env.reset(seed=0)
    for step in range(48):
        _, _, terminated, truncated, _ = env.step(observation["agent_pos"])
        assert not terminated
        assert truncated == (step == 47)
    env.close()


def rolled_out(env: FetchEnv, seed: int, render: bool = False) -> list[tuple]:
    observation, info = env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    steps = [(*observation.values(), *info.values())]
    for _ in range(30):
        target = observation["agent_pos"] + rng.uniform(-0.03, 0.06, size=3)  # towards the wall
        observation, reward, terminated, truncated, info = env.step(target)
        steps.append((*observation.values(), reward, terminated, truncated, *info.values()))
        if render:
            env.render()
    return steps


def assert_same(first: list[tuple], second: list[tuple]) -> None:
    for left, right in zip(first, second, strict=True):
        for a, b in zip(left, right, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_the_same_seed_gives_the_same_rollout_and_another_seed_another(env: FetchEnv, task: str) -> None:
    # A new environment, one that has been used, and one that renders images between the steps.
    new, camera = FetchEnv(task), FetchEnv(task, render_mode="rgb_array", render_size=32)
    first = rolled_out(new, 3)
    assert_same(first, rolled_out(env, 3))
    other = rolled_out(new, 4)
    assert_same(first, rolled_out(new, 3))
    assert_same(first, rolled_out(camera, 3, render=True))
    for a, b in zip(first[0][:2], other[0][:2], strict=True):
        assert not np.array_equal(a, b)
    new.close()
    camera.close()


@pytest.mark.parametrize("task", TASKS)
def test_starts_are_at_rest_and_clear_of_the_wall(env: FetchEnv, task: str) -> None:
    for seed in range(10):
        observation, info = env.reset(seed=seed)
        layout = env.scene.sample(np.random.default_rng(seed))
        np.testing.assert_allclose(observation["agent_pos"], layout.start, atol=0.002)
        assert info["clearance"] > 0.009
        assert not info["is_collision"]
        assert not info["is_plan_in_wall"]
        assert info["path_length"] == 0.0
        # Told to stay where they are, gripper and block stay there.
        after, *_ = env.step(observation["agent_pos"])
        np.testing.assert_allclose(after["agent_pos"], observation["agent_pos"], atol=0.003)
        np.testing.assert_allclose(after["environment_state"], observation["environment_state"], atol=2e-4)


@pytest.mark.parametrize("task", TASKS)
def test_reset_puts_everything_where_the_options_say(env: FetchEnv, task: str) -> None:
    env.reset(seed=0)
    drive(env, [(1.4, 0.9, 0.7)] * 3)
    rng = np.random.default_rng(0)
    for _ in range(10):
        layout = env.scene.sample(rng)
        options = {"start": layout.start, "goal": layout.goal, "block": layout.block}
        observation, info = env.reset(options=options)
        assert math.dist(observation["agent_pos"], layout.start) < 0.002
        assert not info["is_collision"]
        places = [layout.goal] if task == "reach" else [layout.block, layout.goal]
        np.testing.assert_allclose(observation["environment_state"], np.concatenate(places), atol=1e-6)


def test_a_block_may_be_given_without_its_height(push: FetchEnv) -> None:
    short, _ = push.reset(seed=0, options=PAST_THE_WALL)
    long, _ = push.reset(seed=0, options={**PAST_THE_WALL, "block": (1.15, 0.90, 0.425)})
    np.testing.assert_array_equal(short["environment_state"], long["environment_state"])
    np.testing.assert_allclose(short["environment_state"][:3], (1.15, 0.90, 0.425), atol=1e-6)


@pytest.mark.parametrize("start", NEAR_THE_WALL, ids=str)
def test_starts_close_to_the_wall_do_not_touch_it(reach: FetchEnv, start: tuple[float, float, float]) -> None:
    _, info = reach.reset(seed=0, options={**FREE, "start": start})
    assert 0.008 < distance_of_everything_to_wall(reach) < 0.02
    assert touching_the_wall(reach) == set()
    assert not info["is_collision"]
    with pytest.raises(ValueError, match="must be clear of the wall"):
        reach.reset(options={**FREE, "start": np.add(start, (0, 0.004, 0))})


def test_corners_of_the_workspace_are_reached_within_a_centimetre(reach: FetchEnv) -> None:
    for corner in itertools.product(*zip(WORKSPACE.low, WORKSPACE.high, strict=True)):
        observation, _ = reach.reset(seed=0, options={"start": corner})
        assert math.dist(observation["agent_pos"], corner) < 0.01


@pytest.mark.parametrize("name", ["start", "goal"])
def test_reset_draws_anew_what_the_options_leave_out(reach: FetchEnv, name: str) -> None:
    place = np.array(FREE[name])
    drawn, _ = reach.reset(seed=5)
    observation, _ = reach.reset(seed=5, options={name: place, "block": None})
    given, kept = (
        ("agent_pos", "environment_state") if name == "start" else ("environment_state", "agent_pos")
    )
    np.testing.assert_array_equal(observation[kept], drawn[kept])
    np.testing.assert_allclose(observation[given], place, atol=0.002)
    observation, _ = reach.reset(seed=5)
    np.testing.assert_array_equal(observation[given], drawn[given])


@pytest.mark.parametrize("name", ["start", "goal"])
@pytest.mark.parametrize(
    "place",
    [
        (1.3, 0.6),
        (1.3, 0.6, 0.9),
        (1.0, 0.6, 0.5),
        (np.nan, 0.6, 0.5),
        (1.3, 0.6, 0.5, 0.0),
        ((1.3, 0.6, 0.5),),
    ],
    ids=str,
)
def test_starts_and_goals_out_of_reach_are_refused(reach: FetchEnv, name: str, place: tuple) -> None:
    with pytest.raises(
        ValueError, match=rf"{name} must be a position x, y, z in the gripper's workspace, .* got \("
    ):
        reach.reset(options={name: place})


@pytest.mark.parametrize("block", [(1.15,), (1.0, 0.9), (1.15, np.inf), (1.15, 0.9, 0.1)], ids=str)
def test_blocks_out_of_reach_are_refused(push: FetchEnv, block: tuple) -> None:
    with pytest.raises(ValueError, match=r"block must be a position .* got \("):
        push.reset(options={**PAST_THE_WALL, "block": block})


def test_a_block_for_reach_is_refused(reach: FetchEnv) -> None:
    with pytest.raises(ValueError, match=r"block is for push only, got \(1.15, 0.9\)"):
        reach.reset(options={"block": (1.15, 0.90)})


@pytest.mark.parametrize(
    ("task", "options"),
    [
        ("reach", {"start": (1.30, 0.75, 0.50)}),
        ("reach", {"goal": (1.30, 0.75, 0.50)}),
        ("reach", {"goal": (1.47, 0.75, 0.50)}),  # beside the wall, but the hand has no room
        ("push", {**PAST_THE_WALL, "goal": (1.30, 0.75, 0.425)}),
        ("push", {**PAST_THE_WALL, "block": (1.30, 0.75)}),
        ("push", {**PAST_THE_WALL, "block": (1.30, 0.90), "goal": (1.30, 0.60, 0.425)}),  # through the wall
    ],
    ids=str,
)
def test_positions_at_the_wall_are_refused(env: FetchEnv, task: str, options: dict) -> None:
    with pytest.raises(ValueError, match="must be clear of the wall"):
        env.reset(seed=0, options=options)


def test_a_step_before_the_first_reset_is_refused() -> None:
    env = FetchEnv()
    with pytest.raises(gym.error.ResetNeeded, match="reset"):
        env.step(np.array([1.3, 0.6, 0.5]))
    env.close()


# Control


@pytest.mark.parametrize(
    "action",
    [(np.nan, 0.6, 0.5), (1.3, np.inf, 0.5), (1.3, 0.6), (1.3, 0.6, 0.5, 0.0), ((1.3, 0.6, 0.5),), 1.3],
    ids=str,
)
def test_actions_that_are_not_three_finite_coordinates_are_refused(reach: FetchEnv, action: tuple) -> None:
    before, _ = reach.reset(seed=0, options=FREE)
    with pytest.raises(ValueError, match="three finite coordinates .* got"):
        reach.step(np.array(action, dtype=np.float32))
    # Nothing has happened.
    after, *_ = reach.step(before["agent_pos"])
    np.testing.assert_allclose(after["agent_pos"], before["agent_pos"], atol=0.003)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize(
    "direction", [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0.6, 0.0, 0.8)]
)
def test_a_target_two_centimetres_away_is_reached(env: FetchEnv, task: str, direction: tuple) -> None:
    for height in (0.50, 0.55):
        start = np.array([1.30, 0.58, height])
        env.reset(
            seed=0, options=FREE | {"start": start} if task == "reach" else PAST_THE_WALL | {"start": start}
        )
        target = start + 0.02 * np.array(direction)
        first, *_ = env.step(target)
        # From rest it lags behind, by up to a fifth of the way.
        assert math.dist(first["agent_pos"], target) < 0.004
        second, *_ = env.step(target)
        assert math.dist(second["agent_pos"], target) < 0.002


def test_a_gripper_in_motion_follows_its_targets(reach: FetchEnv) -> None:
    reach.reset(seed=0, options=FREE)
    for number, target in enumerate(between((1.30, 0.60, 0.50), (1.20, 0.52, 0.68), 0.01)):
        observation, *_ = reach.step(target)
        assert math.dist(observation["agent_pos"], target) < (0.002 if number else 0.004)


def test_targets_out_of_reach_are_moved_to_the_border(patient: FetchEnv) -> None:
    for target in ((1.3, 0.6, 9.0), (1.3, -1e9, 0.5), (1.0, 0.6, 0.5), (1.45, 0.0, 0.9)):
        patient.reset(seed=0, options=FREE)
        clipped, *_ = patient.step(np.clip(target, patient.action_space.low, patient.action_space.high))
        patient.reset(seed=0, options=FREE)
        observation, *_ = patient.step(np.array(target))
        np.testing.assert_array_equal(observation["agent_pos"], clipped["agent_pos"])
        border = np.clip(target, WORKSPACE.low, WORKSPACE.high)
        assert math.dist(observation["agent_pos"], border) < 0.01


def test_two_inner_steps_are_two_steps_with_the_same_target(reach: FetchEnv) -> None:
    double = FetchEnv("reach", n_inner_steps=2)
    assert reach.metadata["render_fps"] == 25
    assert double.metadata["render_fps"] == 12  # 12.5, but videos have whole numbers
    for options, target in ((FREE, np.array([1.15, 0.50, 0.70])), (FREE, np.array([1.30, 0.90, 0.50]))):
        reach.reset(seed=0, options=options)
        start, _ = double.reset(seed=0, options=options)
        for _ in range(4):
            once, first_reward, *_ = reach.step(target)
            moved = math.dist(once["agent_pos"], start["agent_pos"])
            twice, second_reward, *_, info = reach.step(target)
            start, reward, *_, double_info = double.step(target)
            np.testing.assert_array_equal(start["agent_pos"], twice["agent_pos"])
            assert reward == first_reward + second_reward
            assert double_info["is_collision"] == info["is_collision"]
            assert double_info["path_length"] == pytest.approx(info["path_length"], abs=1e-12)
            assert info["is_collision"] or double_info["path_length"] > moved
    assert double_info["is_collision"]
    double.close()


# Collisions and rewards


@pytest.mark.slow
def test_a_gripper_driven_straight_at_the_goal_hits_the_wall(reach: FetchEnv) -> None:
    _, info = reach.reset(seed=0, options=FREE)
    assert info["clearance"] == pytest.approx(0.067, abs=0.003)  # to the hand's side
    rewards, collided, touched = [], [], []
    for target in between(FREE["start"], FREE["goal"], 0.010):
        observation, reward, terminated, truncated, info = reach.step(target)
        rewards.append(reward)
        collided.append(info["is_collision"])
        touched.append(distance_of_everything_to_wall(reach) < 1e-9)
        assert info["clearance"] < 0 or not collided[-1]
        assert not terminated
        assert not truncated
        assert observation["agent_pos"][1] < reach.scene.wall.low[1]  # the wall is solid
    first = collided.index(True)
    assert 3 < first <= touched.index(True) + 1  # at once but for the last physics step, see below
    assert all(touched[first:])
    assert all(collided[first:])  # it stays
    assert [step for step, reward in enumerate(rewards) if reward] == [first]
    assert rewards[first] == -1.0
    assert info["is_plan_in_wall"]
    _, info = reach.reset(seed=0, options=FREE)
    assert not info["is_collision"]
    assert not info["is_plan_in_wall"]


def test_every_episode_has_its_own_reward_for_a_collision(reach: FetchEnv) -> None:
    here, wall = FREE["start"], (1.30, 0.72, 0.50)
    for targets, expected in (
        ([here] * 2 + [wall] * 6 + [here] * 6 + [wall] * 6, -1.0),
        ([here] * 8, 0.0),
        ([wall] * 8, -1.0),
    ):
        reach.reset(seed=0, options=FREE)
        steps = drive(reach, targets)
        rewards = rewards_of(steps)
        assert sum(rewards) == expected
        assert set(rewards) <= {0.0, -1.0}
        assert steps[-1][-1]["is_collision"] == bool(expected)


def test_passing_above_the_wall_does_not_collide(reach: FetchEnv) -> None:
    reach.reset(seed=0, options=FREE)
    above = 0.66
    way = np.concatenate(
        [
            between((1.30, 0.60, 0.50), (1.30, 0.60, above), 0.012),
            between((1.30, 0.60, above), (1.30, 0.90, above), 0.012),
            between((1.30, 0.90, above), (1.30, 0.90, 0.50), 0.012),
        ]
    )
    steps = drive(reach, way)
    assert sum(rewards_of(steps)) == 0.0
    info = steps[-1][-1]
    assert not info["is_collision"]
    assert not info["is_plan_in_wall"]
    assert info["is_success"]
    assert min(info["clearance"] for *_, info in steps) > 0


def test_a_plan_lies_in_the_wall_when_a_target_does(reach: FetchEnv) -> None:
    wall = reach.scene.wall
    reach.reset(seed=0, options=FREE)
    just_before, just_inside = (1.30, wall.low[1] - 0.001, 0.5), (1.30, wall.low[1] + 0.001, 0.5)
    *_, info = reach.step(just_before)
    assert not info["is_plan_in_wall"]
    *_, info = reach.step((1.30, 0.90, 0.50))  # beyond it
    assert not info["is_plan_in_wall"]
    *_, info = reach.step(just_inside)
    assert info["is_plan_in_wall"]
    *_, info = reach.step(FREE["start"])
    assert info["is_plan_in_wall"]  # in this episode
    # A hand may hit the wall though no planned point is inside, which is why this measure is not the collision.
    reach.reset(seed=0, options=FREE)
    *_, (*_, info) = drive(reach, [just_before] * 8)
    assert info["is_collision"]
    assert not info["is_plan_in_wall"]


def test_a_block_pressed_against_the_wall_is_a_collision(low_wall: FetchEnv) -> None:
    low_wall.reset(seed=0, options=BESIDE_THE_WALL)
    way = [(1.25, 0.98, 0.47), (1.25, 0.98, 0.43)]
    steps = drive(low_wall, [*way, *between((1.25, 0.98, 0.43), (1.25, 0.84, 0.43), 0.01)])
    observation, *_, info = steps[-1]
    assert sum(rewards_of(steps)) == 0.0  # pushed, up to some millimetres before the wall
    assert observation["environment_state"][1] < 0.81
    assert 0 < info["clearance"] < 0.01
    steps = drive(low_wall, [(1.25, 0.83, 0.43)])
    assert steps[0][1] == -1.0
    assert steps[0][-1]["is_collision"]
    assert steps[0][-1]["clearance"] < 0
    assert touching_the_wall(low_wall) == {"object0"}


def test_a_touch_that_ends_before_the_control_step_does_is_a_collision(reach: FetchEnv) -> None:
    # The fingers fly over the wall 5 cm a step, their tips 2 mm too low, and jump up from its edge.
    height = reach.scene.wall.high[2] - FINGERS.low[2] - 0.002
    reach.reset(seed=0, options={"start": (1.30, 0.55, height), "goal": FREE["goal"]})
    for y in np.arange(0.60, 0.95, 0.05):
        _, reward, _, _, info = reach.step(np.array([1.30, y, height]))
        if info["is_collision"]:
            break
    assert reward == -1.0
    assert touching_the_wall(reach) == set()
    assert distance_of_everything_to_wall(reach) > 0.001
    assert -0.01 < info["clearance"] < 0
    *_, info = reach.step(np.array([1.30, y, height + 0.05]))
    assert info["clearance"] > 0  # clearance is that of the step, is_collision that of the episode
    assert info["is_collision"]


def test_a_touch_in_the_middle_of_the_inner_steps_is_a_collision(patient: FetchEnv) -> None:
    patient.reset(seed=0, options={"start": (1.43, 0.62, 0.50), "goal": FREE["goal"]})
    observation, reward, _, _, info = patient.step(np.array([1.53, 0.90, 0.50]))  # past the wall's edge
    assert math.dist(observation["agent_pos"], (1.53, 0.90, 0.50)) < 0.005
    assert distance_of_everything_to_wall(patient) > 0.05
    assert info["is_collision"]
    assert info["clearance"] < 0
    assert reward == -1.0


@pytest.mark.slow
def test_a_touch_in_the_last_physics_step_is_a_collision(reach: FetchEnv) -> None:
    n_touches = 0
    for y in (0.6075, 0.6195, 0.6315):
        reach.reset(seed=0, options={**FREE, "start": (1.30, y, 0.50)})
        for number in range(1, 8):
            *_, info = reach.step(np.array([1.30, y + 0.012 * number, 0.50]))
            if distance_of_everything_to_wall(reach) == pytest.approx(0, abs=1e-9):
                n_touches += 1
                assert info["is_collision"]
    assert n_touches > 0


# Clearance


@dataclass
class Measured:
    """Clearances of one path, as reported and as they are [m]."""

    reported: np.ndarray
    exact: np.ndarray


@pytest.fixture(scope="module")
def clearances(reach: FetchEnv) -> Measured:
    """From random starts straight ahead until something is hit, and at rest beside the wall."""
    reported, exact = [], []

    def note(info: dict) -> None:
        reported.append(info["clearance"])
        exact.append(distance_of_everything_to_wall(reach))

    for seed in range(5):
        observation, info = reach.reset(seed=seed)
        note(info)
        for target in between(observation["agent_pos"], observation["environment_state"], 0.014):
            *_, info = reach.step(target)
            if info["is_collision"]:
                break
            note(info)
    for start in NEAR_THE_WALL:
        note(reach.reset(seed=0, options={**FREE, "start": start})[1])
    return Measured(np.array(reported), np.array(exact))


@pytest.mark.slow
def test_the_clearance_is_the_exact_distance_between_wall_and_robot(clearances: Measured) -> None:
    np.testing.assert_allclose(clearances.reported, clearances.exact, atol=0.002)


def test_the_clearance_is_mostly_the_exact_distance(clearances: Measured) -> None:
    assert len(clearances.exact) > 50
    assert clearances.exact.min() < 0.01
    assert np.ptp(clearances.exact) > 0.05
    assert np.median(np.abs(clearances.reported - clearances.exact)) < 1e-4


def test_the_clearance_is_never_zero_on_a_clear_path(reach: FetchEnv) -> None:
    reach.reset(seed=0, options=FREE)
    above = between((1.30, 0.60, 0.70), (1.30, 0.90, 0.70), 0.01)
    beside = between((1.10, 0.60, 0.70), (1.10, 0.90, 0.70), 0.01)
    reported = [
        info["clearance"] for *_, info in drive(reach, [*above, *above[::-1], *beside, *beside[::-1]])
    ]
    assert len(reported) >= 120
    assert min(reported) > 0.01


def test_the_clearance_above_the_wall_is_that_of_the_nearest_point_of_a_finger(reach: FetchEnv) -> None:
    model, data, wall = reach._fetch.model, reach._fetch.data, reach.scene.wall
    fingers = [model.geom(f"robot0:{side}_gripper_finger_link").id for side in "rl"]
    reach.reset(seed=0, options={**FREE, "start": (1.20, 0.73, 0.68)})
    n_measured = 0
    for target in between((1.20, 0.73, 0.68), (1.40, 0.77, 0.63), 0.01):
        *_, info = reach.step(target)
        nearest = {}
        for finger in fingers:
            sides = [
                np.linspace(-side, side, math.ceil(2 * side / 0.001) + 1) for side in model.geom_size[finger]
            ]
            points = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 3)
            points = points @ data.geom_xmat[finger].reshape(3, 3).T + data.geom_xpos[finger]
            outside = np.maximum(0, np.maximum(wall.low - points, points - wall.high))
            nearest[finger] = np.linalg.norm(outside, axis=1).min()
            assert distance_to_wall(reach, finger) == pytest.approx(nearest[finger], abs=0.001)
        assert info["clearance"] == pytest.approx(min(nearest.values()), abs=0.002)
        n_measured += 1
    assert n_measured >= 20


def test_the_clearance_is_that_of_the_block_too(low_wall: FetchEnv) -> None:
    _, info = low_wall.reset(seed=0, options=BESIDE_THE_WALL)
    wall_side = low_wall.scene.wall.high[1]
    assert info["clearance"] == pytest.approx(0.87 - BLOCK_SIZE / 2 - wall_side, abs=1e-3)
    *_, info = low_wall.step(np.array(BESIDE_THE_WALL["start"]))
    assert info["clearance"] == pytest.approx(0.87 - BLOCK_SIZE / 2 - wall_side, abs=1e-3)


def test_the_clearance_in_contact_is_minus_the_depth(reach: FetchEnv) -> None:
    reach.reset(seed=0, options=FREE)
    *_, (_, _, _, _, info) = drive(reach, between((1.30, 0.60, 0.50), (1.30, 0.69, 0.50), 0.01))
    hand = vertices(reach, reach._fetch.model.geom("robot0:gripper_link").id)
    depth = hand.max(axis=0)[1] - reach.scene.wall.low[1]
    assert 0.004 < depth < 0.02
    assert info["clearance"] == pytest.approx(-depth, abs=0.001)


# Success, path length


def test_success_of_reach_is_being_within_5_centimetres_of_the_goal(reach: FetchEnv) -> None:
    goal = (1.38, 0.58, 0.50)
    _, info = reach.reset(seed=0, options={"start": (1.25, 0.58, 0.50), "goal": goal})
    assert not info["is_success"]
    answers = []
    for target in between((1.25, 0.58, 0.50), (1.47, 0.58, 0.50), 0.008):
        observation, _, terminated, truncated, info = reach.step(target)
        distance = math.dist(observation["agent_pos"], goal)
        if abs(distance - SUCCESS_RADIUS) > 1e-6:
            assert info["is_success"] == (distance < 0.05)
        answers.append(info["is_success"])
        assert not terminated
        assert not truncated
    assert [answer for answer, _ in itertools.groupby(answers)] == [False, True, False]


def test_success_of_push_is_the_block_at_the_goal(push: FetchEnv) -> None:
    goal = np.array(PAST_THE_WALL["goal"])
    _, info = push.reset(seed=0, options=PAST_THE_WALL)
    assert not info["is_success"]
    answers = []
    for target in [(1.15, 1.01, 0.43), *between((1.15, 1.01, 0.43), (1.15, 0.66, 0.43), 0.01)]:
        observation, reward, _, _, info = push.step(np.array(target))
        distance = math.dist(observation["environment_state"][:3], goal)
        if abs(distance - SUCCESS_RADIUS) > 1e-6:
            assert info["is_success"] == (distance < 0.05)
        answers.append(info["is_success"])
        assert reward == 0.0
    assert not answers[0]
    assert answers[-1]
    # A gripper at the goal is none.
    push.reset(seed=0, options={**PAST_THE_WALL, "start": (1.15, 0.60, 0.45)})
    *_, info = push.step(goal)
    assert not info["is_success"]


@pytest.mark.parametrize("terminate_on_success", [False, True])
def test_an_episode_ends_at_the_goal_on_request(terminate_on_success: bool) -> None:
    env = FetchEnv(terminate_on_success=terminate_on_success)
    env.reset(seed=0, options={"start": (1.25, 0.58, 0.50), "goal": (1.35, 0.58, 0.50)})
    steps = drive(env, between((1.25, 0.58, 0.50), (1.35, 0.58, 0.50), 0.02))
    assert [terminated for _, _, terminated, _, _ in steps] == [
        info["is_success"] and terminate_on_success for *_, info in steps
    ]
    assert steps[-1][-1]["is_success"]
    env.close()


def test_the_path_length_is_that_of_the_grippers_path(push: FetchEnv) -> None:
    rng = np.random.default_rng(0)
    for _ in range(2):  # a second episode begins at zero again
        before, info = push.reset(seed=0, options=PAST_THE_WALL)
        assert info["path_length"] == 0.0
        way, target = 0.0, np.array(PAST_THE_WALL["start"])
        for _ in range(15):
            target = target + rng.uniform(-0.02, 0.02, size=3)
            after, *_, info = push.step(target)
            way += math.dist(before["agent_pos"], after["agent_pos"])
            before = after
            assert info["path_length"] == pytest.approx(way, abs=1e-5)
        assert way > 0.05


def test_the_path_of_many_inner_steps_has_its_bends(patient: FetchEnv) -> None:
    start, _ = patient.reset(seed=0, options={"start": (1.43, 0.62, 0.50), "goal": FREE["goal"]})
    end, *_, info = patient.step(np.array([1.53, 0.90, 0.50]))  # around the wall's edge
    straight = math.dist(start["agent_pos"], end["agent_pos"])
    assert 1.02 * straight < info["path_length"] < 1.5 * straight


# Arguments


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"task": "lift"}, "task must be one of .*reach.*push.* got 'lift'"),
        ({"n_inner_steps": 0}, "n_inner_steps must be a whole number from 1 to 25, got 0"),
        ({"n_inner_steps": -3}, "n_inner_steps must be a whole number from 1 to 25, got -3"),
        ({"render_size": 31}, "render_size must be at least 32 pixels, got 31"),
        ({"render_mode": "human"}, "render_mode must be None or one of .*rgb_array.* got 'human'"),
        ({"wall_size": (0.3, 0.04, 0.5)}, "wall must be at most 0.32 m high"),
        ({"block_range": ((1.1, 0.84), (1.5, 0.94))}, "block_range is for push only"),
        (
            {"start_range": ((1.2, 0.5, 0.5), (1.3, 0.6, 0.9))},
            "start_range must be in the gripper's workspace",
        ),
    ],
    ids=str,
)
def test_bad_arguments_are_refused_with_the_rule(kwargs: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FetchEnv(**kwargs)


def test_a_wall_of_ones_own_is_what_is_hit() -> None:
    env = FetchEnv("reach", wall_position=(1.30, 0.85), wall_size=(0.20, 0.06, 0.20))
    env.reset(seed=0, options={"start": (1.30, 0.60, 0.50), "goal": (1.30, 0.98, 0.50)})
    steps = drive(env, between((1.30, 0.60, 0.50), (1.30, 0.98, 0.50), 0.012))
    y_of_first = next(observation["agent_pos"][1] for observation, reward, *_ in steps if reward)
    assert y_of_first == pytest.approx(0.82 - HAND.high[1], abs=0.012)
    env.close()


def test_a_wall_that_stands_in_the_robot_is_refused() -> None:
    with pytest.raises(ValueError, match="wall"):
        FetchEnv("reach", wall_size=(2.0, 0.04, 0.3)).close()


def test_a_goal_alone_may_be_chosen_for_push(push: FetchEnv) -> None:
    for seed in range(10):
        push.reset(seed=seed, options={"goal": PAST_THE_WALL["goal"]})


@pytest.mark.parametrize("places", [{"goal": (1.15, 0.60, 0.80)}, {"block": (1.15, 0.90, 0.70)}], ids=str)
def test_blocks_and_goals_of_push_above_the_table_are_refused(push: FetchEnv, places: dict) -> None:
    with pytest.raises(ValueError, match="goal|block"):
        push.reset(seed=0, options={**PAST_THE_WALL, **places})


# Pictures


def n_red_pixels(picture: np.ndarray) -> int:
    red, green, blue = np.moveaxis(picture.astype(int), -1, 0)
    return int(((red > 60) & (red > 2 * green) & (red > 2 * blue)).sum())


@pytest.fixture(scope="module")
def camera() -> Iterator[FetchEnv]:
    env = FetchEnv("reach", render_mode="rgb_array")
    yield env
    env.close()


def test_images_show_the_wall_the_robot_and_the_goal(camera: FetchEnv) -> None:
    camera.reset(seed=0, options=FREE)
    at_start = camera.render()
    assert at_start.shape == (360, 480, 3)
    assert at_start.dtype == np.uint8
    assert n_red_pixels(at_start) > 2000
    np.testing.assert_array_equal(camera.render(), at_start)
    drive(camera, [(1.30, 0.60, 0.55)] * 2)
    assert (camera.render() != at_start).mean() > 0.005
    camera.reset(seed=0, options={**FREE, "goal": (1.20, 0.90, 0.65)})
    other_goal = camera.render()
    assert 0 < (other_goal != at_start).mean() < 0.01
    camera.reset(seed=0, options=FREE)
    np.testing.assert_array_equal(camera.render(), at_start)


def test_a_smaller_wall_is_a_smaller_part_of_the_image(camera: FetchEnv) -> None:
    env = FetchEnv("reach", wall_size=(0.30, 0.04, 0.05), render_mode="rgb_array")
    camera.reset(seed=0, options=FREE)
    env.reset(seed=0, options=FREE)
    assert 300 < n_red_pixels(env.render()) < 0.6 * n_red_pixels(camera.render())
    env.close()


def test_images_show_the_block() -> None:
    env = FetchEnv("push", render_mode="rgb_array", render_size=240)
    env.reset(seed=0, options=PAST_THE_WALL)
    there = env.render()
    env.reset(seed=0, options={**PAST_THE_WALL, "block": (1.15, 0.88)})
    assert 0 < (env.render() != there).mean() < 0.02
    env.close()


@pytest.mark.parametrize(("size", "shape"), [(32, (24, 32, 3)), (127, (96, 126, 3)), (640, (480, 640, 3))])
def test_images_have_even_sides(size: int, shape: tuple[int, int, int]) -> None:
    env = FetchEnv("reach", render_mode="rgb_array", render_size=size)
    env.reset(seed=0)
    assert env.render().shape == shape
    env.close()
    env.close()  # twice is as good


def test_without_a_render_mode_there_is_no_image(reach: FetchEnv) -> None:
    reach.reset(seed=0)
    assert reach.render() is None


def test_an_image_before_the_first_reset_is_refused() -> None:
    env = FetchEnv("reach", render_mode="rgb_array", render_size=32)
    try:
        with pytest.raises(gym.error.ResetNeeded, match="reset"):
            env.render()
    finally:
        env.close()


# Without a screen


@pytest.fixture
def no_screen(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    monkeypatch.setattr(headless.sys, "platform", "linux")
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.setenv(name, "")  # so that it is put back at the end
        monkeypatch.delenv(name)
    return monkeypatch


def only_these(*libraries: str):
    return lambda name: f"lib{name}.so.0" if name in libraries else None


@pytest.mark.parametrize(
    ("libraries", "backend"), [(("EGL",), "egl"), (("OSMesa",), "osmesa"), (("OSMesa", "EGL"), "egl")]
)
def test_without_a_screen_egl_comes_before_osmesa(
    no_screen: pytest.MonkeyPatch, libraries: tuple[str, ...], backend: str
) -> None:
    no_screen.setattr(headless, "find_library", only_these(*libraries))
    with rendering():
        assert os.environ["MUJOCO_GL"] == backend


def test_without_any_library_the_error_names_the_packages(no_screen: pytest.MonkeyPatch) -> None:
    no_screen.setattr(headless, "find_library", only_these())
    with (
        pytest.raises(RuntimeError, match="EGL or OSMesa: install libegl1 .*libosmesa6.* got neither"),
        rendering(),
    ):
        pytest.fail("nothing can be rendered")
    assert "MUJOCO_GL" not in os.environ


def test_a_chosen_backend_is_left_alone(no_screen: pytest.MonkeyPatch) -> None:
    no_screen.setattr(headless, "find_library", only_these())
    no_screen.setenv("MUJOCO_GL", "osmesa")
    with rendering():
        assert os.environ["MUJOCO_GL"] == "osmesa"


@pytest.mark.parametrize("screen", ["DISPLAY", "WAYLAND_DISPLAY"])
def test_with_a_screen_no_backend_is_chosen(no_screen: pytest.MonkeyPatch, screen: str) -> None:
    no_screen.setattr(headless, "find_library", only_these())
    no_screen.setenv(screen, ":0")
    with rendering():
        assert "MUJOCO_GL" not in os.environ


def test_an_error_while_rendering_names_the_packages_and_its_cause(no_screen: pytest.MonkeyPatch) -> None:
    no_screen.setenv("MUJOCO_GL", "egl")
    with (
        pytest.raises(
            RuntimeError, match="install libegl1.*KeyError with MUJOCO_GL egl: 'no context'"
        ) as caught,
        rendering(),
    ):
        raise KeyError("no context")
    assert isinstance(caught.value.__cause__, KeyError)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # Gymnasium's half-made viewer
def test_a_backend_that_does_not_exist_is_one_clear_error(no_screen: pytest.MonkeyPatch) -> None:
    no_screen.setenv("MUJOCO_GL", "nonsense")
    env = FetchEnv("reach", render_mode="rgb_array", render_size=32)
    env.reset(seed=0)
    with pytest.raises(RuntimeError, match="install libegl1.* with MUJOCO_GL nonsense"):
        env.render()
    env.close()
    gc.collect()


# LeRobot


def vector_env(config: PF2MPFetchEnv, n_envs: int) -> gym.vector.VectorEnv:
    return make_env(config, n_envs=n_envs)["pf2mp_fetch"][0]


@pytest.mark.slow
@pytest.mark.parametrize(("task", "n_coordinates"), [("FetchReachWall-v0", 3), ("FetchPushWall-v0", 6)])
def test_lerobot_makes_vectorised_environments_of_the_configuration(task: str, n_coordinates: int) -> None:
    config = make_env_config("pf2mp_fetch", task=task, episode_length=5, render_size=64)
    env = vector_env(config, n_envs=2)
    assert isinstance(env, gym.vector.SyncVectorEnv)
    observation, _ = env.reset(seed=[0, 1])
    assert {key: value.shape for key, value in observation.items()} == {
        "agent_pos": (2, 3),
        "environment_state": (2, n_coordinates),
    }
    assert not np.array_equal(observation["agent_pos"][0], observation["agent_pos"][1])
    assert env.call("_max_episode_steps") == (5, 5)
    assert env.call("task") == (f"fetch-{FETCH_TASKS[task]}",) * 2
    assert [picture.shape for picture in env.call("render")] == [(48, 64, 3)] * 2
    assert env.unwrapped.metadata["render_fps"] == 25
    for step in range(5):
        *_, truncated, _ = env.step(observation["agent_pos"])
        assert truncated.all() == (step == 4)
    env.close()


@pytest.mark.parametrize(("task", "n_coordinates"), [("FetchReachWall-v0", 3), ("FetchPushWall-v0", 6)])
def test_the_features_of_a_policy_are_state_objects_with_goal_and_action(
    task: str, n_coordinates: int
) -> None:
    features = env_to_policy_features(PF2MPFetchEnv(task=task))
    assert {key: (feature.type, feature.shape) for key, feature in features.items()} == {
        "action": (FeatureType.ACTION, (3,)),
        "observation.state": (FeatureType.STATE, (3,)),
        "observation.environment_state": (FeatureType.ENV, (n_coordinates,)),
    }


def test_the_configuration_hands_on_every_option() -> None:
    options = {
        "wall_position": (1.28, 0.76),
        "wall_size": (0.2, 0.05, 0.08),
        "start_range": ((1.2, 0.52, 0.45), (1.3, 0.6, 0.5)),
        "goal_range": ((1.1, 0.56), (1.5, 0.9)),
        "block_range": ((1.1, 0.86), (1.5, 0.94)),
        "n_inner_steps": 2,
        "terminate_on_success": True,
        "render_size": 64,
    }
    config = PF2MPFetchEnv(task="FetchPushWall-v0", fps=12, episode_length=9, **options)
    env = vector_env(config, n_envs=1)
    inner = env.envs[0].unwrapped
    assert env.call("_max_episode_steps") == (9,)
    assert inner.spec.kwargs == {
        "env_class": "fetch.fetch_env:FetchEnv", "obs_type": "state", "task": "push", "render_mode": "rgb_array", **options
    }  # fmt: skip
    assert inner.scene.wall_size == (0.2, 0.05, 0.08)
    env.close()


@pytest.mark.parametrize("task", ["FetchReach-v4", "reach", None, ""])
def test_a_task_that_does_not_exist_is_refused(task: str | None) -> None:
    with pytest.raises(
        ConfigError, match=f"task must be one of .*FetchReachWall-v0.* got {re.escape(repr(task))}"
    ):
        PF2MPFetchEnv(task=task)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"wall_size": (0.3, 0.04, 0.5)}, "wall must be at most 0.32 m high"),
        ({"wall_position": (0.3, 0.04)}, "a wall must stand on the table"),
        ({"goal_range": ((1.2, 0.74, 0.45), (1.3, 0.76, 0.5))}, "must leave positions clear of the wall"),
        ({"block_range": ((1.1, 0.84), (1.5, 0.94))}, "block_range is for push only"),
        (
            {"task": "FetchPushWall-v0", "goal_range": ((1.2, 0.5, 0.4),) * 2},
            "goal_range must be two corners of 2",
        ),
    ],
    ids=str,
)
def test_a_scene_that_does_not_work_is_refused(options: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        PF2MPFetchEnv(**options)


@dataclass
class Command:
    """What a command with an environment among its options has."""

    env: EnvConfig


def parsed(*options: str) -> PF2MPFetchEnv:
    return draccus.parse(Command, args=["--env.type=pf2mp_fetch", *options]).env


def test_walls_and_ranges_can_be_given_on_the_command_line() -> None:
    config = parsed(
        "--env.task=FetchPushWall-v0",
        "--env.wall_position=[1.28,0.76]",
        "--env.wall_size=[0.2,0.05,0.08]",
        "--env.start_range=[[1.2,0.52,0.45],[1.3,0.6,0.5]]",
        "--env.block_range=[[1.1,0.86],[1.5,0.94]]",
    )
    assert config == PF2MPFetchEnv(
        task="FetchPushWall-v0",
        wall_position=(1.28, 0.76),
        wall_size=(0.2, 0.05, 0.08),
        start_range=((1.2, 0.52, 0.45), (1.3, 0.6, 0.5)),
        block_range=((1.1, 0.86), (1.5, 0.94)),
    )
    again = draccus.decode(Command, json.loads(json.dumps(draccus.encode(Command(config))))).env
    assert again == config


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--env.wall_size=[0.3,0.04,0.5]", "wall must be at most 0.32 m high .* got wall_size"),
        ("--env.wall_size=[0.3,0.04]", "wall_size.*Expected 3 items, got 2"),
        ("--env.wall_size=[0.3,0.04,.nan]", "wall_size must be 3 finite numbers"),
        ("--env.task=reach", "task must be one of .* got 'reach'"),
    ],
)
def test_bad_options_on_the_command_line_are_refused_with_the_rule(option: str, message: str) -> None:
    with pytest.raises(draccus.utils.ParsingError, match=f"(?s){message}"):
        parsed(option)


class Script(nn.Module):
    """Plays back targets, ``(B, T, 3)``."""

    def __init__(self, script: np.ndarray) -> None:
        super().__init__()
        self._script = torch.from_numpy(script)

    def reset(self) -> None:
        self._step = 0

    def select_action(self, batch: dict[str, torch.Tensor]) -> torch.Tensor:
        self._step += 1
        return self._script[:, self._step - 1]


def test_episodes_that_end_at_different_times_sum_to_minus_their_own_collisions() -> None:
    place, goal = (1.30, 0.60, 0.50), (1.30, 0.60, 0.58)
    config = PF2MPFetchEnv(
        start_range=(place, place),
        goal_range=(goal, goal),
        terminate_on_success=True,
        episode_length=14,
        render_size=32,
    )
    wall = (1.30, 0.72, 0.50)
    script = np.array(
        [
            [goal] * 4 + [wall] * 10,  # ends before it would collide
            [wall] * 5 + [place] * 4 + [goal] * 5,  # collides, then ends
            [place] * 14,  # never arrives
            [wall] * 14,  # collides and never arrives
        ]
    )

    def same(batch: dict) -> dict:
        return batch

    env = vector_env(config, n_envs=4)
    for _ in range(2):  # a second rollout of the same environments is not stuck
        result = rollout(env, Script(script), same, same, same, same, seeds=[0, 1, 2, 3])
        np.testing.assert_array_equal(result["reward"].sum(dim=1), [0, -1, 0, -1])
        np.testing.assert_array_equal(result["success"].any(dim=1), [True, True, False, False])
        first_done = result["done"].numpy().argmax(axis=1)
        assert first_done[0] < 5
        assert 8 < first_done[1] < 13
        np.testing.assert_array_equal(first_done[2:], 13)
    env.close()
