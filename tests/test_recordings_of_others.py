# SPDX-License-Identifier: Apache-2.0
"""Handwriting that tablets, Omniglot, LASA and a hand-guided Panda recorded, in small files of the same layouts."""

import json
import struct
import sys
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
import scipy.sparse

from lerobot_pf2mp.commands import cli
from lerobot_pf2mp.dataset_tools.handwriting.handwriting_recording import (
    HandwritingRecording,
    read_handwriting,
)

WAY = np.linspace([10.0, 20.0], [60.0, 40.0], 6)  # 50 x 20 units
TIMES = np.arange(6) * 0.1
DOWN, UP = [1] * 6, [0] * 6


def middle_of(recordings: list[HandwritingRecording]) -> np.ndarray:
    places = np.concatenate([each.values for each in recordings])
    return (places.min(axis=0) + places.max(axis=0)) / 2


def told_by(path: Path, **options: Any) -> tuple[list[HandwritingRecording], list[str]]:
    lines: list[str] = []
    return read_handwriting(path, tell=lines.append, **options), lines


# Tablets


def svc_text(ways: list[np.ndarray], states: list[list[int]], number: str = ".3f") -> str:
    rows = [
        f"{x:{number}} {y:{number}} {i * 7} {state} 510 520 0.5"
        for i, ((x, y), state) in enumerate(zip(np.concatenate(ways), np.concatenate(states), strict=True))
    ]
    return "\n".join([str(len(rows)), *rows])


def svc(folder: Path, content: str) -> Path:
    path = folder / "drawing.svc"
    path.write_text(content, encoding="utf-8")
    return path


def tablet_json(folder: Path, meta: Any = None, **changes: Any) -> Path:
    data = {
        "x": WAY[:, 0].tolist(),
        "y": (WAY[:, 1] + 0.5).tolist(),
        "time": TIMES.tolist(),
        "pen_status": DOWN,
        **changes,
    }
    content = {"data": {name: values for name, values in data.items() if values is not None}}
    path = folder / "drawing.json"
    path.write_text(json.dumps(content if meta is None else {"meta_data": meta, **content}), encoding="utf-8")
    return path


def test_millimetres_of_a_tablet_are_told_and_put_in_the_middle_of_the_sheet(tmp_path: Path) -> None:
    for path in (svc(tmp_path, svc_text([WAY + 0.5], [DOWN])), tablet_json(tmp_path)):
        recordings, lines = told_by(path)
        assert [line.removeprefix(f"{path} is ") for line in lines] == [
            "read in millimetres, because not all are whole numbers: --source.scale=0.001",
            f"put in the middle of the sheet: --source.place={lines[1].partition('place=')[2]}",
        ]
        np.testing.assert_allclose(middle_of(recordings), [0.5, 0.0], atol=1e-4)
        np.testing.assert_allclose(np.ptp(recordings[0].values, axis=0), [0.05, 0.02], atol=1e-9)
        place = json.loads(lines[1].partition("place=")[2])
        (again,), silent = told_by(path, scale=0.001, place=place)
        np.testing.assert_array_equal(again.values, recordings[0].values)
        assert silent == []


@pytest.mark.parametrize(("meta", "inch"), [(None, 5080), ({"lpi": 1025}, 1025), ({}, 5080)])
def test_whole_numbers_of_a_tablet_are_counts_in_an_inch(tmp_path: Path, meta: Any, inch: int) -> None:
    (recording,), lines = told_by(tablet_json(tmp_path, meta, y=WAY[:, 1].tolist()))
    assert f"counts of a tablet with {inch} in an inch, because all are whole numbers" in lines[0]
    np.testing.assert_allclose(np.ptp(recording.values, axis=0), np.array([50, 20]) * 0.0254 / inch)


