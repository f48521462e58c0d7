# SPDX-License-Identifier: Apache-2.0
import dataclasses
import itertools
import json
from pathlib import Path

import draccus
import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import EnvConfig

from lerobot_pf2mp.envs.handwriting.handwriting_env import HandwritingEnv
from lerobot_pf2mp.envs.handwriting.letters import LETTERS
from lerobot_pf2mp.envs.handwriting.pen_kinematics import PenKinematics
from lerobot_pf2mp.envs.handwriting.sheet import SHEET_CENTRE, SHEET_SIDE
from lerobot_pf2mp.envs.handwriting.stroke import distances, evenly_spaced
from lerobot_pf2mp.envs.handwriting.writing_model import make_writing_model
from lerobot_pf2mp.envs.handwriting.writing_scene import make_writing_scene

z1 = pytest.importorskip(
    "lerobot_pf2mp.envs.handwriting.unitree_z1", reason="needs the extra z1", exc_type=ImportError
)
ARM = z1.ARM
LOW, HIGH = np.array(SHEET_CENTRE) - SHEET_SIDE / 2, np.array(SHEET_CENTRE) + SHEET_SIDE / 2
REACH = 0.520  # of the upright pen on the table, from the axis of the first joint [m]


@dataclasses.dataclass
class Command:
    env: EnvConfig


@pytest.fixture(scope="module")
def env() -> HandwritingEnv:
    return HandwritingEnv("pen", robot="unitree_z1")


@pytest.fixture(scope="module")
def limits(env: HandwritingEnv) -> tuple[np.ndarray, np.ndarray]:
    low, high = env._model.jnt_range.T
    return low, high


def places_on_the_sheet(n: int) -> list[np.ndarray]:
    axes = (np.linspace(LOW[axis], HIGH[axis], n) for axis in (0, 1))
    return [np.array(place) for place in itertools.product(*axes)]


def draw(env: HandwritingEnv, places: np.ndarray) -> list[dict]:
    env.reset(options={"start": places[0]})
    return [env.step(place)[-1] for place in places[1:]]


def test_the_limits_are_those_of_the_urdf(env: HandwritingEnv, limits: tuple) -> None:
    assert env._model.nq == env._model.nu == len(ARM.joint_names) == len(ARM.home)
    np.testing.assert_allclose(limits[0], [-2.618, 0, -2.8798, -1.5184, -1.3439, -2.7925, -1.5707], atol=1e-4)
    np.testing.assert_allclose(limits[1], [2.618, 2.9671, 0, 1.5184, 1.3439, 2.7925, 0], atol=1e-4)
    np.testing.assert_array_equal(env._model.actuator_forcerange[:, 1], [30, 60, 30, 30, 30, 30, 30])
    np.testing.assert_array_equal(env._model.actuator_trnid[:, 0], range(7))
    assert env._model.body_mass[1:].sum() == pytest.approx(5.22 + 0.02, abs=0.02)  # with the pen


def test_at_home_the_pen_is_upright_5_mm_below_the_middle_of_the_sheet(env: HandwritingEnv) -> None:
    np.testing.assert_allclose(env.kinematics.tips(ARM.home[None])[0], [*SHEET_CENTRE, -0.005], atol=1e-4)
    np.testing.assert_allclose(
        env.kinematics.joints(np.array(SHEET_CENTRE), height=-0.005), ARM.home, atol=1e-3
    )


@pytest.mark.parametrize("height", [0.0, 0.02])
def test_the_upright_pen_reaches_the_whole_sheet_away_from_the_limits(
    env: HandwritingEnv, limits: tuple, height: float
) -> None:
    data = mujoco.MjData(env._model)
    for place in places_on_the_sheet(7):
        joints, missed = env.kinematics.nearest_joints(place, height)
        assert missed == 0
        assert np.minimum(joints - limits[0], limits[1] - joints)[:6].min() > 0.2
        data.qpos[:] = joints
        mujoco.mj_forward(env._model, data)
        np.testing.assert_allclose(data.site("pen_tip").xpos, [*place, height], atol=1e-4)
        np.testing.assert_allclose(data.site("pen_tip").xmat[[2, 5, 8]], [0, 0, -1], atol=1e-4)
        assert data.ncon == 0  # the arm does not touch itself


