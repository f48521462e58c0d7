# SPDX-License-Identifier: Apache-2.0
"""Claims on files and folders: of two runs with one output, the second ends before it begins.

A claim is a locked file beside the output. The lock ends with its process, however that ends. So whoever holds the claim
knows that everything unfinished there was left by a run that is dead.
"""

from __future__ import annotations

import json
import logging
import os
import re
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

if sys.platform == "win32":
    fcntl = None
else:
    import fcntl

logger = logging.getLogger(__name__)


@contextmanager
def claimed(target: Path) -> Iterator[None]:
    """Claims a file or folder to be written. What a dead run left unfinished beside it is removed, or put back.

    Args:
        target: The file or folder. It need not exist; missing parent folders are made, and removed if they stay empty.

    Raises:
        FileExistsError: If another process is writing it.
    """
    target = Path(target).absolute()
    made = [parent for parent in target.parents if not parent.exists()]
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        with _locked(target.with_name(f".{target.name}.claim"), target) as is_locked:
            if is_locked:
                _clear_up(target)
            yield
    finally:
        for parent in made:
            with suppress(OSError):  # not empty, for example because it holds the target
                parent.rmdir()


def workspace_of(target: Path) -> Path:
    """The folder beside a claimed target in which it is written. It does not exist yet."""
    return target.with_name(f".{target.name}.partial")


@contextmanager
def _locked(file: Path, target: Path) -> Iterator[bool]:
    """Locks a file, if the file system can. Otherwise two runs are not kept apart."""
    if fcntl is None:
        yield False
        return
    is_locked = True
    while True:
        descriptor = os.open(file, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            raise FileExistsError(
                f"{target} is being written by another process{_whose(file)}: wait for it, or choose another output"
            ) from None
        except OSError:
            is_locked = False
        # Another process may have removed the file between these two calls.
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), file.stat()):
                break
        os.close(descriptor)
    try:
        os.write(descriptor, json.dumps({"process": os.getpid()}).encode())
        yield is_locked
    finally:
        file.unlink(missing_ok=True)
        os.close(descriptor)


def _whose(file: Path) -> str:
    try:
        return f", {json.loads(file.read_text())['process']}"
    except (OSError, ValueError, KeyError, TypeError):
        return ""


def _clear_up(target: Path) -> None:
    """Puts an output back that a dead run was about to replace, and removes what it had not finished."""
    left = [workspace_of(target), target.with_name(f".partial.{target.name}")]
    for path in [*left, *_left_by_earlier_versions(target)]:
        if not path.exists():
            continue
        if not target.exists() and (path / "old").exists():
            (path / "old").rename(target)
            logger.warning("Put %s back, which an interrupted run was about to replace.", target)
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
        logger.warning("Removed %s, which an interrupted run left.", path)


def _left_by_earlier_versions(target: Path) -> list[Path]:
    """The same of versions before 0.2, which named them at random. Not of another target whose name begins alike."""
    name = re.compile(rf"\.({re.escape(target.name)}\.[a-z0-9_]{{8}})\.partial")
    found = [(path, name.fullmatch(path.name)) for path in target.parent.iterdir()]
    return [
        path
        for path, match in found
        if match
        and not path.with_name(match[1]).exists()
        and not path.with_name(f".{match[1]}.claim").exists()
    ]
