# SPDX-License-Identifier: Apache-2.0
"""Writes files and folders that appear whole or not at all."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lerobot_pf2mp.process.claims import claimed, workspace_of
from lerobot_pf2mp.process.interruption import uninterrupted
from lerobot_pf2mp.process.renaming import exchange, rename_to_new


@contextmanager
def file_written_beside(path: Path) -> Iterator[Path]:
    """A temporary file beside `path` that replaces it at the end. After an error it is deleted.

    Args:
        path: The file to be written or replaced; missing parent folders are made.

    Yields:
        The path of the temporary file, which has the same suffix and does not exist yet.

    Raises:
        FileExistsError: If another process is writing the file.
    """
    with claimed(path):
        partial = path.with_name(f".partial.{path.name}")
        try:
            yield partial
            partial.replace(path)
        finally:
            with uninterrupted():
                partial.unlink(missing_ok=True)


@contextmanager
def written_beside(folder: Path, overwrite: bool, *, kind: str, mark: str, option: str) -> Iterator[Path]:
    """A temporary folder beside `folder` that replaces it at the end. After an error it is deleted.

    Args:
        folder: The folder to be written.
        overwrite: Whether an existing folder is replaced.
        kind: The kind of folder, for error messages, for example "dataset".
        mark: A file that marks a folder of this kind. A folder without it is never replaced.
        option: The command-line option that chose the folder, for error messages.

    Yields:
        The path of the temporary folder, which does not exist yet.

    Raises:
        FileExistsError: If the folder exists, or appears in the meantime, and `overwrite` is false, if it is of another
            kind, or if another process is writing it.
    """
    folder = Path(folder)
    with claimed(folder):
        _check_replaceable(folder, overwrite, kind, mark, option)
        workspace = workspace_of(folder)
        workspace.mkdir()
        try:
            new = workspace / "new"
            yield new
            if folder.exists():
                _check_replaceable(folder, overwrite, kind, mark, option)
                exchange(new, folder, workspace / "old")
            else:
                rename_to_new(new, folder)
        finally:
            with uninterrupted():
                shutil.rmtree(workspace, ignore_errors=True)


def _check_replaceable(folder: Path, overwrite: bool, kind: str, mark: str, option: str) -> None:
    if not folder.exists():
        return
    if not overwrite:
        raise FileExistsError(f"{folder} exists already: choose another {option}, or pass --overwrite=true")
    if not (folder / mark).is_file():
        raise FileExistsError(
            f"{folder} is no {kind}, it holds no {mark}, and will not be overwritten: choose another {option}"
        )
