# SPDX-License-Identifier: Apache-2.0
import gc
import itertools
import json
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset
from scipy.spatial import KDTree

from lerobot_pf2mp.commands import cli
from lerobot_pf2mp.dataset_tools.handwriting.collect_handwriting import collect_handwriting
from lerobot_pf2mp.dataset_tools.handwriting.convert_handwriting import convert_handwriting
from lerobot_pf2mp.dataset_tools.handwriting.handwriting_expert import ScriptedHandwritingExpert, vary
from lerobot_pf2mp.dataset_tools.handwriting.handwriting_recording import read_handwriting
from lerobot_pf2mp.dataset_tools.writing.attempts import successful
from lerobot_pf2mp.dataset_tools.writing.episodes import Trajectory
from lerobot_pf2mp.dataset_tools.writing.lerobot_writer import DatasetSpec, write_dataset
from lerobot_pf2mp.envs.handwriting.handwriting_env import CONTROLS, SPACES, HandwritingEnv
from lerobot_pf2mp.envs.handwriting.panda import ARM, GRIP, HOME, JOINT_NAMES
from lerobot_pf2mp.envs.handwriting.pen import PEN_TIP
from lerobot_pf2mp.envs.handwriting.sheet import SHEET_CENTRE, SHEET_SIDE
from lerobot_pf2mp.envs.handwriting.stroke import distances
from lerobot_pf2mp.envs.handwriting.writing_episode import START_SPREAD
from lerobot_pf2mp.envs.handwriting.writing_model import make_writing_model
from lerobot_pf2mp.envs.handwriting.writing_scene import make_writing_scene

# Letters that are not held out for measurements: one with an inflection, with corners, closed, and one that crosses itself.
LETTERS = ("S", "M", "O", "8")
N_STEPS = 64
N_DEMONSTRATIONS = 7  # of the letter S and seed 0: the sixth enters a region
N_COLLECTED = 2
AXES = {"joint": list(JOINT_NAMES), "pen": ["x", "y"]}
LOW, HIGH = np.array(SHEET_CENTRE) - SHEET_SIDE / 2, np.array(SHEET_CENTRE) + SHEET_SIDE / 2

# A straight stroke, which four steps write.
STRAIGHT = [[0.45, -0.05], [0.55, -0.05]]


def gates(opening: float) -> list[dict]:
    """Pairs of regions on both sides of the straight stroke, and how far they are from each other [m]."""
    return [
        {"centre": [x, -0.05 + side * (0.009 + opening / 2)], "radius": 0.009}
        for x in (0.47, 0.50, 0.53)
        for side in (-1, 1)
    ]


def write_json(path: Path, content: Any) -> Path:
    path.write_text(json.dumps(content))
    return path


def straight(folder: Path, opening: float | None = None) -> dict[str, Any]:
    """Options of a scene that needs few steps."""
    regions = [] if opening is None else gates(opening)
    return {"scene_file": write_json(folder / "straight.json", {"stroke": STRAIGHT, "regions": regions})}


@cache
def env_of(space: str, control: str = "physics") -> HandwritingEnv:
    return HandwritingEnv(space, control=control)


@cache
def demonstrations(space: str) -> list[Trajectory | str]:
    scribe = ScriptedHandwritingExpert(env_of(space), N_STEPS, seed=0)
    return [scribe.demonstrate(number) for number in range(N_DEMONSTRATIONS)]


def kept(space: str) -> list[np.ndarray]:
    """The trajectories of the demonstrations that succeeded."""
    return [each.positions for each in demonstrations(space) if isinstance(each, Trajectory)]


@cache
def panda() -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = make_writing_model(ARM, np.zeros((8, 8, 3), np.uint8))
    return model, mujoco.MjData(model)


