# SPDX-License-Identifier: Apache-2.0
import gc
import itertools
import json
import os
import tracemalloc
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import torch
from datasets import load_dataset
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_pf2mp.dataset_tools.maze.collect_maze import collect_maze
from lerobot_pf2mp.dataset_tools.maze.maze_dataset import maze_of, write_maze_dataset
from lerobot_pf2mp.dataset_tools.maze.maze_expert import MazeExpert
from lerobot_pf2mp.dataset_tools.writing import lerobot_writer
from lerobot_pf2mp.dataset_tools.writing.episodes import Trajectory, prepare, resample
from lerobot_pf2mp.dataset_tools.writing.lerobot_writer import DatasetSpec, write_dataset
from lerobot_pf2mp.envs.maze.maze_env import SUCCESS_RADIUS
from lerobot_pf2mp.envs.maze.point_maze import BALL_RADIUS, make_point_maze
from lerobot_pf2mp.envs.maze.swept_ball import SweptBall
from lerobot_pf2mp.envs.tasks import MAZE_OF_TASK
from lerobot_pf2mp.process import renaming

CORRIDOR = "1111111/1000001/1111111"
SPEC = DatasetSpec(
    repo_id="local/toy",
    fps=10,
    features={
        "observation.state": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
        "observation.environment_state": {"dtype": "float32", "shape": (3,), "names": None},
        "action": {"dtype": "float32", "shape": (1,), "names": ["x"]},
    },
    task="Do as shown.",
    card="# A toy\n",
)


def toy_episodes(n_episodes: int) -> Iterator[dict[str, np.ndarray]]:
    rng = np.random.default_rng(0)
    lengths = [1, 80, 250, 80, 2]
    for number in range(n_episodes):
        n_frames = lengths[number] if number < len(lengths) else int(rng.integers(1, 20))
        yield {
            key: rng.normal(size=(n_frames, *feature["shape"])).astype(np.float32)
            for key, feature in SPEC.features.items()
        }


def straight_lines(*lengths: int) -> Iterator[Trajectory]:
    """Ways along the corridor, collision-free, with these numbers of steps."""
    for n_steps in lengths:
        positions = np.stack([np.linspace(-2, 2, n_steps + 1), np.zeros(n_steps + 1)], axis=1)
        yield Trajectory(positions, positions[-1])


def written_by_lerobot(root: Path, episodes: Iterator[dict[str, np.ndarray]]) -> LeRobotDataset:
    dataset = LeRobotDataset.create(SPEC.repo_id, SPEC.fps, SPEC.features, root=root, use_videos=False)
    for episode in episodes:
        for frame in range(len(episode["action"])):
            dataset.add_frame({key: value[frame] for key, value in episode.items()} | {"task": SPEC.task})
        dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset(SPEC.repo_id, root=root)


def everything_in(folder: Path) -> list[str]:
    gc.collect()  # what is written when an object is deleted counts
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def contents_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# Episodes


@pytest.mark.parametrize("n_steps", [2, 3, 17, 80, 500])
def test_resampling_keeps_both_ends(n_steps: int) -> None:
    positions = np.random.default_rng(0).normal(size=(38, 2))
    resampled = resample(positions, n_steps)
    assert resampled.shape == (n_steps + 1, 2)
    np.testing.assert_array_equal(resampled[[0, -1]], positions[[0, -1]])


@pytest.mark.parametrize(("n_before", "n_after"), [(2, 80), (80, 2), (7, 80), (333, 80), (80, 80)])
def test_resampling_a_straight_line_is_exact(n_before: int, n_after: int) -> None:
    start, end = np.array([-1.5, 3.0, 7.0]), np.array([4.0, 2.0, 7.0])
    np.testing.assert_allclose(
        resample(np.linspace(start, end, n_before + 1), n_after),
        np.linspace(start, end, n_after + 1),
        rtol=0,
        atol=1e-12,
    )


def test_resampling_to_the_same_or_a_multiple_of_the_steps_keeps_every_position() -> None:
    positions = np.random.default_rng(0).normal(size=(21, 2))
    np.testing.assert_allclose(resample(positions, 20), positions, atol=1e-12)
    np.testing.assert_allclose(resample(positions, 80)[::4], positions, atol=1e-12)
    midpoints = (positions[1:] + positions[:-1]) / 2
    np.testing.assert_allclose(resample(positions, 40)[1::2], midpoints, atol=1e-12)


