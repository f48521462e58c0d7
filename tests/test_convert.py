# SPDX-License-Identifier: Apache-2.0
import json
import shutil
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import h5py
import numpy as np
import pytest
from foreign_recordings import OPEN, demonstrations, line, to_d4rl, write_d4rl, write_minari, write_pointmaze
from lerobot.datasets import LeRobotDataset

from lerobot_pf2mp.dataset_tools.maze import convert_d4rl
from lerobot_pf2mp.dataset_tools.maze.convert_d4rl import read_d4rl
from lerobot_pf2mp.dataset_tools.maze.convert_minari import read_minari, recorded_maze
from lerobot_pf2mp.dataset_tools.maze.maze_dataset import write_maze_dataset
from lerobot_pf2mp.dataset_tools.maze.maze_recognition import maze_of_recording
from lerobot_pf2mp.dataset_tools.writing.episodes import Trajectory, resample
from lerobot_pf2mp.envs.maze.point_maze import parse_maze_map

LOPSIDED = (
    "1111111/1000001/1111101/1110001/1111111"  # tells rows from columns, north from south, east from west
)


def assert_same(read: list[Trajectory], expected: list[Trajectory], atol: float) -> None:
    assert len(read) == len(expected)
    for left, right in zip(read, expected, strict=True):
        assert left.n_steps == right.n_steps
        np.testing.assert_allclose(left.positions, right.positions, rtol=0, atol=atol)
        np.testing.assert_allclose(left.goal, right.goal, rtol=0, atol=atol)


# D4RL


@pytest.mark.parametrize("maze", ["umaze", "medium", "large", LOPSIDED])
@pytest.mark.parametrize("timeouts", [True, False])
def test_d4rl_files_give_back_positions_and_goals_in_the_coordinates_of_the_environment(
    tmp_path: Path, maze: str, timeouts: bool
) -> None:
    expected = demonstrations(maze, 12)
    path = write_d4rl(tmp_path / "maze2d.hdf5", expected, maze, timeouts)
    assert_same(list(read_d4rl(path, maze)[1]), expected, atol=1e-5)


def test_the_first_free_cell_of_d4rl_is_the_northwestern_one(tmp_path: Path) -> None:
    # D4RL's maze2d-large: reset at cell (1, 1) is joint position (0.8, 0.8), goal cell (7, 10) likewise.
    cells = np.array([[1, 1], [1, 2], [2, 1], [7, 10]], np.float32) - 0.2
    observations = np.hstack([cells, np.zeros((4, 2), np.float32)])
    path = write_d4rl(
        tmp_path / "maze2d.hdf5",
        [line((0, 0), (1, 1), 3)],
        "large",
        with_timeouts=False,
        observations=observations,
        infos__goal=np.tile(cells[-1], (4, 1)),
    )
    _, (trajectory,) = read_d4rl(path, "large")
    np.testing.assert_allclose(trajectory.positions, [[-4.5, 3], [-3.5, 3], [-4.5, 2], [4.5, -3]], atol=1e-6)
    np.testing.assert_allclose(trajectory.goal, [4.5, -3], atol=1e-6)


def test_timeouts_part_trajectories_with_one_goal_and_rounding_does_not(tmp_path: Path) -> None:
    # The only goal of the file is not that of the way back, which ends elsewhere.
    there, back = line((-1, 1), (1, 1), 9), line((1, 1), (-1, 1), 7)
    written = [there, Trajectory(back.positions, there.goal)]
    path = write_d4rl(tmp_path / "with.hdf5", written, LOPSIDED, with_timeouts=True)
    assert_same(list(read_d4rl(path, LOPSIDED)[1]), [there, back], atol=1e-5)
    goals = to_d4rl(np.tile(there.goal, (10, 1)), LOPSIDED) * (
        1 + np.float32(2e-7) * np.arange(10)[:, None] % 2
    )
    path = write_d4rl(tmp_path / "without.hdf5", [there], LOPSIDED, with_timeouts=False, infos__goal=goals)
    assert_same(list(read_d4rl(path, LOPSIDED)[1]), [there], atol=1e-5)


