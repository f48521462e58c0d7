# SPDX-License-Identifier: Apache-2.0
"""Opens HDF5 files of others, and checks their arrays before anything is read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py

from lerobot_pf2mp.dataset_tools.array_size import check_size


@contextmanager
def opened_hdf5(path: Path) -> Iterator[h5py.File]:
    """An HDF5 file, open for reading.

    Raises:
        ValueError: If it is not a whole HDF5 file, also where that is noticed while the `with` block reads it.
    """
    try:
        with h5py.File(path) as file:
            yield file
    except OSError as error:
        raise ValueError(f"{path} must be a whole HDF5 file, got one that cannot be read: {error}") from error


def holds(group: h5py.Group, name: str) -> bool:
    """Whether there is anything under a name, be it a link that leads nowhere."""
    try:
        return group.get(name, getlink=True) is not None
    except (KeyError, RuntimeError):  # something on the way to it is no group, or a link to itself
        return False


def array_in(group: h5py.Group, name: str, path: Path) -> h5py.Dataset:
    """The array of numbers under a name, of which nothing is read yet.

    Args:
        group: The file or a group in it.
        name: Name of the array in the group.
        path: The file, for error messages.

    Raises:
        ValueError: If there is something else under this name, or much less is stored than the array's shape says.
    """
    entry = _entry(group, name)
    if isinstance(entry, str):
        raise ValueError(
            f"{_full_name(group, name)} must be an array of real numbers that the file itself holds, got {entry} in {path}"
        )
    n_stored = entry.id.get_storage_size()
    if not n_stored or entry.nbytes > n_stored:  # asking for the name takes time
        check_size(_full_name(group, name), entry.shape, entry.nbytes, n_stored, path)
    return entry


def _full_name(group: h5py.Group, name: str) -> str:
    return f"{group.name}/{name}".strip("/")


def _entry(group: h5py.Group, name: str) -> h5py.Dataset | str:
    """What is under a name: an array of numbers, or the words for anything else."""
    link = group.get(name, getlink=True)
    if link is None:
        return "nothing"
    if isinstance(link, h5py.ExternalLink):
        return "a link to another file"
    try:
        entry = group[name]
    except (KeyError, RuntimeError):  # the latter if it leads to itself
        return "a link that leads nowhere"
    if not isinstance(entry, h5py.Dataset):
        return f"a {type(entry).__name__.lower()}"
    if entry.dtype.kind not in "biuf":
        return f"elements of type {'reference' if _holds_references(entry) else entry.dtype}"
    if entry.shape is None or entry.ndim < 1:
        return "a single number" if entry.shape == () else "nothing"
    return "an array that lies in other files" if entry.is_virtual or entry.external else entry


def _holds_references(entry: h5py.Dataset) -> bool:
    return h5py.check_ref_dtype(entry.dtype) is not None
