# SPDX-License-Identifier: Apache-2.0
"""Writes files and folders that appear whole or not at all."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def file_written_beside(path: Path) -> Iterator[Path]:
    """A temporary file beside `path` that replaces it at the end. After an error it is deleted.

    Args:
        path: The file to be written or replaced; missing parent folders are made.

    Yields:
        The path of the temporary file, which has the same suffix and does not exist yet.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".partial.{path.name}")
    try:
        yield partial
        partial.replace(path)
    finally:
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
        FileExistsError: If the folder exists and `overwrite` is false, or it is of another kind.
    """
    folder = Path(folder)
    if folder.exists():
        if not overwrite:
            raise FileExistsError(
                f"{folder} exists already: choose another {option}, or pass --overwrite=true"
            )
        if not (folder / mark).is_file():
            raise FileExistsError(
                f"{folder} is no {kind}, it holds no {mark}, and will not be overwritten: choose another {option}"
            )
    made = [parent for parent in folder.absolute().parents if not parent.exists()]
    folder.parent.mkdir(parents=True, exist_ok=True)
    workspace = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", suffix=".partial", dir=folder.parent))
    try:
        partial = workspace / "new"
        yield partial
        _swap(partial, folder, spare=workspace / "old")
    finally:
        shutil.rmtree(workspace, ignore_errors=True)
        for parent in made:
            with suppress(OSError):  # not empty, for example because it holds the new folder
                parent.rmdir()


def _swap(new: Path, folder: Path, spare: Path) -> None:
    """Replaces `folder` by `new`; if that fails, `folder` is unchanged."""
    if not folder.exists():
        new.rename(folder)
        return
    folder.rename(spare)
    try:
        new.rename(folder)
    except BaseException:
        spare.rename(folder)
        raise