def test_frames_are_position_goal_and_next_position() -> None:
    positions = np.random.default_rng(0).normal(size=(6, 2))
    trajectory = Trajectory(positions, np.array([5.0, 6.0]))
    (frames,) = prepare([trajectory], 5, lambda way: False, Counter())
    np.testing.assert_allclose(frames["observation.state"], positions[:-1], rtol=1e-6)
    np.testing.assert_allclose(frames["action"], positions[1:], rtol=1e-6)
    np.testing.assert_array_equal(frames["observation.environment_state"], [[5.0, 6.0]] * 5)
    assert {value.dtype for value in frames.values()} == {np.dtype("float32")}


def test_short_and_colliding_trajectories_are_left_out_and_counted() -> None:
    seen = []

    def collides(way: np.ndarray) -> bool:
        seen.append(way)
        return len(seen) % 2 == 0

    dropped: Counter[str] = Counter()
    kept = list(prepare(straight_lines(0, 5, 1, 5, 2, 90, 1, 90), 8, collides, dropped))
    assert len(kept) == 3
    assert dropped == {"shorter than 2 steps": 3, "in collision": 2}
    # What is tested for collision is what is written.
    np.testing.assert_array_equal(np.float32(seen[0][:-1]), kept[0]["observation.state"])


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_trajectories_that_are_not_finite_are_refused(bad: float) -> None:
    good = next(straight_lines(4))
    positions = good.positions.copy()
    positions[2, 1] = bad
    for trajectory in (Trajectory(positions, good.goal), Trajectory(good.positions, np.array([0.0, bad]))):
        with pytest.raises(ValueError, match="positions and goals must be finite, .* in episode 1"):
            list(prepare([good, trajectory], 8, lambda way: False, Counter()))


# The expert


def demonstrations(maze: str, n: int, noise: float = 0.0, seed: int = 0) -> list[Trajectory]:
    return list(itertools.islice(MazeExpert(maze, noise, seed).trajectories(), n))


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_the_expert_repeats_itself_for_a_seed_and_not_for_another(noise: float) -> None:
    first, again, other = (demonstrations("medium", 4, noise, seed) for seed in (1, 1, 2))
    for left, right in zip(first, again, strict=True):
        np.testing.assert_array_equal(left.positions, right.positions)
        np.testing.assert_array_equal(left.goal, right.goal)
    assert not np.array_equal(first[0].positions[0], other[0].positions[0])


@pytest.mark.parametrize(("maze", "noise"), [("umaze", 0.0), ("medium", 0.5), ("large", 0.0)])
def test_the_expert_reaches_its_goals_without_touching_a_wall(maze: str, noise: float) -> None:
    ball = SweptBall(make_point_maze(maze)[1], BALL_RADIUS)
    for trajectory in demonstrations(maze, 15, noise):
        assert not ball.collides(trajectory.positions)
        assert np.linalg.norm(trajectory.positions[-1] - trajectory.goal) <= 0.1
        assert ball.clearance(trajectory.goal, trajectory.goal) >= 0.25 - BALL_RADIUS - 1e-6
        # 5 m/s, PointMaze's limit, and what one step of 0.01 s adds to it
        assert np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1).max() < 0.08


def test_the_expert_goes_on_from_where_it_is() -> None:
    trajectories = demonstrations("large", 10)
    for before, after in itertools.pairwise(trajectories):
        np.testing.assert_array_equal(before.positions[-1], after.positions[0])
        assert not np.array_equal(before.goal, after.goal)


def test_the_expert_starts_afresh_and_counts_when_noise_makes_it_collide() -> None:
    expert = MazeExpert("medium", 1.5, 0)
    trajectories = list(itertools.islice(expert.trajectories(), 15))
    n_breaks = sum(
        not np.array_equal(before.positions[-1], after.positions[0])
        for before, after in itertools.pairwise(trajectories)
    )
    assert 1 <= n_breaks <= expert.n_collisions


def test_the_goals_of_the_expert_spread_over_all_cells_as_those_of_the_environment() -> None:
    trajectories = demonstrations("umaze", 150)
    goals = np.array([trajectory.goal for trajectory in trajectories])
    cells = np.round(goals)
    assert len(np.unique(cells, axis=0)) == 7  # the free cells of a map of 5 x 5 cells have whole centres
    offsets = goals - cells
    assert np.abs(offsets).max() <= 0.25
    assert np.abs(offsets).max() > 0.2


