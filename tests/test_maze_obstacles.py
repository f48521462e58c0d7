# SPDX-License-Identifier: Apache-2.0
"""Discs in the corridors of a maze."""

import math
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from lerobot.envs.utils import preprocess_observation

from lerobot_pf2mp.envs.configs.maze import PF2MPMazeEnv
from lerobot_pf2mp.envs.maze.discs import DISC_RADIUS
from lerobot_pf2mp.envs.maze.maze_env import MazeEnv
from lerobot_pf2mp.obstacle_field import Obstacles


def make(n_obstacles: int = 3, speed: float = 0.0, **options: Any) -> MazeEnv:
    return MazeEnv("large", n_obstacles=n_obstacles, obstacle_speed=speed, **options)


def test_the_environment_with_obstacles_is_one_of_gymnasiums() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about infinite bounds
        check_env(make(speed=0.3), skip_render_check=True)


def test_start_and_goal_are_those_without_obstacles_and_discs_those_of_the_seed() -> None:
    plain, env = MazeEnv("large"), make()
    for seed in range(5):
        without, seen = plain.reset(seed=seed)[0], env.reset(seed=seed)[0]
        assert "obstacles" not in without
        for key, value in without.items():
            assert np.array_equal(seen[key], value)
        assert np.array_equal(env.reset(seed=seed)[0]["obstacles"], seen["obstacles"])
    _, info = plain.reset(seed=0)
    assert "is_obstacle_collision" not in info


@pytest.mark.parametrize("speed", [0.0, 0.3])
def test_a_free_way_exists_beside_every_disc_at_any_time(speed: float) -> None:
    env, n_present = make(speed=speed), 0
    for seed in range(40):
        _, info = env.reset(seed=seed)
        assert info["obstacle_clearance"] > 0.1 and not info["is_obstacle_collision"]
        discs = env._discs
        assert discs is not None
        n_present += int(discs.is_present.sum())
        for time in (0.0, 0.7, 1.9):
            centres = discs.centres(time)
            for k in np.flatnonzero(discs.is_present):
                gaps = [
                    env._swept_ball.clearance(centres[k], centres[k] + sign * 0.2 * discs._across[k])
                    for sign in (1, -1)
                ]  # of the ball that touches the disc on either side
                assert max(gaps) > 0.05
                others = [j for j in np.flatnonzero(discs.is_present) if j != k]
                assert all(math.dist(centres[k], centres[j]) > 2 * 0.2 for j in others) or speed > 0
    assert n_present > 90


def test_the_observation_tells_where_the_discs_will_be() -> None:
    env = make(speed=0.3)
    rows = env.reset(seed=1)[0]["obstacles"]
    obstacles = Obstacles.from_rows(torch.as_tensor(rows).unsqueeze(0))
    assert obstacles.moves() and env._discs is not None
    for time in (0.0, 0.1, 0.2):
        centres = torch.as_tensor(env._discs.centres(time), dtype=torch.float32)
        distance = obstacles.distance(centres.unsqueeze(0), torch.full((3,), time))[0]
        is_straight = (distance.diagonal() + DISC_RADIUS).abs() < 1e-3  # it has not turned
        assert is_straight[obstacles.is_present[0]].any()


def test_a_ball_that_is_driven_through_a_disc_hits_it_and_no_wall() -> None:
    env = make(1)
    seen, _ = env.reset(seed=0)
    centre, start = seen["obstacles"][0, 1:3].astype(float), seen["agent_pos"]
    assert env._discs is not None
    across = env._discs._across[0]
    along = np.array([across[1], -across[0]])
    env.reset(seed=0, options={"start": centre - 0.4 * along, "goal": seen["environment_state"]})
    env._discs._places[0], env._discs.is_present[0] = centre, True
    env._discs._offsets[:] = 0.0
    _, reward, _, _, info = env.step(centre + 0.4 * along)  # over it, in one step
    assert info["is_obstacle_collision"] and not info["is_collision"] and reward == -1.0
    assert info["obstacle_clearance"] == pytest.approx(-0.2, abs=1e-6)
    assert env.step(centre + 0.4 * along)[1] == 0.0
    assert not np.array_equal(start, centre)


def test_a_policy_sees_them_under_a_key_of_their_own() -> None:
    config = PF2MPMazeEnv(n_obstacles=2, obstacle_speed=0.3)
    assert set(config.features) == set(PF2MPMazeEnv().features)  # no policy needs to be trained with them
    (env,) = next(iter(config.create_envs(2).values())).values()
    observation, _ = env.reset(seed=[0, 1])
    seen = preprocess_observation(observation)
    assert seen["observation.obstacles"].shape == (2, 2, 10)
    assert len(Obstacles.from_rows(seen["observation.obstacles"])) == 2
    env.close()


def test_discs_are_drawn() -> None:
    images = []
    for n_obstacles in (0, 2):
        env = make(n_obstacles, render_mode="rgb_array")
        env.reset(seed=0)
        images.append(env.render())
    assert images[0] is not None and (images[0] != images[1]).any(axis=-1).sum() > 50


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_obstacles": -1}, "n_obstacles must be at least 0"),
        ({"speed": math.nan}, "obstacle_speed must be"),
    ],
)
def test_wrong_numbers_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(**options)


def test_images_keep_the_obstacles() -> None:
    env = gym.make("lerobot_pf2mp/MazeLarge-v0", n_obstacles=1, obs_type="pixels_agent_pos")
    assert set(env.observation_space.spaces) == {"agent_pos", "obstacles", "pixels"}  # type: ignore[attr-defined]
