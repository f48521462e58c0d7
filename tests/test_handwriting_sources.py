# SPDX-License-Identifier: Apache-2.0
"""Recordings of handwriting as tablets, robots and spreadsheets leave them."""

import json
import re
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_pf2mp.dataset_tools.handwriting.convert_handwriting import convert_handwriting
from lerobot_pf2mp.dataset_tools.handwriting.handwriting_recording import read_handwriting
from lerobot_pf2mp.dataset_tools.writing.lerobot_writer import DatasetSpec, write_dataset
from lerobot_pf2mp.envs.handwriting.panda import HOME
from lerobot_pf2mp.envs.handwriting.writing_scene import read_writing_scene

STRAIGHT = np.linspace([0.45, -0.05], [0.55, -0.05], 6)
TIMES = np.arange(6) / 10
JOINTS = HOME[:7] + np.linspace(0.0, 0.05, 6)[:, None]
ARM = [f"joint_{number}" for number in range(1, 8)]


def text(header: Sequence[str], columns: Sequence[Sequence[Any]], separator: str = ",") -> str:
    rows = [separator.join(map(str, row)) for row in zip(*columns, strict=True)]
    return "\n".join([separator.join(header), *rows, ""])


def pen_with(**columns: Sequence[Any]) -> str:
    """A table of one stroke with other columns besides."""
    return text(["time", "x", "y", *columns], [TIMES, *STRAIGHT.T, *columns.values()])


def written(path: Path, content: str, encoding: str = "utf-8") -> Path:
    path.write_text(content, encoding=encoding)
    return path


def values_in(path: Path) -> np.ndarray:
    (recording,) = read_handwriting(path)
    np.testing.assert_allclose(recording.times - recording.times[0], TIMES[: len(recording.times)], atol=1e-9)
    return recording.values


# Tables


@pytest.mark.parametrize(
    "header",
    [
        "time,x,y",
        "timestamp,x,y",
        "%time,x,y",
        "t,x,y",
        "Time,X,Y",
        "time [s],x [m],y [m]",
        "# time,x,y",
        "time,pen_x,pen_y",
    ],
)
@pytest.mark.parametrize("suffix", [".csv", ".CSV", ".tsv"])
def test_times_and_positions_have_many_names(tmp_path: Path, header: str, suffix: str) -> None:
    content = text(header.split(","), [TIMES, *STRAIGHT.T])
    path = written(tmp_path / f"a{suffix}", content.replace(",", "\t") if suffix == ".tsv" else content)
    np.testing.assert_allclose(values_in(path), STRAIGHT, atol=1e-12)


@pytest.mark.parametrize(
    "name",
    ["joint_{}", "joint{}", "panda_joint{}", "fr3_joint{}", "q{}", "Joint {}", "joint_{}.pos", "j{} [rad]"],
)
def test_joints_have_many_names_in_any_order(tmp_path: Path, name: str) -> None:
    order = [2, 1, 0, 3, 6, 5, 4]
    header = ["time", *(name.format(number + 1) for number in order)]
    path = written(tmp_path / "a.csv", text(header, [TIMES, *JOINTS[:, order].T]))
    np.testing.assert_allclose(values_in(path)[:, :7], JOINTS, atol=1e-12)


def test_joints_may_be_counted_from_0(tmp_path: Path) -> None:
    header = ["time", *(f"joint_{number}" for number in range(7))]
    path = written(tmp_path / "a.csv", text(header, [TIMES, *JOINTS.T]))
    np.testing.assert_allclose(values_in(path)[:, :7], JOINTS, atol=1e-12)


