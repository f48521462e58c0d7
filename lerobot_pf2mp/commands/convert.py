# SPDX-License-Identifier: Apache-2.0
"""The command pf2mp-convert."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

from lerobot_pf2mp.commands.command import write_and_report
from lerobot_pf2mp.commands.publishing import published_if_asked
from lerobot_pf2mp.commands.scene import SceneConfig
from lerobot_pf2mp.commands.writing import WritingConfig
from lerobot_pf2mp.envs.tasks import (
    FETCH_OF_TASK,
    FETCH_STEPS,
    HANDWRITING_STEPS,
    MAZE_OF_TASK,
    MAZE_STEPS,
    SPACE_OF_TASK,
)


@dataclass
class SourceConfig:
    """The source of recorded demonstrations."""

    # Layout of the recording: d4rl (maze2d, one HDF5 file), minari (pointmaze, a folder), fetch (gymnasium-robotics'
    # FetchReach or FetchPush: an npz file, or the folder of a Minari dataset) or handwriting (a CSV, TSV, JSON or JSONL
    # file, the folder of a LeRobotDataset with joint actions, or recordings of others: an SVC or JSON file of a Wacom
    # tablet, a .mat file of LASA or of the Panda symbols, the zip file or a folder of Omniglot's strokes).
    type: str = "d4rl"
    # The file or folder.
    path: Path | None = None
    # Handwriting: seven angles to add to the recorded joints [rad], if the arm has other zero positions:
    # [0,0,0,0,0,-1.5708,-0.7854] for a real Panda.
    joint_offsets: list[float] = field(default_factory=list)
    # Handwriting: length of the unit in which positions of the pen were recorded [m]: 0.001 for millimetres. By default what
    # the format says, which is then printed: metres for JSON and JSONL files, and for CSV files unless x [mm] is a column.
    scale: float | None = None
    # Handwriting: where x = y = 0 of the recorded positions of the pen lies in the frame of the arm's base [m], for example
    # [0.34,-0.16], the sheet's corner on the right of the arm. By default CSV, JSON and JSONL files are in that frame
    # already, and recordings of others are put in the middle of the sheet, which is then printed.
    place: list[float] | None = None
    # Handwriting: which strokes of a drawing become demonstrations: one (drawings in which the pen is lifted in between are
    # left out), each (every stroke is a demonstration), or the number of a stroke, from 1.
    strokes: str = "one"
    # Omniglot: the character, ALPHABET/CHARACTER, for example Greek/character03, unless the path holds only one.
    character: str | None = None


@dataclass
class ConvertConfig(WritingConfig):
    """Turns recorded demonstrations into a LeRobotDataset.

    Examples:
        pf2mp-convert --source.type=d4rl --source.path=maze2d-large-sparse-v1.hdf5 --task=maze_large --root=data/d4rl
        pf2mp-convert --source.type=minari --source.path=~/.minari/datasets/D4RL/pointmaze/medium-v2 \
--task=maze_medium --root=data/minari
        pf2mp-convert --source.type=fetch --source.path=reach.npz --task=fetch_reach --root=data/reach
        pf2mp-convert --source.type=fetch --source.path=~/.minari/datasets/fetch/push-v0 --task=fetch_push \
--scene.wall_position=[1.30,0.80] --root=data/push
        pf2mp-convert --source.type=handwriting --source.path=strokes.csv --task=handwriting_pen --root=data/mine
        pf2mp-convert --source.type=handwriting --source.path=tablet.csv --source.scale=0.001 --source.place=[0.34,-0.16] \
--task=handwriting_joint --root=data/tablet
        pf2mp-convert --source.type=handwriting --source.path=symbol_17.mat --task=handwriting_pen --scene_file=symbol.json \
--root=data/symbol
        pf2mp-convert --source.type=handwriting --source.path=strokes_background_small1.zip \
--source.character=Greek/character13 --n_regions=0 --task=handwriting_pen --root=data/omniglot
        pf2mp-convert --source.type=handwriting --source.path=data/teleoperated --task=handwriting_joint \
