# SPDX-License-Identifier: Apache-2.0
import gc
import io
import itertools
import json
import math
import os
import re
import signal
import sys
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest
from foreign_recordings import write_minari
from forked_commands import ForkedCommand
from lerobot.datasets import LeRobotDataset
from scipy.sparse.csgraph import shortest_path

from lerobot_pf2mp.commands import cli
from lerobot_pf2mp.dataset_tools.experts.recording import Recording
from lerobot_pf2mp.dataset_tools.fetch import collect_fetch as collecting
from lerobot_pf2mp.dataset_tools.fetch.collect_fetch import collect_fetch
from lerobot_pf2mp.dataset_tools.fetch.convert_fetch import convert_fetch, read_fetch
from lerobot_pf2mp.dataset_tools.fetch.fetch_expert import STYLES, ScriptedFetchExpert
from lerobot_pf2mp.dataset_tools.fetch.fetch_routes import length, routes, walk
from lerobot_pf2mp.dataset_tools.writing.episodes import Trajectory, prepare
from lerobot_pf2mp.envs.box import Box
from lerobot_pf2mp.envs.fetch.fetch_env import MAX_STEP, FetchEnv
from lerobot_pf2mp.envs.fetch.fetch_scene import BLOCK_SIZE, FETCH_SCENES, FINGERS, HAND, WORKSPACE

TASKS = ("reach", "push")
WIDTHS = {"reach": 10, "push": 25}
N_COLLECTED = 20  # more than a process makes in one go
SECONDS = 200
# Out of everyone's way.
NO_WALL = {"wall_position": (1.10, 0.45), "wall_size": (0.02, 0.02, 0.02)}


@cache
def demonstrations(task: str, style: str, n: int = 30) -> list[Recording]:
    env = FetchEnv(task)
    expert = ScriptedFetchExpert(env, style, seed=0)
    recordings = [expert.demonstrate(number) for number in range(n)]
    env.close()
    return recordings


def everything_in(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def contents_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# Routes


def standing_boxes(rng: np.random.Generator) -> list[Box]:
    """Up to four boxes that one cannot pass below, and that may overlap."""
    boxes = []
    for _ in range(rng.integers(5)):
        centre, half = rng.uniform(0.2, 0.8, 2), rng.uniform(0.02, 0.2, 2)
        boxes.append(Box.between((*(centre - half), -1.0), (*(centre + half), rng.uniform(0.1, 0.9))))
    return boxes


def cases(n: int) -> Iterator[tuple[np.ndarray, np.ndarray, list[Box]]]:
    rng = np.random.default_rng(0)
    for _ in range(n):
        boxes = standing_boxes(rng)
        yield *rng.uniform(0, 1, (2, 3)), boxes


def is_inside(points: np.ndarray, boxes: Sequence[Box], by: float = 0.0) -> bool:
    """Whether one of ``(N, 3)`` points lies in a box, deeper than `by`."""
    return any(bool(np.all((points > b.low + by) & (points < b.high - by), axis=1).any()) for b in boxes)


def dense(way: np.ndarray, n: int = 51) -> np.ndarray:
    return np.concatenate([np.linspace(a, b, n) for a, b in itertools.pairwise(way)])


def shortest_above(start: np.ndarray, goal: np.ndarray, boxes: Sequence[Box]) -> float:
    """The length of the shortest path in the vertical plane through both ends, via points at the boxes' edges."""
    nodes = [start, goal]
    for box in boxes:
        for side, axis in itertools.product((box.low, box.high), (0, 1)):
            at = start + (side[axis] - start[axis]) / (goal[axis] - start[axis]) * (goal - start)
            nodes.append(np.array([*at[:2], box.high[2]]))
    shares = [
        np.dot((node - start)[:2], (goal - start)[:2]) / math.dist(start[:2], goal[:2]) ** 2 for node in nodes
    ]
    shrunk = [Box.between(box.low + 1e-9, box.high - 1e-9) for box in boxes]
    distances = np.zeros((len(nodes), len(nodes)))
    for i, j in itertools.combinations(range(len(nodes)), 2):
        is_between = 0 <= shares[i] <= 1 and 0 <= shares[j] <= 1
        if is_between and not any(box.blocks(nodes[i], nodes[j]) for box in shrunk):
            distances[i, j] = math.dist(nodes[i], nodes[j])
    return float(shortest_path(distances, directed=False, indices=0)[1])


@pytest.mark.slow
def test_routes_lead_from_start_to_goal_through_no_box_the_shortest_first() -> None:
    n_routes = Counter()
    for start, goal, boxes in cases(400):
        found = routes(start, goal, boxes)
        n_routes[len(found)] += 1
        for way in found:
            np.testing.assert_allclose(way[[0, -1]], [start, goal], rtol=0, atol=1e-12)
            assert not is_inside(dense(way), boxes, by=1e-6)
        lengths = [length(way) for way in found]
        assert lengths == sorted(lengths)
    assert n_routes[0] > 30
    assert n_routes[1] + n_routes[2] > 30
    assert sum(n_routes[n] for n in n_routes if n > 2) > 60


def test_there_are_no_routes_when_an_end_is_in_a_box_and_otherwise_there_is_one() -> None:
    for start, goal, boxes in cases(400):
        assert bool(routes(start, goal, boxes)) != is_inside(np.array([start, goal]), boxes)


@pytest.mark.slow
def test_a_route_is_straight_when_nothing_is_in_the_way() -> None:
    n_free = 0
    for start, goal, boxes in cases(400):
        if is_inside(
            np.linspace(start, goal, 2001), [box.grown_by(Box((0, 0, 0), (1e-3,) * 3)) for box in boxes]
        ):
            continue
        n_free += 1
        np.testing.assert_allclose(routes(start, goal, boxes)[0], [start, goal], rtol=0, atol=1e-9)
    assert n_free > 100


@pytest.mark.slow
def test_no_route_is_longer_than_the_shortest_one_above() -> None:
    n_blocked = 0
    for start, goal, boxes in cases(200):
        if is_inside(np.array([start, goal]), boxes):
            continue
        best = length(routes(start, goal, boxes)[0])
        above = shortest_above(start, goal, boxes)
        assert best <= above + 1e-6
        n_blocked += above > math.dist(start, goal) + 1e-6
    assert n_blocked > 20


@pytest.mark.slow
@pytest.mark.parametrize("margin", [0.0, 0.02, 0.05])
@pytest.mark.parametrize("task", TASKS)
def test_routes_past_the_walls_of_the_tasks_are_at_most_twice_the_straight_line(
    task: str, margin: float
) -> None:
    scene, rng = FETCH_SCENES[task], np.random.default_rng(0)
    spread = Box((0, 0, 0), (2 * margin,) * 3)
    boxes = [scene.wall.grown_by(part).grown_by(spread) for part in (HAND, FINGERS)]
    ratios = []
    for _ in range(200):
        layout = scene.sample(rng)
        end = layout.goal if layout.block is None else layout.block
        found = routes(layout.start, end, boxes)
        assert bool(found) != is_inside(np.array([layout.start, end]), boxes)
        if found:
            ratios.append(length(found[0]) / math.dist(layout.start, end))
    assert max(ratios) <= 2
    assert np.mean(ratios) < 1.3
    assert len(ratios) > 100


def test_a_low_wide_box_is_passed_above_and_a_high_narrow_one_beside() -> None:
    start, goal = np.array([0.5, 0.0, 0.1]), np.array([0.5, 1.0, 0.2])
    low = Box.between((0.0, 0.4, -1.0), (1.0, 0.6, 0.3))
    np.testing.assert_allclose(
        routes(start, goal, [low])[0], [start, [0.5, 0.4, 0.3], [0.5, 0.6, 0.3], goal], atol=1e-12
    )
    high = Box.between((0.45, 0.4, -1.0), (0.7, 0.6, 0.9))
    way = routes(start, goal, [high])[0]
    np.testing.assert_allclose(way[:, :2], [[0.5, 0.0], [0.45, 0.4], [0.45, 0.6], [0.5, 1.0]], atol=1e-12)
    walked = np.r_[0, np.linalg.norm(np.diff(way[:, :2], axis=0), axis=1).cumsum()]
    np.testing.assert_allclose(way[:, 2], 0.1 + 0.1 * walked / walked[-1], atol=1e-12)


def test_a_corner_that_is_no_detour_is_left_out() -> None:
    box = Box.between((0.4, 0.4, -1.0), (0.6, 0.6, 5.0))
    way = routes(np.array([0.5, 0.0, 0.1]), np.array([0.3, 1.0, 0.1]), [box])[0]
    np.testing.assert_allclose(way[:, :2], [[0.5, 0.0], [0.4, 0.4], [0.3, 1.0]], atol=1e-12)


def test_the_length_of_a_path_is_the_sum_of_its_parts() -> None:
    assert length(np.array([[0.0, 0, 0], [3, 4, 0], [3, 4, 2]])) == pytest.approx(7)
    assert length(np.zeros((1, 3))) == 0


# Walking


@pytest.mark.parametrize("step", [0.001, 0.014, 0.3, 5.0])
def test_walking_takes_equal_steps_of_at_most_the_given_length_to_the_end(step: float) -> None:
    way = np.random.default_rng(0).uniform(size=(5, 3))
    points = walk(way, step)
    np.testing.assert_allclose(points[-1], way[-1], atol=1e-12)
    assert len(points) == math.ceil(length(way) / step)
    # Along the path: put the corners between the points, in the order in which they come.
    at_corner = np.linalg.norm(np.diff(way, axis=0), axis=1).cumsum()
    at_point = length(way) / len(points) * np.arange(1, len(points) + 1)
    order = np.argsort(np.r_[at_corner, at_point], kind="stable")
    merged = np.concatenate([way[:1], np.concatenate([way[1:], points])[order]])
    assert length(merged) == pytest.approx(length(way))
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(merged, axis=0), axis=1).cumsum(), np.r_[at_corner, at_point][order]
    )


