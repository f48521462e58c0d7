# SPDX-License-Identifier: Apache-2.0
"""The vectorised environment of a simulator of many arms, here with arms of MuJoCo, whose environments it must equal."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from lerobot.envs.utils import NEW_ROLLOUT_OPTION

from lerobot_pf2mp.envs.handwriting.handwriting_env import HandwritingEnv
from lerobot_pf2mp.envs.handwriting.many_arms_env import ManyArmsEnv

N_ENVS, N_STEPS = 3, 6
SEEDS = [11, 5, 8]


class MujocoArms:
    """`Arms` that MuJoCo moves."""

    timestep = 0.002

    def __init__(self, n_arms: int) -> None:
        self.envs = [HandwritingEnv("joint") for _ in range(n_arms)]

    def place(self, joints: np.ndarray) -> None:
        for env, each in zip(self.envs, joints, strict=True):
            env.reset(options={"joints": each})

    def drive(self, target: np.ndarray, n_steps: int) -> tuple[np.ndarray, np.ndarray]:
        moved = []
        for env, each in zip(self.envs, target, strict=True):
            assert env._n_substeps == n_steps
            moved.append(env._drive(each))
            env._target = each
        return np.array([tips for tips, _ in moved]), np.array([clearance < 0 for _, clearance in moved])

    def joints(self) -> np.ndarray:
        return np.array([env._data.qpos for env in self.envs])

    def tips(self) -> np.ndarray:
        return np.array([env.pen for env in self.envs])

    def close(self) -> None:
        self.envs = []


def many_arms(space: str, **options: Any) -> ManyArmsEnv:
    return ManyArmsEnv(MujocoArms(N_ENVS), N_ENVS, space=space, max_episode_steps=N_STEPS, fps=10, **options)


def actions_of(env: HandwritingEnv) -> np.ndarray:
    """``(N_ENVS, N_STEPS, D)``: along the letter, into a region, and through the table where joints can do that."""
    regions = [region.outline.mean(axis=0) for region in env.scene.regions]
    share = np.linspace(0, 1, N_STEPS + 1)[1:, None]
    start = env.scene.stroke[0]
    along = env.scene.stroke[: 20 * N_STEPS : 20]
    places = [along, start + share * (regions[0] - start), start + share * (regions[1] - start)]
    if env.action_space.shape == (2,):
        return np.array(places)
    joints = np.array([env.kinematics.joint_trajectory(each) for each in places])
    joints[2] = [env.kinematics.joints(start, height=-height) for height in 0.03 * share[:, 0]]
    return joints


@pytest.mark.parametrize("space", ["joint", "pen"])
def test_every_arm_does_what_it_does_alone(space: str) -> None:
    env = many_arms(space)
    alone = [HandwritingEnv(space) for _ in range(N_ENVS)]
    actions = actions_of(alone[0])
    observation, info = env.reset(seed=SEEDS, options={NEW_ROLLOUT_OPTION: True})
    theirs = [each.reset(seed=seed) for each, seed in zip(alone, SEEDS, strict=True)]
    for step in range(N_STEPS + 1):
        for number, (their_observation, *_, their_info) in enumerate(theirs):
            np.testing.assert_array_equal(observation["agent_pos"][number], their_observation["agent_pos"])
            assert {key: info[key][number] for key in their_info} == pytest.approx(
                their_info, abs=0.02 if their_info["is_collision"] else 0.003
            )
            assert info["is_collision"][number] == their_info["is_collision"]
            assert info["path_length"][number] == their_info["path_length"]
        if step < N_STEPS:
            observation, reward, terminated, truncated, info = env.step(actions[:, step])
            theirs = [each.step(action) for each, action in zip(alone, actions[:, step], strict=True)]
            np.testing.assert_array_equal(reward, [each[1] for each in theirs])
            assert not terminated.any()
            assert (truncated == (step == N_STEPS - 1)).all()
    assert info["is_collision"].tolist() == [False, True, True]


def test_after_the_end_nothing_happens_until_the_next_rollout() -> None:
    env = many_arms("pen")
    with pytest.raises(gym.error.ResetNeeded, match="before step"):
        env.step(np.zeros((N_ENVS, 2)))
    env.reset(seed=3)
    places = np.array([env.scene.stroke[60]] * N_ENVS)
    for _ in range(N_STEPS):
        before = env.step(places)
    after = env.step(places + 0.05)
    np.testing.assert_array_equal(before[0]["agent_pos"], after[0]["agent_pos"])
    assert after[3].all() and not after[1].any()
    for key, value in before[4].items():
        np.testing.assert_array_equal(after[4][key], value)
    observation, info = env.reset(seed=3)
    assert info["path_length"].tolist() == [0] * N_ENVS
    again, _ = env.reset()
    assert not np.array_equal(again["agent_pos"], observation["agent_pos"])  # its random numbers go on


def test_lerobot_gets_what_it_asks_for() -> None:
    env = many_arms("joint", letter="L", render_mode="rgb_array", render_size=64)
    env.reset(seed=0)
    assert env.call("_max_episode_steps") == (N_STEPS,) * N_ENVS
    assert env.get_attr("task_description") == ("Write L without entering a red region.",) * N_ENVS
    assert env.get_attr("task") == ("handwriting-joint",) * N_ENVS
    images = env.call("render")
    assert len(images) == N_ENVS and images[0].shape == (48, 64, 3)
    np.testing.assert_array_equal(env.envs[1].render(), images[1])
    np.testing.assert_array_equal([each.unwrapped.pen for each in env.envs], env._arms.tips())
    assert env.metadata["render_fps"] == 10
    assert env.action_space.shape == (N_ENVS, 9)
    with pytest.raises(AttributeError):
        env.get_attr("nothing")
    env.close()


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.zeros((N_ENVS, 3)), r"finite positions \(3, 2\), got \(3, 3\)"),
        (np.full((N_ENVS, 2), np.nan), "finite"),
    ],
    ids=["shape", "nan"],
)
def test_actions_that_are_no_positions_are_refused(actions: np.ndarray, message: str) -> None:
    env = many_arms("pen")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        env.step(actions)


def test_starts_are_checked_and_followed() -> None:
    env = many_arms("pen")
    places = np.array([[0.4, 0.0], [0.5, 0.1], [0.6, -0.1]])
    observation, _ = env.reset(options={"start": places})
    np.testing.assert_allclose(observation["agent_pos"], places, atol=1e-4)
    with pytest.raises(ValueError, match="start must lie on the sheet"):
        env.reset(options={"start": places + 0.2})
    with pytest.raises(ValueError, match="joints must be"):
        env.reset(options={"joints": np.full((N_ENVS, 9), 3.0)})


def test_what_the_arms_are_not_is_refused() -> None:
    with pytest.raises(ValueError, match="control must be physics with many arms, got 'exact'"):
        many_arms("pen", control="exact")
    with pytest.raises(ValueError, match="robot must be panda with many arms, got 'unitree_z1'"):
        many_arms("pen", robot="unitree_z1")
    with pytest.raises(ValueError, match="fps must divide"):
        ManyArmsEnv(MujocoArms(1), 1, space="pen", max_episode_steps=3, fps=7)
