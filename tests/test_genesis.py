# SPDX-License-Identifier: Apache-2.0
"""Handwriting in Genesis. One scene serves all tests, because it takes a minute to build, the first time several."""

import importlib.util
from collections.abc import Iterator

import mujoco
import numpy as np
import pytest
from lerobot.envs.utils import NEW_ROLLOUT_OPTION

from lerobot_pf2mp import PF2MPHandwritingEnv
from lerobot_pf2mp.envs.handwriting.handwriting_env import HandwritingEnv
from lerobot_pf2mp.envs.handwriting.panda import HOME, PEN
from lerobot_pf2mp.envs.handwriting.panda_frames import from_standard, to_standard
from lerobot_pf2mp.envs.handwriting.stroke import distances
from lerobot_pf2mp.errors import ConfigError

has_genesis = importlib.util.find_spec("genesis") is not None
in_genesis = pytest.mark.skipif(not has_genesis, reason="needs the extra genesis")

N_ENVS, N_STEPS = 3, 64
SEEDS = [7, 8, 9]
# What the same actions draw differs by at most this much. The models of the arm, whose frames gymnasium-robotics has
# rounded, differ by as much as the second number on the sheet; the rest is physics.
SAME_STROKE, SAME_TIP = 0.0005, 0.0003  # [m]


@pytest.fixture(scope="module")
def env() -> Iterator:
    config = PF2MPHandwritingEnv(simulator="genesis", render_size=160)
    env = config.create_envs(N_ENVS)["pf2mp_handwriting"][0]
    yield env
    env.close()


@pytest.fixture(scope="module")
def peer() -> HandwritingEnv:
    """The same scene in MuJoCo."""
    return HandwritingEnv("joint")


def places_on_the_letter(env: HandwritingEnv) -> np.ndarray:
    """``(N_STEPS + 1, 2)`` positions along the letter [m]."""
    stroke = env.scene.stroke
    return stroke[np.linspace(0, len(stroke) - 1, N_STEPS + 1).astype(int)]


def test_one_conversion_of_joints_undoes_the_other() -> None:
    joints = np.random.default_rng(0).uniform(-2, 2, (5, 9))
    np.testing.assert_allclose(from_standard(to_standard(joints)), joints, atol=1e-15)
    np.testing.assert_allclose(to_standard(HOME)[5:7], [HOME[5] + np.pi / 2, HOME[6] + np.pi / 4])
    moved = np.flatnonzero(to_standard(joints)[0] != joints[0])
    np.testing.assert_array_equal(moved, [5, 6])


def test_a_simulator_that_does_not_exist_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"simulator must be one of \['mujoco', 'genesis'\], got 'bullet'"):
        PF2MPHandwritingEnv(simulator="bullet")


def test_without_its_package_genesis_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lerobot_pf2mp.envs.configs.handwriting.find_spec", lambda name: None)
    with pytest.raises(
        ConfigError, match=r'simulator genesis needs: pip install "lerobot_policy_pf2mp\[genesis\]"'
    ):
        PF2MPHandwritingEnv(simulator="genesis")