def test_walking_a_straight_line_takes_equal_steps() -> None:
    points = walk(np.array([[0.0, 0, 0], [0.0, 0.3, 0.4]]), 0.12)
    np.testing.assert_allclose(points, np.linspace([0, 0, 0], [0, 0.3, 0.4], 6)[1:], atol=1e-12)


def test_walking_nowhere_is_one_step() -> None:
    np.testing.assert_array_equal(walk(np.ones((2, 3)), 0.01), np.ones((1, 3)))


# The expert


def gap(recording: Recording, wall: Box) -> float:
    """The smallest distance between hand or fingers and the wall [m]."""
    points = dense(np.array(recording.grips), 11)
    return min(
        float(
            np.linalg.norm(
                np.maximum(0, np.maximum(points + part.low - wall.high, wall.low - points - part.high)),
                axis=1,
            ).min()
        )
        for part in (HAND, FINGERS)
    )


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_the_expert_that_keeps_clear_succeeds_and_does_not_touch_the_wall(task: str) -> None:
    recordings = demonstrations(task, "clear")
    assert sum(r.is_success for r in recordings) >= 29
    assert sum(r.is_success and not r.is_collision for r in recordings) >= 29
    for recording in recordings:
        assert len(recording.blocks) == (len(recording.grips) if task == "push" else 0)
        moved = recording.blocks if recording.blocks else recording.grips
        assert recording.is_success == (math.dist(moved[-1], recording.goal) < 0.05)


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_the_expert_that_hugs_the_wall_mostly_succeeds(task: str) -> None:
    recordings = demonstrations(task, "hug")
    assert sum(r.is_success and not r.is_collision for r in recordings) >= 27


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_hugging_passes_nearer_to_the_wall_than_keeping_clear(task: str) -> None:
    wall = FETCH_SCENES[task].wall
    clear, hug = (np.array([gap(r, wall) for r in demonstrations(task, style)]) for style in ("clear", "hug"))
    assert np.median(clear) > 0.02
    assert np.median(hug) < 0.01
    # Some are not in the wall's way, whatever the style.
    assert np.mean(hug < clear) > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_a_demonstration_depends_on_its_seed_and_number_and_not_on_those_before(task: str) -> None:
    expected = demonstrations(task, "clear")
    env = FetchEnv(task)
    expert = ScriptedFetchExpert(env, "clear", seed=0)
    for number in (7, 2, 7, 0):
        again = expert.demonstrate(number)
        np.testing.assert_array_equal(again.grips, expected[number].grips)
        np.testing.assert_array_equal(again.blocks, expected[number].blocks)
        np.testing.assert_array_equal(again.goal, expected[number].goal)
    other = ScriptedFetchExpert(env, "clear", seed=1).demonstrate(0)
    goals = [other.goal, *(recording.goal for recording in expected)]
    assert len(np.unique(goals, axis=0)) == len(goals)
    env.close()


@pytest.mark.slow
def test_pushing_begins_behind_the_block_and_moves_it_nearer_all_the_time() -> None:
    for recording in demonstrations("push", "clear"):
        distances = np.linalg.norm(np.array(recording.blocks) - recording.goal, axis=1)
        assert np.all(np.diff(distances) < 1e-3)
        still = int(np.argmax(distances < distances[0] - 2e-3))  # the first step in which it has moved
        here, there = recording.grips[still][:2], recording.blocks[0][:2]
        assert np.dot(there - here, recording.goal[:2] - there) > 0


def test_styles_that_do_not_exist_are_refused() -> None:
    with pytest.raises(ValueError, match=r"style must be one of \['clear', 'hug'\], got 'bold'"):
        ScriptedFetchExpert(None, "bold")  # type: ignore[arg-type]
    assert STYLES["hug"][1] < STYLES["clear"][0]