def test_the_pen_status_parts_a_drawing_into_strokes(tmp_path: Path) -> None:
    ways, states = [WAY, WAY + 1.0, WAY + 3.25], [DOWN, UP, DOWN]
    path = svc(tmp_path, svc_text(ways, states))
    with pytest.raises(
        ValueError, match=r"one stroke, got the pen lifted in row 6 .*\(2 strokes: --source.str"
    ):
        read_handwriting(path)
    first, second = read_handwriting(path, strokes="each", scale=0.001, place=[0.0, 0.0])
    np.testing.assert_allclose(first.values, ways[0] / 1000, atol=1e-9)
    np.testing.assert_allclose(second.values, ways[2] / 1000, atol=1e-9)
    assert second.name == f"stroke 2 of the drawing of {path}"
    (chosen,) = read_handwriting(path, strokes="2", scale=0.001, place=[0.0, 0.0])
    np.testing.assert_array_equal(chosen.values, second.values)
    with pytest.raises(ValueError, match=f"a drawing must have 3 strokes, got 2 in the drawing of {path}"):
        read_handwriting(path, strokes="3")


@pytest.mark.parametrize("strokes", ["two", "0", "-1", "", "1.5", "99999"])
def test_strokes_must_be_one_each_or_a_number(tmp_path: Path, strokes: str) -> None:
    path = svc(tmp_path, svc_text([WAY], [DOWN]))
    with pytest.raises(ValueError, match="strokes must be one, each or a number from 1 on, got "):
        read_handwriting(path, strokes=strokes)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "drawing.svc must have the number of its samples in the first line, got an empty file"),
        ("10 20 0 1 2 3 4\n", "number of its samples in the first line, got '10 20 0 1 2 3 4'"),
        ("2\n10 20 0 1 2 3 4\n", "drawing.svc must hold 2 samples as its first line says, got 1"),
        ("1\n\n10 20 0 1 2 3\n", "must hold 7 numbers in each line, x, y, .*, got 6 in line 3"),
        ("1\n10 20 0 down 2 3 4\n", "drawing.svc must hold numbers, got '10 20 0 down 2 3 4' in line 2"),
        ("1\n10 20 0 7 2 3 4\n", "pen_status must be 0 or 1, got 7 in row 0 of .*drawing.svc"),
        ("0\n", "none that is usable: the drawing of .* must have at least 3 samples"),
    ],
)
def test_svc_files_of_another_layout_are_refused(tmp_path: Path, content: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_handwriting(svc(tmp_path, content))


@pytest.mark.parametrize(
    ("changes", "meta", "message"),
    [
        ({"pen_status": None}, None, "must hold lists x, y, time, pen_status, got none of pen_status"),
        ({"x": 3}, None, "x in .*drawing.json must be a list of numbers, got 3"),
        ({"x": [1, 2, None, 4, 5, 6]}, None, "x in .* must be a list of numbers, got None in row 2"),
        ({"y": [1.0]}, None, "y in .*drawing.json must hold a number for each of 6 samples, got 1"),
        ({"x": [1, 2, 10**400, 4, 5, 6]}, None, "must be finite, got NaN or infinity in row 2"),
        ({}, {"lpi": 0}, "lpi in .* must be the tablet's counts in an inch, got 0"),
        ({}, {"lpi": "many"}, "lpi in .* must be the tablet's counts in an inch, got 'many'"),
    ],
)
def test_json_files_of_tablets_with_another_layout_are_refused(
    tmp_path: Path, changes: dict[str, Any], meta: Any, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        read_handwriting(tablet_json(tmp_path, meta, **changes))


# Omniglot


def drawing(*strokes: np.ndarray) -> str:
    parts, time = ["START"], 0
    for stroke in strokes:
        for x, y in stroke:
            parts.append(f"{x:.6f},{-y:.6f},{time}")
            time += 20
        parts.append("BREAK")
    return "\n".join([*parts, ""])


def omniglot(folder: Path, **drawings: str) -> Path:
    """An archive with two characters of Greek; the names are those of the drawings of the second."""
    path = folder / "strokes.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("strokes/Greek/character01/0394_01.txt", drawing(WAY))
        archive.writestr("__MACOSX/strokes/Greek/character01/0395_01.txt", "rubbish")
        archive.writestr("strokes/Greek/character02/.DS_Store", "rubbish")
        for name, content in drawings.items():
            archive.writestr(f"strokes/Greek/character02/{name.lstrip('_')}.txt", content)
    return path


def test_drawings_of_a_character_are_read_from_an_archive_a_folder_and_a_file(tmp_path: Path) -> None:
    archive = omniglot(tmp_path, _0395_01=drawing(WAY), _0395_02=drawing(WAY + 1.0))
    with zipfile.ZipFile(archive) as packed:
        packed.extractall(tmp_path / "unpacked")
    folder = tmp_path / "unpacked" / "strokes"
    sources: list[tuple[Path, str | None]] = [
        (archive, "Greek/character02"),
        (archive, "character02"),
        (folder, "Greek/character02"),
        (folder / "Greek", "character02"),
        (folder / "Greek" / "character02", None),
    ]
    for path, character in sources:
        first, second = read_handwriting(path, character=character)
        assert first.name == f"drawing 0395_01 of {path}"
        np.testing.assert_allclose(first.times, np.arange(6) * 20)
        np.testing.assert_allclose(np.ptp(first.values, axis=0), np.array([50, 20]) * 0.18 / 105)
        # y grows upwards, and its numbers are below 0
        assert (np.diff(first.values[:, 1]) < 0).all()
        np.testing.assert_allclose(second.values - first.values, [[0.18 / 105, -0.18 / 105]] * 6, atol=1e-9)
    assert len(read_handwriting(folder / "Greek" / "character02" / "0395_02.txt")) == 1


def test_strokes_of_a_drawing_end_at_breaks(tmp_path: Path) -> None:
    path = omniglot(
        tmp_path, _0395_01=drawing(WAY, WAY + 5.0), _0395_02=drawing(WAY), _0395_03=drawing(WAY, WAY[:1])
    )
    left_out: Counter[str] = Counter()
    options: dict[str, Any] = {"character": "character02", "scale": 0.001, "place": [0.0, 0.0]}
    assert len(read_handwriting(path, left_out=left_out, **options)) == 1
    assert left_out == {"with the pen lifted in between": 2}
    left_out.clear()
    strokes = read_handwriting(path, strokes="each", left_out=left_out, **options)
    assert [each.name.partition(" of ")[0] for each in strokes] == [
        "stroke 1",
        "stroke 2",
        "drawing 0395_02",
        "stroke 1",
    ]
    assert left_out == {"shorter than 3 samples": 1}
    np.testing.assert_allclose(strokes[1].values, (WAY + 5.0) * [0.001, -0.001], atol=1e-9)
    left_out.clear()
    (second,) = read_handwriting(path, strokes="2", left_out=left_out, **options)
    np.testing.assert_array_equal(second.values, strokes[1].values)
    assert left_out == {"with fewer than 2 strokes": 1, "shorter than 3 samples": 1}


def test_a_character_must_be_chosen_among_those_there_are(tmp_path: Path) -> None:
    path = omniglot(tmp_path, _0395_01=drawing(WAY))
    choices = "Greek/character01, Greek/character02"
    with pytest.raises(ValueError, match=f"--source.character must name one of those in {path}: {choices}"):
        read_handwriting(path)
    with pytest.raises(
        ValueError, match=f"must be one of those in {path}: {choices}; got 'Greek/character03'"
    ):
        read_handwriting(path, character="Greek/character03")
    other = svc(tmp_path, svc_text([WAY], [DOWN]))
    with pytest.raises(ValueError, match=f"--source.character is for Omniglot's drawings, .*: {other}"):
        read_handwriting(other, character="Greek/character01")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "drawing 0395_01 of .* must begin with START, got an empty file"),
        ("1,2,3\n", "must begin with START, got '1,2,3'"),
        ("START\n1,2,3\n", "drawing 0395_01 of .* must end with BREAK, got a file that is cut off"),
        ("START\n1,2\nBREAK\n", "line 2 of drawing 0395_01 of .* must be x,y,time or BREAK, got '1,2'"),
        ("START\n1,2,0\nx,2,3\nBREAK\n", "line 3 of drawing 0395_01 of .* or BREAK, got 'x,2,3'"),
        ("START\nBREAK\n", "must have at least 3 samples, each with a time, got 0 times"),
        (
            "START\n1,2,0\n1,nan,1\n2,3,2\nBREAK\n",
            "must be finite, got NaN or infinity in row 1 of drawing 0395",
        ),
        (
            "START\n1,2,0\n1,2,0\n2,3,2\nBREAK\n",
            "times must increase, got 0 after 0 in row 1 of drawing 0395_01",
        ),
    ],
)
def test_drawings_of_another_layout_are_refused(tmp_path: Path, content: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_handwriting(omniglot(tmp_path, _0395_01=content), character="character02")


def test_archives_that_are_damaged_empty_or_unpack_to_much_more_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.zip"
    path.write_bytes(b"no archive")
    with pytest.raises(ValueError, match=f"{path} must be a whole zip file, got File is not a zip"):
        read_handwriting(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("photo.png", b"")
    with pytest.raises(ValueError, match=f"{path} must hold drawings of Omniglot, NNNN_NN.txt, got none"):
        read_handwriting(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("Greek/character02/0395_01.txt", b"\n" * 2**27)
    with pytest.raises(ValueError, match=r"0395_01.txt must be stored in the file, got an array of shape"):
        read_handwriting(path)
    whole = omniglot(tmp_path, _0395_01=drawing(WAY)).read_bytes()
    at = whole.index(b"character02/0395_01.txt") + len("character02/0395_01.txt")
    path.write_bytes(whole[:at] + bytes(20) + whole[at + 20 :])
    with pytest.raises(
        ValueError, match=f"{path} must be a whole zip file, got strokes/Greek/character02/0395_0"
    ):
        read_handwriting(path, character="character02")


# MATLAB


def lasa(folder: Path, *demos: dict[str, Any], **options: Any) -> Path:
    """A file in LASA's layout: a cell of structs, and their mean time step."""
    cell = np.empty((1, len(demos)), dtype=object)
    for number, demo in enumerate(demos):
        cell[0, number] = demo
    path = folder / "Line.mat"
    scipy.io.savemat(path, {"demos": cell, "dt": 0.1}, **options)
    return path


def demo(way: np.ndarray = WAY) -> dict[str, Any]:
    zeros = np.zeros((2, len(way)))
    return {"pos": way.T, "t": TIMES[None, : len(way)], "vel": zeros, "acc": zeros, "dt": 0.1}


def panda_symbols(folder: Path, *ways: np.ndarray) -> Path:
    """A file in the layout of the Panda symbols: a struct array of the end effector's positions, velocities and forces."""
    structs = np.zeros((1, len(ways)), dtype=[(name, object) for name in ("pos", "vel", "F")])
    for number, way in enumerate(ways):
        structs[0, number] = (way.T, np.zeros_like(way.T), np.zeros_like(way.T))
    path = folder / "symbol.mat"
    scipy.io.savemat(path, {"symbol_data": structs}, do_compression=True)
    return path


@pytest.mark.parametrize("number", [1, 2, 7])
@pytest.mark.parametrize("is_compressed", [True, False])
def test_demonstrations_of_lasa_are_millimetres(tmp_path: Path, number: int, is_compressed: bool) -> None:
    path = lasa(tmp_path, *(demo(WAY + i) for i in range(number)), do_compression=is_compressed)
    recordings, lines = told_by(path)
    assert lines[0] == f"{path} is read in millimetres, as in LASA's files: --source.scale=0.001"
    assert [each.name for each in recordings] == [f"demos {i + 1} of {path}" for i in range(number)]
    for i, each in enumerate(recordings):
        np.testing.assert_allclose(each.values - recordings[0].values, np.full((6, 2), i / 1000), atol=1e-12)
        np.testing.assert_allclose(each.times, TIMES)
    np.testing.assert_allclose(middle_of(recordings), [0.5, 0.0], atol=1e-4)


def test_symbols_of_the_panda_are_metres_and_the_pen_is_lifted_by_its_height(tmp_path: Path) -> None:
    way = np.column_stack([WAY / 1000 - 0.5, np.full(6, 0.2586)])
    lifted = way.copy()
    lifted[:2, 2] += 0.05
    path = panda_symbols(tmp_path, way, lifted)
    (first, second), lines = told_by(path, place=[0.9, 0.0])
    assert lines == [f"{path} is read in metres, as in the Panda symbols: --source.scale=1"]
    np.testing.assert_allclose(first.values, way[:, :2] + [0.9, 0.0])
    np.testing.assert_allclose(first.times, np.arange(6) / 1000)
    np.testing.assert_array_equal(second.values, first.values[2:])


@pytest.mark.parametrize("kind", ["i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8"])
def test_numbers_of_matlab_files_may_have_any_type(tmp_path: Path, kind: str) -> None:
    path = lasa(tmp_path, {**demo(), "pos": WAY.T.astype(kind)})
    (recording,) = read_handwriting(path, place=[0.0, 0.0])
    np.testing.assert_allclose(recording.values, WAY / 1000)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"other": [1.0]}, "must hold one of the variables demos, symbol_data: LASA's demos .*; got other"),
        ({}, "symbol_data with pos; got none"),
        ({"demos": [1.0, 2.0]}, "demos in .*a.mat must be a cell or a struct, got an array of numbers"),
        ({"demos": "text"}, "demos in .*a.mat must be a cell or a struct, got text"),
        ({"demos": np.array([1.0, "a"], dtype=object)}, "demos 1 of .* with pos, got an array of numbers"),
        ({"demos": {"vel": [1.0]}}, "demos 1 of .*a.mat must be a struct with pos, got vel"),
        ({"demos": {"pos": "text"}}, "pos in demos 1 of .* must hold real numbers, got text"),
        ({"demos": {"pos": WAY.T * 1j}}, "pos in demos 1 of .* must hold real numbers, got complex numbers"),
        ({"demos": {"pos": scipy.sparse.eye(2)}}, "pos in demos 1 of .* real numbers, got a sparse matrix"),
        (
            {"demos": {"pos": {"x": 1.0}}},
            "pos in demos 1 of .* must hold real numbers, got a cell or a struct",
        ),
        ({"demos": {"pos": np.zeros((4, 6))}}, r"must have 2 or 3 rows, x, y and z, got .* shape \(4, 6\)"),
        ({"demos": {"pos": WAY.T, "t": [0.0, 1.0]}}, r"hold the time of each of 6 positions, .* \(1, 2\)"),
        ({"symbol_data": {"pos": np.zeros((3, 0))}}, "none that is usable: symbol_data 1 .* at least 3 samp"),
    ],
)
def test_matlab_files_of_another_layout_are_refused(
    tmp_path: Path, content: dict[str, Any], message: str
) -> None:
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, content)
    with pytest.raises(ValueError, match=message):
        read_handwriting(path)


