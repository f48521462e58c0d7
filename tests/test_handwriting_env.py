# SPDX-License-Identifier: Apache-2.0
import importlib.metadata
import itertools
import json
import math
import re
import sys
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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
from lerobot.envs.utils import NEW_ROLLOUT_OPTION, env_to_policy_features
from lerobot.scripts.lerobot_eval import rollout
from torch import nn

from lerobot_pf2mp import PF2MPHandwritingEnv
from lerobot_pf2mp.envs.handwriting.handwriting_env import HandwritingEnv
from lerobot_pf2mp.envs.handwriting.ink import COVERED, INK_HEIGHT, LARGEST_ERROR, Ink
from lerobot_pf2mp.envs.handwriting.letters import LETTERS
from lerobot_pf2mp.envs.handwriting.panda import HOME, JOINT_NAMES
from lerobot_pf2mp.envs.handwriting.pen import PEN_TRAVEL
from lerobot_pf2mp.envs.handwriting.regions import Disc
from lerobot_pf2mp.envs.handwriting.sheet import SHEET_CENTRE, SHEET_SIDE
from lerobot_pf2mp.envs.handwriting.stroke import evenly_spaced
from lerobot_pf2mp.envs.handwriting.writing_episode import START_SPREAD
from lerobot_pf2mp.envs.handwriting.writing_model import TABLE
from lerobot_pf2mp.envs.handwriting.writing_scene import WritingScene, make_writing_scene
from lerobot_pf2mp.envs.tasks import HANDWRITING_TASKS
from lerobot_pf2mp.errors import ConfigError

SPACES = ("joint", "pen")
CONTROLS = ("exact", "physics")
N_JOINTS = len(JOINT_NAMES)
BAR = np.array([[0.42, -0.05], [0.42, 0.05]])  # a stroke, straight to the left
DISC = Disc((0.5, 0.0), 0.005)  # so small that the arm is past it within a step
LOW, HIGH = np.array(SHEET_CENTRE) - SHEET_SIDE / 2, np.array(SHEET_CENTRE) + SHEET_SIDE / 2
# Postures of the joints 2, 4 and 6 in the plane through the arm.
WRIST_ABOVE, WRIST_ON_TABLE = (0.60, -2.24, -0.97), (0.83, -2.24, -0.97)  # with the pen in the air
THROUGH_THE_TABLE = (0.81, -2.94, 0.05), (0.60, -2.06, 1.70)  # the ends are 4 cm clear of it, the way is not
CLOSE_TO_THE_TABLE = (0.10, -1.73, 0.97), (0.31, -3.00, 0.34)  # 8 cm clear, on the way less than 1 mm


def posture(joints: Sequence[float]) -> np.ndarray:
    """The arm in the plane y = 0, with its joints 2, 4 and 6."""
    q = HOME.copy()
    q[[1, 3, 5]] = joints
    return q


def file_of(folder: Path, scene: WritingScene) -> str:
    path = folder / f"{scene.name}.json"
    regions = [{"centre": region.centre, "radius": region.radius} for region in scene.regions]
    path.write_text(json.dumps({"stroke": scene.stroke.tolist(), "regions": regions}), encoding="utf-8")
    return str(path)


@pytest.fixture(scope="module")
def bar_file(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A short stroke, and a disc in the middle of the sheet."""
    return file_of(tmp_path_factory.mktemp("scenes"), WritingScene("bar", BAR, (DISC,)))


@pytest.fixture(scope="module")
def envs(bar_file: str) -> Iterator[dict[tuple[str, str, str], HandwritingEnv]]:
    """One for each space, control and scene, made once."""
    made = {
        (space, control, scene): HandwritingEnv(
            space, control=control, scene_file=bar_file if scene == "bar" else None
        )
        for space in SPACES
        for control in CONTROLS
        for scene in ("S", "bar")
    }
    yield made
    for env in made.values():
        env.close()


@pytest.fixture
def env(envs: dict, space: str, control: str) -> HandwritingEnv:
    """With the letter S."""
    return envs[space, control, "S"]


@pytest.fixture
def bar(envs: dict, space: str, control: str) -> HandwritingEnv:
    """With the disc."""
    return envs[space, control, "bar"]


@pytest.fixture(scope="module")
def exact(envs: dict) -> HandwritingEnv:
    return envs["joint", "exact", "S"]


@pytest.fixture(scope="module")
def physics(envs: dict) -> HandwritingEnv:
    return envs["joint", "physics", "S"]


@pytest.fixture(scope="module")
def exact_bar(envs: dict) -> HandwritingEnv:
    return envs["joint", "exact", "bar"]


def actions_of(env: HandwritingEnv, places: np.ndarray) -> np.ndarray:
    """The actions that move the pen to ``(N, 2)`` positions: these, or joint positions."""
    return places if env.action_space.shape == (2,) else env.kinematics.joint_trajectory(places)


def tip_of(env: HandwritingEnv, observation: dict[str, np.ndarray]) -> np.ndarray:
    """Where the pen is ``(2,)`` or ``(3,)`` [m], from what is observed."""
    measured = observation["agent_pos"].astype(np.float64)
    return measured if measured.shape == (2,) else env.kinematics.tips(measured[None])[0]


def draw(env: HandwritingEnv, places: np.ndarray) -> list[tuple]:
    """Draws the line through ``(N, 2)`` positions, from the first of them."""
    env.reset(seed=0, options={"start": places[0]})
    return [env.step(action) for action in actions_of(env, places)[1:]]


def draw_letter(env: HandwritingEnv, n_steps: int) -> list[tuple]:
    return draw(env, points_along(env.scene.stroke, n_steps + 1))


def points_along(line: np.ndarray, n: int) -> np.ndarray:
    """``(n, 2)`` positions at equal distances along a line ``(N, 2)``."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = np.linspace(0.0, length[-1], n)
    return np.stack([np.interp(at, length, line[:, axis]) for axis in (0, 1)], axis=1)


def rewards_of(steps: list[tuple]) -> list[float]:
    return [reward for _, reward, *_ in steps]


def infos_of(steps: list[tuple]) -> list[dict[str, Any]]:
    return [info for *_, info in steps]


# The arm


def test_joints_and_their_controllers_have_one_order(exact: HandwritingEnv) -> None:
    model = exact._model
    assert model.nq == model.nu == N_JOINTS
    np.testing.assert_array_equal(model.actuator_trnid[:, 0], range(N_JOINTS))
    names = [model.joint(i).name for i in range(N_JOINTS)]
    assert [name.split("_")[-1] for name in names[:7]] == [name.replace("_", "") for name in JOINT_NAMES[:7]]
    assert all("finger" in name for name in (*names[7:], *JOINT_NAMES[7:]))
    # A controller that does not reach a joint's limit would stop short of it.
    assert (model.actuator_ctrlrange[:, 0] <= model.jnt_range[:, 0]).all()
    assert (model.actuator_ctrlrange[:, 1] >= model.jnt_range[:, 1]).all()


def test_at_home_the_pen_is_nearly_upright_5_mm_below_the_middle_of_the_sheet(exact: HandwritingEnv) -> None:
    exact.check_joints(HOME, "home")
    x, y, z = exact.kinematics.tips(HOME[None])[0]
    np.testing.assert_allclose([x, y], SHEET_CENTRE, atol=0.001)
    assert z == pytest.approx(-0.005, abs=0.001)
    upright = exact.kinematics.joints(np.array([x, y]), height=z)
    np.testing.assert_allclose(HOME, upright, atol=0.003)


def test_an_arm_that_is_told_to_stay_stays(physics: HandwritingEnv) -> None:
    # Its own weight does not pull it down, and the joints have no trouble with the pen.
    for place in itertools.product((LOW[0], 0.5, HIGH[0]), (LOW[1], 0.0)):
        observation, _ = physics.reset(options={"start": place})
        at_start = observation["agent_pos"].astype(np.float64)
        for _ in range(10):
            observation, *_ = physics.step(at_start)
        np.testing.assert_allclose(observation["agent_pos"], at_start, atol=1e-5)


def test_the_pen_lags_by_three_hundredths_of_a_second_on_its_way(physics: HandwritingEnv) -> None:
    speed = 0.05  # [m/s]
    for direction in np.array([(0.0, 1.0), (1.0, 0.0), (-0.6, -0.8)]):
        places = SHEET_CENTRE + np.linspace(-0.05, 0.05, 21)[:, None] * direction
        *_, (observation, *_) = draw(physics, places)
        behind = places[-1] - tip_of(physics, observation)[:2]
        assert behind @ direction == pytest.approx(0.03 * speed, rel=0.1)
        assert abs(behind @ (direction[1], -direction[0])) < 1e-4  # the stroke is not bent


def test_limits_of_the_joints_are_checked(exact: HandwritingEnv) -> None:
    exact.check_joints(HOME, "joints")
    exact.check_joints(np.stack([HOME, HOME]), "joints")
    low, high = exact._model.jnt_range.T
    exact.check_joints(np.stack([low - 5e-5, high + 5e-5]), "joints")  # as recordings have them


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {0: np.nan},
            r"joints must be 9 finite positions, .*joint_1, .* got an array of shape \(9,\) with NaN",
        ),
        ({8: np.inf}, "joints must be 9 finite positions, .*finger_2, .* with NaN or infinity"),
        ({3: 0.1}, r"joints must be within the arm's limits, joint_4 in \[-3.0718, -0.4\], got 0.1$"),
        ({7: 0.05}, r"within the arm's limits, finger_1 in \[0, 0.04\], got 0.05$"),
        ({0: 90.0}, "joints must be in radians, got 90, which looks like degrees"),
    ],
    ids=str,
)
def test_joints_beyond_their_limits_are_refused_with_the_rule(
    exact: HandwritingEnv, changes: dict, message: str
) -> None:
    joints = HOME.copy()
    joints[list(changes)] = list(changes.values())
    with pytest.raises(ValueError, match=message):
        exact.check_joints(joints, "joints")
    with pytest.raises(ValueError, match=message):
        exact.reset(options={"joints": joints})