# Collecting


def collect(task: str, root: Path, **changes: Any) -> tuple[int, Counter[str]]:
    arguments = {
        "repo_id": "local/fetch",
        "n_episodes": N_COLLECTED,
        "n_steps": 48,
        "style": "clear",
        "scene_changes": {},
        "seed": 0,
        "n_processes": 1,
        "overwrite": False,
    }
    return collect_fetch(task, root=root, **{**arguments, **changes})


def given(monkeypatch: pytest.MonkeyPatch, recordings: Iterator[Recording]) -> None:
    """Lets `collect_fetch` take demonstrations from here rather than from an expert."""
    monkeypatch.setattr(collecting, "_demonstrations", lambda *_: nullcontext(recordings))


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The folder of a dataset; that of Reach was collected by the expert, as always."""
    folder = tmp_path_factory.mktemp("collected")

    def collected(task: str) -> Path:
        if not (folder / task).exists():
            with pytest.MonkeyPatch.context() as monkeypatch:
                if task == "push":
                    given(monkeypatch, iter(demonstrations("push", "clear")))
                assert collect(task, folder / task)[0] == N_COLLECTED
        return folder / task

    return collected


def frames_of(root: Path) -> dict[str, np.ndarray]:
    """The columns of a dataset, ``(episodes, steps, ...)``."""
    dataset = LeRobotDataset("local/fetch", root=root)
    table = dataset.hf_dataset.with_format("numpy")
    return {
        key: np.stack(list(table[key])).reshape(dataset.num_episodes, -1, *dataset.features[key]["shape"])
        for key in ("observation.state", "observation.environment_state", "action")
    }


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_a_collected_dataset_is_one_of_lerobot_with_named_coordinates(
    collected: Callable[[str], Path], task: str
) -> None:
    dataset = LeRobotDataset("local/fetch", root=collected(task))
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (N_COLLECTED, 48 * N_COLLECTED, 25)
    places = ["block", "goal"] if task == "push" else ["goal"]
    names = {
        "observation.state": ["x", "y", "z"],
        "observation.environment_state": [f"{place}_{axis}" for place in places for axis in "xyz"],
        "action": ["x", "y", "z"],
    }
    for key, axes in names.items():
        assert dataset.features[key]["names"] == axes
        assert dataset.features[key]["shape"] == (len(axes),)
        assert dataset.features[key]["dtype"] == "float32"
        assert tuple(dataset[0][key].shape) == (len(axes),)
    assert dataset[0]["task"].startswith("Push the block" if task == "push" else "Move the gripper")
    card = (collected(task) / "README.md").read_text()
    assert "resampled to 48 steps" in card
    assert "A scripted expert moved it (style clear, seed 0)." in card


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_a_collected_dataset_holds_what_the_expert_did(collected: Callable[[str], Path], task: str) -> None:
    frames = frames_of(collected(task))
    good = [r for r in demonstrations(task, "clear") if r.is_success and not r.is_collision]
    for number, expected in enumerate(expected_frames(good[:N_COLLECTED])):
        for key, values in expected.items():
            np.testing.assert_array_equal(frames[key][number], values)


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_collected_actions_are_the_next_positions_and_near_enough_to_be_reached(
    collected: Callable[[str], Path], task: str
) -> None:
    frames = frames_of(collected(task))
    states, actions = frames["observation.state"], frames["action"]
    np.testing.assert_array_equal(actions[:, :-1], states[:, 1:])
    assert np.linalg.norm(actions - states, axis=2).max() <= MAX_STEP + 1e-6 <= 0.035
    # Corners of the workspace are reached within a centimetre, on either side.
    assert np.all((actions > WORKSPACE.low - 0.01) & (actions < WORKSPACE.high + 0.01))


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_replaying_collected_actions_reaches_the_goal_without_touching_the_wall(
    collected: Callable[[str], Path], task: str
) -> None:
    frames = frames_of(collected(task))
    env = FetchEnv(task)
    outcomes = Counter()
    for starts, places, actions in zip(*frames.values(), strict=True):
        block = {"block": places[0, :2]} if task == "push" else {}
        env.reset(seed=0, options={"start": starts[0], "goal": places[0, -3:].astype(float), **block})
        for action in actions:
            *_, info = env.step(action)
        outcomes[info["is_success"], info["is_collision"]] += 1
    env.close()
    assert outcomes[True, False] >= 0.95 * N_COLLECTED, outcomes


def test_one_process_is_this_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # What would start others is gone.
    monkeypatch.delattr(collecting, "worker_pool")
    assert collect("reach", tmp_path / "d", n_episodes=1)[0] == 1


@pytest.mark.slow
def test_the_number_of_processes_changes_no_byte(collected: Callable[[str], Path], tmp_path: Path) -> None:
    collect("reach", tmp_path / "d", n_processes=2)
    assert contents_of(tmp_path / "d") == contents_of(collected("reach"))


def gliding(start: Sequence[float], end: Sequence[float], n_steps: int = 40, **places: Any) -> Recording:
    """A gripper that moves in a straight line."""
    goal = np.array(places.pop("goal", end), dtype=float)
    return Recording(goal, list(np.linspace(start, end, n_steps + 1)), is_success=True, **places)


def test_demonstrations_that_are_no_good_are_left_out_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    good = gliding((1.2, 0.5, 0.5), (1.4, 0.6, 0.6))
    touching, failing = replace(good, is_collision=True), replace(good, is_success=False)
    far = gliding((1.1, 0.5, 0.5), (1.5, 1.0, 0.7), 100)
    recordings = [touching, good, failing, far, replace(touching, is_success=False), good, failing, good]
    given(monkeypatch, iter(recordings))
    n_written, left_out = collect("reach", tmp_path / "d", n_episodes=3, n_steps=16)
    assert n_written == 3
    assert left_out == {"in collision": 2, "without success": 2, "too long to be repeated in 16 steps": 1}
    assert LeRobotDataset("local/fetch", root=tmp_path / "d").num_episodes == 3


@pytest.mark.slow
@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_interruption_of_collecting_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[BaseException]
) -> None:
    def interrupted() -> Iterator[Recording]:
        yield from [gliding((1.2, 0.5, 0.5), (1.4, 0.6, 0.6))] * 3
        raise error("stop")

    given(monkeypatch, interrupted())
    with pytest.raises(error, match="stop"):
        collect("reach", tmp_path / "data" / "d")
    gc.collect()  # what is written when an object is deleted counts
    assert everything_in(tmp_path) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("send", "number", "code"),
    # As a terminal does, as the scheduler of a cluster does, and as `kill` does: workers are not told.
    [
        (os.killpg, signal.SIGINT, 130),
        (os.killpg, signal.SIGTERM, 143),
        (os.kill, signal.SIGTERM, 143),
    ],
)
def test_ctrl_c_and_sigterm_while_fetch_is_collected_leave_nothing_behind(
    tmp_path: Path, send: Callable[[int, int], None], number: signal.Signals, code: int
) -> None:
    process = ForkedCommand(
        "pf2mp-collect",
        "--task=fetch_reach",
        "--n_processes=2",
        f"--root={tmp_path / 'd'}",
        start_new_session=True,
    )
    try:
        end = time.monotonic() + SECONDS
        while not re.search(r"\| [1-9]\d*/1000 ", process.read()[1]):  # as the progress bar says
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < end
            time.sleep(0.05)
        assert everything_in(tmp_path) != []
        send(process.pid, number)
        output, errors = process.communicate(timeout=SECONDS)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == code
    assert everything_in(tmp_path) == []
    assert output == ""
    assert "Traceback" not in errors
    assert errors.strip().splitlines()[-1] == "interrupted: nothing half-written was left behind"


@pytest.mark.parametrize(
    ("task", "changes", "message"),
    [
        ("lift", {}, r"task must be one of \['reach', 'push'\], got 'lift'"),
        ("reach", {"style": "bold"}, r"style must be one of \['clear', 'hug'\], got 'bold'"),
        ("reach", {"n_processes": 0}, "n_processes must be at least 1, got 0"),
        ("reach", {"n_episodes": 0}, "n_episodes must be at least 1, got 0"),
        ("reach", {"n_steps": 1}, "n_steps must be at least 2, got 1"),
        ("reach", {"scene_changes": {"wall_size": (0.3, 0.04, 1.0)}}, "wall must be at most 0.32 m high"),
        (
            "reach",
            {"scene_changes": {"block_range": ((1.1, 0.9), (1.2, 0.9))}},
            "block_range is for push only",
        ),
    ],
)
def test_bad_options_for_collecting_are_refused_and_leave_nothing_behind(
    tmp_path: Path, task: str, changes: dict, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        collect(task, tmp_path / "d", **changes)
    assert everything_in(tmp_path) == []


def test_a_dataset_is_not_replaced_by_collecting_unless_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recordings = itertools.repeat(gliding((1.2, 0.5, 0.5), (1.4, 0.6, 0.6)))
    given(monkeypatch, recordings)
    collect("reach", tmp_path / "d", n_episodes=2)
    with pytest.raises(FileExistsError, match="exists already: .*--overwrite=true"):
        collect("reach", tmp_path / "d", n_episodes=3)
    collect("reach", tmp_path / "d", n_episodes=3, overwrite=True)
    assert LeRobotDataset("local/fetch", root=tmp_path / "d").num_episodes == 3


# Recordings of others


def trajectory_of(recording: Recording) -> Trajectory:
    blocks = np.array(recording.blocks) if recording.blocks else None
    return Trajectory(np.array(recording.grips), recording.goal, blocks)


def expected_frames(recordings: Sequence[Recording], n_steps: int = 48) -> list[dict[str, np.ndarray]]:
    """What the collector writes."""
    return list(prepare(map(trajectory_of, recordings), n_steps, lambda way: False, Counter()))


def foreign(recording: Recording) -> dict[str, np.ndarray]:
    """An episode in gymnasium-robotics' layout; what else it observes is nonsense here."""
    task = "push" if recording.blocks else "reach"
    n = len(recording.grips)
    observations = np.random.default_rng(0).normal(size=(n, WIDTHS[task]))
    observations[:, :3] = recording.grips
    if task == "push":
        observations[:, 3:6] = recording.blocks
    achieved = np.array(recording.blocks or recording.grips)
    goals = np.tile(recording.goal, (n, 1))
    return {"observation": observations, "achieved_goal": achieved, "desired_goal": goals}