def forward(joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions ``(N, 3)`` of the pen's tip [m] and directions ``(N, 3)`` of the pen for ``(N, 9)`` joint positions."""
    model, data = panda()
    tips, directions = [], []
    for data.qpos[:] in joints:
        mujoco.mj_kinematics(model, data)
        tips.append(data.site(PEN_TIP).xpos.copy())
        directions.append(data.site(PEN_TIP).xmat.reshape(3, 3)[:, 2].copy())
    return np.array(tips), np.array(directions)


def dense(way: np.ndarray, n: int = 5) -> np.ndarray:
    return np.concatenate([np.linspace(a, b, n) for a, b in itertools.pairwise(way)])


def everything_in(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def frames_of(root: Path) -> dict[str, np.ndarray]:
    """The columns of a dataset, ``(episodes, steps, ...)``."""
    dataset = LeRobotDataset("local/handwriting", root=root)
    table = dataset.hf_dataset.with_format("numpy")
    return {
        key: np.stack(list(table[key])).reshape(dataset.num_episodes, -1, *dataset.features[key]["shape"])
        for key in ("observation.state", "action")
    }


def assert_holds(root: Path, ways: Sequence[np.ndarray], atol: float = 1e-6) -> None:
    """Checks that a dataset's episodes are these trajectories ``(T + 1, D)``."""
    frames = frames_of(root)
    assert len(frames["action"]) == len(ways)
    for states, actions, way in zip(frames["observation.state"], frames["action"], ways, strict=True):
        np.testing.assert_allclose(states, way[:-1], rtol=0, atol=atol)
        np.testing.assert_allclose(actions, way[1:], rtol=0, atol=atol)


# Varied strokes


def varied(letter: str, n_steps: int, n: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """A letter's stroke and `n` variations of it."""
    stroke = make_writing_scene(letter, n_regions=0).stroke
    return stroke, [vary(stroke, n_steps, np.random.default_rng(seed)) for seed in range(n)]


@pytest.mark.parametrize("letter", LETTERS)
@pytest.mark.parametrize("n_steps", [2, 64])
def test_a_varied_stroke_begins_and_ends_near_the_letters_ends_after_the_given_steps(
    letter: str, n_steps: int
) -> None:
    stroke, ways = varied(letter, n_steps, 60)
    assert {way.shape for way in ways} == {(n_steps + 1, 2)}
    off = np.array([way[[0, -1]] - stroke[[0, -1]] for way in ways])
    assert np.abs(off).max() <= START_SPREAD + 1e-12
    # All of the spread is used, on both sides, at both ends and on both axes.
    assert np.all(off.max(axis=0) > 0.8 * START_SPREAD)
    assert np.all(off.min(axis=0) < -0.8 * START_SPREAD)


def test_a_varied_stroke_depends_on_the_seed_and_on_nothing_else() -> None:
    stroke, ways = varied("S", N_STEPS, 20)
    for seed, way in enumerate(ways):
        np.testing.assert_array_equal(vary(stroke, N_STEPS, np.random.default_rng(seed)), way)
    for left, right in itertools.combinations(ways, 2):
        assert np.abs(left - right).max() > 0.001
    np.testing.assert_array_equal(stroke, make_writing_scene("S", n_regions=0).stroke)  # as it was


@pytest.mark.parametrize("letter", LETTERS)
def test_a_varied_stroke_stays_near_all_of_the_letter_without_following_it_exactly(letter: str) -> None:
    stroke, ways = varied(letter, N_STEPS, 50)
    for way in ways:
        off = distances(way, stroke)
        assert off.max() < 0.02
        assert 0.0005 < off.mean() < 0.008
        assert distances(stroke, way).max() < 0.02


def straight_and_arcs() -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """A stroke ``(N, 2)``, the bend of its four parts, 1 / radius [1/m], and where in it the middles of the parts are."""
    parts, bends = [np.linspace([-0.15, 0.0], [0.0, 0.0], 200)], [0.0]
    for radius, side in ((0.06, 1), (0.015, -1), (0.03, 1)):
        angles = np.linspace(0.0, np.pi, 400)[1:]
        circle = radius * np.stack([side * np.sin(angles), 1 - np.cos(angles)], axis=1)
        parts.append(parts[-1][-1] + circle)
        bends.append(1 / radius)
    ends = np.cumsum([len(part) for part in parts])
    middles = [
        np.arange(end - 0.7 * len(part), end - 0.3 * len(part)) for end, part in zip(ends, parts, strict=True)
    ]
    return np.concatenate(parts), np.array(bends), middles


@pytest.mark.slow
def test_the_pen_slows_down_in_curves_with_the_third_power_of_their_radius() -> None:
    stroke, bends, middles = straight_and_arcs()
    tree = KDTree(stroke)
    logarithms = []
    for seed in range(60):
        way = vary(stroke, 1500, np.random.default_rng(seed))
        speeds = np.linalg.norm(np.diff(way, axis=0), axis=1)
        at = tree.query((way[1:] + way[:-1]) / 2)[1]
        logarithms.append([np.log(speeds[(at >= part[0]) & (at <= part[-1])]).mean() for part in middles])
    means = np.mean(logarithms, axis=0)
    assert means[0] > means[1] > means[3] > means[2]  # the straight, then radii of 60, 30 and 15 mm
    # The two-thirds power law, with radii that count up to 80 mm.
    slope = np.polyfit(np.log(bends + 1 / 0.08), means, 1)[0]
    assert slope == pytest.approx(-1 / 3, abs=0.05)


@pytest.mark.parametrize("letter", LETTERS)
def test_the_pen_is_slowest_at_both_ends(letter: str) -> None:
    for way in varied(letter, 200, 30)[1]:
        speeds = np.linalg.norm(np.diff(way, axis=0), axis=1)
        assert speeds[[0, -1]].max() < 0.6 * np.median(speeds)


@pytest.mark.parametrize("letter", LETTERS)
def test_a_varied_stroke_has_no_jumps_and_bends_only_where_the_letter_does(letter: str) -> None:
    for way in varied(letter, 1000, 60)[1]:
        steps = np.diff(way, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        assert lengths.max() < 3 * lengths.mean()
        assert np.abs(np.diff(lengths)).max() < 0.3 * lengths.mean()
        if letter != "M":  # the corners of which are corners
            assert np.linalg.norm(np.diff(steps, axis=0), axis=1).max() < 0.1 * lengths.mean()


# Demonstrations


def outcome(env: HandwritingEnv, joints: np.ndarray, actions: np.ndarray) -> tuple[bool, bool]:
    """Success and collision of actions as a dataset holds them."""
    env.reset(options={"joints": joints})
    for action in actions.astype(np.float32):
        *_, info = env.step(action)
    return info["is_success"], info["is_collision"]


@pytest.mark.slow
@pytest.mark.parametrize("space", SPACES)
def test_demonstrations_write_the_letter_without_a_collision_under_both_controls(space: str) -> None:
    assert [each for each in demonstrations(space) if isinstance(each, str)] == ["in collision"]
    for way, joints in zip(kept(space)[:3], kept("joint"), strict=False):
        for control in CONTROLS:
            assert outcome(env_of(space, control), joints[0], way[1:]) == (True, False)


def test_a_path_that_enters_a_region_is_no_demonstration_although_the_arm_cuts_the_corner(
    tmp_path: Path,
) -> None:
    env = env_of("joint")
    stroke, ways = env.scene.stroke, [forward(joints)[0][:, :2] for joints in kept("joint")]
    number, way = max(enumerate(ways), key=lambda each: each[1][:, 0].max())  # the one that goes furthest out
    outermost = way[way[:, 0].argmax()]
    assert outermost[0] > stroke[:, 0].max() + 0.001
    for depth, expected in ((5e-6, "in collision"), (-0.002, None)):
        disc = {"centre": [outermost[0] + 0.01 - depth, outermost[1]], "radius": 0.01}
        scene = write_json(tmp_path / "scene.json", {"stroke": stroke.tolist(), "regions": [disc]})
        other = HandwritingEnv("joint", scene_file=scene)
        assert other.scene.clearance(way) == pytest.approx(-depth, abs=2e-6)
        result = ScriptedHandwritingExpert(other, N_STEPS, seed=0).demonstrate(number)
        assert (result if isinstance(result, str) else None) == expected


def test_a_path_from_which_the_arm_strays_into_a_region_is_in_collision(tmp_path: Path) -> None:
    env, n_steps = HandwritingEnv("pen", n_regions=0), 12  # so fast that it lags behind
    way = ScriptedHandwritingExpert(env, n_steps, seed=0).demonstrate(0).positions
    drawn = np.concatenate(env.ink.strokes)
    away = np.minimum(distances(drawn, way), distances(drawn, env.scene.stroke))
    assert away.max() > 0.0025
    disc = {"centre": drawn[away.argmax()].tolist(), "radius": away.max() - 0.001}
    scene = write_json(tmp_path / "scene.json", {"stroke": env.scene.stroke.tolist(), "regions": [disc]})
    other = HandwritingEnv("pen", scene_file=scene)
    assert other.scene.clearance(way) > 0.0009
    assert ScriptedHandwritingExpert(other, n_steps, seed=0).demonstrate(0) == "in collision"


@pytest.mark.slow
@pytest.mark.parametrize("space", SPACES)
def test_no_demonstration_leaves_the_sheet(space: str) -> None:
    env = HandwritingEnv(space, "O", letter_height=0.31, n_regions=0)
    scribe = ScriptedHandwritingExpert(env, 16, seed=0)
    attempts = [scribe.demonstrate(number) for number in range(8)]
    for attempt in attempts:
        if isinstance(attempt, Trajectory):
            places = attempt.positions if space == "pen" else forward(attempt.positions)[0][:, :2]
            assert np.all((places >= LOW - 1e-5) & (places <= HIGH + 1e-5))
    # Variations are a few millimetres, and so is the margin.
    ways = [vary(env.scene.stroke, 16, np.random.default_rng([0, number])) for number in range(8)]
    assert any((way < LOW).any() or (way > HIGH).any() for way in ways)


def test_joints_of_demonstrations_are_within_their_limits_and_move_smoothly() -> None:
    low, high = panda()[0].jnt_range.T
    for joints in kept("joint"):
        assert joints.shape == (N_STEPS + 1, 9)
        assert np.all((joints >= low) & (joints <= high))
        assert np.abs(np.diff(joints, axis=0)).max() < 0.1
        assert np.abs(np.diff(joints, n=2, axis=0)).max() < 0.02


def test_in_demonstrations_the_fingers_hold_the_pen_upright_on_the_table() -> None:
    for joints in kept("joint"):
        np.testing.assert_allclose(joints[:, 7:], GRIP, rtol=0, atol=1e-6)
        tips, directions = forward(dense(joints))
        assert np.abs(tips[:, 2]).max() <= 0.001
        assert np.abs(directions - [0, 0, -1]).max() < 0.01


def test_joints_and_positions_of_a_demonstration_are_the_same_trajectory_along_the_letter() -> None:
    stroke = env_of("pen").scene.stroke
    for joints, places in zip(kept("joint"), kept("pen"), strict=True):
        assert np.abs(places[[0, -1]] - stroke[[0, -1]]).max() <= START_SPREAD + 1e-12
        np.testing.assert_allclose(forward(joints)[0][:, :2], places, rtol=0, atol=1e-5)


@pytest.mark.slow
def test_a_demonstration_depends_on_its_seed_and_number_and_not_on_those_before() -> None:
    expected = demonstrations("joint")
    scribe = ScriptedHandwritingExpert(HandwritingEnv("joint"), N_STEPS, seed=0)
    for number in (3, 0, 3):
        np.testing.assert_array_equal(scribe.demonstrate(number).positions, expected[number].positions)
    other = ScriptedHandwritingExpert(env_of("joint"), N_STEPS, seed=1).demonstrate(0)
    for left, right in itertools.combinations([other.positions, *kept("joint")], 2):
        assert np.abs(left - right).max() > 0.01


def test_a_letter_that_is_not_written_is_without_success() -> None:
    scribe = ScriptedHandwritingExpert(
        HandwritingEnv("pen", n_regions=0), 2, seed=0
    )  # two steps cut all curves
    assert scribe.demonstrate(0) == "without success"


# Attempts


def test_attempts_that_fail_are_left_out_and_counted_by_reason() -> None:
    good = Trajectory(np.zeros((3, 2)))
    failed = Counter()
    assert list(successful([good, "a", good, "b", "a"], failed)) == [good, good]
    assert failed == {"a": 2, "b": 1}


@pytest.mark.parametrize(("n_successes", "is_enough"), [(0, False), (3, False), (4, True)])
def test_an_expert_that_hardly_ever_succeeds_is_given_up(n_successes: int, is_enough: bool) -> None:
    good = Trajectory(np.zeros((3, 2)))
    attempts = [*["in collision"] * (199 - n_successes), "out of reach", *[good] * n_successes, good]
    taken = successful(attempts, Counter())
    if is_enough:
        assert len(list(taken)) == n_successes + 1
        return
    with pytest.raises(
        ValueError,
        match=rf"at least 4 of its first 200 attempts, got {n_successes} "
        rf"\({199 - n_successes} in collision, 1 out of reach\)",
    ):
        list(taken)


# Collecting


def collect(space: str, root: Path, **changes: Any) -> tuple[int, Counter[str]]:
    arguments = {
        "repo_id": "local/handwriting",
        "n_episodes": N_COLLECTED,
        "n_steps": N_STEPS,
        "scene_options": {},
        "seed": 0,
        "overwrite": False,
    }
    return collect_handwriting(space, root=root, **{**arguments, **changes})


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The folder of a dataset of the letter S."""
    folder = tmp_path_factory.mktemp("collected")

    def collected(space: str) -> Path:
        if not (folder / space).exists():
            assert collect(space, folder / space) == (N_COLLECTED, {})
        return folder / space

    return collected


@pytest.mark.slow
@pytest.mark.parametrize("space", SPACES)
def test_a_collected_dataset_is_one_of_lerobot_with_named_coordinates_and_nothing_else(
    collected: Callable[[str], Path], space: str
) -> None:
    dataset = LeRobotDataset("local/handwriting", root=collected(space))
    assert (dataset.num_episodes, dataset.num_frames) == (N_COLLECTED, N_COLLECTED * N_STEPS)
    assert dataset.fps == 10
    for key in ("observation.state", "action"):
        assert dataset.features[key]["names"] == AXES[space]
        assert dataset.features[key]["shape"] == (len(AXES[space]),)
        assert dataset.features[key]["dtype"] == "float32"
        assert tuple(dataset[0][key].shape) == (len(AXES[space]),)
    places = [key for key in dataset.features if key.startswith("observation")]
    assert places == ["observation.state"]
    assert dataset[0]["task"] == env_of(space).task_description
    np.testing.assert_allclose(dataset[N_STEPS + 3]["timestamp"], 0.3, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("space", SPACES)
def test_a_collected_dataset_holds_what_the_expert_wrote(
    collected: Callable[[str], Path], space: str
) -> None:
    frames = frames_of(collected(space))
    np.testing.assert_array_equal(frames["action"][:, :-1], frames["observation.state"][:, 1:])
    assert_holds(collected(space), kept(space)[:N_COLLECTED])
    statistics = LeRobotDataset("local/handwriting", root=collected(space)).meta.stats
    np.testing.assert_allclose(statistics["action"]["max"], frames["action"].max(axis=(0, 1)), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("space", "meaning"),
    [
        ("joint", "positions of the seven joints [rad] and the two fingers [m]"),
        ("pen", "position x, y of the pen's tip [m]"),
    ],
)
def test_the_card_says_what_is_written_by_whom_and_in_which_units(
    collected: Callable[[str], Path], space: str, meaning: str
) -> None:
    card = (collected(space) / "README.md").read_text()
    assert card.startswith("---\nlicense: apache-2.0\n")
    for fact in (
        "# local/handwriting",
        "Write S without entering a red region.",
        "A scripted expert wrote it (seed 0).",
        "64 steps; 10 fps",
        f"| `observation.state` | {meaning} |",
        "x forward, y to its left",
    ):
        assert fact in card


def test_failed_demonstrations_are_left_out_of_the_dataset_and_counted(tmp_path: Path) -> None:
    options = straight(tmp_path, opening=0.006)
    scribe = ScriptedHandwritingExpert(HandwritingEnv("pen", **options), 2, seed=3)
    expected, failed = [], Counter()
    for number in itertools.count():
        attempt = scribe.demonstrate(number)
        if isinstance(attempt, str):
            failed[attempt] += 1
        else:
            expected.append(attempt.positions)
        if len(expected) == 4:
            break
    assert failed["in collision"] > 0
    changes = {"n_episodes": 4, "n_steps": 2, "scene_options": options, "seed": 3}
    assert collect("pen", tmp_path / "d", **changes) == (4, failed)
    assert_holds(tmp_path / "d", expected)


@pytest.mark.slow
def test_a_scene_that_leaves_hardly_any_room_ends_in_an_error_and_nothing_written(tmp_path: Path) -> None:
    options = straight(tmp_path, opening=0.001)
    with pytest.raises(
        ValueError, match=r"must succeed in at least 4 of its first 200 attempts, got [0-3] \(.*in collision"
    ):
        collect("pen", tmp_path / "d", n_steps=2, scene_options=options)
    assert everything_in(tmp_path) == ["straight.json"]


@pytest.mark.slow
@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_interruption_of_collecting_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[BaseException]
) -> None:
    def interrupted(self: ScriptedHandwritingExpert, number: int) -> Trajectory:
        if number == 3:
            raise error("stop")
        return Trajectory(np.full((3, 2), 0.5))

    monkeypatch.setattr(ScriptedHandwritingExpert, "demonstrate", interrupted)
    with pytest.raises(error, match="stop"):
        collect("pen", tmp_path / "data" / "d", n_episodes=4)
    gc.collect()  # what is written when an object is deleted counts
    assert everything_in(tmp_path) == []


def test_a_dataset_is_not_replaced_by_collecting_unless_asked_for(tmp_path: Path) -> None:
    small = {"n_steps": 4, "scene_options": straight(tmp_path)}
    collect("pen", tmp_path / "d", n_episodes=2, **small)
    with pytest.raises(FileExistsError, match="exists already: .*--overwrite=true"):
        collect("pen", tmp_path / "d", n_episodes=3, **small)
    assert len(frames_of(tmp_path / "d")["action"]) == 2
    collect("pen", tmp_path / "d", n_episodes=3, overwrite=True, **small)
    assert len(frames_of(tmp_path / "d")["action"]) == 3
    (tmp_path / "photos").mkdir()
    with pytest.raises(FileExistsError, match=r"photos is no dataset, .* will not be overwritten"):
        collect("pen", tmp_path / "photos", overwrite=True, **small)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n_steps": 1}, "n_steps must be at least 2, got 1"),
        ({"n_episodes": 0}, "n_episodes must be at least 1, got 0"),
        ({"scene_options": {"letter": "Q"}}, r"letter must be one of \['C', .*\], got 'Q'"),
        ({"scene_options": {"letter_height": 0.5}}, "the stroke of S must lie on the sheet, .* got"),
        ({"scene_options": {"letter_height": -0.1}}, "letter_height must be above 0 m, got -0.1"),
        ({"scene_options": {"region_gap": 0.0}}, "region_gap must be above 0 m, got 0.0"),
        ({"scene_options": {"n_regions": -1}}, "n_regions must be at least 0, got -1"),
    ],
)
def test_bad_options_for_collecting_are_refused_and_leave_nothing_behind(
    tmp_path: Path, changes: dict, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        collect("joint", tmp_path / "d", **changes)
    assert everything_in(tmp_path) == []


# Recordings of others


def write_csv(path: Path, columns: dict[str, Sequence[Any]], encoding: str = "utf-8") -> Path:
    rows = [",".join(columns), *(",".join(map(str, row)) for row in zip(*columns.values(), strict=True))]
    path.write_text("\n".join(rows) + "\n", encoding=encoding)
    return path


def columns_of(values: np.ndarray, times: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """The columns of a CSV file that holds ``(N, 2, 7 or 9)`` positions."""
    names = AXES["pen"] if values.shape[1] == 2 else JOINT_NAMES[: values.shape[1]]
    times = np.arange(len(values)) / 10 if times is None else times
    return {"time": times, **dict(zip(names, values.T, strict=True))}


def stacked(*episodes: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The columns of several episodes, one after the other, and which is which."""
    labels = [np.full(len(each["time"]), number) for number, each in enumerate(episodes)]
    columns = {name: np.concatenate([each[name] for each in episodes]) for name in episodes[0]}
    return {"episode": np.concatenate(labels), **columns}


def episode(values: np.ndarray, **changes: Any) -> dict[str, Any]:
    """An episode of a JSON file."""
    key = "pen" if values.shape[1] == 2 else "joints"
    return {"time": (np.arange(len(values)) / 10).tolist(), key: values.tolist(), **changes}


def in_json(path: Path, *ways: np.ndarray) -> Path:
    return write_json(path, {"episodes": [episode(way) for way in ways]})


def teleoperated(root: Path, ways: Sequence[np.ndarray], key: str = "action") -> Path:
    """A LeRobotDataset with these trajectories ``(T, D)`` as actions."""
    feature = {"dtype": "float32", "shape": (ways[0].shape[1],), "names": None}
    frames = [{key: way.astype(np.float32)} for way in ways]
    write_dataset(root, DatasetSpec("local/arm", 10, {key: feature}, "Write.", ""), frames)
    return root


def assert_read(path: Path, ways: Sequence[np.ndarray], atol: float = 1e-12) -> None:
    recordings = read_handwriting(path)
    assert len(recordings) == len(ways)
    for number, (recording, way) in enumerate(zip(recordings, ways, strict=True)):
        np.testing.assert_allclose(recording.times, np.arange(len(way)) / 10, rtol=0, atol=1e-6)
        np.testing.assert_allclose(recording.values, way, rtol=0, atol=atol)
        assert recording.name == f"episode {number} of {path}"


def random_joints(n_rows: int, seed: int = 0) -> np.ndarray:
    """Positions near `HOME` of joints [rad], and of fingers that are not closed on a pen [m]."""
    noise = np.random.default_rng(seed).uniform(-1, 1, (n_rows, 9))
    return HOME + noise * [*[0.1] * 7, 0.002, 0.002]


def with_closed_fingers(joints: np.ndarray) -> np.ndarray:
    return np.column_stack([joints[:, :7], np.full((len(joints), 2), GRIP)])


@pytest.mark.parametrize("with_episodes", [True, False])
def test_csv_files_hold_joints_with_or_without_fingers_or_the_pen(
    tmp_path: Path, with_episodes: bool
) -> None:
    joints = [random_joints(5, seed=0), random_joints(8, seed=1)]
    for number, (ways, expected) in enumerate(
        [
            (joints, joints),
            ([each[:, :7] for each in joints], [with_closed_fingers(each) for each in joints]),
            ([each[:, :2] for each in joints], [each[:, :2] for each in joints]),
        ]
    ):
        columns = [columns_of(way) for way in ways]
        path = write_csv(tmp_path / f"{number}.csv", stacked(*columns) if with_episodes else columns[0])
        assert_read(path, expected if with_episodes else expected[:1])


def test_rows_of_a_csv_file_belong_to_their_episode_wherever_they_are(tmp_path: Path) -> None:
    ways = [random_joints(5, seed=0), random_joints(5, seed=1)]
    columns = stacked(*map(columns_of, ways))
    order = np.argsort(np.tile(np.arange(5), 2), kind="stable")  # in turn
    shuffled = {name: values[order] for name, values in columns.items()}
    assert_read(write_csv(tmp_path / "a.csv", shuffled), ways)


@pytest.mark.parametrize("header", [" time, x, y, note", "\ttime,x,y,note", "time , x , y ,note "])
def test_a_mark_and_spaces_in_the_header_of_a_csv_file_do_no_harm(tmp_path: Path, header: str) -> None:
    places = random_joints(4)[:, :2]
    rows = [f" {i / 10}, {x} ,{y}, good" for i, (x, y) in enumerate(places.tolist())]
    path = tmp_path / "excel.csv"
    path.write_text("\r\n".join([header, *rows, ""]), encoding="utf-8-sig")
    assert_read(path, [places])


def test_json_files_hold_joints_with_or_without_fingers_or_the_pen(tmp_path: Path) -> None:
    joints = random_joints(6)
    path = in_json(tmp_path / "a.json", joints, joints[:, :7], joints[:4, :2])
    assert_read(path, [joints, with_closed_fingers(joints), joints[:4, :2]])


def test_datasets_of_lerobot_hold_joints_with_or_without_fingers(tmp_path: Path) -> None:
    joints = [random_joints(6, seed=0), random_joints(4, seed=1)]
    assert_read(teleoperated(tmp_path / "nine", joints), joints, atol=1e-6)
    path = teleoperated(tmp_path / "seven", [each[:, :7] for each in joints])
    assert_read(path, [with_closed_fingers(each) for each in joints], atol=1e-6)


def test_joint_offsets_are_added_to_the_joints_and_not_to_the_fingers(tmp_path: Path) -> None:
    joints = random_joints(5)
    offsets = [0.1, -0.2, 0.3, 0.4, -0.5, 0.6, 0.7]
    expected = joints + np.array([*offsets, 0.0, 0.0])
    path = in_json(tmp_path / "a.json", joints, joints[:, :7])
    nine, seven = read_handwriting(path, offsets)
    np.testing.assert_allclose(nine.values, expected, atol=1e-12)
    np.testing.assert_allclose(seven.values, with_closed_fingers(expected), atol=1e-12)


def test_a_recording_may_be_given_below_the_home_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    in_json(tmp_path / "a.json", random_joints(5))
    assert len(read_handwriting(Path("~/a.json"))) == 1


# Converting


def convert(path: Path, space: str, root: Path, **changes: Any) -> tuple[int, Counter[str]]:
    arguments = {"repo_id": "local/handwriting", "n_steps": N_STEPS, "scene_options": {}}
    return convert_handwriting(path, space, root=root, **{**arguments, **changes})


def joints_at(places: Sequence[Sequence[float]], height: float = 0.0) -> np.ndarray:
    return np.array([env_of("joint").kinematics.joints(np.array(place), height=height) for place in places])


@pytest.mark.slow
@pytest.mark.parametrize("recorded", SPACES)
def test_joints_and_positions_of_the_pen_become_each_other(tmp_path: Path, recorded: str) -> None:
    ways = kept(recorded)[:2]
    path = in_json(tmp_path / "strokes.json", *ways)
    for space in SPACES:
        assert convert(path, space, tmp_path / space) == (2, {})
    assert_holds(tmp_path / recorded, ways)
    places = [forward(way)[0][:, :2] if recorded == "joint" else way for way in ways]
    assert_holds(tmp_path / "pen", places, atol=1e-5)
    joints = frames_of(tmp_path / "joint")["action"]
    for number, place in enumerate(places):
        tips, directions = forward(joints[number])
        np.testing.assert_allclose(tips[:, :2], place[1:], rtol=0, atol=1e-4)
        assert np.abs(tips[:, 2]).max() < 1e-4
        assert np.abs(directions - [0, 0, -1]).max() < 0.001
        np.testing.assert_allclose(joints[number][:, 7:], GRIP, rtol=0, atol=1e-6)
    card = (tmp_path / "pen" / "README.md").read_text()
    assert "Converted from strokes.json (handwriting)." in card


@pytest.mark.slow
def test_a_converted_dataset_of_joints_is_what_was_collected(
    collected: Callable[[str], Path], tmp_path: Path
) -> None:
    assert convert(collected("joint"), "joint", tmp_path / "d") == (N_COLLECTED, {})
    recorded = frames_of(collected("joint"))["action"]
    at = np.linspace(0, N_STEPS - 1, N_STEPS + 1)
    ways = [
        np.stack([np.interp(at, np.arange(N_STEPS), column) for column in way.T], axis=1) for way in recorded
    ]
    assert_holds(tmp_path / "d", ways)
    info = [LeRobotDataset("local/a", root=root).features for root in (collected("joint"), tmp_path / "d")]
    assert info[0] == info[1]


def test_uneven_times_become_even(tmp_path: Path) -> None:
    at = np.array([0.0, 0.1, 0.15, 0.9, 2.0])  # [s]
    places = np.stack([0.45 + 0.05 * at, -0.05 + 0.01 * at], axis=1)
    path = write_csv(tmp_path / "a.csv", columns_of(places, times=5 + at))
    convert(path, "pen", tmp_path / "d", n_steps=20, scene_options=straight(tmp_path))
    even = np.linspace(0.0, 2.0, 21)
    assert_holds(tmp_path / "d", [np.stack([0.45 + 0.05 * even, -0.05 + 0.01 * even], axis=1)])


def test_joint_offsets_let_the_recording_of_another_convention_be_converted(tmp_path: Path) -> None:
    joints = joints_at(np.linspace(*STRAIGHT, 6))
    convention = np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.pi / 2, np.pi / 4])
    path = in_json(tmp_path / "real.json", joints[:, :7] + convention)
    options = {"scene_options": straight(tmp_path), "n_steps": 5}
    convert(path, "joint", tmp_path / "d", joint_offsets=(-convention).tolist(), **options)
    assert_holds(tmp_path / "d", [joints])


def test_recordings_that_enter_a_region_or_lift_the_pen_are_left_out_and_counted(tmp_path: Path) -> None:
    disc = env_of("joint").scene.regions[0]
    good = kept("joint")[0]
    lifted, touching = good.copy(), kept("pen")[0].copy()
    lifted[30] = joints_at([kept("pen")[0][30]], height=0.012)[0]
    touching[30] = disc.centre
    path = in_json(tmp_path / "a.json", lifted, good, touching, lifted, kept("pen")[1])
    n_written, left_out = convert(path, "pen", tmp_path / "d")
    assert n_written == 2
    assert left_out == {"with the pen off the table": 2, "in collision": 1}
    assert_holds(tmp_path / "d", kept("pen")[:2], atol=1e-5)


def test_a_region_between_two_resampled_positions_is_entered(tmp_path: Path) -> None:
    disc = {"centre": [0.5, 0.0], "radius": 0.005}
    scene = write_json(tmp_path / "scene.json", {"stroke": STRAIGHT, "regions": [disc]})
    through = np.array([[0.47, 0.0], [0.49, 0.0], [0.51, 0.0], [0.53, 0.0]])
    path = in_json(tmp_path / "a.json", through, through - [0.0, 0.05])
    for space in SPACES:
        options = {"n_steps": 3, "scene_options": {"scene_file": scene}}
        assert convert(path, space, tmp_path / space, **options) == (1, {"in collision": 1})


def test_no_more_recordings_are_written_than_asked_for(tmp_path: Path) -> None:
    path = in_json(tmp_path / "a.json", *[np.linspace(*STRAIGHT, 4)] * 5)
    options = {"n_steps": 3, "scene_options": straight(tmp_path)}
    assert convert(path, "pen", tmp_path / "d", n_episodes=3, **options) == (3, {})
    assert len(frames_of(tmp_path / "d")["action"]) == 3


def test_a_dataset_is_not_replaced_by_converting_unless_asked_for(tmp_path: Path) -> None:
    path = in_json(tmp_path / "a.json", np.linspace(*STRAIGHT, 4))
    options = {"n_steps": 3, "scene_options": straight(tmp_path)}
    convert(path, "pen", tmp_path / "d", **options)
    with pytest.raises(FileExistsError, match="exists already: .*--overwrite=true"):
        convert(path, "joint", tmp_path / "d", **options)
    assert frames_of(tmp_path / "d")["action"].shape == (1, 3, 2)
    convert(path, "joint", tmp_path / "d", overwrite=True, **options)
    assert frames_of(tmp_path / "d")["action"].shape == (1, 3, 9)


# Recordings that are refused


JOINTS, PLACES = random_joints(6), np.linspace(*STRAIGHT, 6)


def with_value(values: np.ndarray, index: tuple, value: float) -> np.ndarray:
    values = values.copy()
    values[index] = value
    return values


def without(columns: dict, *names: str) -> dict:
    return {name: values for name, values in columns.items() if name not in names}


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        # Columns
        ({}, r"others.csv must have a column time and joint_1 to joint_7, or x and y; got \[\]"),
        (without(columns_of(PLACES), "time"), r"must have a column time .* got \['x', 'y'\]"),
        (without(columns_of(PLACES), "y"), r"must have a column time .* got \['time', 'x'\]"),
        (without(columns_of(JOINTS), "joint_4"), r"must have a column time .* got \['time', 'joint_1', 'j"),
        # Numbers
        (
            {**columns_of(PLACES), "x": [*[0.5] * 5, "left"]},
            r"others.csv must hold a number in each column of each row: .*'left'",
        ),
        ({**columns_of(PLACES), "time": [*range(5), ""]}, "must hold a number in each column of each row"),
        (
            columns_of(with_value(PLACES, (2, 1), np.nan)),
            "positions must be finite, got NaN or infinity in row 2 of episode 0 of .*others.csv",
        ),
        (
            columns_of(with_value(JOINTS, (4, 6), np.inf)),
            "positions must be finite, got NaN or infinity in row 4 of episode 0",
        ),
        (
            columns_of(PLACES, times=np.array([0, 1, 2, np.nan, 4, 5])),
            "times must be finite, got NaN or infinity in row 3 of episode 0",
        ),
        # Times
        (
            columns_of(PLACES, times=np.array([0.0, 0.1, 0.2, 0.2, 0.3, 0.4])),
            "times must increase, got 0.2 after 0.2 in row 3 of episode 0 of .*others.csv",
        ),
        (
            stacked(*[columns_of(PLACES, times=np.array([0.0, 0.3, 0.1, 0.4, 0.5, 0.6]))] * 2),
            r"usable \(2 whose times do not increase\): times must increase, got 0.1 after 0.3 in row 2",
        ),
        (columns_of(PLACES[:2]), "episode 0 of .* at least 3 samples, .* got 2 times and 2 samples"),
        (columns_of(PLACES[:0]), "others.csv must hold at least one episode, got none"),
    ],
)
def test_csv_files_of_another_layout_are_refused(tmp_path: Path, columns: dict, message: str) -> None:
    path = write_csv(tmp_path / "others.csv", columns)
    with pytest.raises(ValueError, match=message):
        read_handwriting(path)


