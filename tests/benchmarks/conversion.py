# SPDX-License-Identifier: Apache-2.0
"""How fast recordings become LeRobotDatasets, beside LeRobot's own recorder, and how much memory that takes."""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median

import h5py
import numpy as np
from harness import Row, growth_exponent, time_in_turns
from lerobot.datasets import LeRobotDataset

from lerobot_pf2mp.dataset_tools.maze.maze_expert import MazeExpert
from lerobot_pf2mp.dataset_tools.writing.lerobot_writer import DatasetSpec, write_dataset
from lerobot_pf2mp.envs.maze.point_maze import parse_maze_map

PART = "conversion"
EPISODE_FRAMES = 80
N_EPISODES = (100, 1_000, 10_000)
N_EPISODES_OF_LEROBOT = 5  # its time grows in proportion, and it takes 0.1 s for each
N_STEPS = (250_000, 1_000_000, 4_000_000)
N_ROUNDS = 5
TARGET_SPEED, TARGET_MEMORY = 100_000, 500  # [frames/s], [MB]
MAZE = "large"
type Episode = dict[str, np.ndarray]

_SPEC = DatasetSpec(
    repo_id="local/benchmark",
    fps=10,
    features={
        key: {"dtype": "float32", "shape": (2,), "names": ["x", "y"]}
        for key in ("observation.state", "observation.environment_state", "action")
    },
    task="Do as shown.",
    card="# A benchmark\n",
)
_CONVERT = """
import json, sys, time
from pathlib import Path
from lerobot_pf2mp.dataset_tools.maze.convert_d4rl import read_d4rl
from lerobot_pf2mp.dataset_tools.maze.maze_dataset import write_maze_dataset

def peak():  # of this program alone [MB]: what getrusage says includes the one that started it
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024

source, root, maze = sys.argv[1:]
before, began = peak(), time.perf_counter()
n_expected, trajectories = read_d4rl(Path(source), maze)
n_written, _ = write_maze_dataset(
    trajectories, root=Path(root), repo_id="local/benchmark", maze=maze, origin="", n_steps=80
)
print(json.dumps([n_written, time.perf_counter() - began, peak() - before]))
"""


def measure() -> Iterator[Row]:
    """The rows of this part."""
    yield from _measure_writer()
    yield from _measure_conversion()


def _measure_writer() -> Iterator[Row]:
    episodes = make_episodes(max(N_EPISODES))
    theirs = "LeRobotDataset.save_episode"
    calls = {str(n): _in_new_folder(write, episodes[:n]) for n in N_EPISODES}
    times = time_in_turns(
        {**calls, theirs: _in_new_folder(record, episodes[:N_EPISODES_OF_LEROBOT])}, N_ROUNDS
    )
    seconds = {n: times[str(n)] for n in N_EPISODES}
    n_frames = N_EPISODES_OF_LEROBOT * EPISODE_FRAMES
    case = f"{N_EPISODES_OF_LEROBOT} episodes of {EPISODE_FRAMES} frames"
    yield Row(PART, case, theirs, n_frames / median(times[theirs]), "frames/s")
    for n in N_EPISODES:
        case = f"{n} episodes of {EPISODE_FRAMES} frames"
        speed = n * EPISODE_FRAMES / median(seconds[n])
        target = TARGET_SPEED if n >= 1_000 else None
        yield Row(PART, case, "write_dataset", speed, "frames/s", target=target, at_least=True)
        speedup = median(
            (slow / N_EPISODES_OF_LEROBOT) / (fast / n)
            for slow, fast in zip(times[theirs], seconds[n], strict=True)
        )
        yield Row(PART, case, f"write_dataset / {theirs}, frames/s", speedup, "x")
    exponent = growth_exponent(N_EPISODES, [median(seconds[n]) for n in N_EPISODES])
    yield Row(PART, f"{min(N_EPISODES)} to {max(N_EPISODES)} episodes", "exponent of time", exponent, "")


