# SPDX-License-Identifier: Apache-2.0
"""Reads recorded handwriting of Omniglot: drawings of a character, as its archives of strokes hold them.

The source is an archive like ``strokes_background_small1.zip``, the folder that it unpacks to, a folder of it, or one drawing.
A drawing is ``ALPHABET/characterNN/NNNN_NN.txt``: lines ``x,y,time`` in pixels of a sheet of 105 x 105 and milliseconds, y
upwards and negative, between ``START`` and a last ``BREAK``. Each ``BREAK`` ends a stroke. See
https://github.com/brendenlake/omniglot.
"""  # noqa: E501

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from lerobot_pf2mp.dataset_tools.array_size import check_size
from lerobot_pf2mp.dataset_tools.handwriting.recorded_episode import RecordedEpisode, Recording
from lerobot_pf2mp.envs.handwriting.sheet import LETTER_HEIGHT

_DRAWING = re.compile(r"\d{4}_\d{2}\.txt")
_SIDE = 105  # of Omniglot's sheet [pixels]
_UNIT = f"pixels, of which {_SIDE} become {LETTER_HEIGHT:g} m, the height of a letter"
_MANY = 12  # names in a message

_Name = tuple[str, ...]  # the folders above a drawing, and its file
_Read = Callable[[], bytes]


def read_omniglot(path: Path, character: str | None) -> Recording:
    """Reads the drawings of one character.

    Args:
        path: An archive, a folder or a drawing.
        character: ``ALPHABET/CHARACTER``, or its end; None if there is only one.

    Raises:
        ValueError: If there is no such character, several fit, or a drawing has another layout.
    """
    with _contents(path) as drawings:
        chosen = _of_character(drawings, character, path)
        episodes = [_episode(name, drawings[name](), path) for name in chosen]
    return Recording(episodes, LETTER_HEIGHT / _SIDE, _UNIT, is_of_another_sheet=True)


def is_omniglot_folder(path: Path) -> bool:
    """Whether a folder, or one of those up to two levels below it, holds drawings."""
    depths = ("*.txt", "*/*.txt", "*/*/*.txt", "*/*/*/*.txt")
    return any(_DRAWING.fullmatch(file.name) for depth in depths for file in path.glob(depth))


@contextmanager
def _contents(path: Path) -> Iterator[dict[_Name, _Read]]:
    """The drawings by name, and how each is read."""
    if path.is_dir():
        files = sorted(file for file in path.rglob("*.txt") if _DRAWING.fullmatch(file.name))
        # The folder may be an alphabet or a character: the names above a drawing are those of the path.
        yield {file.absolute().parts: file.read_bytes for file in files}
    elif path.suffix.lower() == ".txt":
        yield {path.absolute().parts: path.read_bytes}
    else:
        try:
            archive = zipfile.ZipFile(path)
        except (zipfile.BadZipFile, NotImplementedError) as error:
            raise ValueError(f"{path} must be a whole zip file, got {error}") from error
        with archive:
            yield {name: _reader(archive, info, path) for name, info in _drawings_in(archive)}


def _drawings_in(archive: zipfile.ZipFile) -> Iterator[tuple[_Name, zipfile.ZipInfo]]:
    for info in sorted(archive.infolist(), key=lambda info: info.filename):
        name = tuple(info.filename.split("/"))
        if _DRAWING.fullmatch(name[-1]) and "__MACOSX" not in name:
            yield name, info


def _reader(archive: zipfile.ZipFile, info: zipfile.ZipInfo, path: Path) -> _Read:
    def read() -> bytes:
        check_size(info.filename, (info.file_size,), info.file_size, info.compress_size, path)
        try:
            return archive.read(info)
        except Exception as error:  # the reader of zip files raises a dozen types
            raise ValueError(f"{path} must be a whole zip file, got {info.filename}: {error}") from error

    return read


def _of_character(drawings: dict[_Name, _Read], character: str | None, path: Path) -> list[_Name]:
    """The drawings of the chosen character."""
    if not drawings:
        raise ValueError(f"{path} must hold drawings of Omniglot, NNNN_NN.txt, got none")
    wanted = tuple(character.strip("/").split("/")) if character else ()
    fitting = [name for name in drawings if not wanted or name[:-1][-len(wanted) :] == wanted]
    characters = {"/".join(name[-3:-1]) for name in fitting}
    if not fitting:
        choices = {"/".join(name[-3:-1]) for name in drawings}
        raise ValueError(
            f"--source.character must be one of those in {path}: {_listed(choices)}; got {character!r}"
        )
    if len(characters) > 1:
        raise ValueError(f"--source.character must name one of those in {path}: {_listed(characters)}")
    return fitting


def _listed(characters: set[str]) -> str:
    """Names of characters; with many, how many there are of each alphabet."""
    if len(characters) <= _MANY:
        return ", ".join(sorted(characters))
    of_alphabet: dict[str, list[str]] = {}
    for alphabet, _, character in sorted(name.rpartition("/") for name in characters):
        of_alphabet.setdefault(alphabet, []).append(character)
    return ", ".join(f"{alphabet}/{mine[0]} to {mine[-1]}" for alphabet, mine in of_alphabet.items())


def _episode(name: _Name, content: bytes, path: Path) -> RecordedEpisode:
    rows: list[list[float]] = []
    breaks: list[int] = []
    title = f"drawing {name[-1].removesuffix('.txt')}"
    lines = content.decode("utf-8", errors="replace").splitlines()
    if not lines or lines[0].strip() != "START":
        got = f"{lines[0]!r:.40}" if lines else "an empty file"
        raise ValueError(f"{title} of {path} must begin with START, got {got}")
    for number, line in enumerate(lines[1:], 2):
        if line.strip() == "BREAK":
            breaks.append(len(rows))
        elif line.strip():
            rows.append(_sample(line, f"line {number} of {title} of {path}"))
    if not breaks or breaks[-1] != len(rows):
        raise ValueError(f"{title} of {path} must end with BREAK, got a file that is cut off")
    samples = np.array(rows).reshape(-1, 3)
    return RecordedEpisode(title, samples[:, 2], samples[:, :2], new_strokes=breaks[:-1])


def _sample(line: str, name: str) -> list[float]:
    try:
        x, y, time = (float(cell) for cell in line.split(","))
    except ValueError as error:
        raise ValueError(f"{name} must be x,y,time or BREAK, got {line!r:.40}") from error
    return [x, y, time]