def test_csv_files_with_a_row_that_is_too_short_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "others.csv"
    path.write_text("time,x,y\n0.0,0.5,0.0\n0.1,0.5\n0.2,0.5,0.1\n")
    with pytest.raises(ValueError, match=r"others.csv must hold a number in each column of each row"):
        read_handwriting(path)


@pytest.mark.parametrize(
    "content",
    [
        "time,x,y\n0,0.5,0\n".encode("utf-16"),
        "time,x,y,größe\n0,0.5,0,1\n".encode("latin-1"),
        b'time,x,y\n"' + b"a" * 200_000,
        bytes(range(256)),
    ],
    ids=["utf-16", "latin-1", "endless field", "binary"],
)
def test_files_that_are_not_csv_are_refused_and_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "others.csv").write_bytes(content)
    with pytest.raises(ValueError, match=r"others\.csv"):
        read_handwriting(tmp_path / "others.csv")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], r'others.json must hold {"episodes": \[...\]}'),
        ({"strokes": []}, r'others.json must hold {"episodes": \[...\]}'),
        ({"episodes": {"time": []}}, r'others.json must hold {"episodes": \[...\]}'),
        ({"episodes": []}, "others.json must hold at least one episode, got none"),
        *(
            ({"episodes": [episode(PLACES), other]}, "an episode must be .* got something else as episode 1 ")
            for other in (
                [],
                without(episode(PLACES), "time"),
                without(episode(PLACES), "pen"),
                episode(PLACES, joints=JOINTS.tolist()),
                episode(PLACES, pen=JOINTS.tolist()),
                episode(JOINTS, joints=JOINTS[:, :8].tolist()),
                episode(JOINTS, joints=JOINTS[0].tolist()),
                episode(PLACES, pen=[[0.5, 0.0], [0.5], [0.5, 0.1]]),
                episode(PLACES, pen=[["left", "right"]] * 6),
                episode(PLACES, pen={"x": 0.5, "y": 0.0}),
                episode(PLACES, pen=[[10**400, 0]] * 6),
                episode(PLACES, time=0.1),
                episode(PLACES, pen=[]),
            )
        ),
        (
            {"episodes": [episode(PLACES, time=[0.0, 0.1, 0.2, 0.3, 0.4])]},
            "episode 0 of .*others.json must have at least 3 samples, each with a time, got 5 times and 6",
        ),
        ({"episodes": [episode(PLACES[:2])]}, "must have at least 3 samples, .* got 2 times and 2 samples"),
        (
            {"episodes": [episode(PLACES), episode(with_value(JOINTS, (5, 0), np.nan))]},
            "positions must be finite, got NaN or infinity in row 5 of episode 1",
        ),
        (
            {"episodes": [episode(PLACES, time=[0.0, 0.1, None, 0.3, 0.4, 0.5])]},
            "times must be finite, got NaN or infinity in row 2",
        ),
        (
            {"episodes": [episode(PLACES, time=[5, 4, 3, 2, 1, 0])]},
            "times must increase, got 4 after 5 in row 1",
        ),
    ],
)
def test_json_files_of_another_layout_are_refused(tmp_path: Path, content: Any, message: str) -> None:
    path = write_json(tmp_path / "others.json", content)
    with pytest.raises(ValueError, match=message):
        read_handwriting(path)