def test_of_several_times_the_first_kind_is_taken(tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv", text(["t", "timestamp", "x", "y"], [TIMES * 0, TIMES, *STRAIGHT.T]))
    np.testing.assert_allclose(values_in(path), STRAIGHT, atol=1e-12)


@pytest.mark.parametrize("mark", ["", "\ufeff"])
@pytest.mark.parametrize("first", ["", "sep=;\n", "SEP=;\r\n", '"sep=;"\n', "\n\n"])
@pytest.mark.parametrize("last", ["", "\n\n", ";;\n"])
def test_spreadsheets_of_other_countries_are_read(tmp_path: Path, mark: str, first: str, last: str) -> None:
    content = text(["time", "x", "y"], [TIMES, *STRAIGHT.T], separator=";").replace(".", ",")
    path = written(tmp_path / "a.csv", mark + first + content + last)
    np.testing.assert_allclose(values_in(path), STRAIGHT, atol=1e-12)


def test_empty_rows_between_samples_are_skipped(tmp_path: Path) -> None:
    lines = pen_with().splitlines()
    path = written(tmp_path / "a.csv", "\n".join([*lines[:3], "", ",,", " , ,", *lines[3:]]))
    np.testing.assert_allclose(values_in(path), STRAIGHT, atol=1e-12)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            "time,x,y\n0,0.5,0\n\n0.1,left,0\n",
            r"in each column of each row: got 'left' as x in row 1 \(line 4\)",
        ),
        ("time,x,y\n0,0.5,0\n0.1,0.5\n", r"each row: got '' as y in row 1 \(line 3\)"),
        ("time;x;y\n0;1.000,5;0\n", r"each row: got '1.000,5' as x in row 0 \(line 2\)"),
        (
            "time,x,y\n0,0,5,0,1\n",
            r"as columns, 3, got 5 in row 0 \(line 2\); decimal commas need another sep",
        ),
        (
            "time,x,y,episode\n0,0.5,0,a\n0,0.5,0\n",
            r"name the episode of each row, got none in row 1 \(line 3\)",
        ),
        ("time,x,y,pen\n0,0.5,0,lifted\n", r"got 'lifted' as pen in row 0 \(line 2\)"),
        (
            "time,x,pos_x,y\n0,0.5,0.5,0\n",
            r"must have one column for x, got several: \['time', 'x', 'pos_x', 'y'\]",
        ),
        (
            "time,x,y,z,qx,qy,qz,qw\n0,0,0,0,0,0,0,1\n",
            r"got \[.*\]: poses of an end effector \(time, x, y, z, qx",
        ),
        ("time,pos_x,pos_y,pos_z,quat_x,quat_y\n0,0,0,0,0,0\n", "poses of an end effector"),
        ("time,x,y,z,roll,pitch,yaw\n0,0,0,0,0,0,0\n", "poses of an end effector"),
        ("time,delta_x,delta_y\n0,0,0\n", r"displacements or rates \(delta_x, delta_y\)"),
        (
            f"time,{','.join(f'{name}.vel' for name in ARM)}\n",
            r"displacements or rates \(joint_1.vel, joint_2.vel",
        ),
    ],
)
def test_tables_that_cannot_be_read_are_refused_naming_the_row_or_the_columns(
    tmp_path: Path, content: str, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        read_handwriting(written(tmp_path / "a.csv", content))


# The pen is lifted


@pytest.mark.parametrize(
    "column",
    [
        {"pen_down": [0, 1, 1, 1, 1, 0]},
        {"pen_up": [1, 0, 0, 0, 0, 1]},
        {"pressure": [0.0, 0.4, 0.1, 0.2, 0.4, 0.0]},
        {"Pen": ["up", "down", "Down", "down", "down", "up"]},
        {"is_down": ["False", "True", "True", "True", "True", "False"]},
        {"z": [0.05, 0.0, 0.002, 0.0, 0.0, 0.02]},
    ],
)
def test_samples_before_and_after_the_stroke_are_left_out(tmp_path: Path, column: dict[str, list]) -> None:
    path = written(tmp_path / "a.csv", pen_with(**column))
    np.testing.assert_allclose(values_in(path), STRAIGHT[1:5], atol=1e-12)


def test_lists_of_a_json_file_tell_where_the_pen_is_lifted(tmp_path: Path) -> None:
    one = {"time": TIMES.tolist(), "pen": STRAIGHT.tolist()}
    heights = np.column_stack([STRAIGHT, [0.05, 0, 0, 0, 0, 0.05]]).tolist()
    for other in ({"pen_down": [False, True, True, True, True, False]}, {"pen": heights}):
        path = written(tmp_path / "a.json", json.dumps({"episodes": [{**one, **other}]}))
        np.testing.assert_allclose(values_in(path), STRAIGHT[1:5], atol=1e-12)
    path = written(tmp_path / "a.json", json.dumps({"episodes": [{**one, "pressure": [1, 1]}]}))
    with pytest.raises(
        ValueError, match=r"pressure must hold a number for each of 6 samples, got \(2,\) in episode 0"
    ):
        read_handwriting(path)


def test_episodes_in_which_the_pen_is_lifted_are_left_out_and_counted(tmp_path: Path) -> None:
    states = {"good": [1, 1, 1, 1, 1, 1], "joined": [1, 1, 0, 0, 1, 1], "in the air": [0, 0, 0, 0, 0, 0]}
    episodes = [name for name in states for _ in TIMES]
    columns = [
        episodes,
        np.tile(TIMES, 3),
        *np.tile(STRAIGHT, (3, 1)).T,
        np.concatenate(list(states.values())),
    ]
    path = written(tmp_path / "a.csv", text(["episode", "time", "x", "y", "pen_down"], columns))
    left_out: Counter[str] = Counter()
    (recording,) = read_handwriting(path, left_out=left_out)
    assert recording.name == f"episode good of {path}"
    assert left_out == {"with the pen lifted in between": 1, "with the pen off the table": 1}
    path = written(tmp_path / "a.csv", pen_with(pen_down=states["joined"]))
    with pytest.raises(
        ValueError, match="none that is usable: a demonstration must be one stroke, .* lifted in row 2 "
    ):
        read_handwriting(path)


def test_episodes_with_wrong_times_or_too_few_samples_are_left_out_and_counted(tmp_path: Path) -> None:
    times = {"good": TIMES, "equal": [0, 1, 1, 2, 3, 4], "falling": [0, 1, 3, 2, 4, 5], "short": [0, 1]}
    episodes = [name for name, values in times.items() for _ in values]
    places = np.concatenate([STRAIGHT[: len(values)] for values in times.values()])
    columns = [episodes, np.concatenate([*times.values()]), *places.T]
    path = written(tmp_path / "a.csv", text(["episode", "time", "x", "y"], columns))
    options = {"root": tmp_path / "d", "repo_id": "a/b", "n_steps": 5, "scene_options": {"n_regions": 0}}
    n_written, left_out = convert_handwriting(path, "pen", **options)
    assert n_written == 1
    assert left_out == {"whose times do not increase": 2, "shorter than 3 samples": 1}


# JSON


def test_json_lines_hold_an_episode_or_a_sample_each(tmp_path: Path) -> None:
    episode = json.dumps({"time": TIMES.tolist(), "pen": STRAIGHT.tolist()})
    path = written(tmp_path / "a.jsonl", f"{episode}\n\n{episode}\n")
    for recording in read_handwriting(path):
        np.testing.assert_allclose(recording.values, STRAIGHT, atol=1e-12)
    assert len(read_handwriting(path)) == 2
    samples = [{"t": t, "x": x, "y": y} for t, (x, y) in zip(TIMES.tolist(), STRAIGHT.tolist(), strict=True)]
    path = written(tmp_path / "b.jsonl", "\n".join(map(json.dumps, samples)))
    np.testing.assert_allclose(values_in(path), STRAIGHT, atol=1e-12)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "must hold a JSON object in each line"),
        ("[1]\n[2]\n", "must hold a JSON object in each line"),
        ('{"t": 0, "x": 1, "y": 1}\n{"t"\n', "line 2 of .*a.jsonl must be a JSON file"),
        ('{"t": 0, "x": 1, "y": 1}\n{"t": 1, "x": null, "y": 1}\n', r"got 'None' as x in row 1 \(line 2\)"),
        ("[" * 100_000, "must be a JSON file"),
    ],
)
def test_json_lines_of_another_layout_are_refused(tmp_path: Path, content: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_handwriting(written(tmp_path / "a.jsonl", content))


def test_json_files_may_begin_with_a_mark(tmp_path: Path) -> None:
    content = json.dumps({"episodes": [{"timestamp": TIMES.tolist(), "pen": STRAIGHT.tolist()}]})
    np.testing.assert_allclose(
        values_in(written(tmp_path / "a.JSON", content, "utf-8-sig")), STRAIGHT, atol=1e-12
    )


def test_eight_numbers_are_recognised(tmp_path: Path) -> None:
    eight = np.column_stack([JOINTS, JOINTS[:, 0]])
    path = written(
        tmp_path / "a.json", json.dumps({"episodes": [{"time": TIMES.tolist(), "joints": eight.tolist()}]})
    )
    with pytest.raises(ValueError, match="8 numbers in a sample, which may be seven joints and a gripper"):
        read_handwriting(path)


# Units and places


def test_millimetres_of_another_sheet_become_metres_in_the_frame_of_the_arm(tmp_path: Path) -> None:
    millimetres = (STRAIGHT - [0.34, -0.16]) * 1000
    path = written(tmp_path / "a.csv", text(["time", "x", "y"], [TIMES, *millimetres.T]))
    (recording,) = read_handwriting(path, scale=0.001, place=[0.34, -0.16])
    np.testing.assert_allclose(recording.values, STRAIGHT, atol=1e-12)
    lifted = text(["time", "x", "y", "z"], [TIMES, *millimetres.T, [5, 5, 5, 5, 5, 20]])  # up to 7 mm is ink
    (recording,) = read_handwriting(written(tmp_path / "b.csv", lifted), scale=0.001, place=[0.34, -0.16])
    np.testing.assert_allclose(recording.values, STRAIGHT[:5], atol=1e-12)


@pytest.mark.parametrize(
    ("names", "scale", "told"),
    [
        ("x [mm],y [mm]", 0.001, "millimetres, as its columns say: --source.scale=0.001"),
        ("X (CM),pos_y (cm)", 0.01, "centimetres, as its columns say: --source.scale=0.01"),
        ("x [m],y", 1.0, ""),
    ],
)
def test_units_of_columns_are_used_and_told(tmp_path: Path, names: str, scale: float, told: str) -> None:
    content = text(["time [ms]", *names.split(",")], [1000 * TIMES, *(STRAIGHT / scale).T])
    path, lines = written(tmp_path / "a.csv", content), []
    (recording,) = read_handwriting(path, tell=lines.append)
    np.testing.assert_allclose(recording.values, STRAIGHT, atol=1e-12)
    assert lines == ([f"{path} is read in {told}"] if told else [])
    (recording,) = read_handwriting(path, scale=2.0)
    np.testing.assert_allclose(recording.values, 2 * STRAIGHT / scale, atol=1e-9)


def test_positions_in_several_units_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv", text(["time", "x [mm]", "y"], [TIMES, *STRAIGHT.T]))
    with pytest.raises(ValueError, match=r"a.csv: positions of the pen must have one unit, got x \[mm\], y"):
        read_handwriting(path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scale": 0.0}, "scale must be a finite length above 0 m, got 0.0"),
        ({"scale": np.nan}, "scale must be a finite length above 0 m, got nan"),
        ({"scale": -0.001}, "scale must be a finite length above 0 m, got -0.001"),
        ({"place": [0.5]}, r"place must be two finite positions x, y \[m\], got \[0.5\]"),
        ({"place": [0.5, None]}, r"place must be two finite positions x, y \[m\], got \[0.5, None\]"),
        (
            {"joint_offsets": [None, 0, 0, 0, 0, 0, 0]},
            r"joint_offsets must be 7 finite angles \[rad\], got \[None, 0",
        ),
    ],
)
def test_units_and_places_must_be_numbers(tmp_path: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_handwriting(written(tmp_path / "a.csv", pen_with()), **options)


@pytest.mark.parametrize("options", [{"scale": 0.001}, {"place": [0.5, 0.0]}])
def test_units_and_places_of_the_pen_are_refused_for_joints(tmp_path: Path, options: dict[str, Any]) -> None:
    path = written(tmp_path / "a.csv", text(["time", *ARM], [TIMES, *JOINTS.T]))
    with pytest.raises(ValueError, match="scale and place are for recordings of the pen, got one of joints"):
        read_handwriting(path, **options)


def test_positions_off_the_sheet_are_refused_naming_the_row(tmp_path: Path) -> None:
    places = STRAIGHT.copy()
    places[4, 1] = 0.2
    options = {"root": tmp_path / "d", "repo_id": "a/b", "n_steps": 5, "scene_options": {}}
    for scale, message in ((1, "0.2] in row 4; --source.place moves"), (1000, "larger than the sheet; mill")):
        path = written(tmp_path / "a.csv", text(["time", "x", "y"], [TIMES, *(places * scale).T]))
        with pytest.raises(ValueError, match=f"must lie on the sheet, .* got .*{re.escape(message)}"):
            convert_handwriting(path, "pen", **options)


# Datasets of LeRobot


def actions_of(root: Path, values: np.ndarray, names: Any) -> Path:
    feature = {"dtype": "float32", "shape": (values.shape[1],), "names": names}
    frames = [{"action": values.astype(np.float32)}] * 2
    write_dataset(root, DatasetSpec("local/arm", 10, {"action": feature}, "Write.", ""), frames)
    return root


def test_joints_of_datasets_are_found_by_their_names(tmp_path: Path) -> None:
    order = [2, 1, 0, 3, 4, 5, 6]
    names = [f"panda_joint{number + 1}" for number in order]
    for number, given in enumerate((names, {"motors": names})):
        path = actions_of(tmp_path / str(number), JOINTS[:, order], given)
        for recording in read_handwriting(path):
            np.testing.assert_allclose(recording.values[:, :7], JOINTS, atol=1e-6)
            np.testing.assert_allclose(recording.times, TIMES, atol=1e-6)


def test_fingers_of_datasets_are_found_by_their_names(tmp_path: Path) -> None:
    values = np.column_stack([np.full(6, 0.01), np.full(6, 0.02), JOINTS])
    names = ["panda_finger_joint1", "panda_finger_joint2", *ARM]
    recording = read_handwriting(actions_of(tmp_path / "d", values, names))[0]
    np.testing.assert_allclose(recording.values, np.roll(values, -2, axis=1), atol=1e-6)


@pytest.mark.parametrize(
    ("width", "names", "message"),
    [
        (7, [*ARM[:6], "gripper"], r"got \(7,\): unknown names gripper"),
        (7, [f"motor_{number}" for number in range(7)], "unknown names motor_0, motor_1, .*, motor_6"),
        (7, [*ARM[:6], ARM[0]], r"must be 7 joint positions or 9 with fingers, got \(7,\)"),
        (8, [*ARM, "gripper"], r"got \(8,\): as of seven joints and a gripper unknown names gripper"),
        (8, None, r"got \(8,\): as of seven joints and a gripper"),
        (
            7,
            ["x", "y", "z", "roll", "pitch", "yaw", "gripper"],
            r"got \(7,\): poses of an end effector \(x, y, z, roll",
        ),
        (
            4,
            ["delta_x", "delta_y", "delta_z", "gripper"],
            r"got \(4,\): displacements or rates \(delta_x, delta_y",
        ),
        (7, [f"{name}.vel" for name in ARM], r"displacements or rates \(joint_1.vel"),
    ],
)
def test_datasets_of_other_actions_are_refused_saying_what_they_are(
    tmp_path: Path, width: int, names: Any, message: str
) -> None:
    path = actions_of(tmp_path / "d", np.tile(JOINTS, 2)[:, :width], names)
    with pytest.raises(ValueError, match=message):
        read_handwriting(path)


def test_displacements_without_names_are_recognised_by_the_elbow(tmp_path: Path) -> None:
    path = actions_of(tmp_path / "d", np.random.default_rng(0).uniform(0, 0.1, (6, 7)), None)
    with pytest.raises(
        ValueError, match="must be joint positions, .* row 0 .*: displacements or poses of an end eff"
    ):
        read_handwriting(path)


def test_datasets_are_read_without_their_videos_and_never_looked_for_on_the_hub(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = actions_of(tmp_path / "d", JOINTS, ARM)
    info = json.loads((path / "meta" / "info.json").read_text())
    info["features"]["observation.image"] = {"dtype": "video", "shape": [48, 64, 3], "names": None}
    info["video_path"] = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
    (path / "meta" / "info.json").write_text(json.dumps(info))

    def answer(*_: object, **__: object) -> None:
        raise AssertionError("the Hub was asked")

    monkeypatch.setattr("huggingface_hub.HfApi.list_repo_refs", answer)
    monkeypatch.setattr("lerobot.datasets.dataset_metadata.snapshot_download", answer)
    np.testing.assert_allclose(read_handwriting(path)[0].values[:, :7], JOINTS, atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"total_frames": 13}, "must hold the 13 frames of its meta/info.json, and one at least, got 12"),
        ({"total_frames": None}, "cannot be read as a LeRobotDataset"),
        ({"features": {"action": {"shape": [9]}}}, "its actions must be 9 numbers, got 7"),
    ],
)
def test_datasets_whose_metadata_promise_something_else_are_refused(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    path = actions_of(tmp_path / "d", JOINTS, ARM)
    info = json.loads((path / "meta" / "info.json").read_text())
    (path / "meta" / "info.json").write_text(json.dumps({**info, **changes}))
    with pytest.raises(ValueError, match=message):
        read_handwriting(path)


def test_datasets_that_have_lost_a_file_are_refused(tmp_path: Path) -> None:
    path = actions_of(tmp_path / "d", JOINTS, ARM)
    (file,) = (path / "data").rglob("*.parquet")
    file.unlink()
    with pytest.raises(ValueError, match="cannot be read as a LeRobotDataset: it holds no data/"):
        read_handwriting(path)


# Large recordings


@pytest.mark.slow
def test_many_episodes_are_read_in_seconds(tmp_path: Path) -> None:
    rows = [f"{number},{i / 10},{0.45 + i / 100},0.0" for number in range(30_000) for i in range(4)]
    path = written(tmp_path / "a.csv", "\n".join(["episode,time,x,y", *rows]))
    begin = time.process_time()
    assert len(read_handwriting(path)) == 30_000
    assert time.process_time() - begin < 15  # two on an idle core; by comparing each with each it was minutes


def test_more_frames_than_can_be_made_are_refused_at_once(tmp_path: Path) -> None:
    rows = [f"{number},{i / 10},{0.45 + i / 100},0.0" for number in range(11) for i in range(4)]
    path = written(tmp_path / "a.csv", "\n".join(["episode,time,x,y", *rows]))
    options = {"root": tmp_path / "d", "repo_id": "a/b", "scene_options": {}}
    with pytest.raises(ValueError, match="n_steps must be at most 100000, got 1000000000"):
        convert_handwriting(path, "pen", n_steps=10**9, **options)
    with pytest.raises(
        ValueError, match="episodes must be at most 1000000, got 100000 x 11: choose a smaller"
    ):
        convert_handwriting(path, "pen", n_steps=10**5, **options)
    assert convert_handwriting(path, "pen", n_steps=5, n_episodes=2, **options)[0] == 2


def test_strokes_of_many_points_are_read_in_seconds(tmp_path: Path) -> None:
    turn = np.linspace(0, 2 * np.pi, 40_000)
    ring = np.stack([0.5 + 0.1 * np.cos(turn), 0.1 * np.sin(turn)], axis=1)
    path = written(tmp_path / "a.json", json.dumps({"stroke": ring.tolist()}))
    begin = time.process_time()
    assert len(read_writing_scene(path).stroke) == 629
    assert time.process_time() - begin < 5
    scribble = np.random.default_rng(0).uniform([0.35, -0.15], [0.65, 0.15], (40_000, 2))
    path = written(tmp_path / "b.json", json.dumps({"stroke": scribble.tolist()}))
    with pytest.raises(ValueError, match="at most 100 m long, got 6.* m, that of b"):
        read_writing_scene(path)