@pytest.mark.parametrize("angle", [-2.0, -0.8, 0.0, 0.8, 2.0])
def test_a_place_out_of_reach_is_followed_as_near_as_possible(
    env: HandwritingEnv, limits: tuple, angle: float
) -> None:
    ahead = np.array([np.cos(angle), np.sin(angle)])
    nearest = ARM.position[:2] + REACH * ahead
    for beyond in (0.01, 0.1, 0.5, 2.0):
        place = nearest + beyond * ahead
        joints, missed = env.kinematics.nearest_joints(place)
        assert np.isfinite(joints).all()
        assert (joints >= limits[0]).all() and (joints <= limits[1]).all()
        tip = env.kinematics.tips(joints[None])[0]
        assert missed == pytest.approx(np.linalg.norm(tip - [*place, 0]))
        assert missed == pytest.approx(beyond, abs=0.005)
        np.testing.assert_allclose(tip, [*nearest, 0], atol=0.008)


@pytest.mark.parametrize("place", [(-5.0, 0.0), (0.0, 0.0), (0.22, 40.0), (1e6, -1e6)], ids=str)
def test_no_place_gives_a_nan(env: HandwritingEnv, limits: tuple, place: tuple) -> None:
    joints, missed = env.kinematics.nearest_joints(np.array(place))
    assert np.isfinite(joints).all()
    assert (joints >= limits[0]).all() and (joints <= limits[1]).all()
    tip = env.kinematics.tips(joints[None])[0]
    assert missed == pytest.approx(np.linalg.norm(tip - [*place, 0]))


def test_an_arm_too_far_away_draws_where_it_can_and_says_what_it_missed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    far = dataclasses.replace(ARM, position=(0.0, 0.0, 0.1))
    monkeypatch.setattr(z1, "ARM", far)
    env = HandwritingEnv("pen", robot="unitree_z1", control="exact")
    infos = draw(env, np.array([[0.45, 0.0], [0.5, 0.0], [0.6, 0.0], [0.5, 0.0]]))
    assert [info["beyond_reach"] for info in infos] == pytest.approx([0, 0.6 - REACH, 0], abs=1e-3)
    np.testing.assert_allclose(env.ink.strokes[0][:, 0].max(), REACH, atol=1e-3)
    _, info = env.reset(options={"start": (0.45, 0.0)})
    assert info["beyond_reach"] == 0


def test_positions_mean_the_same_for_both_arms(env: HandwritingEnv) -> None:
    panda = HandwritingEnv("pen")
    assert env.scene.regions == panda.scene.regions
    np.testing.assert_array_equal(env.scene.stroke, panda.scene.stroke)
    for place in places_on_the_sheet(3):
        for each in (env, panda):
            observation, _ = each.reset(options={"start": place})
            np.testing.assert_allclose(observation["agent_pos"], place, atol=1e-4)


@pytest.mark.parametrize("letter", LETTERS)
def test_the_arm_draws_every_letter_smoothly(env: HandwritingEnv, letter: str) -> None:
    places = evenly_spaced(make_writing_scene(letter, n_regions=0).stroke, 0.005)
    joints = env.kinematics.joint_trajectory(places)
    assert np.abs(np.diff(joints, axis=0)).max() < 0.04


@pytest.mark.slow
@pytest.mark.parametrize("letter", ["S", "W", "8"])
def test_drawing_a_letter_in_physics_is_a_success_without_a_collision(letter: str) -> None:
    env = HandwritingEnv("pen", letter, robot="unitree_z1")
    spacing = np.linspace(0, len(env.scene.stroke) - 1, 65).astype(int)
    info = draw(env, env.scene.stroke[spacing])[-1]
    assert info["is_success"] and not info["is_collision"]
    assert len(env.ink.strokes) == 1
    assert distances(env.ink.strokes[0], env.scene.stroke).max() < 0.002
    assert info["stroke_error"] < 0.001


def test_the_pen_lags_by_three_hundredths_of_a_second_and_rests_where_it_should(env: HandwritingEnv) -> None:
    places = np.stack([np.full(21, 0.45), np.linspace(-0.05, 0.05, 21)], axis=1)  # 5 cm a second
    draw(env, places)
    np.testing.assert_allclose(places[-1] - env.pen[:2], [0, 0.0015], atol=3e-4)
    for _ in range(5):
        env.step(places[-1])
    np.testing.assert_allclose(env.pen, [*places[-1], 0], atol=1e-4)