@pytest.mark.parametrize("content", [b"", b'{"episodes": [', b"<html>404</html>", bytes(range(256))])
def test_files_that_are_not_json_are_refused_and_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "others.json").write_bytes(content)
    with pytest.raises(ValueError, match=r"others\.json must be a JSON file, got"):
        read_handwriting(tmp_path / "others.json")


def test_missing_recordings_and_those_of_another_kind_are_named(tmp_path: Path) -> None:
    with pytest.raises(
        FileNotFoundError, match=f"must be a file or folder, got {tmp_path}/no.csv, which does not exist"
    ):
        read_handwriting(tmp_path / "no.csv")
    (tmp_path / "a.npz").write_bytes(b"")
    with pytest.raises(ValueError, match=r"must be a .csv or .json file or a LeRobotDataset's .*a\.npz"):
        read_handwriting(tmp_path / "a.npz")
    (tmp_path / "photos").mkdir()
    with pytest.raises(ValueError, match=r"photos must be the folder of a LeRobotDataset, got one without m"):
        read_handwriting(tmp_path / "photos")


def test_datasets_without_actions_of_joints_are_refused(tmp_path: Path) -> None:
    for name, width, key, found in (
        ("pen", 2, "action", r"\(2,\)"),
        ("none", 7, "observation.state", "None"),
    ):
        path = teleoperated(tmp_path / name, [np.zeros((4, width))], key)
        with pytest.raises(
            ValueError,
            match=rf"actions of .*{name} must be 7 joint positions or 9 with fingers, got {found}",
        ):
            read_handwriting(path)


