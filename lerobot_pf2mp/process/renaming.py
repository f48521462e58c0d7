# SPDX-License-Identifier: Apache-2.0
"""Renaming that replaces nothing, and exchanging two files or folders at once, where the operating system can."""

from __future__ import annotations

import ctypes
import errno
import os
import sys
from pathlib import Path

# Of renameat2 (Linux) and renamex_np (macOS).
_NO_REPLACE, _EXCHANGE = (4, 2) if sys.platform == "darwin" else (1, 2)
_AT_FDCWD = -100
_CANNOT = {errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP}


def rename_to_new(old: Path, new: Path) -> None:
    """Renames a file or folder to a name that does not exist.

    Raises:
        FileExistsError: If it exists.
    """
    if not _rename(old, new, _NO_REPLACE):
        if new.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(new))
        old.rename(new)


def exchange(one: Path, other: Path, spare: Path) -> None:
    """Exchanges two files or folders at once.

    Where the system cannot do that, it takes three renames. A process that is killed between them leaves `other` at
    `spare`.

    Args:
        one: The first.
        other: The second, at whose place something is at every time, if the system can do that.
        spare: A name in between, which does not exist.
    """
    if _rename(one, other, _EXCHANGE):
        return
    other.rename(spare)
    try:
        one.rename(other)
    except BaseException:
        spare.rename(other)
        raise
    spare.rename(one)


def _rename(old: Path, new: Path, flags: int) -> bool:
    """Renames with flags; returns false if the system cannot."""
    library = ctypes.CDLL(None, use_errno=True)
    names = os.fsencode(old), os.fsencode(new)
    if sys.platform == "darwin" and hasattr(library, "renamex_np"):
        failed = library.renamex_np(*names, flags)
    elif sys.platform == "linux" and hasattr(library, "renameat2"):
        failed = library.renameat2(_AT_FDCWD, names[0], _AT_FDCWD, names[1], flags)
    else:
        return False
    if not failed:
        return True
    code = ctypes.get_errno()
    if code in _CANNOT:
        return False
    raise OSError(code, os.strerror(code), str(old), None, str(new))