def test_the_row_of_joints_beyond_their_limits_is_named(exact: HandwritingEnv) -> None:
    with pytest.raises(ValueError, match=r"actions must be .* joint_1 in .* got -3 in row 2$"):
        exact.check_joints(np.array([HOME, HOME, np.r_[-3.0, HOME[1:]], HOME]), "actions")
    with pytest.raises(ValueError, match=r"got an array of shape \(4, 7\)$"):
        exact.check_joints(np.zeros((4, 7)), "actions")


# Kinematics


@pytest.mark.parametrize("height", [-0.03, 0.0, 0.05])
def test_joints_for_a_position_hold_the_pen_there_upright(exact: HandwritingEnv, height: float) -> None:
    data = mujoco.MjData(exact._model)
    for place in itertools.product(np.linspace(LOW[0], HIGH[0], 5), np.linspace(LOW[1], HIGH[1], 5)):
        joints = exact.kinematics.joints(np.array(place), height=height)
        exact.check_joints(joints, "joints")
        np.testing.assert_allclose(exact.kinematics.tips(joints[None])[0], [*place, height], atol=1e-4)
        data.qpos[:] = joints
        mujoco.mj_forward(exact._model, data)
        np.testing.assert_allclose(data.site("pen_tip").xpos, [*place, height], atol=1e-4)
        np.testing.assert_allclose(data.site("pen_tip").xmat[[2, 5, 8]], [0, 0, -1], atol=1e-4)


def test_joints_for_a_position_are_those_next_to_home(exact: HandwritingEnv) -> None:
    # The way to them from home has no part along which the arm can move and the pen stay.
    data, jacobian = mujoco.MjData(exact._model), np.zeros((6, N_JOINTS))
    for place in itertools.product((LOW[0], 0.5, HIGH[0]), (LOW[1], 0.06, HIGH[1])):
        data.qpos[:] = joints = exact.kinematics.joints(np.array(place))
        mujoco.mj_forward(exact._model, data)
        site = exact._model.site("pen_tip").id
        mujoco.mj_jacSite(exact._model, data, jacobian[:3], jacobian[3:], site)
        *_, free = np.linalg.svd(jacobian[:, :7])[2]
        assert free @ (joints - HOME)[:7] == pytest.approx(0, abs=1e-3)
        assert np.abs(jacobian[:, :7] @ free).max() < 1e-9


def test_joints_for_a_position_do_not_depend_on_what_was_asked_before(exact: HandwritingEnv) -> None:
    rng = np.random.default_rng(0)
    for _ in range(30):
        place = rng.uniform(LOW, HIGH)
        joints = exact.kinematics.joints(place)
        exact.kinematics.joints(rng.uniform(LOW, HIGH))
        assert np.array_equal(exact.kinematics.joints(place), joints)


@pytest.mark.parametrize(
    ("place", "height"), [((1.2, 0.0), 0.0), ((0.05, 0.0), 0.0), ((0.5, 0.0), 1.5)], ids=str
)
def test_positions_out_of_reach_are_refused(exact: HandwritingEnv, place: tuple, height: float) -> None:
    message = re.escape(f"the arm must reach the pen's position x, y [m], got {list(place)}")
    with pytest.raises(ValueError, match=message):
        exact.kinematics.joints(np.array(place), height=height)
    if height == 0:
        with pytest.raises(ValueError, match=message):
            exact.kinematics.joint_trajectory(np.array([SHEET_CENTRE, place]))


@pytest.mark.parametrize("letter", LETTERS)
def test_the_arm_draws_every_letter_smoothly_and_within_its_limits(
    exact: HandwritingEnv, letter: str
) -> None:
    places = evenly_spaced(make_writing_scene(letter, n_regions=0).stroke, 0.005)
    joints = exact.kinematics.joint_trajectory(places)
    low, high = exact._model.jnt_range.T
    assert np.minimum(joints - low, high - joints)[:, :7].min() > 0.3
    assert np.abs(np.diff(joints, axis=0)).max() < 0.025
    np.testing.assert_allclose(exact.kinematics.tips(joints), np.c_[places, np.zeros(len(places))], atol=1e-4)


# Ink


def scene_with(stroke: np.ndarray, *regions: Disc) -> WritingScene:
    return WritingScene("mine", evenly_spaced(stroke, 0.001), regions)


def on_paper(places: np.ndarray, height: float = 0.0) -> np.ndarray:
    """``(N, 3)`` positions of the pen above ``(N, 2)`` positions on the sheet."""
    return np.c_[places, np.full(len(places), height)]


def parallel_to_bar(gap: float, ends: tuple[float, float] = (-0.05, 0.05)) -> np.ndarray:
    """Places beside the bar, 1 mm apart."""
    return evenly_spaced(np.array([[0.42 + gap, ends[0]], [0.42 + gap, ends[1]]]), 0.001)


def test_a_lifted_pen_draws_nothing_and_enters_no_region() -> None:
    ink = Ink(scene_with(BAR, DISC))
    over_the_disc = np.array([[0.45, 0.0], [0.5, 0.0], [0.55, 0.0]])
    assert ink.draw(on_paper(over_the_disc, INK_HEIGHT + 1e-6)) == math.inf
    assert ink.strokes == []
    assert ink.length == 0
    assert ink.error == math.inf
    assert not ink.is_success
    assert ink.draw(on_paper(over_the_disc, INK_HEIGHT - 1e-6)) == pytest.approx(-DISC.radius)
    assert ink.length == pytest.approx(0.1)


def test_a_pen_pressed_onto_the_table_draws_at_every_depth() -> None:
    for depth in np.linspace(0, PEN_TRAVEL, 11):
        ink = Ink(scene_with(BAR, DISC))
        assert ink.draw(on_paper(np.array([[0.45, 0.0], [0.55, 0.0]]), -depth)) < 0
        assert ink.length == pytest.approx(0.1)


def test_a_new_stroke_begins_after_a_lift_and_the_path_between_is_not_drawn() -> None:
    ink = Ink(scene_with(BAR, DISC))
    tips = np.array(
        [
            *on_paper(np.array([[0.40, 0.0], [0.41, 0.0], [0.42, 0.0]])),
            *on_paper(np.array([[0.44, 0.0], [0.56, 0.0]]), 0.02),
            *on_paper(np.array([[0.58, 0.0], [0.58, 0.03]])),
        ]
    )
    assert ink.draw(tips) == pytest.approx(0.5 - 0.42 - DISC.radius)
    assert len(ink.strokes) == 2
    np.testing.assert_array_equal(ink.strokes[0], tips[:3, :2])
    np.testing.assert_array_equal(ink.strokes[1], tips[5:, :2])
    assert ink.length == pytest.approx(0.02 + 0.03)