def cut_off(content: bytes) -> bytes:
    return content[:-100]


def of_version_7_3(content: bytes) -> bytes:
    return b"MATLAB 7.3 MAT-file".ljust(124) + content[124:]


def scrambled(content: bytes) -> bytes:
    return content[:160] + bytes(200) + content[360:]


def bomb(content: bytes) -> bytes:
    packed = zlib.compress(bytes(2**27))
    return content[:128] + struct.pack("<II", 15, len(packed)) + packed


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda _: b"text", "Line.mat must be a MATLAB file of version 5 to 7, got another file"),
        (of_version_7_3, "must be a MATLAB file of version 7 or before, got one of 7.3: save it with -v7"),
        (cut_off, "Line.mat must be a whole MATLAB file: an element is cut off"),
        (scrambled, "Line.mat must be a whole MATLAB file"),
        (bomb, "a variable must be stored in the file, got an array of shape"),
    ],
)
def test_matlab_files_that_are_damaged_or_too_new_are_refused(
    tmp_path: Path, damage: Callable[[bytes], bytes], message: str
) -> None:
    path = lasa(tmp_path, demo(), do_compression=True)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ValueError, match=message):
        read_handwriting(path)


@pytest.mark.parametrize("is_compressed", [True, False])
def test_matlab_files_with_a_wrong_byte_anywhere_are_read_or_refused(
    tmp_path: Path, is_compressed: bool
) -> None:
    whole = lasa(tmp_path, demo(), do_compression=is_compressed).read_bytes()
    path, n_refused = tmp_path / "a.mat", 0
    for at in range(126, len(whole), 3):
        for byte in (0, 255, whole[at] ^ 1):
            path.write_bytes(whole[:at] + bytes([byte]) + whole[at + 1 :])
            try:
                read_handwriting(path)
            except ValueError as error:
                n_refused += 1
                assert str(path) in str(error)
    assert n_refused > 100