def write_npz(path: Path, arrays: dict[str, np.ndarray | None]) -> Path:
    np.savez_compressed(path, **{name: values for name, values in arrays.items() if values is not None})
    return path


def rows(recordings: Sequence[Recording], marks: str = "episode_ends") -> dict[str, np.ndarray]:
    """All episodes, one after the other."""
    episodes = [foreign(recording) for recording in recordings]
    arrays = {name: np.concatenate([episode[name] for episode in episodes]) for name in episodes[0]}
    ends = np.cumsum([len(recording.grips) for recording in recordings])
    if marks == "episode_ends":
        return {**arrays, "episode_ends": ends}
    is_last = np.isin(np.arange(ends[-1]) + 1, ends)
    if marks == "both":  # ends for different reasons
        number = np.arange(len(is_last)) % 2 == 0
        return {**arrays, "terminals": is_last & number, "timeouts": is_last & ~number}
    return {**arrays, marks: is_last}


def episodes_of_one_length(recordings: Sequence[Recording]) -> dict[str, np.ndarray]:
    """The robot waits at the goal until the slowest has arrived, as the original environments have it."""
    n = max(len(recording.grips) for recording in recordings)
    padded = []
    for recording in recordings:
        episode = foreign(recording)
        padded.append({k: np.pad(v, ((0, n - len(v)), (0, 0)), mode="edge") for k, v in episode.items()})
    return {name: np.stack([episode[name] for episode in padded]) for name in padded[0]}


def write_minari_fetch(
    folder: Path, monkeypatch: pytest.MonkeyPatch, recordings: Sequence[Recording], without: str | None = None
) -> Path:
    episodes = [{name: values for name, values in foreign(r).items() if name != without} for r in recordings]
    spaces = {
        name: gym.spaces.Box(-np.inf, np.inf, values.shape[1:], np.float64)
        for name, values in episodes[0].items()
    }
    return write_minari(folder, monkeypatch, episodes, gym.spaces.Dict(spaces))


def convert(path: Path, task: str, root: Path, **changes: Any) -> tuple[int, Counter[str]]:
    arguments = {"repo_id": "local/fetch", "n_steps": 48, "scene_changes": {}}
    return convert_fetch(path, task, root=root, **{**arguments, **changes})


def assert_holds(root: Path, recordings: Sequence[Recording], n_steps: int = 48) -> None:
    frames = frames_of(root)
    expected = expected_frames(recordings, n_steps)
    assert len(frames["action"]) == len(expected)
    for number, episode in enumerate(expected):
        for key, values in episode.items():
            np.testing.assert_allclose(frames[key][number], values, rtol=0, atol=1e-6)


# Trajectories of the gripper without simulation: beside the wall, through it, and beside it but not to the goal.
BESIDE = gliding((1.20, 0.50, 0.50), (1.40, 0.60, 0.55))
ABOVE = gliding((1.30, 0.50, 0.72), (1.30, 0.95, 0.72), 55)
THROUGH = gliding((1.30, 0.55, 0.45), (1.30, 0.95, 0.45))
ASTRAY = gliding((1.20, 0.50, 0.50), (1.40, 0.60, 0.55), goal=(1.40, 0.60, 0.601))
NEARLY = gliding((1.20, 0.50, 0.50), (1.40, 0.60, 0.55), goal=(1.40, 0.60, 0.599))
SHORT = gliding((1.20, 0.50, 0.50), (1.21, 0.50, 0.50), 1)