@pytest.mark.parametrize("noise", [-0.1, np.nan, np.inf])
def test_a_noise_that_is_none_is_refused(noise: float) -> None:
    with pytest.raises(ValueError, match="action_noise must be finite and at least 0"):
        MazeExpert("umaze", noise, 0)


# The writer, against LeRobot's own


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[LeRobotDataset, LeRobotDataset]:
    folder = tmp_path_factory.mktemp("pair")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lerobot_writer, "_BATCH_FRAMES", 85)  # several batches
        n_written = write_dataset(folder / "ours", SPEC, toy_episodes(12))
    assert n_written == 12
    theirs = written_by_lerobot(folder / "theirs", toy_episodes(12))
    return LeRobotDataset(SPEC.repo_id, root=folder / "ours"), theirs


def test_every_sample_equals_that_of_a_dataset_written_by_lerobot(pair) -> None:
    ours, theirs = pair
    assert len(ours) == len(theirs) == sum(len(episode["action"]) for episode in toy_episodes(12))
    for left, right in zip(ours, theirs, strict=True):
        assert left.keys() == right.keys()
        for key in left:
            if isinstance(left[key], torch.Tensor):
                assert left[key].dtype == right[key].dtype, key
                assert left[key].shape == right[key].shape, key
                assert torch.equal(left[key], right[key]), key
            else:
                assert left[key] == right[key], key


@pytest.mark.slow
def test_chunks_of_actions_equal_those_of_a_dataset_written_by_lerobot(pair) -> None:
    deltas = {"action": [i / SPEC.fps for i in range(4)]}
    ours, theirs = (
        LeRobotDataset(SPEC.repo_id, root=dataset.root, delta_timestamps=deltas) for dataset in pair
    )
    for left, right in zip(ours, theirs, strict=True):
        assert torch.equal(left["action"], right["action"])
        assert torch.equal(left["action_is_pad"], right["action_is_pad"])


def test_the_info_and_the_tasks_equal_those_of_a_dataset_written_by_lerobot(pair) -> None:
    ours, theirs = (json.loads((dataset.root / "meta/info.json").read_text()) for dataset in pair)
    assert ours == theirs
    assert ours["total_episodes"] == 12
    assert ours["total_tasks"] == 1
    assert ours["splits"] == {"train": "0:12"}
    ours, theirs = (pd.read_parquet(dataset.root / "meta/tasks.parquet") for dataset in pair)
    pd.testing.assert_frame_equal(ours, theirs)


def test_the_metadata_of_the_episodes_equal_those_of_a_dataset_written_by_lerobot(pair) -> None:
    ours, theirs = (pq.read_table(dataset.root / "meta/episodes") for dataset in pair)
    assert ours.num_rows == theirs.num_rows == 12
    # Of these only the order of the columns is their own: statistics are the same to the last bit.
    assert sorted(ours.column_names) == sorted(theirs.column_names)
    assert {"stats/action/q99", "stats/index/count"} < set(ours.column_names)
    assert ours.select(theirs.column_names).equals(theirs)


def test_the_statistics_equal_those_of_a_dataset_written_by_lerobot(pair) -> None:
    ours, theirs = (json.loads((dataset.root / "meta/stats.json").read_text()) for dataset in pair)
    assert ours.keys() == theirs.keys()
    assert set(SPEC.features) < ours.keys()
    for feature, statistics in theirs.items():
        assert ours[feature].keys() == statistics.keys()
        for name, values in statistics.items():
            # LeRobot adds one episode after the other, which rounds in another order.
            np.testing.assert_allclose(
                ours[feature][name], values, rtol=1e-12, atol=1e-15, err_msg=f"{feature} {name}"
            )


def test_a_dataset_opens_with_datasets_and_names_its_robot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = {"root": tmp_path / "d", "repo_id": "a/b", "maze": CORRIDOR, "origin": "", "n_steps": 10}
    write_maze_dataset(straight_lines(20, 30), **options)
    frames = load_dataset(str(tmp_path / "d"), cache_dir=str(tmp_path / "cache"))["train"]
    assert len(frames) == 20
    assert set(frames.column_names) >= {"observation.state", "action", "episode_index"}
    assert LeRobotDatasetMetadata("a/b", root=tmp_path / "d").robot_type == "point_maze"