def test_a_dataset_with_one_number_for_action_is_refused(tmp_path: Path) -> None:
    path = teleoperated(tmp_path / "a", [np.zeros((7, 1))])  # as many as there are joints
    with pytest.raises(ValueError, match="must be 7 joint positions or 9 with fingers, got"):
        read_handwriting(path)


@pytest.mark.parametrize("info", ["", "{}", "[]", '{"codebase_version": "v2.1", "fps": 10, "features": {}}'])
def test_datasets_that_cannot_be_read_are_refused_and_named(tmp_path: Path, info: str) -> None:
    path = teleoperated(tmp_path / "broken", [np.zeros((4, 7))])
    (path / "meta" / "info.json").write_text(info)
    with pytest.raises((ValueError, OSError), match=str(path)):
        read_handwriting(path)


def test_datasets_that_have_lost_their_frames_are_refused_and_named(tmp_path: Path) -> None:
    path = teleoperated(tmp_path / "broken", [np.zeros((4, 7))])
    for file in (path / "data").rglob("*.parquet"):
        file.write_bytes(file.read_bytes()[:100])
    with pytest.raises((ValueError, OSError), match=str(path)):
        read_handwriting(path)


@pytest.mark.parametrize("offsets", [[0.1], [0.0] * 9, [*[0.0] * 6, np.nan]])
def test_joint_offsets_must_be_seven_angles(tmp_path: Path, offsets: list[float]) -> None:
    path = in_json(tmp_path / "a.json", JOINTS)
    with pytest.raises(ValueError, match=r"joint_offsets must be 7 finite angles \[rad\], got \[0"):
        read_handwriting(path, offsets)