def _measure_conversion() -> Iterator[Row]:
    used = []
    with tempfile.TemporaryDirectory() as folder:
        for n_steps in N_STEPS:
            source = Path(folder) / "maze2d.hdf5"
            write_d4rl(source, n_steps)
            arguments = [str(source), str(Path(folder) / str(n_steps)), MAZE]
            finished = subprocess.run(
                [sys.executable, "-c", _CONVERT, *arguments], stdout=subprocess.PIPE, text=True, check=True
            )
            n_written, seconds, megabytes = json.loads(finished.stdout.splitlines()[-1])
            used.append(megabytes)
            case = f"D4RL, {n_steps} steps"
            yield Row(PART, case, "recorded steps read and written", n_steps / seconds, "steps/s")
            yield Row(PART, case, "frames written", n_written * EPISODE_FRAMES / seconds, "frames/s")
            yield Row(PART, case, "memory beyond that of the imports", megabytes, "MB", target=TARGET_MEMORY)
    case = f"D4RL, {min(N_STEPS)} to {max(N_STEPS)} steps"
    yield Row(PART, case, "exponent of memory", growth_exponent(N_STEPS, used), "")


def make_episodes(n_episodes: int) -> list[Episode]:
    """Episodes of random walks [m]."""
    rng = np.random.default_rng(0)
    return [
        {
            key: rng.normal(size=(EPISODE_FRAMES, 2)).cumsum(axis=0).astype(np.float32)
            for key in _SPEC.features
        }
        for _ in range(n_episodes)
    ]


def write(root: Path, episodes: list[Episode]) -> None:
    """Writes episodes with this package's writer."""
    write_dataset(root, _SPEC, episodes)


def record(root: Path, episodes: list[Episode]) -> None:
    """Writes episodes as LeRobot's recorder does, frame by frame."""
    dataset = LeRobotDataset.create(_SPEC.repo_id, _SPEC.fps, _SPEC.features, root=root, use_videos=False)
    for episode in episodes:
        for number in range(EPISODE_FRAMES):
            frame = {key: values[number] for key, values in episode.items()}
            dataset.add_frame({**frame, "task": _SPEC.task})
        dataset.save_episode()
    dataset.finalize()


def _in_new_folder(
    call: Callable[[Path, list[Episode]], None], episodes: list[Episode]
) -> Callable[[], None]:
    def in_new_folder() -> None:
        with tempfile.TemporaryDirectory() as folder:
            call(Path(folder) / "dataset", episodes)

    return in_new_folder


def write_d4rl(path: Path, n_steps: int) -> None:
    """Writes a file in D4RL's layout: the same 60 demonstrations again and again, of 200 steps on average."""
    demonstrations = list(itertools.islice(MazeExpert(MAZE, 0.0, 0).trajectories(), 60))
    lengths = [len(demonstration.positions) for demonstration in demonstrations]
    positions = _to_d4rl(np.concatenate([demonstration.positions for demonstration in demonstrations]))
    columns = {
        "observations": np.hstack([positions, np.zeros_like(positions)]),
        "infos/goal": np.repeat(_to_d4rl(np.array([d.goal for d in demonstrations])), lengths, axis=0),
        "timeouts": np.isin(np.arange(sum(lengths)), np.cumsum(lengths) - 1),
    }
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            column = file.create_dataset(name, (n_steps, *values.shape[1:]), values.dtype, compression="gzip")
            for first in range(0, n_steps, len(values)):
                column[first : first + len(values)] = values[: n_steps - first]


def _to_d4rl(positions: np.ndarray) -> np.ndarray:
    """Joint positions of D4RL's model: i - 0.2 and j - 0.2 at the centre of cell (i, j)."""
    rows = parse_maze_map(MAZE)
    x, y = positions.T
    return np.stack([len(rows) / 2 - y - 0.7, x + len(rows[0]) / 2 - 0.7], axis=1).astype(np.float32)