def test_the_statistics_are_those_of_all_frames(tmp_path: Path) -> None:
    write_dataset(tmp_path / "d", SPEC, toy_episodes(12))
    states = np.concatenate([episode["observation.state"] for episode in toy_episodes(12)])
    stats = LeRobotDatasetMetadata(SPEC.repo_id, root=tmp_path / "d").stats["observation.state"]
    np.testing.assert_allclose(stats["min"], states.min(axis=0), rtol=1e-6)
    np.testing.assert_allclose(stats["max"], states.max(axis=0), rtol=1e-6)
    np.testing.assert_allclose(stats["mean"], states.mean(axis=0), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(stats["std"], states.std(axis=0), rtol=1e-4)
    assert stats["count"] == len(states)


def test_the_schema_of_the_frames_equals_that_of_a_dataset_written_by_lerobot(pair) -> None:
    ours, theirs = (pq.ParquetFile(next(dataset.root.glob("data/*/*.parquet"))) for dataset in pair)
    assert ours.schema_arrow.names == theirs.schema_arrow.names
    assert ours.schema_arrow.types == theirs.schema_arrow.types
    ours, theirs = (json.loads(file.schema_arrow.metadata[b"huggingface"]) for file in (ours, theirs))
    assert ours["info"] == theirs["info"]


def test_every_episode_is_one_row_group(pair) -> None:
    ours, _ = pair
    file = pq.ParquetFile(next(ours.root.glob("data/*/*.parquet")))
    lengths = [file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)]
    assert lengths == [len(episode["action"]) for episode in toy_episodes(12)]


def test_single_episodes_can_be_loaded(pair) -> None:
    ours, _ = pair
    alone = LeRobotDataset(SPEC.repo_id, root=ours.root, episodes=[7])
    expected = list(toy_episodes(12))[7]
    assert len(alone) == len(expected["action"])
    np.testing.assert_array_equal(
        [sample["observation.state"] for sample in alone], expected["observation.state"]
    )


@pytest.mark.slow
def test_files_and_folders_begin_where_lerobot_begins_them(tmp_path: Path, monkeypatch) -> None:
    # A new file after every few episodes, a new folder after two files.
    monkeypatch.setattr(LeRobotDatasetMetadata, "data_files_size_in_mb", property(lambda self: 0.05))
    monkeypatch.setattr(LeRobotDatasetMetadata, "chunks_size", property(lambda self: 2))
    monkeypatch.setattr(lerobot_writer, "_BATCH_FRAMES", 100)
    write_dataset(tmp_path / "ours", SPEC, toy_episodes(60))
    ours = LeRobotDataset(SPEC.repo_id, root=tmp_path / "ours")
    theirs = written_by_lerobot(tmp_path / "theirs", toy_episodes(60))
    files = [
        sorted(str(path.relative_to(dataset.root)) for path in dataset.root.glob("data/*/*"))
        for dataset in (ours, theirs)
    ]
    assert files[0] == files[1]
    assert "data/chunk-001/file-000.parquet" in files[0]
    assert (tmp_path / "ours/meta/episodes/chunk-000/file-001.parquet").is_file()
    for column in ("episode_index", "length", "dataset_to_index", "data/chunk_index", "data/file_index"):
        assert ours.meta.episodes[column][:] == theirs.meta.episodes[column][:], column
    assert ours.hf_dataset.with_format("arrow")[:].equals(theirs.hf_dataset.with_format("arrow")[:])