# pf2mp-convert


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "options", "what", "n_written"),
    [
        (lambda folder: svc(folder, svc_text([WAY + 0.5], [DOWN])), [], "millimetres, because not all", 1),
        (
            lambda folder: svc(folder, svc_text([WAY, WAY, WAY + 0.5], [DOWN, UP, DOWN])),
            ["--source.strokes=each"],
            "millimetres, because not all",
            2,
        ),
        (
            lambda folder: omniglot(folder, _0395_01=drawing(WAY), _0395_02=drawing(WAY)),
            ["--source.character=Greek/character02"],
            "pixels, of which 105 become 0.18 m",
            2,
        ),
        (lambda folder: lasa(folder, demo(), demo(), demo()), [], "millimetres, as in LASA's files", 3),
        (
            lambda folder: panda_symbols(folder, WAY / 1000),
            ["--source.place=[0.45,0]", "--source.scale=2"],
            "",
            1,
        ),
    ],
)
def test_the_command_converts_recordings_of_others_and_says_their_unit(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    make: Callable[[Path], Path],
    options: list[str],
    what: str,
    n_written: int,
) -> None:
    usual = ["--source.type=handwriting", "--task=handwriting_pen", "--n_regions=0", "--n_steps=5"]
    own = [f"--source.path={make(tmp_path)}", f"--root={tmp_path / 'd'}"]
    monkeypatch.setattr(sys, "argv", ["pf2mp-convert", *usual, *own, *options])
    cli.convert()
    *told, last = capfd.readouterr().out.strip().splitlines()
    assert last.startswith(f"Wrote {n_written} episodes of 5 steps to {tmp_path / 'd'} ")
    assert len(told) == (2 if what else 0)
    assert what in (told or [""])[0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--source.strokes=all"], "error: strokes must be one, each or a number from 1 on, got 'all'"),
        (["--source.scale=0"], "error: scale must be a finite length above 0 m, got 0.0"),
        (["--source.character=a/b"], "error: --source.character is for Omniglot's drawings, got another"),
        (["--source.path=drawing.mat"], "error: drawing.mat must be a MATLAB file of version 5 to 7"),
        (["--source.scale=0.1"], "error: the pen in the drawing of drawing.svc must lie on the sheet"),
    ],
)
def test_bad_options_for_recordings_of_others_end_in_one_line_and_nothing_written(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    options: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    svc(Path(), svc_text([WAY + 0.5], [DOWN]))
    Path("drawing.mat").write_bytes(b"text")
    usual = ["--source.type=handwriting", "--source.path=drawing.svc", "--task=handwriting_pen", "--root=d"]
    monkeypatch.setattr(sys, "argv", ["pf2mp-convert", *usual, "--n_regions=0", *options])
    with pytest.raises(SystemExit, match="1"):
        cli.convert()
    assert capfd.readouterr().err.strip().splitlines()[-1].startswith(message)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drawing.mat", "drawing.svc"]