@in_genesis
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"robot": "unitree_z1"}, "robot must be panda with the simulator genesis, got 'unitree_z1'"),
        ({"control": "exact"}, "control must be physics with the simulator genesis, got 'exact'"),
        ({"obs_type": "pixels_agent_pos"}, "obs_type must be state with the simulator genesis"),
    ],
    ids=str,
)
def test_what_genesis_does_not_have_is_refused(options: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        PF2MPHandwritingEnv(simulator="genesis", **options)


@in_genesis
def test_the_same_joints_hold_the_pen_in_the_same_place_in_both_models(peer: HandwritingEnv) -> None:
    from lerobot_pf2mp.envs.handwriting.genesis_panda import arm_with_pen

    model = mujoco.MjModel.from_xml_string(arm_with_pen())
    data = mujoco.MjData(model)
    low, high = peer._model.jnt_range.T
    rng = np.random.default_rng(0)
    on_sheet = peer.kinematics.joint_trajectory(rng.uniform((0.34, -0.16), (0.66, 0.16), (20, 2)))
    for joints, largest in ((rng.uniform(low, high, (20, 9)), 0.001), (on_sheet, SAME_TIP)):
        for each in joints:
            data.qpos[:] = to_standard(each)
            mujoco.mj_kinematics(model, data)
            tip = data.body("link7").xpos + data.body("link7").xmat.reshape(3, 3)[:, 2] * PEN[1]
            np.testing.assert_allclose(data.site("pen_tip").xpos, tip, atol=1e-9)
            assert np.linalg.norm(tip - peer.kinematics.tips(each[None])[0]) < largest


@in_genesis
@pytest.mark.slow
def test_the_same_seeds_start_in_the_same_places_as_in_mujoco(env, peer: HandwritingEnv) -> None:
    observation, info = env.reset(seed=SEEDS, options={NEW_ROLLOUT_OPTION: True})
    for number, seed in enumerate(SEEDS):
        theirs, their_info = peer.reset(seed=seed)
        np.testing.assert_allclose(observation["agent_pos"][number], theirs["agent_pos"], atol=1e-5)
        assert set(their_info) == {key for key in info if not key.startswith("_")}
    assert not info["is_collision"].any()
    again, _ = env.reset(seed=SEEDS[0])
    assert np.array_equal(again["agent_pos"], observation["agent_pos"])  # 7, 8, 9


@in_genesis
@pytest.mark.slow
def test_the_same_actions_draw_the_same_strokes_in_both_simulators(env, peer: HandwritingEnv) -> None:
    places = places_on_the_letter(peer)
    rng = np.random.default_rng(0)
    # A careful writer, one whose hand shakes, and one who cuts through a region.
    across = np.linspace(places[0], peer.scene.regions[0].outline.mean(axis=0), N_STEPS + 1)
    writers = np.stack([places, places + rng.normal(0, 0.003, places.shape), across])
    joints = np.stack([peer.kinematics.joint_trajectory(each) for each in writers])
    env.reset(options={"joints": joints[:, 0]})
    rewards = np.zeros(N_ENVS)
    for step in range(1, N_STEPS + 1):
        _, reward, terminated, truncated, info = env.step(joints[:, step])
        rewards += reward
        assert not terminated.any()
        assert (truncated == (step == N_STEPS)).all()
    for number in range(N_ENVS):
        peer.reset(options={"joints": joints[number, 0]})
        total = 0.0
        for action in joints[number, 1:]:
            _, reward, _, _, their_info = peer.step(action)
            total += reward
        ours, theirs = (each.ink.strokes for each in (env._episodes[number], peer))
        assert len(ours) == len(theirs) == 1
        assert distances(ours[0], theirs[0]).max() < SAME_STROKE
        assert distances(theirs[0], ours[0]).max() < SAME_STROKE
        assert rewards[number] == total
        for key in ("is_success", "is_collision"):
            assert bool(info[key][number]) == their_info[key]
        for key in ("stroke_error", "clearance"):
            assert info[key][number] == pytest.approx(their_info[key], abs=SAME_STROKE)
    assert info["is_collision"].tolist() == [False, False, True]
    assert info["is_success"].tolist() == [True, True, False]
    before = {key: value.copy() for key, value in info.items()}
    observation, reward, _, truncated, info = env.step(joints[:, 0])  # after the end nothing happens
    assert truncated.all() and not reward.any()
    for key, value in before.items():
        np.testing.assert_array_equal(info[key], value)
    np.testing.assert_allclose(observation["agent_pos"], joints[:, -1], atol=0.02)


@in_genesis
@pytest.mark.slow
def test_a_pen_pressed_through_the_table_touches_it(env, peer: HandwritingEnv) -> None:
    up, down = (peer.kinematics.joints(np.array([0.45, 0.0]), height=height) for height in (0.05, -0.03))
    env.reset(options={"joints": np.stack([up] * N_ENVS)})
    *_, info = env.step(np.stack([up, down, up]))
    for _ in range(3):
        *_, info = env.step(np.stack([up, down, up]))
    assert info["is_collision"].tolist() == [False, True, False]
    assert info["clearance"][1] < 0 < info["clearance"][0]
    assert env._arms.tips()[1, 2] > -0.025  # the table holds the barrel


@in_genesis
@pytest.mark.slow
def test_lerobot_gets_what_it_asks_for(env) -> None:
    env.reset(seed=0)
    assert env.call("_max_episode_steps") == (64,) * N_ENVS
    assert env.get_attr("task_description") == ("Write S without entering a red region.",) * N_ENVS
    assert env.get_attr("task") == ("handwriting-joint",) * N_ENVS
    images = env.call("render")
    assert len(images) == N_ENVS
    assert images[0].shape == (120, 160, 3) and images[0].std() > 10
    assert env.metadata["render_fps"] == 10
    assert env.action_space.shape == (N_ENVS, 9)
    with pytest.raises(ValueError, match="actions must be finite positions"):
        env.step(np.full((N_ENVS, 9), np.nan))