def test_a_path_in_several_parts_leaves_the_same_ink_as_in_one() -> None:
    rng = np.random.default_rng(0)
    tips = np.array([0.45, 0.0, 0.0]) + np.cumsum(rng.normal(0, 0.004, size=(200, 3)), axis=0)
    tips[:, 2] = 0.02 + 0.02 * np.sin(np.arange(200) / 6)  # down every 38 positions
    whole, parts = Ink(scene_with(BAR, DISC)), Ink(scene_with(BAR, DISC))
    clearance = whole.draw(tips)
    ends = [0, 1, 27, 28, 40, 66, 90, 141, 199]  # some of them while it draws
    clearances = [parts.draw(tips[start : end + 1]) for start, end in itertools.pairwise(ends)]
    assert min(clearances) == pytest.approx(clearance)
    assert len(whole.strokes) == len(parts.strokes) > 4
    for left, right in zip(whole.strokes, parts.strokes, strict=True):
        np.testing.assert_array_equal(left, right)
    assert parts.length == pytest.approx(whole.length)
    assert parts.error == pytest.approx(whole.error, rel=0.01)


def test_the_error_is_the_mean_distance_of_the_ink_to_the_letter() -> None:
    ways = {
        "beside": (parallel_to_bar(0.004), 0.004),
        "on it": (parallel_to_bar(0.0), 0.0),
        "beyond its end": (parallel_to_bar(0.0, ends=(0.05, 0.09)), 0.02),
        "away from it": (np.array([[0.42, 0.0], [0.48, 0.0]]), 0.03),
        "across it": (np.array([[0.40, 0.0], [0.44, 0.0]]), 0.01),
    }
    for way, expected in ways.values():
        ink = Ink(scene_with(BAR))
        ink.draw(on_paper(way))
        # It is measured once for each millimetre, at its end.
        assert ink.error == pytest.approx(expected, abs=0.0006)


def test_the_error_of_a_letter_is_that_of_a_dense_sample() -> None:
    rng = np.random.default_rng(0)
    scene = make_writing_scene("S")
    ink = Ink(scene)
    places = scene.stroke[::8] + rng.normal(0, 0.005, size=(len(scene.stroke[::8]), 2))
    ink.draw(on_paper(places))
    dense = points_along(places, 20000)
    nearest = [np.linalg.norm(scene.stroke - place, axis=1).min() for place in dense]
    assert ink.error == pytest.approx(np.mean(nearest), rel=0.02)
    assert ink.length == pytest.approx(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())


def test_the_error_does_not_depend_on_how_long_the_pen_rests() -> None:
    way = np.array([[0.42, 0.0], [0.42, 0.05], [0.46, 0.05]])
    ink = Ink(scene_with(BAR))
    ink.draw(on_paper(way))
    error = ink.error
    assert error == pytest.approx(0.02 * 0.04 / 0.09, abs=0.0006)
    rng = np.random.default_rng(0)
    last = way[-1]
    for _ in range(200):  # an arm at rest trembles by nanometres
        trembling = last + rng.normal(0, 1e-9, size=2)
        ink.draw(on_paper(np.array([last, trembling])))
        last = trembling
    assert ink.error == pytest.approx(error, abs=1e-6)


def test_the_error_does_not_depend_on_the_speed() -> None:
    slow, fast = Ink(scene_with(BAR)), Ink(scene_with(BAR))
    on_it, beside = parallel_to_bar(0.0), parallel_to_bar(0.008)
    for places in (on_it, beside):
        fast.draw(on_paper(places))
        slow_ones = points_along(places, 4 * len(places)) if places is beside else places
        for start, end in itertools.pairwise(slow_ones):
            slow.draw(on_paper(np.array([start, end])))
        slow.draw(on_paper(places[-1:], 0.02))  # lifts it
        fast.draw(on_paper(places[-1:], 0.02))
    assert fast.error == pytest.approx(0.004, abs=1e-4)
    assert slow.error == pytest.approx(fast.error, abs=1e-4)


@pytest.mark.parametrize(
    ("gap", "success"),
    [(0.0, True), (0.009, True), (0.0101, False), (0.014, False), (-0.009, True), (-0.0101, False)],
)
def test_success_needs_ink_within_a_centimetre_of_the_letter_on_the_mean(gap: float, success: bool) -> None:
    assert LARGEST_ERROR == 0.01
    ink = Ink(scene_with(BAR))
    ink.draw(on_paper(parallel_to_bar(gap)))
    assert ink.error == pytest.approx(abs(gap), abs=1e-6)
    assert ink.is_success == success


def test_success_needs_the_whole_letter() -> None:
    assert COVERED == 0.015
    for ends, success in [((-0.05, 0.05), True), ((-0.036, 0.036), True), ((-0.05, 0.034), False)]:
        ink = Ink(scene_with(BAR))
        ink.draw(on_paper(parallel_to_bar(0.0, ends)))
        assert ink.is_success == success
    ink = Ink(scene_with(BAR))
    for ends, success in [((-0.05, -0.02), False), ((0.05, 0.02), False), ((0.0, 0.01), True)]:
        ink.draw(on_paper(parallel_to_bar(0.0, ends)))  # in any order and direction
        ink.draw(on_paper(np.array(SHEET_CENTRE)[None], 0.02))
        assert ink.is_success == success
    assert len(ink.strokes) == 3


def test_scribbling_over_the_sheet_is_no_success() -> None:
    ink = Ink(make_writing_scene("S"))
    lines = np.array([[x, y] for x in np.arange(0.42, 0.58, 0.01) for y in (-0.1, 0.1)])
    lines[2::4], lines[3::4] = lines[3::4].copy(), lines[2::4].copy()  # there and back
    ink.draw(on_paper(lines))
    assert ink._is_covered.all()
    assert ink.error > LARGEST_ERROR
    assert not ink.is_success


# Gymnasium


@pytest.mark.slow
@pytest.mark.parametrize(
    ("control", "render_mode"), [("exact", None), ("physics", None), ("physics", "rgb_array")]
)
@pytest.mark.parametrize("task", HANDWRITING_TASKS)
def test_gymnasium_finds_nothing_to_complain_about(task: str, control: str, render_mode: str | None) -> None:
    env = gym.make(f"lerobot_pf2mp/{task}", control=control, render_mode=render_mode, render_size=64)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Positions in radians and metres cannot follow the first; a pen may be pushed anywhere.
        warnings.filterwarnings("ignore", message=".*we recommend using a symmetric and normalized space")
        warnings.filterwarnings("ignore", message=".*A Box observation space (minimum|maximum) value is")
        check_env(env.unwrapped, skip_render_check=render_mode is None)
    env.close()


@pytest.mark.parametrize(("task", "space"), HANDWRITING_TASKS.items())
def test_every_task_is_its_space_for_64_steps(task: str, space: str) -> None:
    env = gym.make(f"lerobot_pf2mp/{task}", control="exact")
    assert env.spec.max_episode_steps == 64
    assert env.unwrapped.task == f"handwriting-{space}"
    assert env.unwrapped.task_description == "Write S without entering a red region."
    assert env.unwrapped.metadata["render_fps"] == 10
    if space == "joint":
        np.testing.assert_allclose(
            [env.action_space.low, env.action_space.high], env.unwrapped._model.jnt_range.T, rtol=1e-6
        )
    else:
        np.testing.assert_allclose([env.action_space.low, env.action_space.high], [LOW, HIGH], rtol=1e-6)
    observation, info = env.reset(seed=0)
    assert observation["agent_pos"].shape == env.action_space.shape
    assert observation["agent_pos"].dtype == np.float32
    for step in range(64):
        observation, reward, terminated, truncated, info = env.step(observation["agent_pos"])
        assert not terminated
        assert truncated == (step == 63)
    kinds = {key: type(value) for key, value in info.items()}
    assert kinds == {
        "is_success": bool,
        "is_collision": bool,
        "clearance": float,
        "stroke_error": float,
        "beyond_reach": float,
        "path_length": float,
    }
    assert type(reward) is float
    env.close()


def rolled_out(env: HandwritingEnv, seed: int, render: bool = False) -> list[tuple]:
    observation, info = env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    steps = [(*observation.values(), *info.values())]
    spread = 0.1 if env.action_space.shape == (N_JOINTS,) else 0.03
    for number in range(15):
        target = observation["agent_pos"] + rng.uniform(-spread, spread, size=env.action_space.shape)
        observation, reward, terminated, truncated, info = env.step(target)
        steps.append((*observation.values(), reward, terminated, truncated, *info.values()))
        if render and number % 5 == 0:
            env.render()
    return steps


