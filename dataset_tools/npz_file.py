# SPDX-License-Identifier: Apache-2.0
"""Reads npz files of others: without pickles, and not before the sizes of their arrays are checked."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.lib import format as npy

from lerobot_pf2mp.dataset_tools.array_size import check_size


def read_npz(path: Path, names: Sequence[str]) -> tuple[list[str], dict[str, np.ndarray]]:
    """Reads arrays of an npz file.

    Args:
        path: The file.
        names: Names of the arrays to read, if there are any.

    Returns:
        The names of all arrays in the file, and the arrays.

    Raises:
        ValueError: If the file is damaged or holds pickles, or an array is much larger than what is stored of it.
    """
    with _explained(path), zipfile.ZipFile(path) as archive:
        sizes = [_size_of(archive, name) for name in names if f"{name}.npy" in archive.namelist()]
    for name, shape, n_bytes, n_stored in sizes:
        check_size(name, shape, n_bytes, n_stored, path)
    with _explained(path), np.load(path, allow_pickle=False) as file:
        return list(file.files), {name: np.asarray(file[name]) for name in names if name in file.files}


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # the readers of zip and npy raise a dozen types
        raise ValueError(
            f"{path} must be a whole npz file without pickles, got one that cannot be read: {error}"
        ) from error


def _size_of(archive: zipfile.ZipFile, name: str) -> tuple[str, tuple[int, ...], int, int]:
    """The name of an array, its shape, its size in memory, and what the file stores of it [bytes]."""
    info = archive.getinfo(f"{name}.npy")
    with archive.open(info) as stream:
        read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
        shape, _, dtype = read[npy.read_magic(stream)](stream)
    return name, shape, math.prod(shape) * dtype.itemsize, info.compress_size