def test_a_pen_pressed_through_the_table_and_a_region_entered_are_collisions() -> None:
    env = HandwritingEnv("joint", robot="unitree_z1", control="exact")
    down = env.kinematics.joints(np.array([0.42, 0.05]), height=-0.012)
    env.reset(options={"joints": env.kinematics.joints(np.array([0.42, 0.05]), height=0.05)})
    *_, info = env.step(down)
    assert info["is_collision"]
    region = env.scene.regions[0].outline.mean(axis=0)
    env.reset(options={"joints": env.kinematics.joints(region)})
    *_, info = env.step(env.kinematics.joints(region + 0.002))
    assert info["is_collision"] and info["clearance"] < 0


@pytest.mark.slow
@pytest.mark.parametrize("task", ["HandwritingPen-v0", "HandwritingJoint-v0"])
def test_gymnasium_finds_nothing_to_complain_about(task: str) -> None:
    env = gym.make(f"lerobot_pf2mp/{task}", robot="unitree_z1", render_mode="rgb_array", render_size=64)
    check_env(env.unwrapped, skip_render_check=True)
    env.close()


def test_images_show_the_arm_from_the_side_and_its_ink() -> None:
    env = HandwritingEnv("pen", robot="unitree_z1", render_mode="rgb_array", render_size=320)
    env.reset(options={"start": (0.42, -0.1)})
    before = env.render().astype(int)
    for y in np.linspace(-0.1, 0.1, 11):
        env.step(np.array([0.42, y]))
    changed = np.abs(env.render().astype(int) - before).max(axis=-1) > 30
    assert 0.02 < changed.mean() < 0.5  # the arm moved, and left a line; the table did not move
    env.close()


def test_other_limits_and_names_are_told(env: HandwritingEnv) -> None:
    with pytest.raises(
        ValueError, match=r"7 finite positions, those of joint_1, .*, joint_6, gripper, got .*\(9,\)"
    ):
        env.check_joints(np.zeros(9), "joints")
    with pytest.raises(ValueError, match=r"limits, joint_2 in \[0, 2.96706\], got -0.1"):
        env.reset(options={"joints": np.r_[0.0, -0.1, np.zeros(5)]})


def test_the_robot_is_chosen_on_the_command_line() -> None:
    options = ["--env.type=pf2mp_handwriting", "--env.robot=unitree_z1", "--env.task=HandwritingJoint-v0"]
    config = draccus.parse(Command, args=options).env
    assert config.features["action"].shape == (7,)
    vector = config.create_envs(1)["pf2mp_handwriting"][0]
    assert vector.envs[0].unwrapped.arm.robot == "unitree_z1"
    assert vector.single_action_space.shape == (7,)
    vector.close()


@pytest.mark.slow
def test_demonstrations_have_the_right_robot_type(tmp_path: Path) -> None:
    from lerobot_pf2mp.dataset_tools.handwriting.collect_handwriting import collect_handwriting

    n_written, _ = collect_handwriting(
        "pen",
        root=tmp_path / "z1",
        repo_id="local/z1",
        n_episodes=2,
        n_steps=64,
        scene_options={"letter": "C"},
        seed=0,
        overwrite=False,
        robot="unitree_z1",
    )
    assert n_written == 2
    info = json.loads((tmp_path / "z1/meta/info.json").read_text())
    assert info["robot_type"] == "unitree_z1"
    assert "A Unitree Z1 writes" in (tmp_path / "z1/README.md").read_text()
    dataset = LeRobotDataset("local/z1", root=tmp_path / "z1")
    actions = np.stack([dataset[i]["action"].numpy() for i in range(64)])
    assert distances(actions, make_writing_scene("C").stroke).max() < 0.02


def test_a_copy_of_the_model_does_not_depend_on_the_sheet() -> None:
    model = make_writing_model(ARM, np.zeros((8, 8, 3), np.uint8))
    joints = PenKinematics(ARM, model).joints(np.array([0.4, 0.1]))
    assert joints.shape == (7,)