def pushed(
    start: Sequence[float], end: Sequence[float], height: float = 0.425, n_steps: int = 30
) -> Recording:
    """A block that is pushed along a line by a gripper that is always 7 cm behind, at some height."""
    blocks = np.linspace((*start, 0.425), (*end, 0.425), n_steps + 1)
    way = blocks[-1] - blocks[0]
    grips = blocks - 0.07 * way / np.linalg.norm(way)
    grips[:, 2] = height
    return Recording(blocks[-1].copy(), list(grips), list(blocks), is_success=True)


PUSHED = pushed((1.15, 0.90), (1.15, 0.60))


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_recordings_of_others_become_what_the_collector_writes(
    collected: Callable[[str], Path], tmp_path: Path, task: str
) -> None:
    good = [r for r in demonstrations(task, "clear") if r.is_success and not r.is_collision][:N_COLLECTED]
    path = write_npz(tmp_path / "others.npz", rows(good))
    assert convert(path, task, tmp_path / "d") == (N_COLLECTED, {})
    for name in ("data", "meta"):
        assert contents_of(tmp_path / "d" / name) == contents_of(collected(task) / name)
    assert "Converted from others.npz (fetch)." in (tmp_path / "d" / "README.md").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_episodes_in_which_the_robot_waits_at_the_goal_keep_their_trajectory(
    tmp_path: Path, task: str
) -> None:
    good = [r for r in demonstrations(task, "clear") if r.is_success and not r.is_collision][:10]
    path = write_npz(tmp_path / "others.npz", episodes_of_one_length(good))
    assert convert(path, task, tmp_path / "d") == (10, {})
    frames = frames_of(tmp_path / "d")
    for number, recording in enumerate(good):
        way = dense(np.array(recording.grips), 21)
        far = np.linalg.norm(frames["observation.state"][number][:, None] - way, axis=2).min(axis=1)
        assert far.max() < 0.004  # corners that resampling cuts
        np.testing.assert_allclose(frames["action"][number, -1], recording.grips[-1], atol=1e-6)
        places = frames["observation.environment_state"][number]
        np.testing.assert_allclose(places[:, -3:], np.tile(recording.goal, (48, 1)), atol=1e-6)
        if task == "push":
            np.testing.assert_allclose(places[0, :3], recording.blocks[0], atol=1e-6)


@pytest.mark.parametrize("marks", ["episode_ends", "terminals", "timeouts", "both"])
def test_rows_are_parted_where_they_are_marked(tmp_path: Path, marks: str) -> None:
    recordings = [BESIDE, ABOVE, NEARLY, BESIDE]
    path = write_npz(tmp_path / "others.npz", rows(recordings, marks))
    assert convert(path, "reach", tmp_path / "d") == (4, {})
    assert_holds(tmp_path / "d", recordings)


@pytest.mark.parametrize("marks", ["terminals", "timeouts"])
def test_rows_behind_the_last_mark_are_an_episode(tmp_path: Path, marks: str) -> None:
    arrays = rows([BESIDE, ABOVE], marks)
    arrays[marks][-1] = False
    n_episodes, trajectories = read_fetch(write_npz(tmp_path / "others.npz", arrays), "reach")
    assert n_episodes == 2
    for trajectory, recording in zip(trajectories, (BESIDE, ABOVE), strict=True):
        np.testing.assert_array_equal(trajectory.positions, recording.grips)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("n_goals", [40, 41])
@pytest.mark.parametrize("with_achieved", [True, False])
def test_goals_may_be_one_fewer_than_observations(
    tmp_path: Path, dtype: type, n_goals: int, with_achieved: bool
) -> None:
    arrays = episodes_of_one_length([BESIDE, NEARLY])
    arrays["desired_goal"] = arrays["desired_goal"][:, :n_goals]
    if not with_achieved:
        del arrays["achieved_goal"]
    path = write_npz(tmp_path / "others.npz", {name: values.astype(dtype) for name, values in arrays.items()})
    assert convert(path, "reach", tmp_path / "d", n_steps=20) == (2, {})
    assert_holds(tmp_path / "d", [BESIDE, NEARLY], 20)


def test_the_goal_of_an_episode_is_its_last(tmp_path: Path) -> None:
    arrays = episodes_of_one_length([BESIDE])
    arrays["desired_goal"][:, :-1] += 0.2
    _, (trajectory,) = read_fetch(write_npz(tmp_path / "others.npz", arrays), "reach")
    np.testing.assert_array_equal(trajectory.goal, BESIDE.goal)


def test_only_positions_are_read_from_observations(tmp_path: Path) -> None:
    arrays = episodes_of_one_length([PUSHED])
    arrays["observation"][:, :, 6:] = np.nan
    arrays |= {"action": np.full((1, 30, 4), np.nan), "info": np.array(["anything"])}
    assert convert(write_npz(tmp_path / "others.npz", arrays), "push", tmp_path / "d") == (1, {})
    assert_holds(tmp_path / "d", [PUSHED])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "recordings"), [("reach", [BESIDE, THROUGH, ABOVE]), ("push", [PUSHED] * 2)]
)
def test_minari_datasets_of_fetch_are_converted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, task: str, recordings: list[Recording]
) -> None:
    folder = write_minari_fetch(tmp_path / "in", monkeypatch, recordings)
    kept = [recording for recording in recordings if recording is not THROUGH]
    for number, path in enumerate((folder, folder / "data")):
        root = tmp_path / str(number)
        n_written, left_out = convert(path, task, root)
        assert n_written == len(kept)
        assert left_out == ({"in collision": 1} if task == "reach" else {})
        assert_holds(root, kept)


def recorded_in_gymnasium(task: str, n_episodes: int) -> dict[str, np.ndarray]:
    """What gymnasium-robotics' own environment observes while the gripper is driven to the goal."""
    import gymnasium_robotics

    gym.register_envs(gymnasium_robotics)
    env = gym.make(f"Fetch{task.capitalize()}-v4")
    episodes = []
    for seed in range(n_episodes):
        observations = [env.reset(seed=seed)[0]]
        for _ in range(env.spec.max_episode_steps):
            way = 10 * (observations[-1]["desired_goal"] - observations[-1]["observation"][:3])
            observations.append(env.step(np.array([*way.clip(-1, 1), 0.0]))[0])
        episodes.append({name: np.stack([o[name] for o in observations]) for name in observations[0]})
    env.close()
    return {name: np.stack([episode[name] for episode in episodes]) for name in episodes[0]}


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_the_layout_is_that_of_gymnasium_robotics(tmp_path: Path, task: str) -> None:
    arrays = recorded_in_gymnasium(task, 2)
    path = write_npz(tmp_path / "others.npz", arrays)
    n_episodes, trajectories = read_fetch(path, task)
    assert n_episodes == 2
    for trajectory, achieved, goals in zip(
        trajectories, arrays["achieved_goal"], arrays["desired_goal"], strict=True
    ):
        moved = trajectory.objects if task == "push" else trajectory.positions
        np.testing.assert_array_equal(moved, achieved)
        np.testing.assert_array_equal(trajectory.goal, goals[-1])
    if task == "reach":
        # The gripper starts where this package's wall stands.
        with pytest.raises(
            ValueError, match=r"none that is usable in .*others.npz \(left out: 2 in collision\)"
        ):
            convert(path, "reach", tmp_path / "d")
        assert convert(path, "reach", tmp_path / "d", scene_changes=NO_WALL) == (2, {})


