# SPDX-License-Identifier: Apache-2.0
"""How much a MATLAB file holds, found out before any of it is kept in memory."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

from lerobot_pf2mp.dataset_tools.array_size import check_size

# MAT-File Format, MathWorks: 128 bytes of text, version and byte order, then elements with a tag of 8 bytes each.
_HEADER, _TAG, _COMPRESSED = 128, 8, 15
_PIECE = 2**20  # bytes unpacked at a time


def unpacked_size(path: Path) -> int:
    """The bytes that the variables of a MATLAB file have in memory.

    Raises:
        ValueError: If the file is none of version 5 to 7, is damaged, or unpacks to much more than is stored.
    """
    if path.is_dir():
        raise ValueError(f"{path} must be a MATLAB file, got a folder")
    total = 0
    with path.open("rb") as file:
        header = file.read(_HEADER)
        if header.startswith(b"MATLAB 7.3") or b"\x89HDF" in header[:8]:
            raise ValueError(
                f"{path} must be a MATLAB file of version 7 or before, got one of 7.3: save it with -v7"
            )
        order = {b"IM": "<", b"MI": ">"}.get(header[126:])
        if order is None:
            raise ValueError(f"{path} must be a MATLAB file of version 5 to 7, got another file")
        while tag := file.read(_TAG):
            kind, n_bytes = struct.unpack(f"{order}II", tag.ljust(_TAG, b"\0"))
            content = file.read(n_bytes)
            if len(tag) < _TAG or len(content) < n_bytes:
                raise ValueError(f"{path} must be a whole MATLAB file, got one that is cut off")
            total += _inflated(content, path) if kind == _COMPRESSED else len(content)
    return total


def _inflated(content: bytes, path: Path) -> int:
    stream, total = zlib.decompressobj(), 0
    rest = content
    try:
        while rest and not stream.eof:
            total += len(stream.decompress(rest, _PIECE))
            rest = stream.unconsumed_tail
            check_size("a variable", (total,), total, len(content), path)
    except zlib.error as error:
        raise ValueError(f"{path} must be a whole MATLAB file, got one that is damaged: {error}") from error
    return total
