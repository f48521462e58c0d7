# SPDX-License-Identifier: Apache-2.0
"""Meta-World's tasks with a wall: collisions are those of MuJoCo's contacts, and experts are recorded as they act."""

import sys

import gymnasium as gym
import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs import make_env, make_env_config

from lerobot_pf2mp.envs.configs.metaworld import PF2MPMetaWorldEnv
from lerobot_pf2mp.envs.tasks import METAWORLD_TASKS
from lerobot_pf2mp.errors import ConfigError
from lerobot_pf2mp.policies.guided.displacement_scale import measured_scale

pytest.importorskip("metaworld", reason="needs the extra metaworld")
import mujoco

from lerobot_pf2mp.dataset_tools.metaworld.collect_metaworld import collect_metaworld
from lerobot_pf2mp.dataset_tools.metaworld.metaworld_expert import MetaWorldExpert
from lerobot_pf2mp.envs.metaworld.metaworld_env import MetaWorldEnv


def into_the_wall(env):
    """Moves the hand down in front of the wall, then against it, and yields what each step returns."""
    for step in range(60):
        yield env.step(np.array([0.3, 0.0, -1.0, 0.0]) if step < 12 else np.array([0.0, 1.0, 0.0, 0.0]))


@pytest.mark.parametrize("task", METAWORLD_TASKS)
def test_an_environment_keeps_gymnasiums_rules_and_is_reproducible(task):
    rollouts = []
    for _ in range(2):
        env = gym.make(f"lerobot_pf2mp/{task}")
        observation, info = env.reset(seed=7)
        assert env.observation_space.contains(observation)
        env.action_space.seed(0)
        seen = [observation]
        for _ in range(10):
            observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
            assert env.observation_space.contains(observation)
            assert (reward, terminated, truncated) == (0.0, False, False)
            seen.append(observation)
        assert set(info) == {"is_success", "is_collision", "clearance", "path_length"}
        rollouts.append(np.array([np.concatenate(list(one.values())) for one in seen]))
        env.reset(seed=8)
        env.reset(seed=7)  # what happened before makes no difference
        env.close()
    np.testing.assert_array_equal(*rollouts)
    assert not np.array_equal(
        rollouts[0][0, 4:], gym.make(f"lerobot_pf2mp/{task}").reset(seed=8)[0]["environment_state"]
    )


@pytest.mark.parametrize("task", METAWORLD_TASKS)
def test_the_wall_of_the_configuration_is_that_of_the_simulation(task):
    task_of_meta_world, wall = MetaWorldEnv(task)._wall_task, PF2MPMetaWorldEnv(task=task).wall
    task_of_meta_world.reset(task_of_meta_world.positions[0])
    model, data = task_of_meta_world.model, task_of_meta_world.data
    geoms = np.flatnonzero(model.geom_bodyid == model.body("wall").id)
    assert len(geoms) == 2
    for geom in geoms:
        np.testing.assert_allclose(data.geom_xpos[geom], wall.centre)
        np.testing.assert_allclose(2 * model.geom_size[geom], wall.size)


def test_an_action_of_one_moves_the_hands_target_by_a_centimetre():
    env = MetaWorldEnv("reach-wall-v3")
    env.reset(seed=0)
    mocap = env._wall_task.data.mocap_pos
    before = mocap.copy()
    env.step(np.array([1.0, -0.5, 0.25, 0.0]))
    np.testing.assert_allclose(mocap - before, [[0.01, -0.005, 0.0025]], atol=1e-12)
    before = mocap.copy()
    env.step(np.array([7.0, 0.0, 0.0, 0.0]))  # clipped
    np.testing.assert_allclose(mocap - before, [[0.01, 0.0, 0.0]], atol=1e-12)


@pytest.mark.parametrize("task", ["reach-wall-v3", "push-wall-v3"])
def test_a_collision_is_a_contact_in_any_physics_step(task):
    env = MetaWorldEnv(task)
    env.reset(seed=0)
    model, data = env._wall_task.model, env._wall_task.data
    wall, inner = model.body("wall").id, env._wall_task.sawyer.do_simulation
    touched = []

    def simulate(ctrl, n_frames):
        inner(ctrl, n_frames)
        mujoco.mj_forward(model, data)
        bodies = model.geom_bodyid[data.contact.geom]
        is_wall = (bodies == wall).sum(axis=1) == 1
        touched.append(bool((is_wall & (data.contact.dist < 0)).any()))

    rewards, told, depth = [], [], 0.0
    env._wall_task.sawyer.do_simulation = simulate
    for _, reward, _, _, info in into_the_wall(env):
        env._wall_task.sawyer.do_simulation = simulate
        rewards.append(reward)
        told.append(info["is_collision"])
        assert info["is_collision"] == any(touched)
        depth = min(depth, info["clearance"])
    assert any(told) and not told[0] and told[-1]
    assert sum(rewards) == -1.0 and rewards[told.index(True)] == -1.0
    assert depth < 0
    assert env.reset(seed=1)[1]["is_collision"] is False