@pytest.mark.slow
def test_metadata_say_in_which_file_they_and_the_frames_are(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(LeRobotDatasetMetadata, "data_files_size_in_mb", property(lambda self: 0.05))
    monkeypatch.setattr(lerobot_writer, "_BATCH_FRAMES", 100)
    write_dataset(tmp_path / "d", SPEC, toy_episodes(60))
    meta = LeRobotDatasetMetadata(SPEC.repo_id, root=tmp_path / "d")
    for path in sorted(tmp_path.glob("d/meta/episodes/*/*")):
        for row in pq.read_table(path).to_pylist():
            chunk, file = row["meta/episodes/chunk_index"], row["meta/episodes/file_index"]
            assert path == tmp_path / f"d/meta/episodes/chunk-{chunk:03d}/file-{file:03d}.parquet"
            frames = pd.read_parquet(tmp_path / "d" / meta.get_data_file_path(row["episode_index"]))
            assert (frames["episode_index"] == row["episode_index"]).sum() == row["length"]


@pytest.mark.slow
def test_memory_does_not_grow_with_the_number_of_episodes(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(lerobot_writer, "_BATCH_FRAMES", 300)

    def peak(n_episodes: int) -> int:
        """Of the memory that Python knows of [bytes]."""
        tracemalloc.start()
        write_dataset(tmp_path / "d", SPEC, toy_episodes(n_episodes), overwrite=True)
        gc.collect()
        used = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return used

    peak(60)  # what is imported at first use
    assert peak(480) < 1.5 * peak(60)


# The writer, when something goes wrong


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda e: e.pop("action"), "episode 2 must hold .*'action'.* got"),
        (lambda e: e.update(more=e["action"]), "episode 2 must hold .* got .*'more'"),
        (lambda e: e.update(action=e["action"][:-1]), "action of episode 2 must have shape"),
        (lambda e: e.update(action=np.ones((9, 2), np.float32)), "action of episode 2 must have shape"),
        (lambda e: e.update({key: value[:0] for key, value in e.items()}), "of episode 2 must have shape"),
        (lambda e: e["action"].__setitem__((1, 0), np.nan), "action must be finite, .* in episode 2"),
        (lambda e: e["action"].__setitem__((1, 0), -np.inf), "action must be finite, .* in episode 2"),
    ],
)
def test_bad_episodes_are_refused_and_leave_nothing_behind(
    tmp_path: Path, change: Callable[[dict], object], message: str
) -> None:
    def episodes() -> Iterator[dict[str, np.ndarray]]:
        for number in range(5):
            episode = {key: np.zeros((9, *f["shape"]), np.float32) for key, f in SPEC.features.items()}
            if number == 2:
                change(episode)
            yield episode

    with pytest.raises(ValueError, match=message):
        write_dataset(tmp_path / "d", SPEC, episodes())
    assert everything_in(tmp_path) == []


def test_a_dataset_without_episodes_is_refused_and_leaves_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least one episode"):
        write_dataset(tmp_path / "d", SPEC, iter([]))
    assert everything_in(tmp_path) == []


@pytest.mark.slow
@pytest.mark.parametrize("n_before", [0, 1, 3, 120])
@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_interruption_leaves_nothing_behind(
    tmp_path: Path, monkeypatch, n_before: int, error: type[BaseException]
) -> None:
    monkeypatch.setattr(lerobot_writer, "_BATCH_FRAMES", 200)  # after 120 episodes, some have been written

    def interrupted() -> Iterator[dict[str, np.ndarray]]:
        yield from toy_episodes(n_before)
        raise error("stop")

    with pytest.raises(error, match="stop"):
        write_dataset(tmp_path / "d", SPEC, interrupted())
    assert everything_in(tmp_path) == []


@pytest.mark.slow
@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_interruption_keeps_the_dataset_that_was_to_be_replaced(
    tmp_path: Path, error: type[BaseException]
) -> None:
    write_dataset(tmp_path / "d", SPEC, toy_episodes(2))
    before = contents_of(tmp_path)

    def interrupted() -> Iterator[dict[str, np.ndarray]]:
        yield from toy_episodes(3)
        raise error("stop")

    with pytest.raises(error, match="stop"):
        write_dataset(tmp_path / "d", SPEC, interrupted(), overwrite=True)
    gc.collect()
    assert contents_of(tmp_path) == before


@pytest.mark.slow
@pytest.mark.parametrize("n_before", [0, 2, 5])  # 5 episodes, then their metadata
def test_a_full_disk_leaves_nothing_behind(tmp_path: Path, monkeypatch, n_before: int) -> None:
    write_table, n_calls = pq.ParquetWriter.write_table, itertools.count()

    def write_until_full(self: pq.ParquetWriter, *args: object, **kwargs: object) -> None:
        if next(n_calls) >= n_before:
            raise OSError(28, "No space left on device")
        write_table(self, *args, **kwargs)

    monkeypatch.setattr(pq.ParquetWriter, "write_table", write_until_full)
    with pytest.raises(OSError, match="No space left on device"):
        write_dataset(tmp_path / "d", SPEC, toy_episodes(5))
    assert everything_in(tmp_path) == []