def test_joint_offsets_are_refused_for_a_recording_without_joints(tmp_path: Path) -> None:
    path = in_json(tmp_path / "a.json", PLACES)
    with pytest.raises(ValueError, match="joint_offsets .* joints"):
        read_handwriting(path, [0.0, 0.0, 0.0, 0.0, 0.0, -1.5708, -0.7854])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("values", "changes", "message"),
    [
        (
            np.rad2deg(JOINTS[:, :7]),
            {},
            "the joints in episode 0 of .*others.json must be in radians, got 1.*, which looks like degrees",
        ),
        (
            with_value(JOINTS, (4, 3), 0.5),
            {},
            r"the joints in episode 0 of .*others.json must be within the arm's limits, "
            r"joint_4 in \[-3.*, -0.*\], got 0.5 in row 4",
        ),
        (1000 * JOINTS * [*[0.001] * 7, 1, 1], {}, r"limits, finger_1 in \[0, 0.04\], got .* in row 0"),
        (JOINTS, {"joint_offsets": [0, 0, 0, 3.0, 0, 0, 0]}, r"limits, joint_4 in .*, got .* in row 0"),
        (
            with_value(PLACES, (3, 1), -0.17),
            {},
            r"the pen in episode 0 of .*others.json must lie on the sheet, .* x in \[0.34, 0.66\] and "
            r"y in \[-0.16, 0.16\] m of the table's frame; got \[.*, -0.17\]",
        ),
        (1000 * PLACES, {}, r"the pen in episode 0 .* must lie on the sheet, .* got \[450"),
        (PLACES, {"n_steps": 1}, "n_steps must be at least 2, got 1"),
        (PLACES, {"n_episodes": 0}, "n_episodes must be at least 1, got 0"),
        (PLACES, {"scene_options": {"letter_height": 0.5}}, "the stroke of S must lie on the sheet"),
        (PLACES, {"scene_options": {"letter": "s"}}, r"letter must be one of \['C', .*, got 's'"),
    ],
)
def test_recordings_that_the_arm_cannot_repeat_are_refused_and_leave_nothing_behind(
    tmp_path: Path, values: np.ndarray, changes: dict, message: str
) -> None:
    path = in_json(tmp_path / "others.json", values, values)
    with pytest.raises(ValueError, match=message):
        convert(path, "joint", tmp_path / "d", **changes)
    gc.collect()
    assert everything_in(tmp_path) == ["others.json"]


