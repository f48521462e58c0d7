# SPDX-License-Identifier: Apache-2.0
"""Reads numbers, cells and structs of MATLAB files of version 5 to 7.

SciPy's reader crashes the interpreter on some damaged files. This one reads what recordings need, within the bytes that are
there. The format is described in MathWorks' "MAT-File Format".
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_pf2mp.dataset_tools.array_size import check_size
from lerobot_pf2mp.errors import explained

_HEADER, _TAG, _DEEPEST = 128, 8, 8  # bytes, bytes, cells or structs within each other
_PIECE = 2**20  # bytes unpacked at a time
_MATRIX, _COMPRESSED = 14, 15
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_CELL, _STRUCT, _NUMERIC = 1, 2, range(6, 16)  # classes of arrays
_CLASSES = {3: "an object", 4: "text", 5: "a sparse matrix", 16: "a function", 17: "an object"}
_IS_COMPLEX = 0x0800


class Unread(str):
    """What stands for an array of another kind: its kind, for error messages."""

    __slots__ = ()


def read_matlab_variables(path: Path, names: Sequence[str]) -> tuple[list[str], dict[str, Any]]:
    """Reads variables of a MATLAB file.

    Args:
        path: The file.
        names: The variables to read, if they are there.

    Returns:
        The names of all variables, and the values of those asked for: arrays of numbers in their shape, lists of the elements
        of cells, lists of dictionaries for structs, and `Unread` for everything else.

    Raises:
        ValueError: If the file is none of version 5 to 7, is damaged, or unpacks to much more than is stored.
    """  # noqa: E501
    content = path.read_bytes()
    if content.startswith(b"MATLAB 7.3") or content.startswith(b"\x89HDF"):
        raise ValueError(
            f"{path} must be a MATLAB file of version 7 or before, got one of 7.3: save it with -v7"
        )
    order = {b"IM": "<", b"MI": ">"}.get(content[_HEADER - 2 : _HEADER])
    if order is None:
        raise ValueError(f"{path} must be a MATLAB file of version 5 to 7, got another file")
    found: list[str] = []
    values = {}
    with explained(f"{path} must be a whole MATLAB file"):
        for kind, data in _elements(memoryview(content)[_HEADER:], order):
            inner = [(kind, data)]
            if kind == _COMPRESSED:
                inner = list(_elements(_inflated(data, path), order))
            for inner_kind, matrix in inner:
                if inner_kind != _MATRIX:
                    continue
                name = _name_of(matrix, order)
                found.append(name)
                if name in names:
                    values[name] = _value(matrix, order)
    return found, values


def _inflated(data: memoryview, path: Path) -> memoryview:
    stream, pieces, total = zlib.decompressobj(), [], 0
    rest: bytes = bytes(data)
    while rest and not stream.eof:
        pieces.append(stream.decompress(rest, _PIECE))
        rest = stream.unconsumed_tail
        total += len(pieces[-1])
        check_size("a variable", (total,), total, len(data), path)
    if not stream.eof:
        raise ValueError("a variable is cut off")
    return memoryview(b"".join(pieces))


def _elements(data: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """The kind and the content of each element. Small ones have both in eight bytes."""
    at = 0
    while at < len(data):
        if len(data) - at < _TAG:
            raise ValueError("an element is cut off")
        kind, n_bytes = struct.unpack_from(f"{order}II", data, at)
        start = at + _TAG
        if kind >> 16:
            kind, n_bytes, start = kind & 0xFFFF, kind >> 16, at + 4
            end = at + _TAG
        else:
            end = start + n_bytes + (0 if kind == _COMPRESSED else -n_bytes % _TAG)
        if start + n_bytes > min(len(data), end):
            raise ValueError("an element is cut off")
        yield kind, data[start : start + n_bytes]
        at = end


def _name_of(matrix: memoryview, order: str) -> str:
    parts = _elements(matrix, order)
    next(parts, None)
    next(parts, None)
    _, name = next(parts, (0, memoryview(b"")))
    return bytes(name).decode("latin-1")


def _value(matrix: memoryview, order: str, depth: int = 0) -> Any:
    """The value of an array, whose parts are flags, shape, name and content."""
    if not len(matrix):
        return np.zeros((0, 0))
    if depth > _DEEPEST:
        raise ValueError(f"cells and structs must be at most {_DEEPEST} within each other")
    parts = _elements(matrix, order)
    flags = int(_numbers(*next(parts), order)[0])
    shape = tuple(int(length) for length in _numbers(*next(parts), order))
    next(parts)  # its name
    if any(length < 0 for length in shape):
        raise ValueError(f"a shape must have no negative length, got {shape}")
    kind, n_elements = flags & 0xFF, math.prod(shape)
    if kind in _NUMERIC:
        if flags & _IS_COMPLEX:
            return Unread("complex numbers")
        numbers = _numbers(*next(parts), order) if n_elements else np.zeros(0)
        if numbers.size != n_elements:
            raise ValueError(f"an array of shape {shape} must have as many numbers, got {numbers.size}")
        return numbers.astype(np.float64).reshape(shape, order="F")
    if kind == _CELL:
        return [_nested(parts, order, depth) for _ in range(n_elements)]
    if kind == _STRUCT:
        width = int(_numbers(*next(parts), order)[0])
        text = bytes(next(parts)[1])
        if width < 1 or len(text) % width:
            raise ValueError("names of fields must have the same length")
        starts = range(0, len(text), width)
        fields = [text[at : at + width].split(b"\0")[0].decode("latin-1") for at in starts]
        if not fields:
            return []
        return [{field: _nested(parts, order, depth) for field in fields} for _ in range(n_elements)]
    return Unread(_CLASSES.get(kind, f"an array of the unknown class {kind}"))


def _nested(parts: Iterator[tuple[int, memoryview]], order: str, depth: int) -> Any:
    kind, data = next(parts, (0, memoryview(b"")))
    if kind != _MATRIX:
        raise ValueError("a cell or struct must hold arrays, got fewer than its shape says")
    return _value(data, order, depth + 1)


def _numbers(kind: int, data: memoryview, order: str) -> np.ndarray:
    if kind not in _NUMBERS:
        raise ValueError(f"numbers must be of a known kind, got kind {kind}")
    return np.frombuffer(data, dtype=np.dtype(f"{order}{_NUMBERS[kind]}"))