def test_a_disk_too_full_for_metadata_leaves_nothing_behind(tmp_path: Path, monkeypatch) -> None:
    begin = pq.ParquetWriter.__init__

    def begin_unless_full(self: pq.ParquetWriter, where: object, *args: object, **kwargs: object) -> None:
        if "episodes" in str(where):
            raise OSError(28, "No space left on device")
        begin(self, where, *args, **kwargs)

    monkeypatch.setattr(pq.ParquetWriter, "__init__", begin_unless_full)
    with pytest.raises(OSError, match="No space left on device"):
        write_dataset(tmp_path / "d", SPEC, toy_episodes(5))
    assert everything_in(tmp_path) == []


@pytest.mark.slow
def test_a_dataset_survives_when_its_replacement_cannot_take_its_place(tmp_path: Path, monkeypatch) -> None:
    write_dataset(tmp_path / "d", SPEC, toy_episodes(2))
    before = contents_of(tmp_path)

    rename = Path.rename

    def fail_for_the_new_one(path: Path, target: Path) -> Path:
        if path.name == "new":
            raise OSError(5, "Input/output error")
        return rename(path, target)

    monkeypatch.setattr(
        renaming, "_rename", lambda *_: False
    )  # where the system cannot exchange folders at once
    monkeypatch.setattr(Path, "rename", fail_for_the_new_one)
    with pytest.raises(OSError, match="Input/output error"):
        write_dataset(tmp_path / "d", SPEC, toy_episodes(3), overwrite=True)
    gc.collect()
    assert contents_of(tmp_path) == before


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_write_permission_is_an_error_of_the_system(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(PermissionError, match="Permission denied"):
            write_dataset(tmp_path / "d", SPEC, toy_episodes(1))
        assert everything_in(tmp_path) == []
    finally:
        tmp_path.chmod(0o700)


def test_a_dataset_is_not_replaced_unless_asked_for(tmp_path: Path) -> None:
    write_dataset(tmp_path / "d", SPEC, toy_episodes(2))
    before = contents_of(tmp_path)
    with pytest.raises(FileExistsError, match="exists already: .*--overwrite=true"):
        write_dataset(tmp_path / "d", SPEC, toy_episodes(3))
    assert contents_of(tmp_path) == before


@pytest.mark.slow
def test_a_dataset_is_replaced_when_asked_for(tmp_path: Path) -> None:
    for n_episodes in (2, 3):
        write_dataset(tmp_path / "d", SPEC, toy_episodes(n_episodes), overwrite=True)
        assert LeRobotDataset(SPEC.repo_id, root=tmp_path / "d").num_episodes == n_episodes
    gc.collect()
    assert [path.name for path in tmp_path.iterdir()] == ["d"]


@pytest.mark.slow
def test_a_folder_that_is_no_dataset_is_never_replaced(tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("years of work")
    with pytest.raises((ValueError, FileExistsError), match=r"(?i)no.* dataset"):
        write_dataset(tmp_path / "home", SPEC, toy_episodes(2), overwrite=True)
    assert everything_in(tmp_path) == ["home", "home/thesis.tex"]


def test_missing_parents_are_made(tmp_path: Path) -> None:
    write_dataset(tmp_path / "a" / "b" / "d", SPEC, toy_episodes(1))
    assert LeRobotDataset(SPEC.repo_id, root=tmp_path / "a/b/d").num_episodes == 1


# Maze datasets


def test_a_collected_dataset_reads_back_as_the_expert_drove(tmp_path: Path) -> None:
    n_written, dropped = collect_maze(
        "umaze",
        root=tmp_path / "d",
        repo_id="local/umaze",
        n_episodes=6,
        n_steps=20,
        action_noise=0.0,
        seed=4,
        overwrite=False,
    )
    assert (n_written, dropped) == (6, {})
    dataset = LeRobotDataset("local/umaze", root=tmp_path / "d")
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (6, 120, 10)
    for number, trajectory in enumerate(demonstrations("umaze", 6, seed=4)):
        way = resample(trajectory.positions, 20)
        samples = [dataset[20 * number + step] for step in range(20)]
        np.testing.assert_allclose([s["observation.state"] for s in samples], way[:-1], rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose([s["action"] for s in samples], way[1:], rtol=1e-6, atol=1e-7)
        for sample in samples:
            np.testing.assert_allclose(sample["observation.environment_state"], trajectory.goal, rtol=1e-6)
        assert np.linalg.norm(way[-1] - trajectory.goal) < SUCCESS_RADIUS
        assert samples[0]["task"] == "Move the ball to the red goal without touching a wall."


@pytest.mark.slow
def test_a_collected_dataset_is_the_same_bytes_for_the_same_seed(tmp_path: Path) -> None:
    for name, seed in (("first", 0), ("again", 0), ("other", 1)):
        collect_maze(
            CORRIDOR,
            root=tmp_path / name,
            repo_id="local/corridor",
            n_episodes=3,
            n_steps=10,
            action_noise=0.1,
            seed=seed,
            overwrite=False,
        )
    first, again, other = (contents_of(tmp_path / name / "data") for name in ("first", "again", "other"))
    assert first == again != other


def test_collisions_of_the_expert_are_counted_among_those_left_out(tmp_path: Path) -> None:
    n_written, dropped = collect_maze(
        "medium",
        root=tmp_path / "d",
        repo_id="local/noisy",
        n_episodes=10,
        n_steps=40,
        action_noise=1.5,
        seed=0,
        overwrite=False,
    )
    assert n_written == 10
    assert dropped.keys() == {"in collision"}
    assert dropped["in collision"] >= 1


def test_paths_that_cut_a_corner_when_resampled_are_left_out(tmp_path: Path) -> None:
    # Collision-free at full resolution, through the block in the middle with two steps.
    corners = np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0], [1.0, -1.0]])
    around = Trajectory(resample(corners, 300), corners[-1])
    beside = Trajectory(resample(corners[:2], 300), corners[1])
    for n_steps, n_kept in ((80, 2), (2, 1)):
        n_written, dropped = write_maze_dataset(
            [around, beside],
            root=tmp_path / str(n_steps),
            repo_id="local/ring",
            maze="11111/10001/10101/10001/11111",
            origin="",
            n_steps=n_steps,
        )
        assert n_written == n_kept
        assert dropped["in collision"] == 2 - n_kept