def test_episodes_that_are_no_good_are_left_out_and_counted(tmp_path: Path) -> None:
    path = write_npz(tmp_path / "others.npz", rows([THROUGH, BESIDE, ASTRAY, SHORT, THROUGH, NEARLY]))
    n_written, left_out = convert(path, "reach", tmp_path / "d")
    assert n_written == 2
    assert left_out == {"in collision": 2, "without success": 1, "shorter than 2 steps": 1}
    assert_holds(tmp_path / "d", [BESIDE, NEARLY])


def test_paths_are_checked_between_resampled_positions(tmp_path: Path) -> None:
    corners = [(1.30, 0.62, 0.42), (1.30, 0.62, 0.63), (1.30, 0.88, 0.63), (1.30, 0.88, 0.42)]
    parts = [np.linspace(a, b, 20, endpoint=False) for a, b in itertools.pairwise(corners)]
    around = Recording(np.array(corners[-1]), list(np.concatenate([*parts, corners[-1:]])))
    path = write_npz(tmp_path / "others.npz", rows([around, BESIDE]))
    assert convert(path, "reach", tmp_path / "fine", n_steps=60) == (2, {})
    assert convert(path, "reach", tmp_path / "coarse", n_steps=2) == (1, {"in collision": 1})


def test_a_block_that_passes_through_the_wall_is_a_collision_although_the_gripper_is_above(
    tmp_path: Path,
) -> None:
    through = pushed((1.30, 0.90), (1.30, 0.60), height=0.70)
    path = write_npz(tmp_path / "others.npz", rows([through, PUSHED]))
    assert convert(path, "push", tmp_path / "d") == (1, {"in collision": 1})


def test_the_block_counts_as_wide_as_it_is_when_turned(tmp_path: Path) -> None:
    side = FETCH_SCENES["push"].wall.low[0]
    for share, n_written in ((0.69, 1), (0.72, 2)):
        x = side - share * BLOCK_SIZE  # half its diagonal is 0.707 times its side
        passing = pushed((x, 0.90), (x, 0.60), height=0.70)
        path = write_npz(tmp_path / f"{share}.npz", rows([passing, PUSHED]))
        assert convert(path, "push", tmp_path / str(share))[0] == n_written


def test_success_of_push_is_the_block_at_the_goal(tmp_path: Path) -> None:
    left_behind = replace(PUSHED, blocks=[PUSHED.blocks[0]] * len(PUSHED.blocks), goal=PUSHED.grips[-1])
    path = write_npz(tmp_path / "others.npz", rows([left_behind, PUSHED]))
    assert convert(path, "push", tmp_path / "d") == (1, {"without success": 1})


def test_the_wall_may_be_where_it_was_when_they_were_recorded(tmp_path: Path) -> None:
    path = write_npz(tmp_path / "others.npz", rows([THROUGH, BESIDE]))
    assert convert(path, "reach", tmp_path / "without", scene_changes=NO_WALL) == (2, {})
    low = {"wall_size": (0.30, 0.04, 0.02)}
    assert convert(path, "reach", tmp_path / "low", scene_changes=low) == (2, {})
    higher = {"wall_size": (0.30, 0.04, 0.04)}
    assert convert(path, "reach", tmp_path / "high", scene_changes=higher) == (1, {"in collision": 1})


def test_no_more_recordings_are_written_than_asked_for(tmp_path: Path) -> None:
    path = write_npz(tmp_path / "others.npz", rows([BESIDE] * 5))
    assert convert(path, "reach", tmp_path / "d", n_episodes=3) == (3, {})
    assert LeRobotDataset("local/fetch", root=tmp_path / "d").num_episodes == 3


# Recordings that are refused


def changed(arrays: dict[str, np.ndarray], **changes: Any) -> dict[str, np.ndarray]:
    return {**arrays, **changes}


def with_value(values: np.ndarray, index: tuple, value: float) -> np.ndarray:
    values = values.copy()
    values[index] = value
    return values


REACH, ROWS, PUSH = (
    episodes_of_one_length([BESIDE, NEARLY]),
    rows([BESIDE, ABOVE]),
    episodes_of_one_length([PUSHED]),
)