def test_joints_that_hold_the_pen_off_the_sheet_are_refused_for_a_dataset_of_the_pen(tmp_path: Path) -> None:
    beside = joints_at(np.linspace([0.45, 0.12], [0.45, 0.18], 6))  # on the table
    path = in_json(tmp_path / "others.json", beside)
    with pytest.raises(ValueError, match="episode 0 of .*others.json must lie on the sheet"):
        convert(path, "pen", tmp_path / "d", n_steps=5)
    assert everything_in(tmp_path) == ["others.json"]


def test_recordings_without_a_usable_episode_are_refused_with_the_reasons(tmp_path: Path) -> None:
    x, y = env_of("joint").scene.regions[0].centre
    through = np.linspace([x - 0.01, y], [x + 0.01, y], 4)
    lifted = joints_at(np.linspace(*STRAIGHT, 4), height=0.02)
    path = in_json(tmp_path / "others.json", through, lifted, through)
    with pytest.raises(
        ValueError,
        match=r"none that is usable in .*others.json "
        r"\(left out: 2 in collision, 1 with the pen off the table\)",
    ):
        convert(path, "joint", tmp_path / "d", n_steps=4)
    assert everything_in(tmp_path) == ["others.json"]


def test_a_scene_whose_regions_block_the_stroke_is_refused(tmp_path: Path) -> None:
    path = in_json(tmp_path / "others.json", PLACES)
    disc = {"centre": [0.5, -0.05], "radius": 0.01}
    scene = write_json(tmp_path / "blocked.json", {"stroke": STRAIGHT, "regions": [disc]})
    options = {"scene_options": {"scene_file": scene}}
    message = "regions must leave the stroke free, got one that blocks blocked"
    with pytest.raises(ValueError, match=message):
        convert(path, "pen", tmp_path / "d", **options)
    with pytest.raises(ValueError, match=message):
        collect("pen", tmp_path / "d", **options)
    assert everything_in(tmp_path) == ["blocked.json", "others.json"]