def test_no_more_episodes_are_written_than_asked_for(tmp_path: Path) -> None:
    n_written, dropped = write_maze_dataset(
        straight_lines(*[30] * 9),
        root=tmp_path / "d",
        repo_id="a/b",
        maze=CORRIDOR,
        origin="",
        n_steps=5,
        n_episodes=4,
    )
    assert (n_written, dropped) == (4, {})
    assert LeRobotDataset("a/b", root=tmp_path / "d").num_episodes == 4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"n_steps": 1}, "n_steps must be at least 2, got 1"),
        ({"n_episodes": 0}, "n_episodes must be at least 1, got 0"),
        ({"maze": "111/101"}, "maze_map must"),
        ({"trajectories": []}, "at least one episode, got none"),
        ({"trajectories": straight_lines(1, 0)}, "at least one episode, got none"),
    ],
)
def test_bad_arguments_are_refused_and_leave_nothing_behind(
    tmp_path: Path, kwargs: dict, message: str
) -> None:
    arguments = {"trajectories": straight_lines(9), "maze": CORRIDOR, "n_steps": 4, **kwargs}
    with pytest.raises(ValueError, match=message):
        write_maze_dataset(**arguments, root=tmp_path / "d", repo_id="a/b", origin="")
    assert everything_in(tmp_path) == []


def test_the_card_tells_units_axes_steps_and_origin(tmp_path: Path) -> None:
    write_maze_dataset(
        straight_lines(9),
        root=tmp_path / "d",
        repo_id="me/mine",
        maze=CORRIDOR,
        origin="From a test.",
        n_steps=12,
    )
    card = (tmp_path / "d" / "README.md").read_text()
    assert card.startswith("---\nlicense: apache-2.0\n")
    assert "# me/mine\n" in card
    assert "From a test." in card
    assert "resampled to 12 steps" in card
    assert "10 fps is nominal" in card
    assert "x points east and y north" in card
    rows = [line.strip("|").split("|") for line in card.splitlines() if line.startswith("| `")]
    assert {name.strip(" `"): unit.strip() for name, _, unit in rows} == {
        "observation.state": "m",
        "observation.environment_state": "m",
        "action": "m",
    }


def test_every_task_has_a_maze_and_a_map_of_ones_own_comes_first() -> None:
    for task, maze in MAZE_OF_TASK.items():
        assert maze_of(task, None) == maze
        assert maze_of(task, CORRIDOR) == CORRIDOR
    with pytest.raises(ValueError, match="task must be one of .*'maze_large'.* got 'kitchen'"):
        maze_of("kitchen", None)