@pytest.mark.parametrize("timeouts", [True, False])
@pytest.mark.parametrize("n_rows", [1, 7, 10, 64])
def test_d4rl_files_give_back_the_same_whatever_slices_they_are_read_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, timeouts: bool, n_rows: int
) -> None:
    # Trajectories that end in a slice's middle, at its end, in the next one's first row, and that span several.
    lengths = [6, 2, 9, 20, 19, 1, 0, 30, 6]
    goals = [(1.0, 1.0)] if timeouts else [(1.0, 1.0), (-1.0, 1.0)]
    expected = [
        line((0.6, 1.0), goals[number % len(goals)], n_steps) for number, n_steps in enumerate(lengths)
    ]
    path = write_d4rl(tmp_path / "maze2d.hdf5", expected, LOPSIDED, timeouts)
    monkeypatch.setattr(convert_d4rl, "_SLICE_ROWS", n_rows)
    n_trajectories, trajectories = read_d4rl(path, LOPSIDED)
    assert n_trajectories == len(lengths)
    assert_same(list(trajectories), expected, atol=1e-5)


def test_the_memory_to_read_d4rl_files_does_not_grow_with_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(convert_d4rl, "_SLICE_ROWS", 1000)
    there, back = line((-1, 1), (1, 1), 199), line((1, 1), (-1, 1), 199)

    def peak(n_rows: int) -> int:
        path = write_d4rl(tmp_path / "maze2d.hdf5", [there, back] * (n_rows // 400), LOPSIDED, True)
        tracemalloc.start()
        for _ in read_d4rl(path, LOPSIDED)[1]:
            pass
        used = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return used

    assert peak(80_000) < 1.5 * peak(8_000)


@pytest.mark.parametrize("timeouts", [True, False])
def test_colliding_and_short_trajectories_of_d4rl_are_left_out_and_counted(
    tmp_path: Path, timeouts: bool
) -> None:
    good = demonstrations("medium", 5)
    through_walls = line((-2.5, 2.5), (2.5, -2.5), 200)
    trajectories = [
        good[0],
        through_walls,
        line((-2.5, 2.5), (-2.4, 2.5), 1),
        *good[1:4],
        line((-2.5, 2.5), (-2.5, 2.5), 0),
        good[4],
    ]
    path = write_d4rl(tmp_path / "maze2d.hdf5", trajectories, "medium", timeouts)
    n_written, dropped = write_maze_dataset(
        read_d4rl(path, "medium")[1], root=tmp_path / "d", repo_id="a/b", maze="medium", origin="", n_steps=80
    )
    assert n_written == 5
    assert dropped == {"in collision": 1, "shorter than 2 steps": 2}
    dataset = LeRobotDataset("a/b", root=tmp_path / "d")
    for number, trajectory in enumerate(good):
        way = resample(trajectory.positions, 80)
        for step in (0, 1, 40, 79):
            sample = dataset[80 * number + step]
            np.testing.assert_allclose(sample["observation.state"], way[step], atol=1e-5)
            np.testing.assert_allclose(sample["action"], way[step + 1], atol=1e-5)
            np.testing.assert_allclose(sample["observation.environment_state"], trajectory.goal, atol=1e-5)


def test_d4rl_files_without_a_usable_trajectory_are_refused(tmp_path: Path) -> None:
    short = [line((-1, 1), (x, 1), 1) for x in (-0.9, -0.8, -0.7)]
    path = write_d4rl(tmp_path / "maze2d.hdf5", short, LOPSIDED, with_timeouts=True)
    with pytest.raises(ValueError, match="at least one episode, got none that is usable"):
        write_maze_dataset(
            read_d4rl(path, LOPSIDED)[1],
            root=tmp_path / "d",
            repo_id="a/b",
            maze=LOPSIDED,
            origin="",
            n_steps=80,
        )
    assert [path.name for path in tmp_path.iterdir()] == ["maze2d.hdf5"]


def test_a_missing_d4rl_file_is_named(tmp_path: Path) -> None:
    for path in (tmp_path / "nowhere.hdf5", tmp_path):
        with pytest.raises(FileNotFoundError, match=f"source.path must be an HDF5 file, got {path}"):
            read_d4rl(path, "large")


def test_a_d4rl_file_may_be_given_below_the_home_folder(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    expected = demonstrations("umaze", 2)
    write_d4rl(tmp_path / "maze2d.hdf5", expected, "umaze", with_timeouts=True)
    assert_same(list(read_d4rl(Path("~/maze2d.hdf5"), "umaze")[1]), expected, atol=1e-5)


def text(path: Path) -> None:
    path.write_text("<html>404 not found</html>")


def empty(path: Path) -> None:
    path.write_bytes(b"")


def cut_in_half(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def garbled_in_the_middle(path: Path) -> None:
    content = bytearray(path.read_bytes())
    with h5py.File(path) as file:
        chunk = file["observations"].id.get_chunk_info(0)
    content[chunk.byte_offset : chunk.byte_offset + chunk.size] = bytes(chunk.size)
    path.write_bytes(content)


@pytest.mark.parametrize("damage", [text, empty, cut_in_half, garbled_in_the_middle])
def test_files_that_are_not_whole_hdf5_files_are_refused(
    tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    path = write_d4rl(tmp_path / "maze2d.hdf5", demonstrations("umaze", 4), "umaze", with_timeouts=True)
    damage(path)
    with pytest.raises(ValueError, match=r"maze2d\.hdf5 must be a whole HDF5 file"):
        list(read_d4rl(path, "umaze")[1])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observations": None}, "must hold observations and infos/goal, .* missing: observations"),
        ({"infos__goal": None}, "must hold observations and infos/goal, .* missing: infos/goal"),
        ({"observations": np.zeros((10, 2))}, r"shape \(N, 4\) .* got \(10, 2\)"),
        ({"observations": np.zeros((10, 4, 1))}, r"shape \(N, 4\) .* got \(10, 4, 1\)"),
        ({"observations": np.zeros(10)}, r"shape \(N, 4\) .* got \(10,\)"),
        ({"observations": np.zeros((9, 4))}, r"infos/goal \(N, 2\), got \(9, 4\) and \(10, 2\)"),
        ({"infos__goal": np.zeros((10, 3))}, r"infos/goal \(N, 2\), got \(10, 4\) and \(10, 3\)"),
        ({"infos__goal": np.zeros((0, 2)), "observations": np.zeros((0, 4))}, "timeouts must have one entry"),
        ({"timeouts": np.zeros(9, bool)}, "timeouts must have one entry .* got \\(9,\\) for 10"),
        ({"timeouts": np.zeros((10, 2), bool)}, "timeouts must have one entry"),
        ({"observations": np.full((10, 4), np.nan)}, "observations must be finite, .* in row 0"),
        (
            {"observations": np.diag(np.r_[np.zeros(9), np.nan])[:, 6:]},
            "observations must be finite, .* in row 9",
        ),
        (
            {"infos__goal": np.diag(np.r_[np.zeros(9), np.inf])[:, 8:]},
            "infos/goal must be finite, .* in row 9",
        ),
    ],
)
def test_hdf5_files_of_another_layout_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: dict, message: str
) -> None:
    monkeypatch.setattr(convert_d4rl, "_SLICE_ROWS", 4)
    path = write_d4rl(
        tmp_path / "a.hdf5", [line((-1, 1), (1, 1), 9)], LOPSIDED, with_timeouts=True, **changes
    )
    with pytest.raises(ValueError, match=message):
        list(read_d4rl(path, LOPSIDED)[1])


def test_hdf5_files_with_groups_or_numbers_for_columns_are_refused(tmp_path: Path) -> None:
    # As in a Minari file, and in a file of summaries.
    path = write_d4rl(
        tmp_path / "a.hdf5", [line((-1, 1), (1, 1), 9)], LOPSIDED, with_timeouts=True, observations=None
    )
    with h5py.File(path, "a") as file:
        file.create_group("observations").create_dataset("achieved_goal", data=np.zeros((10, 2)))
    with pytest.raises(ValueError, match=r"observations|a\.hdf5"):
        read_d4rl(path, LOPSIDED)
    with h5py.File(path, "a") as file:
        del file["observations"]
        file["observations"] = 3.0
    with pytest.raises(ValueError, match=r"observations|a\.hdf5|scalar"):
        read_d4rl(path, LOPSIDED)


@pytest.mark.parametrize(
    ("recorded", "option"),
    [("umaze", "--task=maze_umaze"), ("large", "--task=maze_large"), (OPEN, f"--maze_map={OPEN}")],
)
def test_d4rl_files_recorded_in_another_maze_are_refused_naming_it(
    tmp_path: Path, recorded: str, option: str
) -> None:
    path = write_d4rl(tmp_path / "maze2d.hdf5", demonstrations(recorded, 6), recorded, with_timeouts=True)
    with pytest.raises(ValueError, match=f"in its walls or outside; the maze that fits: {option} "):
        read_d4rl(path, "medium")


def test_d4rl_files_recorded_in_no_known_maze_are_refused(tmp_path: Path) -> None:
    corridor = "11111111111/10000000001/11111111111"
    path = write_d4rl(tmp_path / "maze2d.hdf5", demonstrations(corridor, 6), corridor, with_timeouts=True)
    with pytest.raises(ValueError, match="the maze that fits: none that is known"):
        read_d4rl(path, "umaze")


@pytest.mark.parametrize("column", ["terminals", "timeouts"])
@pytest.mark.parametrize("recorded_goals", [True, False])
def test_terminals_end_trajectories_as_timeouts_do(tmp_path: Path, column: str, recorded_goals: bool) -> None:
    # In an open maze nothing else tells that the ball has jumped to where the next trajectory begins.
    expected = demonstrations(OPEN, 6)
    n_rows = [len(each.positions) for each in expected]
    marks = np.isin(np.arange(sum(n_rows)), np.cumsum(n_rows) - 1)
    changes = {"timeouts": np.zeros(sum(n_rows), bool), column: marks}
    if not recorded_goals:
        changes["infos__goal"] = np.tile(to_d4rl(expected[0].goal[None], OPEN), (sum(n_rows), 1))
    path = write_d4rl(tmp_path / "maze2d.hdf5", expected, OPEN, with_timeouts=True, **changes)
    n_trajectories, trajectories = read_d4rl(path, OPEN)
    read = list(trajectories)
    assert n_trajectories == len(read) == 6
    for left, right in zip(read, expected, strict=True):
        np.testing.assert_allclose(left.positions, right.positions, atol=1e-5)
        # Without a goal of its own, a trajectory leads to where it ends.
        np.testing.assert_allclose(left.goal, right.goal, atol=1e-5 if recorded_goals else 0.5)


@pytest.mark.parametrize("timeouts", [True, False])
def test_a_last_trajectory_of_d4rl_that_is_cut_off_is_left_out_and_counted(
    tmp_path: Path, timeouts: bool
) -> None:
    *whole, last = demonstrations("medium", 5)
    cut_off = Trajectory(last.positions[: len(last.positions) // 3], last.goal)
    assert np.linalg.norm(cut_off.positions[-1] - cut_off.goal) > 1.0
    n_rows = np.array([len(each.positions) for each in (*whole, cut_off)])
    marks = np.isin(np.arange(n_rows.sum()), np.cumsum(n_rows)[:-1] - 1)
    changes = {"timeouts": marks} if timeouts else {}
    path = write_d4rl(tmp_path / "a.hdf5", [*whole, cut_off], "medium", with_timeouts=timeouts, **changes)
    options = {"root": tmp_path / "d", "repo_id": "a/b", "maze": "medium", "origin": "", "n_steps": 80}
    assert write_maze_dataset(read_d4rl(path, "medium")[1], **options) == (4, {"far from their goal": 1})


def test_trajectories_with_a_jump_are_left_out_and_counted(tmp_path: Path) -> None:
    good = demonstrations(OPEN, 2)
    joined = Trajectory(
        np.concatenate([line((-2, 1), (-1, 1), 9).positions, good[0].positions]), good[0].goal
    )
    assert np.abs(np.diff(joined.positions, axis=0)).max() > 1
    options = {"root": tmp_path / "d", "repo_id": "a/b", "maze": OPEN, "origin": "", "n_steps": 80}
    assert write_maze_dataset([*good, joined], **options) == (2, {"with a jump": 1})


# HDF5 files with something else in the place of an array


def a_link_that_leads_nowhere(file: h5py.File, name: str) -> None:
    file[name] = h5py.SoftLink("/nowhere")


def a_link_to_itself(file: h5py.File, name: str) -> None:
    file[name] = h5py.SoftLink(f"/{name}")


def a_link_to_another_file(file: h5py.File, name: str) -> None:
    file[name] = h5py.ExternalLink("other.hdf5", "/observations")


def a_group(file: h5py.File, name: str) -> None:
    file.create_group(name)


def references(file: h5py.File, name: str) -> None:
    file.create_dataset(name, (10, 4), h5py.ref_dtype)


def pairs(file: h5py.File, name: str) -> None:
    file.create_dataset(name, (10, 4), np.dtype([("a", "f4"), ("b", "f4")]))


def texts(file: h5py.File, name: str) -> None:
    file.create_dataset(name, data=[["left"] * 4] * 10)


def complex_numbers(file: h5py.File, name: str) -> None:
    file.create_dataset(name, (10, 4), "c8")


def one_number(file: h5py.File, name: str) -> None:
    file[name] = 3.0


def terabytes(file: h5py.File, name: str) -> None:
    file.create_dataset(name, (10**12, 4), "f4", chunks=(2**16, 4))


def virtual(file: h5py.File, name: str) -> None:
    layout = h5py.VirtualLayout((10, 4), "f4")
    layout[:5] = h5py.VirtualSource("other.hdf5", "observations", shape=(5, 4))
    file.create_virtual_dataset(name, layout)


@pytest.mark.parametrize(
    ("put", "found"),
    [
        (a_link_that_leads_nowhere, "a link that leads nowhere"),
        (a_link_to_itself, "a link that leads nowhere"),
        (a_link_to_another_file, "a link to another file"),
        (a_group, "a group"),
        (references, "elements of type reference"),
        (pairs, "elements of type .*'a', '<f4'"),
        (texts, "elements of type object"),
        (complex_numbers, "elements of type complex64"),
        (one_number, "a single number"),
        (
            terabytes,
            r"an array of shape \(1000000000000, 4\) and 1.6e\+13 bytes of which only 0 bytes are stored",
        ),
        (virtual, "an array that lies in other files"),
    ],
)
@pytest.mark.parametrize("name", ["observations", "infos/goal", "timeouts", "terminals"])
def test_whatever_is_no_array_of_numbers_is_refused_before_it_is_read(
    tmp_path: Path, put: Callable[[h5py.File, str], None], found: str, name: str
) -> None:
    path = write_d4rl(tmp_path / "a.hdf5", [line((-1, 1), (1, 1), 9)], LOPSIDED, with_timeouts=True)
    with h5py.File(path, "a") as file:
        del file[name]
        put(file, name)
    with pytest.raises(ValueError, match=f"{name} must be .* got {found}.* in {path}"):
        read_d4rl(path, LOPSIDED)


# Minari


def test_minari_datasets_give_back_positions_and_the_goal_that_is_not_stale(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = demonstrations("large", 8)
    folder = write_pointmaze(tmp_path, monkeypatch, expected)
    n_episodes, trajectories = read_minari(folder)
    assert n_episodes == 8
    assert_same(list(trajectories), expected, atol=1e-12)


def test_the_folder_of_a_minari_dataset_may_be_named_with_and_without_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = demonstrations("umaze", 3)
    folder = write_pointmaze(tmp_path, monkeypatch, expected)
    assert (folder / "data").is_dir()
    monkeypatch.delenv("MINARI_DATASETS_PATH")
    monkeypatch.setenv("HOME", str(tmp_path))
    for path in (folder, folder / "data", Path("~") / folder.relative_to(tmp_path)):
        assert_same(list(read_minari(path)[1]), expected, atol=1e-12)


def test_colliding_and_short_trajectories_of_minari_are_left_out_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    good = demonstrations("large", 3)
    through_walls = line((-4.5, 3), (4.5, -3), 300)
    fragment = line((-4.5, 3), (-4.4, 3), 1)
    folder = write_pointmaze(
        tmp_path / "in", monkeypatch, [good[0], through_walls, good[1], fragment, good[2]]
    )
    n_written, dropped = write_maze_dataset(
        read_minari(folder)[1], root=tmp_path / "d", repo_id="a/b", maze="large", origin="", n_steps=40
    )
    assert n_written == 3
    assert dropped == {"in collision": 1, "shorter than 2 steps": 1}
    dataset = LeRobotDataset("a/b", root=tmp_path / "d")
    goals = [dataset[40 * number]["observation.environment_state"] for number in range(3)]
    np.testing.assert_allclose(goals, [trajectory.goal for trajectory in good], rtol=1e-6)


def one_episode(*trajectories: Trajectory) -> Trajectory:
    """An episode of a continuing task: the goal is a new one whenever the ball has reached it."""
    goals = [np.tile(each.goal, (len(each.positions), 1)) for each in trajectories]
    return Trajectory(np.concatenate([each.positions for each in trajectories]), np.concatenate(goals))


def test_episodes_of_minari_are_split_where_the_goal_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = demonstrations(OPEN, 6)
    cut_off = Trajectory(expected[5].positions[: len(expected[5].positions) // 3], expected[5].goal)
    episodes = [one_episode(*expected[:3]), one_episode(*expected[3:5], cut_off)]
    folder = write_pointmaze(tmp_path, monkeypatch, episodes)
    n_episodes, trajectories = read_minari(folder)
    assert n_episodes == 2
    assert_same(list(trajectories), [*expected[:5], cut_off], atol=1e-12)
    options = {"root": tmp_path / "d", "repo_id": "a/b", "maze": OPEN, "origin": "", "n_steps": 80}
    assert write_maze_dataset(read_minari(folder)[1], **options) == (5, {"far from their goal": 1})


def with_env_spec(folder: Path, spec: dict) -> Path:
    path = folder / "data" / "metadata.json"
    common = {"entry_point": "gymnasium_robotics.envs.maze.point_maze:PointMazeEnv", "max_episode_steps": 600}
    metadata = {
        **json.loads(path.read_text()),
        "env_spec": json.dumps({"id": "PointMaze-v3", **common, **spec}),
    }
    path.write_text(json.dumps(metadata))
    return folder


def test_the_maze_of_a_minari_dataset_is_the_one_it_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_pointmaze(tmp_path, monkeypatch, demonstrations(OPEN, 3))
    assert recorded_maze(folder) is None
    rows = [[int(cell) for cell in row] for row in OPEN.split("/")]
    rows[1][1], rows[3][5] = "r", "g"
    assert recorded_maze(with_env_spec(folder, {"kwargs": {"maze_map": rows}})) == OPEN
    with pytest.raises(
        ValueError, match=f"{folder} names a maze that cannot be used: maze_map must be closed"
    ):
        recorded_maze(with_env_spec(folder, {"kwargs": {"maze_map": [[0, 0], [0, 0]]}}))
    for spec in ({}, {"kwargs": {}}, {"kwargs": {"maze_map": 3}}, {"kwargs": []}):
        assert recorded_maze(with_env_spec(folder, spec)) is None


def test_a_maze_that_no_task_has_takes_the_place_of_the_task_s() -> None:
    assert maze_of_recording(OPEN, "large", False, Path("a")) == OPEN
    large = "/".join("".join(map(str, row)) for row in parse_maze_map("large"))
    assert maze_of_recording(large, "large", False, Path("a")) == "large"
    with pytest.raises(
        ValueError, match="maze that is chosen, umaze, got a, which was made in that of --task=maze_large"
    ):
        maze_of_recording(large, "umaze", False, Path("a"))
    with pytest.raises(ValueError, match=f"made in that of --maze_map={OPEN}"):
        maze_of_recording(OPEN, LOPSIDED, True, Path("a"))


def test_minari_datasets_of_another_maze_are_refused_naming_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_pointmaze(tmp_path, monkeypatch, demonstrations("medium", 5))
    assert read_minari(folder, "medium")[0] == 5
    with pytest.raises(ValueError, match="in its walls or outside; the maze that fits: --task=maze_medium"):
        read_minari(folder, "large")


def test_minari_datasets_of_an_ant_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_pointmaze(tmp_path, monkeypatch, demonstrations("umaze", 2))
    ant = {"id": "AntMaze_UMaze-v4", "entry_point": "gymnasium_robotics.envs.maze.ant_maze_v4:AntMazeEnv"}
    for read in (read_minari, recorded_maze):
        with pytest.raises(
            ValueError, match=r"must hold PointMaze episodes, got AntMaze \(AntMaze_UMaze-v4\)"
        ):
            read(with_env_spec(folder, ant))


def test_d4rl_files_of_an_ant_are_named(tmp_path: Path) -> None:
    ant = {"observations": np.zeros((10, 29))}
    path = write_d4rl(tmp_path / "a.hdf5", [line((-1, 1), (1, 1), 9)], LOPSIDED, with_timeouts=True, **ant)
    with pytest.raises(ValueError, match=r"got \(10, 29\) and \(10, 2\) in .*, which is of AntMaze"):
        read_d4rl(path, LOPSIDED)


def test_incomplete_and_old_minari_datasets_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_pointmaze(tmp_path, monkeypatch, demonstrations("umaze", 3))
    path = folder / "data" / "main_data.hdf5"
    with h5py.File(path, "a") as file:
        del file["episode_1/rewards"]
    with pytest.raises(ValueError, match="episode_1/rewards must be an array .* got nothing in"):
        read_minari(folder)
    with h5py.File(path, "a") as file:
        del file["episode_1"]
    with pytest.raises(ValueError, match="its metadata.json promises 3 episodes, got 2, without episode_1"):
        read_minari(folder)
    metadata = folder / "data" / "metadata.json"
    content = json.loads(metadata.read_text())
    for total in (0, 2.5, None, "3"):
        metadata.write_text(json.dumps({**content, "total_episodes": total}))
        with pytest.raises(ValueError, match=f"must promise at least one episode, got {total}"):
            read_minari(folder)
    metadata.write_text(json.dumps({**content, "total_episodes": 10**12}))
    with pytest.raises(ValueError, match="promises 1000000000000 episodes, got 2, without episode_1"):
        read_minari(folder)
    metadata.write_text(json.dumps({**content, "observation_space": None} | {"env_spec": "{}"}))
    with pytest.raises(ValueError, match="must hold a Minari dataset, got one that cannot be read"):
        read_minari(folder)
    metadata.write_text(json.dumps({name: content[name] for name in content if name != "action_space"}))
    with pytest.raises(ValueError, match=r"cannot be read: its metadata\.json holds no action_space"):
        read_minari(folder)
    metadata.unlink()
    with pytest.raises(
        ValueError, match=r"holds no metadata\.json: Minari before 0\.5 wrote it, or its copy is"
    ):
        read_minari(folder)


@pytest.mark.parametrize("name", ["observations/achieved_goal", "observations/desired_goal", "rewards"])
@pytest.mark.parametrize(
    "put", [a_link_that_leads_nowhere, a_group, references, pairs, terabytes, virtual, one_number]
)
def test_whatever_is_no_array_in_a_minari_file_is_refused_before_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, put: Callable[[h5py.File, str], None], name: str
) -> None:
    folder = write_pointmaze(tmp_path, monkeypatch, demonstrations("umaze", 2))
    with h5py.File(folder / "data" / "main_data.hdf5", "a") as file:
        del file[f"episode_1/{name}"]
        put(file, f"episode_1/{name}")
    with pytest.raises(ValueError, match=f"episode_1/{name} must be .* in {folder}"):
        read_minari(folder)


def test_a_missing_minari_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=f"must be the folder of a Minari dataset, got {tmp_path}/no"):
        read_minari(tmp_path / "no")


def test_folders_that_hold_no_minari_dataset_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "foreign" / "data").mkdir(parents=True)
    (tmp_path / "foreign" / "data" / "notes.txt").write_text("nothing")
    (tmp_path / "empty").mkdir()
    incomplete = write_pointmaze(tmp_path / "in", monkeypatch, demonstrations("umaze", 2))
    shutil.copytree(incomplete, tmp_path / "no_metadata")
    (tmp_path / "no_metadata" / "data" / "metadata.json").unlink()
    (incomplete / "data" / "main_data.hdf5").unlink()
    for folder in (tmp_path / "foreign", tmp_path / "empty", tmp_path / "no_metadata", incomplete):
        with pytest.raises(
            ValueError, match=f"{folder} must hold a Minari dataset, got one that cannot be read"
        ):
            read_minari(folder)


def test_a_minari_file_that_is_cut_off_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_pointmaze(tmp_path, monkeypatch, demonstrations("umaze", 3))
    path = folder / "data" / "main_data.hdf5"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises((ValueError, OSError), match=r"Minari|truncated"):
        list(read_minari(folder)[1])


def test_minari_datasets_of_other_environments_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = gym.spaces.Box(-1, 1, (3,))
    folder = write_minari(tmp_path / "box", monkeypatch, [np.zeros((5, 3), np.float32)], box)
    with pytest.raises(ValueError, match="must hold PointMaze episodes with achieved_goal and desired_goal"):
        list(read_minari(folder)[1])
    other = gym.spaces.Dict({"achieved_goal": box, "joints": box})
    observation = {"achieved_goal": np.zeros((5, 3), np.float32), "joints": np.zeros((5, 3), np.float32)}
    folder = write_minari(tmp_path / "other", monkeypatch, [observation], other)
    with pytest.raises(ValueError, match="must hold PointMaze episodes with achieved_goal and desired_goal"):
        list(read_minari(folder)[1])


def test_minari_datasets_of_goals_in_space_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fetch = [Trajectory(np.zeros((6, 3)), np.ones(3))]
    folder = write_pointmaze(tmp_path, monkeypatch, fetch, n_dims=3)
    with pytest.raises(ValueError, match="must hold PointMaze episodes"):
        list(read_minari(folder)[1])


def test_minari_trajectories_that_are_not_finite_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    good = demonstrations("umaze", 2)
    positions = good[1].positions.copy()
    positions[3] = np.nan
    folder = write_pointmaze(tmp_path / "in", monkeypatch, [good[0], Trajectory(positions, good[1].goal)])
    with pytest.raises(ValueError, match="positions and goals must be finite, .* in episode 1"):
        write_maze_dataset(
            read_minari(folder)[1], root=tmp_path / "d", repo_id="a/b", maze="umaze", origin="", n_steps=10
        )
