# SPDX-License-Identifier: Apache-2.0
"""Recognises the format of recorded handwriting. This is the only place that does."""

from __future__ import annotations

from pathlib import Path

from lerobot_pf2mp.dataset_tools.handwriting.recorded_dataset import read_dataset
from lerobot_pf2mp.dataset_tools.handwriting.recorded_episode import Recording
from lerobot_pf2mp.dataset_tools.handwriting.recorded_json import episodes_of_json, parsed, read_json_lines
from lerobot_pf2mp.dataset_tools.handwriting.recorded_matlab import read_matlab
from lerobot_pf2mp.dataset_tools.handwriting.recorded_omniglot import is_omniglot_folder, read_omniglot
from lerobot_pf2mp.dataset_tools.handwriting.recorded_table import read_table
from lerobot_pf2mp.dataset_tools.handwriting.recorded_tablet import (
    is_tablet_json,
    read_svc,
    tablet_recording,
)

_READERS = {".csv": read_table, ".tsv": read_table, ".svc": read_svc, ".mat": read_matlab}
_OMNIGLOT = (".zip", ".txt")


def read_recording(path: Path, character: str | None = None) -> Recording:
    """Reads a recording of any format.

    | format | recognised by |
    |---|---|
    | CSV, TSV, JSON lines, SVC, MATLAB | the end of the file's name |
    | JSON | the same; a tablet's holds ``"data"``, others ``"episodes"`` |
    | Omniglot | ``.zip``, ``.txt``, or a folder with drawings NNNN_NN.txt |
    | LeRobotDataset | any other folder |

    Args:
        path: The file or folder.
        character: Of Omniglot, the character; see `read_omniglot`.

    Raises:
        ValueError: If its format is unknown, it breaks the rules of its format, or has no characters.
    """
    suffix = "" if path.is_dir() else path.suffix.lower()
    is_lerobot = path.is_dir() and (path / "meta" / "info.json").is_file()
    if suffix in _OMNIGLOT or (path.is_dir() and not is_lerobot and is_omniglot_folder(path)):
        return read_omniglot(path, character)
    if character is not None:
        raise ValueError(f"--source.character is for Omniglot's drawings, got another recording: {path}")
    if path.is_dir():
        return Recording(read_dataset(path))
    if suffix in _READERS:
        return _READERS[suffix](path)
    if suffix == ".jsonl":
        return Recording(read_json_lines(path))
    if suffix != ".json":
        raise ValueError(
            "a recording must be a .csv or .json file or a LeRobotDataset's folder, or a .tsv, .jsonl, .svc (tablets), .mat "
            f"(LASA, Panda symbols), .zip or .txt (Omniglot) file, got {path}"
        )
    content = parsed(path.read_bytes(), str(path))
    if is_tablet_json(content):
        return tablet_recording(content, path)
    return Recording(episodes_of_json(content, path))