def assert_same(first: list[tuple], second: list[tuple]) -> None:
    for left, right in zip(first, second, strict=True):
        for a, b in zip(left, right, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.slow
@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("space", SPACES)
def test_the_same_seed_gives_the_same_rollout_and_another_seed_another(
    env: HandwritingEnv, space: str, control: str
) -> None:
    # A new environment that renders images between the steps, and one that has been used.
    new = HandwritingEnv(space, control=control, render_mode="rgb_array", render_size=32)
    first = rolled_out(new, 3, render=True)
    assert_same(first, rolled_out(env, 3))
    other = rolled_out(env, 4)
    assert not np.array_equal(first[0][0], other[0][0])
    assert_same(first, rolled_out(new, 3))
    new.close()


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("space", SPACES)
def test_episodes_start_on_the_table_beside_the_beginning_of_the_letter(env: HandwritingEnv) -> None:
    offsets = []
    for seed in range(25):
        observation, info = env.reset(seed=seed)
        tip = tip_of(env, observation)
        offsets.append(tip[:2] - env.scene.stroke[0])
        assert not info["is_collision"]
        assert not info["is_success"]
        assert info["path_length"] == 0
        assert info["stroke_error"] == math.inf
        if len(tip) == 3:
            assert tip[2] == pytest.approx(0, abs=1e-4)
            upright = env.kinematics.joints(tip[:2])
            np.testing.assert_allclose(observation["agent_pos"], upright, atol=1e-4)
    offsets = np.array(offsets)
    assert START_SPREAD == 0.005
    assert np.abs(offsets).max() <= START_SPREAD + 1e-5
    assert (offsets.min(axis=0) < -0.6 * START_SPREAD).all()
    assert (offsets.max(axis=0) > 0.6 * START_SPREAD).all()


def test_letters_as_large_as_the_sheet_can_be_started() -> None:
    env = HandwritingEnv("pen", "L", letter_height=SHEET_SIDE, control="exact")
    for seed in range(10):
        observation, _ = env.reset(seed=seed)
        tip = observation["agent_pos"]
        assert np.abs(tip - env.scene.stroke[0]).max() <= START_SPREAD + 1e-5
        assert ((tip >= LOW - 1e-5) & (tip <= HIGH + 1e-5)).all()
    env.close()


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("space", SPACES)
def test_reset_puts_the_pen_where_the_options_say(env: HandwritingEnv) -> None:
    for start in [(0.5, 0.0), LOW, HIGH, [0.4, 0.13]]:
        env.reset(seed=0)
        observation, info = env.reset(options={"start": start})
        np.testing.assert_allclose(tip_of(env, observation)[:2], start, atol=1e-4)
        assert info["path_length"] == 0
        # At rest: told to stay, it stays.
        observation, *_ = env.step(actions_of(env, np.array([start]))[0])
        np.testing.assert_allclose(tip_of(env, observation)[:2], start, atol=1e-4)


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("space", SPACES)
def test_reset_puts_the_joints_where_the_options_say(env: HandwritingEnv, space: str) -> None:
    rng = np.random.default_rng(0)
    above = env.kinematics.joints(np.array(SHEET_CENTRE), height=0.1)
    for _ in range(5):
        joints = above + np.r_[rng.uniform(-0.1, 0.1, size=7), rng.uniform(-0.007, 0.007, size=2)]
        observation, info = env.reset(options={"joints": joints.tolist()})
        tip = env.kinematics.tips(joints[None])[0]
        expected = joints if space == "joint" else tip[:2]
        np.testing.assert_allclose(observation["agent_pos"], expected, atol=1e-6)
        assert not info["is_collision"]


def test_an_option_that_is_none_is_left_out(exact: HandwritingEnv) -> None:
    expected, _ = exact.reset(seed=7)
    # LeRobot adds one of its own.
    for options in ({"start": None, "joints": None}, {NEW_ROLLOUT_OPTION: True}, {}):
        observation, _ = exact.reset(seed=7, options=options)
        np.testing.assert_array_equal(observation["agent_pos"], expected["agent_pos"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"start": (0.5, np.nan)}, r"start must be finite positions x, y \[m\], got"),
        ({"start": (0.5,)}, r"start must be finite positions x, y \[m\], got"),
        ({"start": (0.5, 0.0, 0.0)}, r"start must be finite positions x, y \[m\], got"),
        ({"start": ((0.5, 0.0), (0.5, 0.1))}, "start must be"),
        ({"start": (0.5, 0.17)}, r"start must lie on the sheet, .* got \[0.5, 0.17\]"),
        ({"joints": HOME[:7]}, r"joints must be 9 finite positions, .* got an array of shape \(7,\)"),
        ({"joints": np.array([HOME, HOME])}, r"joints must be 9 finite positions.* \(2, 9\)"),
        ({"joints": HOME[None]}, r"joints must be 9 finite positions.* \(1, 9\)"),
    ],
    ids=lambda value: str(value).replace("\n", ""),
)
def test_options_that_are_no_start_are_refused_with_the_rule(
    exact: HandwritingEnv, options: dict, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        exact.reset(seed=0, options=options)


def test_a_step_or_an_image_before_the_first_reset_is_refused() -> None:
    env = HandwritingEnv("pen", render_mode="rgb_array", render_size=32)
    with pytest.raises(gym.error.ResetNeeded, match="reset"):
        env.step(np.array(SHEET_CENTRE))
    with pytest.raises(gym.error.ResetNeeded, match="reset"):
        env.render()
    env.close()


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("space", SPACES)
def test_actions_that_are_not_finite_positions_are_refused(env: HandwritingEnv, space: str) -> None:
    n = 9 if space == "joint" else 2
    env.reset(seed=0)
    for action in (
        np.full(n, np.nan),
        np.r_[np.full(n - 1, 0.5), np.inf],
        np.full(n + 1, 0.5),
        np.full(11 - n, 0.5),  # of the other space
        np.full((1, n), 0.5),
        np.array(0.5),
    ):
        with pytest.raises(ValueError, match=f"an action must be {n} finite positions, got "):
            env.step(action)


# Control


def test_exact_joints_reach_every_action(exact: HandwritingEnv) -> None:
    exact.reset(seed=0)
    exact.action_space.seed(0)
    for _ in range(20):
        action = exact.action_space.sample()
        observation, *_ = exact.step(action)
        np.testing.assert_array_equal(observation["agent_pos"], action)


@pytest.mark.slow
def test_an_exact_pen_reaches_every_position_on_the_sheet_from_every_other(envs: dict) -> None:
    env = envs["pen", "exact", "S"]
    corners = [np.array(corner) for corner in itertools.product(*zip(LOW, HIGH, strict=True))]
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    for place in [*corners, *corners[::-1], *rng.uniform(LOW, HIGH, size=(150, 2))]:
        observation, *_ = env.step(place)
        np.testing.assert_allclose(observation["agent_pos"], place, atol=1e-4)


def test_a_pen_reaches_its_position_from_every_posture(envs: dict) -> None:
    env = envs["pen", "exact", "S"]
    rng = np.random.default_rng(0)
    for _ in range(5):
        env.reset(options={"joints": rng.uniform(*env._model.jnt_range.T)})
        observation, *_ = env.step(np.array(SHEET_CENTRE))
        np.testing.assert_allclose(observation["agent_pos"], SHEET_CENTRE, atol=1e-4)


def test_the_pen_space_is_the_joint_space_with_kinematics_in_between(envs: dict) -> None:
    for control in CONTROLS:
        joint, pen = envs["joint", control, "S"], envs["pen", control, "S"]
        places = points_along(pen.scene.stroke, 41)[:15]
        for left, right in zip(draw(joint, places), draw(pen, places), strict=True):
            np.testing.assert_allclose(
                tip_of(joint, left[0])[:2], tip_of(pen, right[0]), atol=1e-6 if control == "exact" else 1e-5
            )
            assert left[-1]["path_length"] == pytest.approx(right[-1]["path_length"], abs=1e-5)


def test_physics_follow_a_slow_stroke_within_a_millimetre(physics: HandwritingEnv) -> None:
    places = points_along(physics.scene.stroke, 321)[:161]  # 13 mm/s over the upper half of the letter
    steps = draw(physics, places)
    for place, (observation, *_) in zip(places[1:], steps, strict=True):
        np.testing.assert_allclose(tip_of(physics, observation), [*place, 0.0], atol=0.001)
    assert infos_of(steps)[-1]["stroke_error"] < 1e-4
    length = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
    assert infos_of(steps)[-1]["path_length"] == pytest.approx(length, abs=0.001)
    last = actions_of(physics, places[-1:])[0]
    for _ in range(10):  # and arrive
        observation, *_ = physics.step(last)
    np.testing.assert_allclose(observation["agent_pos"], last, atol=1e-4)


def test_two_steps_at_twice_the_frequency_are_one_step() -> None:
    slow, fast = HandwritingEnv(fps=10), HandwritingEnv(fps=20)
    places = points_along(slow.scene.stroke, 61)[:10]
    joints = slow.kinematics.joint_trajectory(places)
    for env in (slow, fast):
        env.reset(seed=0, options={"joints": joints[0]})
    for before, after in itertools.pairwise(joints):
        *_, info = slow.step(after)
        fast.step((before + after) / 2)
        *_, again = fast.step(after)
        np.testing.assert_allclose(fast._data.qpos, slow._data.qpos, atol=1e-9)
        assert again["path_length"] == pytest.approx(info["path_length"], rel=1e-3)
    assert fast._data.time == pytest.approx(0.9)
    slow.close()
    fast.close()


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("space", SPACES)
def test_actions_beyond_the_limits_are_moved_to_them(env: HandwritingEnv, control: str) -> None:
    low, high = env.action_space.low, env.action_space.high
    for beyond, limit in ((high + 10, high), (low - 1e6, low)):
        ends = []
        for action in (beyond, limit):
            env.reset(seed=0)
            observation, *outcome = env.step(action)
            ends.append((observation["agent_pos"], *outcome[:3], *outcome[3].values()))
        assert_same(ends[:1], ends[1:])
        if control == "exact":
            np.testing.assert_allclose(ends[0][0], limit, atol=1e-4)


def test_wild_actions_leave_everything_finite(physics: HandwritingEnv) -> None:
    physics.reset(seed=0)
    physics.action_space.seed(0)
    low, high = physics._model.jnt_range.T
    for _ in range(40):
        observation, *_, info = physics.step(physics.action_space.sample())
        assert (observation["agent_pos"] > low - 0.05).all()
        assert (observation["agent_pos"] < high + 0.05).all()
        assert np.isfinite(info["clearance"])
    assert not physics._data.warning.number.any()


# Collisions


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("space", SPACES)
def test_a_region_crossed_between_two_actions_is_a_collision(bar: HandwritingEnv) -> None:
    start, end = np.array([[0.47, 0.0], [0.53, 0.0]])
    _, info = bar.reset(options={"start": start})
    assert not info["is_collision"]
    observation, reward, _, _, info = bar.step(actions_of(bar, end[None])[0])
    assert math.dist(tip_of(bar, observation)[:2], DISC.centre) > DISC.radius + 0.005  # past it
    assert info["is_collision"]
    assert reward == -1
    assert info["clearance"] == pytest.approx(-DISC.radius, abs=3e-4)


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("space", SPACES)
def test_a_path_around_a_region_is_no_collision(bar: HandwritingEnv) -> None:
    around = np.array([[0.47, 0.0], [0.485, 0.012], [0.5, 0.015], [0.515, 0.012], [0.53, 0.0]])
    steps = draw(bar, points_along(around, 21))
    assert sum(rewards_of(steps)) == 0
    assert not any(info["is_collision"] for info in infos_of(steps))
    assert 0 < min(info["clearance"] for info in infos_of(steps)) < 0.01


@pytest.mark.parametrize("control", CONTROLS)
def test_a_lifted_pen_passes_over_a_region_and_draws_nothing(envs: dict, control: str) -> None:
    env = envs["joint", control, "bar"]
    for height in (INK_HEIGHT + 0.001, 0.03):
        env.reset(options={"joints": env.kinematics.joints(np.array([0.45, 0.0]), height=height)})
        for x in np.linspace(0.46, 0.55, 10):
            *_, info = env.step(env.kinematics.joints(np.array([x, 0.0]), height=height))
        assert not info["is_collision"]
        assert info["path_length"] == 0
        assert info["stroke_error"] == math.inf
        assert env.ink.strokes == []


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("depth", [0.0, 0.004, 0.006, 0.009, 0.012])
def test_a_pen_pressed_onto_the_table_does_not_cross_a_region_unseen(
    envs: dict, control: str, depth: float
) -> None:
    env = envs["joint", control, "bar"]
    env.reset(options={"joints": env.kinematics.joints(np.array([0.47, 0.0]), height=-depth)})
    for x in np.linspace(0.48, 0.53, 6):
        *_, info = env.step(env.kinematics.joints(np.array([x, 0.0]), height=-depth))
    assert info["is_collision"]


def test_a_jump_across_the_sheet_does_not_pass_a_region_unseen(envs: dict) -> None:
    # The joints move evenly, which lifts the pen on the way.
    env = envs["pen", "exact", "bar"]
    for start, end in itertools.permutations(((0.36, 0.0), (0.64, 0.0))):
        env.reset(options={"start": start})
        *_, info = env.step(np.array(end))
        assert info["is_collision"]


@pytest.mark.parametrize("control", CONTROLS)
def test_a_pen_pressed_through_the_table_collides_with_its_barrel(envs: dict, control: str) -> None:
    env = envs["joint", control, "S"]
    place = np.array([0.45, 0.12])  # far from the regions
    for depth, collides in ((0.008, False), (0.013, True), (0.03, True)):
        env.reset(options={"start": place})
        steps = [env.step(env.kinematics.joints(place, height=-depth)) for _ in range(4)]
        assert steps[-1][-1]["is_collision"] == collides
        assert sum(rewards_of(steps)) == -collides
        assert (steps[-1][-1]["clearance"] < 0) == collides


def test_a_touch_that_ends_before_the_control_step_does_is_a_collision(physics: HandwritingEnv) -> None:
    place = np.array([0.45, 0.12])
    physics.reset(options={"joints": physics.kinematics.joints(place, height=-PEN_TRAVEL - 0.003)})
    _, reward, _, _, info = physics.step(physics.kinematics.joints(place, height=0.05))
    assert lowest_point(physics)[2] > 0.01
    assert info["is_collision"]
    assert info["clearance"] < 0
    assert reward == -1


@pytest.mark.parametrize("control", CONTROLS)
def test_a_wrist_on_the_table_is_a_collision(envs: dict, control: str) -> None:
    env = envs["joint", control, "S"]
    _, info = env.reset(options={"joints": posture(WRIST_ABOVE)})
    assert info["clearance"] > 0.03
    steps = [env.step(posture(WRIST_ON_TABLE)) for _ in range(5)]
    assert sum(rewards_of(steps)) == -1
    assert infos_of(steps)[-1]["is_collision"]
    assert infos_of(steps)[-1]["clearance"] < 0
    assert infos_of(steps)[-1]["path_length"] == 0  # the pen is in the air


def test_a_path_through_the_table_collides_though_both_its_ends_are_free(exact: HandwritingEnv) -> None:
    start, end = map(posture, THROUGH_THE_TABLE)
    for first, second in ((start, end), (end, start)):
        _, info = exact.reset(options={"joints": first})
        assert info["clearance"] > 0.03
        _, reward, _, _, info = exact.step(second)
        assert info["is_collision"]
        assert info["clearance"] < 0
        assert reward == -1
        assert exact.reset(options={"joints": second})[1]["clearance"] > 0.03


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("space", SPACES)
def test_the_reward_is_minus_one_once_for_each_episode_with_a_collision(bar: HandwritingEnv) -> None:
    free, region = (0.47, 0.0), (0.515, 0.0)  # across the disc
    for places, expected in [
        ([free, free, free], [0, 0, 0]),
        ([free, region, region, free, region], [0, -1, 0, 0, 0]),
        ([region, free], [-1, 0]),
        ([free, free], [0, 0]),
    ]:
        _, info = bar.reset(options={"start": free})
        assert not info["is_collision"]
        rewards = []
        for place in places:
            _, reward, terminated, truncated, info = bar.step(actions_of(bar, np.array([place]))[0])
            rewards.append(reward)
            assert not terminated  # a collision does not end the episode
            assert not truncated
            assert sum(rewards) == -info["is_collision"]
        assert rewards == expected


def test_random_episodes_earn_minus_their_collision(envs: dict) -> None:
    env = envs["pen", "exact", "S"]
    rng = np.random.default_rng(0)
    sums = []
    for seed in range(12):
        observation, _ = env.reset(seed=seed)
        total = 0.0
        for _ in range(10):
            place = observation["agent_pos"] + rng.normal(0, 0.01, size=2)
            observation, reward, _, _, info = env.step(place)
            total += reward
        assert total == -info["is_collision"]
        sums.append(total)
    assert set(sums) == {0.0, -1.0}


# Clearance


def lowest_point(env: HandwritingEnv) -> np.ndarray:
    """The lowest point ``(3,)`` of arm and pen [m], from model and state alone."""
    model, data = env._model, env._data
    base = model.body("panda0_link0").id
    lowest = np.array([0.0, 0.0, np.inf])
    for geom in range(model.ngeom):
        solid = model.geom_contype[geom] or model.geom_conaffinity[geom]
        if model.geom_bodyid[geom] <= base or not solid:
            continue
        size = model.geom_size[geom]
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.geom_dataid[geom]
            first = model.mesh_vertadr[mesh]
            points = model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(float)
        elif model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
            points = np.array(list(itertools.product(*[(-side, side) for side in size])))
        else:
            assert model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE
            points = np.array([[0, 0, -size[1]], [0, 0, size[1]]])
        points = points @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE:
            points[:, 2] -= size[0]
        below = points[points[:, 2].argmin()]
        lowest = min(lowest, below, key=lambda point: point[2])
    return lowest


def test_the_clearance_of_an_arm_in_the_air_is_the_height_of_its_lowest_point(exact: HandwritingEnv) -> None:
    rng = np.random.default_rng(0)
    table = exact._model.geom(TABLE)
    centre, half = np.array(table.pos), np.array(table.size)
    assert centre[2] + half[2] == 0
    above = exact.kinematics.joints(np.array(SHEET_CENTRE), height=0.1)
    heights = []
    for _ in range(150):
        tilted = above + rng.uniform(-1, 1, size=N_JOINTS) * [0.3, 0.2, 0.3, 0.3, 0.5, 0.9, 1, 0, 0]
        tilted = tilted.clip(*exact._model.jnt_range.T)
        _, info = exact.reset(options={"joints": tilted})
        lowest = lowest_point(exact)
        if (np.abs(lowest - centre)[:2] > half[:2]).any() or not 0.006 < lowest[2] < 0.19:
            continue
        heights.append(lowest[2])
        assert info["clearance"] == pytest.approx(lowest[2], abs=1e-4)
    assert len(heights) > 60
    assert min(heights) < 0.03


def test_the_clearance_of_an_upright_pen_is_that_of_its_barrel(exact: HandwritingEnv) -> None:
    for height in (0.05, 0.012, 0.006, 0.0):
        joints = exact.kinematics.joints(np.array([0.45, 0.12]), height=height)
        _, info = exact.reset(options={"joints": joints})
        assert info["clearance"] == pytest.approx(PEN_TRAVEL + height, abs=1e-5)


def test_the_clearance_of_ink_is_its_distance_to_the_nearest_region(exact_bar: HandwritingEnv) -> None:
    rng = np.random.default_rng(0)
    n_near = 0
    for _ in range(40):
        angle, distance = rng.uniform(0, 2 * np.pi), rng.uniform(0.0, 0.014)
        start = np.array(DISC.centre) + distance * np.array([np.cos(angle), np.sin(angle)])
        end = start + rng.normal(0, 0.004, size=2)
        (*_, info), *_ = draw(exact_bar, np.array([start, end]))
        dense = start + np.linspace(0, 1, 1000)[:, None] * (end - start)
        expected = np.linalg.norm(dense - DISC.centre, axis=1).min() - DISC.radius
        assert info["clearance"] == pytest.approx(min(expected, PEN_TRAVEL), abs=1e-4)
        assert info["is_collision"] == (expected < 0)
        n_near += 0 < expected < PEN_TRAVEL
    assert n_near > 10


def test_the_clearance_of_a_step_is_the_smallest_on_its_way(exact: HandwritingEnv) -> None:
    start, end = map(posture, CLOSE_TO_THE_TABLE)
    at_ends = [exact.reset(options={"joints": joints})[1]["clearance"] for joints in (start, end)]
    on_the_way = [
        exact.reset(options={"joints": start + share * (end - start)})[1]["clearance"]
        for share in np.linspace(0, 1, 200)
    ]
    assert 0 < min(on_the_way) < 0.001
    assert min(at_ends) > 0.08
    exact.reset(options={"joints": start})
    *_, info = exact.step(end)
    assert not info["is_collision"]
    assert info["clearance"] == pytest.approx(min(on_the_way), abs=0.001)


# Success, error, path length


@pytest.mark.parametrize("letter", LETTERS)
def test_drawing_a_letter_exactly_is_a_success_without_a_collision(letter: str) -> None:
    env = HandwritingEnv("joint", letter, control="exact")
    steps = draw_letter(env, 64)
    assert sum(rewards_of(steps)) == 0
    info = infos_of(steps)[-1]
    assert info["is_success"]
    assert not info["is_collision"]
    assert info["stroke_error"] < 2e-4
    length = np.linalg.norm(np.diff(env.scene.stroke, axis=0), axis=1).sum()
    assert info["path_length"] == pytest.approx(length, rel=0.02)
    assert not infos_of(steps)[50]["is_success"]  # not before its end
    env.close()


@pytest.mark.parametrize("letter", ["S", "N"])
@pytest.mark.parametrize("space", SPACES)
def test_drawing_a_letter_in_physics_is_a_success_without_a_collision(space: str, letter: str) -> None:
    env = HandwritingEnv(space, letter)
    steps = draw_letter(env, 64)
    assert sum(rewards_of(steps)) == 0
    info = infos_of(steps)[-1]
    assert info["is_success"]
    assert not info["is_collision"]
    assert info["stroke_error"] < 3e-4
    assert min(info["clearance"] for info in infos_of(steps)) > 0.005
    env.close()


def test_success_comes_with_the_last_part_of_the_letter_and_goes_with_too_much_ink(envs: dict) -> None:
    env = envs["pen", "exact", "bar"]
    steps = draw(env, np.array([[0.42, y] for y in (-0.05, 0.0, 0.03, 0.05)]))
    assert [info["is_success"] for info in infos_of(steps)] == [False, False, True]
    env.step(np.array([0.42, 0.15]))
    for y in (0.05, 0.15, 0.05, 0.15):
        *_, info = env.step(np.array([0.42, y]))
    assert info["stroke_error"] > LARGEST_ERROR
    assert not info["is_success"]


def test_neither_success_nor_collision_ends_an_episode(envs: dict) -> None:
    env = envs["pen", "exact", "bar"]
    for places in (BAR, np.array([[0.47, 0.0], [0.53, 0.0]])):
        *_, (_, _, terminated, truncated, info) = draw(env, places)
        assert info["is_success"] or info["is_collision"]
        assert not terminated
        assert not truncated


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("space", SPACES)
def test_the_path_length_is_that_of_the_ink_so_far(bar: HandwritingEnv, control: str) -> None:
    way = np.array([(0.40, 0.0), (0.41, 0.02), (0.41, 0.02), (0.40, 0.03), (0.43, 0.03), (0.42, -0.02)])
    for _ in range(2):  # a second episode begins at zero again
        steps = draw(bar, way)
        polyline = np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))
        lengths = [info["path_length"] for info in infos_of(steps)]
        if control == "exact":
            np.testing.assert_allclose(lengths, polyline, rtol=0.01)
        else:  # it lags, and cuts the corners
            assert (np.diff(lengths) > 0).all()
            assert 0.7 * polyline[-1] < lengths[-1] < polyline[-1]


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("space", SPACES)
def test_a_reset_forgets_the_ink(bar: HandwritingEnv) -> None:
    steps = draw(bar, np.array([[0.47, 0.0], [0.53, 0.0]]))
    assert infos_of(steps)[-1]["is_collision"]
    observation, info = bar.reset(options={"start": (0.42, 0.0)})
    assert not info["is_collision"]
    assert not info["is_success"]
    assert info["path_length"] == 0
    assert info["stroke_error"] == math.inf
    assert info["clearance"] > 0
    np.testing.assert_allclose(np.concatenate(bar.ink.strokes), [tip_of(bar, observation)[:2]], atol=1e-5)