@pytest.mark.parametrize(
    ("task", "arrays", "message"),
    [
        # Arrays
        (
            "reach",
            changed(REACH, observation=None),
            "must hold observation and desired_goal, .* missing: observation$",
        ),
        (
            "reach",
            changed(REACH, desired_goal=None),
            "must hold observation and desired_goal, .* missing: desired_goal$",
        ),
        ("reach", {"actions": np.zeros(3)}, r"got \['actions'\] in .* missing: observation, desired_goal$"),
        (
            "reach",
            changed(REACH, observation=np.array([{}] * 2)),
            "npz file without pickles, .* allow_pickle=False",
        ),
        (
            "reach",
            changed(REACH, achieved_goal=np.array([{}])),
            "npz file without pickles, .* allow_pickle=False",
        ),
        (
            "reach",
            changed(REACH, desired_goal=np.array(["a", "b"])),
            "desired_goal must hold real numbers, got <U1",
        ),
        (
            "reach",
            changed(REACH, observation=REACH["observation"] + 1j),
            "observation must hold real numbers, got comp",
        ),
        ("reach", changed(REACH, observation=np.float64(3)), r"must have shape .* got .*'observation': \(\)"),
        (
            "reach",
            changed(REACH, observation=np.zeros((0, 41, 10))),
            "with at least one episode or row, got .*0, 41, 10",
        ),
        ("reach", {k: v[:0] for k, v in REACH.items()}, "with at least one episode or row, got"),
        ("reach", {k: v[:0] for k, v in ROWS.items()}, "with at least one episode or row, got"),
        (
            "reach",
            changed(REACH, desired_goal=REACH["desired_goal"][:1]),
            "must have shape .*'desired_goal': .1, 41, 3",
        ),
        (
            "reach",
            changed(REACH, desired_goal=REACH["desired_goal"][:, 0]),
            "must have shape .*'desired_goal': .2, 3",
        ),
        (
            "reach",
            changed(REACH, achieved_goal=np.zeros((3, 41, 3))),
            "must have shape .*'achieved_goal': .3, 41, 3",
        ),
        # Their shapes in an episode
        ("push", REACH, r"25 columns for fetch_push, .* got shape \(41, 10\) in episode 0 of .*others.npz"),
        ("reach", PUSH, r"10 columns for fetch_reach, .* got shape \(31, 25\) in episode 0"),
        (
            "reach",
            changed(REACH, observation=np.ones((2, 41, 4))),
            r"10 columns for fetch_reach, .* got shape \(41, 4\)",
        ),
        ("reach", changed(REACH, observation=np.ones((2, 0, 10))), r"10 columns for .* got shape \(0, 10\)"),
        (
            "reach",
            changed(REACH, desired_goal=np.ones((2, 41, 2))),
            r"must have 3 columns .* got shape \(41, 2\)",
        ),
        (
            "reach",
            changed(REACH, desired_goal=np.ones((2, 39, 3))),
            r"as observation, 41, or one less .* \(39, 3\)",
        ),
        (
            "reach",
            {k: v[:, : k != "desired_goal"] for k, v in REACH.items()},
            r"at least one, got shape \(0, 3\)",
        ),
        (
            "reach",
            changed(REACH, achieved_goal=np.ones((2, 40, 3))),
            r"achieved_goal must have shape \(41, 3\), got",
        ),
        (
            "push",
            changed(PUSH, achieved_goal=PUSH["observation"][..., :3]),
            "must be the block's position, columns 3 to 5",
        ),
        (
            "reach",
            changed(REACH, achieved_goal=REACH["achieved_goal"] + 0.01),
            "must be the gripper's .* columns 0 to 2",
        ),
        # Ends of episodes
        (
            "reach",
            changed(ROWS, episode_ends=None),
            "with episode_ends, terminals or timeouts, got none of them",
        ),
        (
            "reach",
            changed(ROWS, episode_ends=np.array([41, 96])),
            "increase from at least 1 to the number of rows, 97, got",
        ),
        (
            "reach",
            changed(ROWS, episode_ends=np.array([41, 41, 97])),
            r"increase .* got array\(\[41, 41, 97\]\)",
        ),
        ("reach", changed(ROWS, episode_ends=np.array([0, 97])), "increase from at least 1"),
        ("reach", changed(ROWS, episode_ends=np.array([50, 97, 41], np.uint8)), "increase from at least 1"),
        ("reach", changed(ROWS, episode_ends=np.array([41.0, 97.0])), "must be whole numbers"),
        ("reach", changed(ROWS, episode_ends=np.array([[41, 97]])), "must be whole numbers"),
        ("reach", changed(ROWS, episode_ends=np.array([], int)), "must be whole numbers"),
        (
            "reach",
            changed(ROWS, episode_ends=None, terminals=np.zeros(97, bool)),
            "terminals must mark where episodes end, got no mark",
        ),
        (
            "reach",
            changed(ROWS, episode_ends=None, timeouts=np.ones(96, bool)),
            r"timeouts must have one entry for each of 97 rows, got \(96,\)",
        ),
        # Values
        (
            "reach",
            changed(REACH, observation=with_value(REACH["observation"], (1, 5, 2), np.nan)),
            "must be finite, got NaN or infinity in observation of episode 1",
        ),
        (
            "push",
            changed(PUSH, observation=with_value(PUSH["observation"], (0, 5, 3), -np.inf)),
            "must be finite, got NaN or infinity in observation of episode 0",
        ),
        (
            "reach",
            changed(REACH, desired_goal=with_value(REACH["desired_goal"], (0, 0, 0), np.inf)),
            "must be finite, got NaN or infinity in desired_goal of episode 0",
        ),
        (
            "reach",
            changed(REACH, achieved_goal=with_value(REACH["achieved_goal"], (0, 0, 0), np.nan)),
            "achieved_goal must be the gripper's position",
        ),
        # Places
        (
            "reach",
            {name: 1000 * values for name, values in REACH.items()},
            r"from \[0.3, -0.3, -0.335\] to \[2.3, 1.8, 1.55\] m, got \[1200.0, 500.0, 500.0\] to .* not in metres\?",
        ),
        (
            "push",  # a Panda at the origin
            {name: values - np.array(1.3) for name, values in PUSH.items()},
            r"about where Fetch can reach, .* got \[-0.15, .* in episode 0 of .*: is it from another robot",
        ),
        (
            "reach",
            changed(REACH, desired_goal=REACH["desired_goal"] * [1, 1, 1000]),
            "about where Fetch can reach, .* in episode 0",
        ),
        (
            "reach",
            {
                "observation": with_value(REACH["observation"], (1, 7, 0), 1e6),
                "desired_goal": REACH["desired_goal"],
            },
            r"about where Fetch can reach, .* to \[1000000.0, .* in episode 1",
        ),
    ],
)
def test_npz_files_of_another_layout_are_refused_and_leave_nothing_behind(
    tmp_path: Path, task: str, arrays: dict, message: str
) -> None:
    path = write_npz(tmp_path / "others.npz", arrays)
    with pytest.raises(ValueError, match=message):
        convert(path, task, tmp_path / "d")
    assert everything_in(tmp_path) == ["others.npz"]


def text(path: Path) -> None:
    path.write_text("<html>404 not found</html>")


def empty(path: Path) -> None:
    path.write_bytes(b"")