def test_an_action_that_is_not_four_finite_numbers_is_an_error():
    env = MetaWorldEnv()
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(4))
    env.reset()
    for action in (np.zeros(3), np.array([0, 0, np.nan, 0])):
        with pytest.raises(ValueError, match="four finite numbers"):
            env.step(action)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "reach-v3"}, "task must be one of"),
        ({"episode_length": 501}, "episode_length must lie in 1 to 500"),
        ({"obs_type": "pixels"}, "obs_type must be one of"),
    ],
)
def test_a_configuration_that_breaks_a_rule_is_an_error(options, message):
    with pytest.raises(ConfigError, match=message):
        PF2MPMetaWorldEnv(**options)


def test_without_meta_world_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setattr("lerobot_pf2mp.envs.configs.metaworld.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r'pip install "lerobot_policy_pf2mp\[metaworld\]"'):
        PF2MPMetaWorldEnv()
    monkeypatch.setitem(sys.modules, "metaworld.env_dict", None)
    monkeypatch.delitem(sys.modules, "lerobot_pf2mp.envs.metaworld.wall_tasks")
    with pytest.raises(ImportError, match=r'pip install "lerobot_policy_pf2mp\[metaworld\]"'):
        import lerobot_pf2mp.envs.metaworld.wall_tasks  # noqa: F401


@pytest.mark.slow
def test_lerobots_evaluation_gets_states_and_images():
    config = make_env_config("pf2mp_metaworld", task="push-wall-v3", episode_length=3, render_size=64)
    env = make_env(config, n_envs=2)["pf2mp_metaworld"][0]
    observation, _ = env.reset(seed=[1, 2])
    assert observation["agent_pos"].shape == (2, 4) and observation["environment_state"].shape == (2, 6)
    assert env.call("render")[0].shape == (48, 64, 3)
    for _ in range(3):
        _, _, _, truncated, _ = env.step(np.zeros((2, 4), dtype=np.float32))
    assert truncated.all()
    env.close()


@pytest.mark.slow
def test_demonstrations_are_the_experts_and_repeat_themselves(tmp_path):
    written, dropped = collect_metaworld(
        "push-wall-v3",
        root=tmp_path / "data",
        repo_id="local/push",
        n_episodes=3,
        n_steps=100,
        seed=3,
        overwrite=False,
    )
    assert written == 3 and set(dropped) <= {"in collision", "without success"}
    table = LeRobotDataset("local/push", root=tmp_path / "data").hf_dataset.with_format("torch")[:]
    assert len(table["action"]) == 300 and table["action"].abs().max() <= 1
    actions, states = (table[key].double().numpy() for key in ("action", "observation.state"))
    scale, correlation = measured_scale(actions[:, :3], states[:, :3], table["episode_index"].numpy())
    assert scale == pytest.approx(0.01, rel=0.25) and correlation > 0.95
    # Executed again, what was recorded gives the same states, and the target of the hand goes along the running sum.
    env, expert = (
        MetaWorldEnv("push-wall-v3"),
        MetaWorldExpert(MetaWorldEnv("push-wall-v3"), "push-wall-v3", 3),
    )
    attempts = (expert.demonstrate(number, 100) for number in range(9))
    number, first = next(
        (number, one) for number, one in enumerate(attempts) if one.is_success and not one.is_collision
    )
    torch.testing.assert_close(table["action"][:100], torch.from_numpy(np.array(first.actions)))
    (seed,) = np.random.SeedSequence([3, number]).generate_state(1)
    observation, _ = env.reset(seed=int(seed))
    target = env.hand_target
    for frame, action in enumerate(actions[:100]):
        np.testing.assert_allclose(observation["agent_pos"], states[frame], atol=1e-4)
        observation = env.step(action)[0]
        target += 0.01 * action[:3]
        np.testing.assert_allclose(env.hand_target, target, atol=1e-6)


def test_more_steps_than_meta_world_takes_are_an_error(tmp_path):
    with pytest.raises(ValueError, match="n_steps must be at most 500"):
        collect_metaworld(
            "reach-wall-v3", root=tmp_path, repo_id="a/b", n_episodes=1, n_steps=501, seed=0, overwrite=False
        )