def test_an_episode_without_regions_knows_the_table_only() -> None:
    env = HandwritingEnv("pen", n_regions=0, control="exact")
    for info in infos_of(draw_letter(env, 30)):
        assert info["clearance"] == pytest.approx(PEN_TRAVEL, abs=1e-3)
    env.close()


# Arguments


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"space": "hand"}, r"space must be one of \('joint', 'pen'\), got 'hand'"),
        ({"control": "pd"}, "control must be one of .*'physics', 'exact'.* got 'pd'"),
        ({"camera": "front"}, r"camera must be one of \('arm', 'top'\), got 'front'"),
        ({"render_mode": "human"}, "render_mode must be one of .*None, 'rgb_array'.* got 'human'"),
        ({"fps": 0}, "fps must divide the physics' 500 Hz, got 0"),
        ({"fps": -10}, "fps must divide .* got -10"),
        ({"fps": 30}, "fps must divide the physics' 500 Hz, got 30"),
        ({"fps": 1000}, "fps must divide .* got 1000"),
        ({"render_size": 16}, "render_size must be at least 32 pixels, got 16"),
        ({"letter": "Q"}, "letter must be one of .* got 'Q'"),
        ({"letter_height": 0.5}, "the stroke of S must lie on the sheet"),
        ({"region_gap": 0}, "region_gap must be above 0 m, got 0"),
        ({"n_regions": -1}, "n_regions must be at least 0, got -1"),
    ],
    ids=str,
)
def test_bad_arguments_are_refused_with_the_rule(kwargs: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        HandwritingEnv(**kwargs)


def test_a_scene_of_ones_own_is_what_is_written(envs: dict) -> None:
    env = envs["pen", "exact", "bar"]
    assert env.task_description == "Write bar without entering a red region."
    assert env.scene.regions == (DISC,)
    np.testing.assert_allclose(env.scene.stroke[[0, -1]], BAR)


@pytest.mark.parametrize("fps", [10, 50])
def test_videos_play_at_the_control_frequency(fps: int) -> None:
    assert HandwritingEnv(fps=fps, control="exact").metadata["render_fps"] == fps
    assert HandwritingEnv.metadata["render_fps"] == 10


# Pictures


def is_red(picture: np.ndarray) -> np.ndarray:
    red, green, blue = np.moveaxis(picture.astype(int), -1, 0)
    return (red > 100) & (red > 1.6 * green) & (red > 1.6 * blue)


def is_blue(picture: np.ndarray) -> np.ndarray:
    red, _, blue = np.moveaxis(picture.astype(int), -1, 0)
    return blue > red + 40


def pixels_of(places: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """Row and column of ``(N, 2)`` positions on the sheet in an image from the top."""
    height, width, _ = picture.shape
    scale = height / 2 / (0.42 * math.tan(math.radians(45) / 2))  # [pixels/m]
    across = scale * (np.asarray(places) - SHEET_CENTRE)
    return np.stack([height / 2 - across[:, 1], width / 2 + across[:, 0]], axis=1)


def any_near(mask: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Whether the mask holds within 2 pixels of each of ``(N, 2)``."""
    return np.array([mask[r - 2 : r + 3, c - 2 : c + 3].any() for r, c in pixels.round().astype(int)])


@pytest.fixture(scope="module")
def arm_camera() -> Iterator[HandwritingEnv]:
    env = HandwritingEnv("joint", "L", control="exact", render_mode="rgb_array", render_size=320)
    yield env
    env.close()


@pytest.fixture(scope="module")
def top_camera() -> Iterator[HandwritingEnv]:
    env = HandwritingEnv("pen", control="exact", render_mode="rgb_array", render_size=400, camera="top")
    yield env
    env.close()


@pytest.mark.slow
def test_images_show_the_ink_where_it_is_drawn(top_camera: HandwritingEnv) -> None:
    stroke = points_along(top_camera.scene.stroke, 41)
    top_camera.reset(seed=0, options={"start": stroke[0]})
    at_start = top_camera.render()
    assert at_start.dtype == np.uint8
    assert at_start.shape == (300, 400, 3)
    assert not is_blue(at_start).any()
    draw(top_camera, stroke[:21])
    half, pixels = top_camera.render(), pixels_of(stroke, at_start)
    assert any_near(is_blue(half), pixels[1:20]).all()
    assert not any_near(is_blue(half), pixels[22:]).any()
    changed = (half != at_start).any(axis=-1)
    assert is_blue(half)[changed].mean() > 0.6  # its edge is a mixture
    np.testing.assert_array_equal(top_camera.render(), half)  # rendering adds nothing
    draw(top_camera, stroke)
    assert any_near(is_blue(top_camera.render()), pixels[1:]).all()
    top_camera.reset(seed=0, options={"start": stroke[0]})
    np.testing.assert_array_equal(top_camera.render(), at_start)


def test_images_show_letter_and_regions_where_they_are(bar_file: str, tmp_path: Path) -> None:
    regions = (Disc((0.47, 0.09), 0.03), Disc((0.60, -0.05), 0.02))
    scene = WritingScene("two", np.array([[0.38, -0.1], [0.38, 0.1], [0.42, 0.1]]), regions)
    env = HandwritingEnv(
        "pen",
        scene_file=file_of(tmp_path, scene),
        control="exact",
        render_mode="rgb_array",
        camera="top",
    )
    env.reset(seed=0)
    picture = env.render()
    red = is_red(picture)
    for region in regions:
        inside = region.centre + 0.85 * (region.outline - region.centre)
        outside = region.centre + 1.2 * (region.outline - region.centre)
        assert all(red[row, column] for row, column in pixels_of(inside, picture).round().astype(int))
        assert not any_near(red, pixels_of(outside, picture)).any()
    brightness = picture.astype(int).sum(axis=-1)
    on_letter = pixels_of(evenly_spaced(scene.stroke, 0.02)[1:-1], picture).round().astype(int)
    beside = pixels_of(np.array([[0.36, 0.0], [0.40, -0.05], [0.52, 0.0]]), picture).round().astype(int)
    assert max(brightness[tuple(on_letter.T)]) < min(brightness[tuple(beside.T)]) - 30
    env.close()


@pytest.mark.slow
def test_images_from_the_top_leave_out_the_arm_and_from_the_side_show_it(
    arm_camera: HandwritingEnv, top_camera: HandwritingEnv
) -> None:
    for env, shows_it in ((arm_camera, True), (top_camera, False)):
        pictures = []
        for place in ([0.45, 0.0], [0.55, 0.05]):
            env.reset(options={"joints": env.kinematics.joints(np.array(place), height=0.05)})
            pictures.append(env.render())
        different = (pictures[0] != pictures[1]).any(axis=-1).mean()
        assert (different > 0.01) == shows_it
        assert (different == 0) != shows_it
        assert is_red(pictures[0]).mean() > 0.002


@pytest.mark.slow
def test_two_environments_rendered_in_turns_do_not_disturb_each_other() -> None:
    envs = [
        HandwritingEnv(
            "pen", letter, control="exact", render_mode="rgb_array", render_size=size, camera=camera
        )
        for letter, size, camera in (("L", 160, "arm"), ("S", 240, "top"))
    ]
    alone = []
    for env in envs:
        draw_letter(env, 20)
        alone.append(env.render())  # of a new renderer
    for _ in range(2):
        for env, expected in zip(envs, alone, strict=True):
            np.testing.assert_array_equal(env.render(), expected)
    envs[0].reset(seed=0)
    assert (envs[0].render() != alone[0]).any()
    np.testing.assert_array_equal(envs[1].render(), alone[1])
    for env in envs:
        env.close()


@pytest.mark.slow
def test_a_sheet_full_of_strokes_can_be_rendered(top_camera: HandwritingEnv) -> None:
    rng = np.random.default_rng(0)
    top_camera.reset(seed=0)
    for place in rng.uniform(np.array(SHEET_CENTRE) - 0.12, np.array(SHEET_CENTRE) + 0.12, size=(64, 2)):
        top_camera.step(place)
    assert top_camera.ink.length > 7
    assert is_blue(top_camera.render()).mean() > 0.05


@pytest.mark.slow
@pytest.mark.parametrize(("size", "shape"), [(32, (24, 32, 3)), (127, (96, 126, 3)), (800, (600, 800, 3))])
def test_images_have_even_sides(size: int, shape: tuple[int, int, int]) -> None:
    env = HandwritingEnv("pen", control="exact", render_mode="rgb_array", render_size=size, camera="top")
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == shape
    env.close()
    env.close()  # twice is as good
    np.testing.assert_array_equal(env.render(), picture)  # and it can go on
    env.close()


def test_without_a_render_mode_there_is_no_image(exact: HandwritingEnv) -> None:
    exact.reset(seed=0)
    assert exact.render() is None


# LeRobot


def vector_env(config: PF2MPHandwritingEnv, n_envs: int) -> gym.vector.VectorEnv:
    return make_env(config, n_envs=n_envs)["pf2mp_handwriting"][0]


@pytest.mark.slow
@pytest.mark.parametrize(("task", "n"), [("HandwritingJoint-v0", 9), ("HandwritingPen-v0", 2)])
def test_lerobot_makes_vectorised_environments_of_the_configuration(task: str, n: int) -> None:
    config = make_env_config("pf2mp_handwriting", task=task, episode_length=4, fps=20, render_size=64)
    env = vector_env(config, n_envs=2)
    assert isinstance(env, gym.vector.SyncVectorEnv)
    observation, _ = env.reset(seed=[0, 1])
    assert {key: value.shape for key, value in observation.items()} == {"agent_pos": (2, n)}
    assert not np.array_equal(observation["agent_pos"][0], observation["agent_pos"][1])
    assert env.call("_max_episode_steps") == (4, 4)
    assert env.call("task_description") == ("Write S without entering a red region.",) * 2
    assert env.call("task") == (f"handwriting-{HANDWRITING_TASKS[task]}",) * 2
    assert [picture.shape for picture in env.call("render")] == [(48, 64, 3)] * 2
    assert env.unwrapped.metadata["render_fps"] == 20
    for step in range(4):
        *_, truncated, _ = env.step(observation["agent_pos"])
        assert truncated.all() == (step == 3)
    env.close()


@pytest.mark.parametrize(("task", "n"), [("HandwritingJoint-v0", 9), ("HandwritingPen-v0", 2)])
def test_the_features_of_a_policy_are_state_and_action(task: str, n: int) -> None:
    features = env_to_policy_features(PF2MPHandwritingEnv(task=task))
    assert {key: (feature.type, feature.shape) for key, feature in features.items()} == {
        "action": (FeatureType.ACTION, (n,)),
        "observation.state": (FeatureType.STATE, (n,)),
    }


def test_the_configuration_hands_on_every_option() -> None:
    options = {
        "letter": "L",
        "letter_height": 0.15,
        "region_gap": 0.01,
        "n_regions": 1,
        "scene_file": None,
        "control": "exact",
        "fps": 25,
        "render_size": 64,
        "camera": "top",
        "robot": "panda",
    }
    env = vector_env(PF2MPHandwritingEnv(task="HandwritingPen-v0", episode_length=9, **options), n_envs=1)
    inner = env.envs[0].unwrapped
    assert env.call("_max_episode_steps") == (9,)
    assert inner.spec.kwargs == {
        "env_class": "handwriting.handwriting_env:HandwritingEnv",
        "obs_type": "state",
        "space": "pen",
        "render_mode": "rgb_array",
        **options,
    }
    assert inner.scene.name == "L"
    assert len(inner.scene.regions) == 1
    env.close()


def test_the_scene_of_the_configuration_is_that_of_the_environment(bar_file: str) -> None:
    for config in (
        PF2MPHandwritingEnv(letter="N", letter_height=0.2),
        PF2MPHandwritingEnv(scene_file=bar_file),
    ):
        env = vector_env(config, n_envs=1)
        scene = env.envs[0].unwrapped.scene
        np.testing.assert_array_equal(scene.stroke, config.scene.stroke)
        assert scene.regions == config.scene.regions
        env.close()


def test_a_robot_that_does_not_exist_is_refused() -> None:
    message = r"robot must be one of \['panda', 'unitree_z1'\], got 'ur5'"
    with pytest.raises(ConfigError, match=message):
        PF2MPHandwritingEnv(robot="ur5")
    with pytest.raises(ValueError, match=message):
        HandwritingEnv("pen", robot="ur5")


def test_a_robot_without_its_package_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "distribution", missing)
    monkeypatch.delitem(sys.modules, "lerobot_pf2mp.envs.handwriting.unitree_z1", raising=False)
    message = r'^the robot unitree_z1 needs: pip install "lerobot_policy_pf2mp\[z1\]"$'
    with pytest.raises(ConfigError, match=message):
        PF2MPHandwritingEnv(robot="unitree_z1")
    with pytest.raises(ImportError, match=message):
        HandwritingEnv("pen", robot="unitree_z1")


@pytest.mark.parametrize("task", ["HandwritingHand-v0", "joint", None, ""])
def test_a_task_that_does_not_exist_is_refused(task: str | None) -> None:
    with pytest.raises(
        ConfigError, match=f"task must be one of .*HandwritingJoint-v0.* got {re.escape(repr(task))}"
    ):
        PF2MPHandwritingEnv(task=task)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"letter": "s"}, "letter must be one of .* got 's'"),
        ({"letter_height": 0.4}, "the stroke of S must lie on the sheet"),
        ({"letter_height": 0.0}, "letter_height must be above 0 m, got 0.0"),
        ({"region_gap": -0.01}, "region_gap must be above 0 m, got -0.01"),
        ({"n_regions": -1}, "n_regions must be at least 0, got -1"),
    ],
    ids=str,
)
def test_a_scene_that_does_not_work_is_refused(options: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        PF2MPHandwritingEnv(**options)


def test_a_file_that_blocks_its_stroke_or_does_not_exist_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "blocked.json"
    path.write_text(
        json.dumps({"stroke": BAR.tolist(), "regions": [{"centre": [0.42, 0], "radius": 0.01}]}),
        encoding="utf-8",
    )
    with pytest.raises(ConfigError, match="regions must leave the stroke free, got one that blocks blocked"):
        PF2MPHandwritingEnv(scene_file=str(path))
    with pytest.raises(ConfigError, match=r"nowhere\.json"):
        PF2MPHandwritingEnv(scene_file=str(tmp_path / "nowhere.json"))


@dataclass
class Command:
    """What a command with an environment among its options has."""

    env: EnvConfig


def parsed(*options: str) -> PF2MPHandwritingEnv:
    return draccus.parse(Command, args=["--env.type=pf2mp_handwriting", *options]).env


def test_letters_and_files_can_be_given_on_the_command_line(bar_file: str) -> None:
    config = parsed("--env.task=HandwritingPen-v0", "--env.letter=1", "--env.letter_height=0.1")
    assert config == PF2MPHandwritingEnv(task="HandwritingPen-v0", letter="1", letter_height=0.1)
    again = draccus.decode(Command, json.loads(json.dumps(draccus.encode(Command(config))))).env
    assert again == config
    assert parsed(f"--env.scene_file={bar_file}").scene.name == "bar"


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--env.letter=s", "^letter must be one of .* got 's'"),
        ("--env.letter_height=0.4", "^the stroke of S must lie on the sheet"),
        ("--env.task=pen", "^task must be one of .* got 'pen'"),
        ("--env.scene_file=nowhere.json", r"nowhere\.json"),
    ],
)
def test_bad_options_on_the_command_line_are_refused_with_the_rule(option: str, message: str) -> None:
    with pytest.raises(draccus.utils.ParsingError, match=message):
        parsed(option)


class Script(nn.Module):
    """Plays back actions, ``(B, T, A)``."""

    def __init__(self, script: np.ndarray) -> None:
        super().__init__()
        self._script = torch.from_numpy(script)

    def reset(self) -> None:
        self._step = 0

    def select_action(self, batch: dict[str, torch.Tensor]) -> torch.Tensor:
        self._step += 1
        return self._script[:, self._step - 1]


def played(env: gym.vector.VectorEnv, script: np.ndarray) -> dict[str, np.ndarray]:
    def same(batch: dict) -> dict:
        return batch

    result = rollout(env, Script(script), same, same, same, same, seeds=list(range(len(script))))
    return {key: result[key].numpy() for key in ("reward", "success", "done")}


@pytest.mark.parametrize("control", CONTROLS)
def test_a_collision_of_one_episode_is_not_counted_in_the_next(bar_file: str, control: str) -> None:
    config = PF2MPHandwritingEnv(
        task="HandwritingPen-v0", scene_file=bar_file, control=control, episode_length=6, render_size=32
    )
    env = vector_env(config, n_envs=3)
    begin, end = BAR
    write = [begin + share * (end - begin) for share in (0.2, 0.5, 0.8, 1, 1, 1)]
    early = [np.array([0.5, 0.0])] * 2 + [np.array([0.45, 0.0])] * 4
    late = [*write[:4], np.array([0.47, 0.0]), np.array([0.53, 0.0])]
    for script, collides, succeeds in [
        ([write, early, late], [False, True, True], [True, False, True]),
        ([early, write, write], [True, False, False], [False, True, True]),
        ([write, write, early], [False, False, True], [True, True, False]),
    ]:
        result = played(env, np.array(script))
        assert result["reward"].shape == (3, 6)
        np.testing.assert_array_equal(result["reward"].sum(axis=1), -1.0 * np.array(collides))
        np.testing.assert_array_equal(result["success"].any(axis=1), succeeds)
        np.testing.assert_array_equal(result["done"].argmax(axis=1), 5)
    env.close()


def test_nothing_happens_after_the_end_of_an_episode_until_the_next_rollout(bar_file: str) -> None:
    config = PF2MPHandwritingEnv(
        task="HandwritingPen-v0", scene_file=bar_file, control="exact", episode_length=2, render_size=32
    )
    env = vector_env(config, n_envs=2)
    for _ in range(2):
        env.reset(seed=[0, 1], options={NEW_ROLLOUT_OPTION: True})
        total = np.zeros(2)
        for step in range(6):
            place = np.array([[0.42, 0.0], [0.5, 0.0]] if step < 2 else [[0.5, 0.0], [0.42, 0.0]])
            _, reward, *_ = env.step(place.astype(np.float32))
            total += reward
        np.testing.assert_array_equal(total, [0, -1])
    env.close()