--scene_file=my_stroke.json --root=data/mine

    npz files of Fetch hold, without pickles, observation (E, T+1, 10 for Reach or 25 for Push) and desired_goal (E, T+1 or
    T, 3) of E episodes. Or they hold the rows of all episodes: observation (N, 10 or 25) and desired_goal (N, 3), with
    episode_ends (E), the row after each episode's last row, or terminals and timeouts (N), true in each episode's last row.
    An observation begins with the gripper's position, for Push followed by the block's [m]. The last desired goal of an
    episode is its goal. Episodes that do not end within 0.05 m of it are left out.

    CSV files of handwriting have columns time [s], optionally episode, and joint_1 to joint_7 [rad], optionally finger_1
    and finger_2 [m], or x and y of the pen [m]. Other usual names are understood (timestamp, %time, t; panda_joint1, joint1,
    q1), and semicolons, tabs and decimal commas. JSON files are {"episodes": [{"time": [...], "joints": [[7 or 9], ...]}]}
    or "pen": [[x, y], ...] instead; JSONL files have such an episode, or a sample {"time": 0.1, "x": 0.5, "y": 0.1}, in each
    line. Of a LeRobotDataset the actions are used, by their names: 7 joints, or 7 joints and 2 fingers.

    Recordings of others, from a sheet of their own: SVC and JSON files of the package handwriting-sample (x, y, time, pen
    status, ...; millimetres, or whole numbers for counts of the tablet, 5080 or "lpi" in an inch). MATLAB files of version 5
    to 7 with LASA's demos (pos and t; millimetres) or the Panda symbols' symbol_data (pos; metres, 1 kHz). Omniglot's
    strokes (x, y, time between START and BREAK; 105 pixels become 0.18 m). Unit and place are printed as the options that
    say the same. x points away from the arm there too, so that a page is written with its right side ahead.

    A demonstration of handwriting is one stroke. Columns pen_down, pen_up, pressure or z (height of the pen above the table)
    tell where the pen is lifted: what comes before the stroke and after it is left out, and so are episodes in which the pen
    is lifted in between (but see --source.strokes), in which the times do not increase, or with fewer than 3 samples. Times
    may have any unit: each demonstration is resampled to --n_steps equal shares of its duration.

    Trajectories of a maze end where timeouts or terminals of D4RL say so, and where the goal changes. Those that end more
    than 0.5 m from their goal, cut off, are left out. A recording in another maze is refused; a maze that no task has is
    taken from a Minari dataset that names it.
    """

    # The recording.
    source: SourceConfig = field(default_factory=SourceConfig)
    # Recorded task: maze_umaze, maze_medium, maze_large, fetch_reach, fetch_push, handwriting_joint or
    # handwriting_pen. Episodes that touch its walls or enter its regions are left out.
    task: str = "maze_large"
    # Folder of the dataset; by default where LeRobot keeps the datasets of your Hub account.
    root: Path | None = None
    # Name of the dataset, user/name; by default local/TASK.
    repo_id: str | None = None
    # Largest number of episodes to write; all by default.
    n_episodes: int | None = None
    # Steps that each episode is resampled to; by default 80 for a maze, 48 for Fetch, 64 for handwriting.
    n_steps: int | None = None
    # Mazes: your own map instead of the task's: rows of 0 (free) and 1 (wall) separated by "/".
    maze_map: str | None = None
    # Fetch: the wall. The ranges are only checked: they must contain positions clear of it.
    scene: SceneConfig = field(default_factory=SceneConfig)
    # Whether to replace an existing dataset.
    overwrite: bool = False
    # Whether to publish the dataset on the Hugging Face Hub under the name --repo_id. You must be logged in there.
    push_to_hub: bool = False
    # Whether a new repository on the Hub is private.
    private: bool | None = None


def main(config: ConvertConfig) -> None:
    """Runs the command."""
    with published_if_asked(config.repo_id, config.root, config.push_to_hub, config.private):
        _convert(config)


def _convert(config: ConvertConfig) -> None:
    source = config.source
    if source.path is None:
        raise ValueError("--source.path must name the recording, got none")
    if source.type in ("d4rl", "minari"):
        _convert_maze(config, source.path)
        return
    if source.type not in ("fetch", "handwriting"):
        types = ["d4rl", "minari", "fetch", "handwriting"]
        raise ValueError(f"--source.type must be one of {types}, got {source.type!r}")
    if config.maze_map is not None:
        raise ValueError(f"--maze_map is for mazes only, got {config.maze_map}")
    (_convert_fetch if source.type == "fetch" else _convert_handwriting)(config, source.path)


def _convert_maze(config: ConvertConfig, path: Path) -> None:
    for tasks, source_type in ((FETCH_OF_TASK, "fetch"), (SPACE_OF_TASK, "handwriting")):
        if config.task in tasks:
            raise ValueError(
                f"--source.type must be {source_type} for {config.task}, got {config.source.type!r}"
            )
    from lerobot_pf2mp.dataset_tools.maze.convert_d4rl import read_d4rl
    from lerobot_pf2mp.dataset_tools.maze.convert_minari import read_minari, recorded_maze
    from lerobot_pf2mp.dataset_tools.maze.maze_dataset import maze_of, write_maze_dataset
    from lerobot_pf2mp.dataset_tools.maze.maze_recognition import maze_of_recording

    chosen = maze = maze_of(config.task, config.maze_map)
    if config.source.type == "d4rl":
        n_expected, trajectories = read_d4rl(path, maze)
    elif (recorded := recorded_maze(path)) is None:
        n_expected, trajectories = read_minari(path, maze)
    else:
        maze = maze_of_recording(recorded, chosen, config.maze_map is not None, path)
        n_expected, trajectories = read_minari(path)
    write = partial(
        write_maze_dataset,
        trajectories,
        maze=maze,
        origin=f"Converted from {path.name} ({config.source.type}).",
        n_episodes=config.n_episodes,
        n_expected=n_expected,
    )
    write_and_report(config, config.task if maze in MAZE_OF_TASK.values() else "maze", MAZE_STEPS, write)


def _convert_fetch(config: ConvertConfig, path: Path) -> None:
    if config.task not in FETCH_OF_TASK:
        raise ValueError(f"task must be one of {list(FETCH_OF_TASK)}, got {config.task!r}")
    from lerobot_pf2mp.dataset_tools.fetch.convert_fetch import convert_fetch

    write = partial(
        convert_fetch,
        path,
        FETCH_OF_TASK[config.task],
        scene_changes=asdict(config.scene),
        n_episodes=config.n_episodes,
    )
    write_and_report(config, config.task, FETCH_STEPS, write)


def _convert_handwriting(config: ConvertConfig, path: Path) -> None:
    if config.task not in SPACE_OF_TASK:
        raise ValueError(f"task must be one of {list(SPACE_OF_TASK)}, got {config.task!r}")
    from lerobot_pf2mp.dataset_tools.handwriting.convert_handwriting import convert_handwriting

    write = partial(
        convert_handwriting,
        path,
        SPACE_OF_TASK[config.task],
        scene_options=config.scene_options,
        joint_offsets=config.source.joint_offsets,
        scale=config.source.scale,
        place=config.source.place,
        strokes=config.source.strokes,
        character=config.source.character,
        tell=print,
        n_episodes=config.n_episodes,
    )
    write_and_report(config, config.task, HANDWRITING_STEPS, write)