# pf2mp-collect and pf2mp-convert


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a command in this process; returns the last line it prints."""

    def command(run: Callable[[], None], *arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", [f"pf2mp-{run.__name__}", *arguments])
        capfd.readouterr()
        try:
            run()
        except SystemExit as exit_:
            assert exit_.code == 1
            captured = capfd.readouterr()
            assert captured.out == ""
            assert "Traceback" not in captured.err
            return captured.err.strip().splitlines()[-1]
        return capfd.readouterr().out.strip()

    return command


@pytest.mark.slow
def test_the_command_collects_a_letter_in_joints(tmp_path: Path, command: Callable[..., str]) -> None:
    root = tmp_path / "d"
    options = ("--task=handwriting_joint", "--letter=8", "--letter_height=0.15", "--n_regions=1")
    line = command(cli.collect, *options, "--n_episodes=2", "--seed=4", f"--root={root}")
    assert line == f"Wrote 2 episodes of 64 steps to {root} (left out: none)."
    dataset = LeRobotDataset("local/handwriting_joint", root=root)
    assert "# local/handwriting_joint" in (root / "README.md").read_text()
    assert dataset.features["action"]["names"] == AXES["joint"]
    assert dataset[0]["task"] == "Write 8 without entering a red region."
    env = HandwritingEnv("joint", "8", letter_height=0.15, n_regions=1)
    first = ScriptedHandwritingExpert(env, N_STEPS, seed=4).demonstrate(0)
    np.testing.assert_allclose(frames_of(root)["observation.state"][0], first.positions[:-1], atol=1e-6)


def test_the_command_collects_a_stroke_of_your_own_with_the_pen(
    tmp_path: Path, command: Callable[..., str]
) -> None:
    scene, root = straight(tmp_path)["scene_file"], tmp_path / "d"
    options = ("--task=handwriting_pen", f"--scene_file={scene}", "--n_steps=4", f"--root={root}")
    assert command(cli.collect, *options) == f"Wrote 10 episodes of 4 steps to {root} (left out: none)."
    assert frames_of(root)["action"].shape == (10, 4, 2)
    assert "Write straight without" in (root / "README.md").read_text()
    assert command(cli.collect, *options).startswith(f"error: {root} exists already")


@pytest.mark.slow
def test_the_command_converts_csv_files_and_says_what_was_left_out(
    tmp_path: Path, command: Callable[..., str]
) -> None:
    through = np.linspace([0.45, -0.1], [0.55, 0.1], N_STEPS + 1)
    columns = stacked(*map(columns_of, (through, *kept("pen")[:2])))
    path = write_csv(tmp_path / "strokes.csv", columns)
    usual = ("--source.type=handwriting", f"--source.path={path}")
    for space in SPACES:
        root = tmp_path / space
        line = command(cli.convert, *usual, f"--task=handwriting_{space}", f"--root={root}")
        assert line == f"Wrote 2 episodes of 64 steps to {root} (left out: 1 in collision)."
        assert LeRobotDataset("local/a", root=root).features["action"]["names"] == AXES[space]
    assert_holds(tmp_path / "pen", kept("pen")[:2])


def test_the_command_adds_joint_offsets(tmp_path: Path, command: Callable[..., str]) -> None:
    joints = joints_at(np.linspace(*STRAIGHT, 6))
    path = in_json(tmp_path / "real.json", joints + np.array([0, 0, 0, 0, 0, 1.5708, 0.7854, 0, 0]))
    root = tmp_path / "d"
    usual = ("--source.type=handwriting", f"--source.path={path}", "--task=handwriting_joint", "--n_steps=5")
    own = f"--scene_file={straight(tmp_path)['scene_file']}"
    offsets = "--source.joint_offsets=[0,0,0,0,0,-1.5708,-0.7854]"
    line = command(cli.convert, *usual, own, offsets, f"--root={root}")
    assert line == f"Wrote 1 episodes of 5 steps to {root} (left out: none)."
    assert_holds(root, [joints])


def test_a_scene_file_may_be_given_below_the_home_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Callable[..., str]
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    straight(tmp_path)
    options = ("--task=handwriting_pen", "--scene_file=~/straight.json", "--n_steps=4", "--n_episodes=1")
    line = command(cli.collect, *options, f"--root={tmp_path / 'd'}")
    assert line == f"Wrote 1 episodes of 4 steps to {tmp_path / 'd'} (left out: none)."


@pytest.mark.parametrize(
    ("run", "facts"),
    [
        (
            cli.collect,
            [
                "Examples: pf2mp-collect --",
                "pf2mp-collect --task=handwriting_joint --letter=S",
                "pf2mp-collect --task=handwriting_pen --scene_file=",
                "metaworld_pick_place_wall or so101_fence",
                "20 for handwriting_joint, 10 for handwriting_pen",
                "64 for handwriting",
            ],
        ),
        (
            cli.convert,
            [
                "Examples: pf2mp-convert --",
                "pf2mp-convert --source.type=handwriting --source.path=strokes.csv --task=handwriting_pen",
                "CSV files of handwriting have columns time [s], optionally episode, and joint_1 to joint_7 [rad]",
                '{"episodes": [{"time": [...], "joints": [[7 or 9], ...]}]}',
                "seven angles to add to the recorded joints [rad]",
                "64 for handwriting",
            ],
        ),
    ],
)
def test_help_shows_examples_and_units(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], run: Callable, facts: list[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [f"pf2mp-{run.__name__}", "--help"])
    with pytest.raises(SystemExit, match="0"):
        run()
    words = " ".join(capsys.readouterr().out.split())
    scene = ["height of the letter [m]", "restricted regions to the letter [m]", "x forward and y left"]
    assert [fact for fact in facts + scene if fact not in words] == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--letter=Q"], "error: letter must be one of ['C', "),
        (["--letter_height=0.5"], "error: the stroke of S must lie on the sheet"),
        (["--letter_height=tall"], "error: `letter_height`"),
        (["--region_gap=-0.01"], "error: region_gap must be above 0 m, got -0.01"),
        (["--n_regions=-1"], "error: n_regions must be at least 0, got -1"),
        (["--n_steps=1"], "error: n_steps must be at least 2, got 1"),
        (["--n_episodes=0"], "error: n_episodes must be at least 1, got 0"),
        (["--expert=outputs/expert"], "error: expert must be scripted for handwriting, got 'outputs/expert'"),
        (["--task=handwriting"], "error: task must be one of ['maze_umaze', "),
        (["--scene_file=blocked.json"], "error: regions must leave the stroke free, got one that blocks blo"),
        (["--scene_file=strokes.csv"], "error: strokes.csv must be a JSON file"),
        (["--scene_file=others.json"], "error: others.json must hold {"),
    ],
)
def test_bad_values_for_collecting_end_in_one_line_and_nothing_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Callable[..., str], options: list, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    before = write_recordings()
    assert command(cli.collect, "--task=handwriting_joint", "--root=d", *options).startswith(message)
    assert everything_in(tmp_path) == before


def write_recordings() -> list[str]:
    """Files in the working folder; returns their names."""
    write_csv(Path("strokes.csv"), columns_of(PLACES))
    in_json(Path("others.json"), PLACES)
    disc = {"centre": [0.5, -0.05], "radius": 0.01}
    write_json(Path("blocked.json"), {"stroke": STRAIGHT, "regions": [disc]})
    Path("binary.csv").write_bytes(bytes(range(256)))
    (Path("broken") / "meta").mkdir(parents=True)
    write_json(Path("broken") / "meta" / "info.json", {})
    return everything_in(Path())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ["--task=maze_large"],
            "error: task must be one of ['handwriting_joint', 'handwriting_pen'], got 'maze_large'",
        ),
        (["--task=fetch_reach"], "error: task must be one of ['handwriting_joint', 'handwriting_pen'], got"),
        (["--source.type=d4rl"], "error: --source.type must be handwriting for handwriting_pen, got 'd4rl'"),
        (["--source.type=minari"], "error: --source.type must be handwriting for handwriting_pen, got 'min"),
        (["--source.type=fetch"], "error: task must be one of ['fetch_reach', 'fetch_push'], got 'handw"),
        (
            ["--source.type=rlds"],
            "error: --source.type must be one of ['d4rl', 'minari', 'fetch', 'handwriting'], got 'rlds'",
        ),
        (["--maze_map=11111/10001/11111"], "error: --maze_map is for mazes only, got 11111/10001/11111"),
        (["--source.path=no.csv"], "error: source.path must be a file or folder, got no.csv"),
        (["--source.path=."], "error: . must be the folder of a LeRobotDataset"),
        (["--source.path=binary.csv"], "error: binary.csv must be a CSV file"),
        (["--source.path=broken"], "error: broken "),
        (["--source.joint_offsets=[0,1]"], "error: joint_offsets must be 7 finite angles [rad], got [0"),
        (["--source.joint_offsets=[none]"], "error: `source.joint_offsets"),
        (["--letter_height=0.5"], "error: the stroke of S must lie on the sheet"),
        (["--scene_file=blocked.json"], "error: regions must leave the stroke free"),
        (["--n_steps=1"], "error: n_steps must be at least 2, got 1"),
    ],
)
def test_bad_values_for_converting_end_in_one_line_and_nothing_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Callable[..., str], options: list, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    before = write_recordings()
    usual = ("--source.type=handwriting", "--source.path=strokes.csv", "--task=handwriting_pen", "--root=d")
    assert command(cli.convert, *usual, *options).startswith(message)
    assert everything_in(tmp_path) == before


def test_a_source_must_be_given(command: Callable[..., str]) -> None:
    line = command(cli.convert, "--source.type=handwriting", "--task=handwriting_pen")
    assert line == "error: --source.path must name the recording, got none"