def d4rl(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["observations"] = np.zeros((10, 4), np.float32)


def single_array(path: Path) -> None:
    with path.open("wb") as file:
        np.save(file, np.zeros((2, 41, 10)))


def cut_in_half(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize("damage", [text, empty, d4rl, single_array, cut_in_half])
def test_files_that_are_not_whole_npz_files_are_refused_and_leave_nothing_behind(
    tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    path = write_npz(tmp_path / "others.npz", REACH)
    damage(path)
    with pytest.raises(
        ValueError,
        match=r"others\.npz must be a whole npz file or the folder of a Minari dataset, got neither",
    ):
        convert(path, "reach", tmp_path / "d")
    assert everything_in(tmp_path) == ["others.npz"]


def test_npz_files_that_are_garbled_in_the_middle_are_refused(tmp_path: Path) -> None:
    path = write_npz(tmp_path / "others.npz", REACH)
    content = bytearray(path.read_bytes())
    content[300:400] = bytes(100)
    path.write_bytes(content)
    with pytest.raises(
        ValueError, match="must be a whole npz file without pickles, got one that cannot be read"
    ):
        convert(path, "reach", tmp_path / "d")
    assert everything_in(tmp_path) == ["others.npz"]


def test_npz_files_that_unpack_to_much_more_than_is_stored_are_refused_before_they_are_read(
    tmp_path: Path,
) -> None:
    def header(shape: tuple[int, ...]) -> bytes:
        stream = io.BytesIO()
        np.lib.format.write_array_header_1_0(stream, {"shape": shape, "fortran_order": False, "descr": "<f8"})
        return stream.getvalue()

    path = write_npz(tmp_path / "others.npz", changed(REACH, observation=None))
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("observation.npy", header((10**9, 11, 10)) + bytes(10**6))
    with pytest.raises(
        ValueError, match=r"observation must be stored .* shape \(1000000000, 11, 10\) and 8.8e\+"
    ):
        read_fetch(path, "reach")


def test_a_missing_recording_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=f"must be an npz file or the folder of .* got {tmp_path}/no"):
        convert(tmp_path / "no", "reach", tmp_path / "d")
    assert everything_in(tmp_path) == []


def test_a_recording_may_be_given_below_the_home_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    write_npz(tmp_path / "others.npz", REACH)
    assert read_fetch(Path("~/others.npz"), "reach")[0] == 2


def test_minari_datasets_that_are_not_of_fetch_are_refused_and_leave_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "empty").mkdir()
    plain = write_minari(
        tmp_path / "plain", monkeypatch, [np.zeros((5, 3), np.float32)], gym.spaces.Box(-1, 1, (3,))
    )
    refused = [
        (tmp_path / "empty", "reach", "must hold a Minari dataset, got one that cannot be read"),
        (plain, "reach", "must hold episodes with observation, desired_goal, achieved_goal, got array"),
        (
            write_minari_fetch(tmp_path / "goalless", monkeypatch, [BESIDE], without="desired_goal"),
            "reach",
            "must hold episodes with observation, desired_goal, achieved_goal, got {",
        ),
        (
            write_minari_fetch(tmp_path / "other", monkeypatch, [PUSHED]),
            "reach",
            r"observation must have 10 columns for fetch_reach, .* got shape \(31, 25\) in episode 0 of",
        ),
    ]
    before = everything_in(tmp_path)
    for path, task, message in refused:
        with pytest.raises(ValueError, match=message):
            convert(path, task, tmp_path / "d")
    assert everything_in(tmp_path) == before


def test_recordings_without_a_usable_episode_are_refused_with_the_reasons(tmp_path: Path) -> None:
    path = write_npz(tmp_path / "others.npz", rows([THROUGH, ASTRAY, THROUGH]))
    with pytest.raises(
        ValueError,
        match=r"got none that is usable in .*others.npz \(left out: 2 in collision, 1 without success\); "
        r"the wall is at \(1.3, 0.75\) m and \(0.3, 0.04, 0.2\) m in size",
    ):
        convert(path, "reach", tmp_path / "d")
    assert everything_in(tmp_path) == ["others.npz"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n_steps": 1}, "n_steps must be at least 2, got 1"),
        ({"n_episodes": 0}, "n_episodes must be at least 1, got 0"),
        ({"scene_changes": {"wall_size": (0.3, 0.04, 1.0)}}, "wall must be at most 0.32 m high"),
        ({"task": "lift"}, r"task must be one of \['reach', 'push'\], got 'lift'"),
    ],
)
def test_bad_options_for_converting_are_refused_and_leave_nothing_behind(
    tmp_path: Path, changes: dict, message: str
) -> None:
    path = write_npz(tmp_path / "others.npz", REACH)
    with pytest.raises(ValueError, match=message):
        convert(path, changes.pop("task", "reach"), tmp_path / "d", **changes)
    assert everything_in(tmp_path) == ["others.npz"]


# pf2mp-convert


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs pf2mp-convert in this process; returns the last line it prints."""

    def command(*arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", ["pf2mp-convert", *arguments])
        capfd.readouterr()
        try:
            cli.convert()
        except SystemExit as exit_:
            assert exit_.code == 1
            captured = capfd.readouterr()
            assert captured.out == ""
            assert "Traceback" not in captured.err
            return captured.err.strip().splitlines()[-1]
        return capfd.readouterr().out.strip()

    return command


def test_the_command_writes_48_steps_and_says_what_was_left_out(
    tmp_path: Path, command: Callable[..., str]
) -> None:
    path = write_npz(tmp_path / "others.npz", rows([THROUGH, BESIDE, ASTRAY, NEARLY, THROUGH]))
    options = ("--source.type=fetch", f"--source.path={path}", "--task=fetch_reach")
    root = tmp_path / "d"
    assert command(*options, f"--root={root}") == (
        f"Wrote 2 episodes of 48 steps to {root} (left out: 2 in collision, 1 without success)."
    )
    info = json.loads((root / "meta/info.json").read_text())
    assert (info["total_episodes"], info["total_frames"]) == (2, 96)
    assert command(*options, f"--root={root}").startswith(f"error: {root} exists already")
    root = tmp_path / "moved"
    moved = ("--scene.wall_position=[1.1,0.45]", "--scene.wall_size=[0.02,0.02,0.02]", "--n_steps=20")
    assert command(*options, *moved, f"--root={root}") == (
        f"Wrote 4 episodes of 20 steps to {root} (left out: 1 without success)."
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--task=maze_large"], "error: task must be one of ['fetch_reach', 'fetch_push'], got 'maze_large'"),
        (["--maze_map=11111/10001/11111"], "error: --maze_map is for mazes only, got 11111/10001/11111"),
        (["--source.type=d4rl"], "error: --source.type must be fetch for fetch_reach, got 'd4rl'"),
        (["--source.type=minari"], "error: --source.type must be fetch for fetch_reach, got 'minari'"),
        (
            ["--source.type=rlds"],
            "error: --source.type must be one of ['d4rl', 'minari', 'fetch', 'handwriting'], got 'rlds'",
        ),
        (
            ["--source.path=no.npz"],
            "error: source.path must be an npz file or the folder of a Minari dataset",
        ),
        (["--source.path=maze.hdf5"], "error: maze.hdf5 must be a whole npz file"),
        (["--source.path=."], "error: . must hold a Minari dataset"),
        (["--task=fetch_push"], "error: observation must have 25 columns for fetch_push"),
        (["--n_steps=1"], "error: n_steps must be at least 2, got 1"),
        (["--scene.wall_size=[0.3,0.04,2]"], "error: a wall must be at most 0.32 m high"),
        (["--scene.wall_position=[1.3]"], "error: `scene.wall_position`"),
    ],
)
def test_bad_values_for_the_command_end_in_one_line_and_nothing_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Callable[..., str], options: list, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    write_npz(Path("others.npz"), REACH)
    d4rl(Path("maze.hdf5"))
    usual = ("--source.type=fetch", "--source.path=others.npz", "--task=fetch_reach", "--root=d")
    assert command(*usual, *options).startswith(message)
    assert everything_in(tmp_path) == ["maze.hdf5", "others.npz"]
