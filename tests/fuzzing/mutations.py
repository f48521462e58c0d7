# SPDX-License-Identifier: Apache-2.0
"""Small changes to inputs that are right: what bugs, other tools, interrupted downloads and strangers do to files."""

from __future__ import annotations

import copy
import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from safetensors.torch import load_file, save_file

# Either tiny or absurd: a large number that is possible is not a fault, it only takes long.
VALUES: list[Any] = [
    None, True, False, 0, 1, 2, -1, 0.5, -0.5, 1e-300, 1e300, -1e300, 10**9, 10**18, 10**30, -(10**30),
    float("nan"), float("inf"), float("-inf"), "", " ", "x", "null", "~", "1e9", "2026-01-01", "../x", "/etc/passwd",
    "a #b", "[", "{a: b}", "ünïcödé", "\x00", "x" * 5000, [], {}, [None], [[]], {"a": 1}, [1, "x", None], [0] * 50,
    {"class": "foreign_marker.Step"}, "foreign_marker.Step",
]  # fmt: skip
FOREIGN_YAML = [
    "!!python/object/apply:foreign_marker.touch []",
    "!!python/name:foreign_marker.touch",
    "!include /etc/hostname",
    "!x",
    "&a [*a]",
    "*a",
    "<<: {}",
]


def places_in(value: Any, below: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The paths of all values within a value of dictionaries and lists."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [place for key, item in items for place in ((*below, key), *places_in(item, (*below, key)))]


def mutate_value(value: Any, rng: random.Random) -> Any:
    """A copy of dictionaries and lists in which one or two places are changed, removed, renamed or added to."""
    value = copy.deepcopy(value)
    for _ in range(rng.choice([1, 1, 2])):
        places = places_in(value)
        if not places or rng.random() < 0.05:
            return copy.deepcopy(rng.choice(VALUES))
        *parents, key = rng.choice(places)
        owner = value
        for parent in parents:
            owner = owner[parent]
        what = rng.random()
        if what < 0.7:
            owner[key] = copy.deepcopy(rng.choice(VALUES))
        elif what < 0.85:
            del owner[key]
        elif isinstance(owner, dict):
            owner[rng.choice(["x", "type", str(key).upper(), ""])] = copy.deepcopy(rng.choice(VALUES))
        else:
            owner.insert(0, copy.deepcopy(rng.choice(VALUES)))
    return value


def mutate_bytes(data: bytes, rng: random.Random) -> bytes:
    """Bytes that are cut off, overwritten, repeated, or have others in between."""
    if not data:
        return rng.randbytes(10)
    start = rng.randrange(len(data))
    length = rng.choice([1, 2, 8, 64, len(data) // 2])
    return rng.choice(
        [
            lambda: data[:start],
            lambda: data[:start] + rng.randbytes(length) + data[start + length :],
            lambda: data[:start] + bytes(length) + data[start + length :],
            lambda: data[:start] + data[start : start + length] + data[start:],
            lambda: data[:start] + data[start + length :],
            lambda: b"",
            lambda: rng.randbytes(length),
            lambda: data + rng.randbytes(length),
        ]
    )()


def mutate_text(text: str, rng: random.Random) -> bytes:
    """A text with a changed line or cell, or changed bytes."""
    if rng.random() < 0.3:
        return mutate_bytes(text.encode(), rng)
    lines = text.splitlines()
    number = rng.randrange(len(lines))
    separator = ";" if ";" in lines[0] else "\t" if "\t" in lines[0] else ","
    cells = lines[number].split(separator)
    column = rng.randrange(len(cells))
    shown = rng.choice(VALUES)
    cells[column] = shown if isinstance(shown, str) else json.dumps(shown)
    lines[number] = separator.join(cells if rng.random() < 0.8 else cells[:column] + cells[column + 1 :])
    if rng.random() < 0.1:
        rng.shuffle(lines)
    return ("\n".join(lines) + "\n").encode("utf-8", "replace")


def mutate_json(path: Path, rng: random.Random) -> None:
    """Changes a JSON file: a value in it, or its bytes."""
    if rng.random() < 0.2:
        path.write_bytes(mutate_bytes(path.read_bytes(), rng))
    else:
        path.write_text(json.dumps(mutate_value(json.loads(path.read_text()), rng)))


def yaml_of(value: Any, rng: random.Random) -> str:
    """A value as YAML, at times with what only YAML has."""
    text = json.dumps(value, ensure_ascii=False)  # which YAML can read
    if rng.random() < 0.2 and isinstance(value, dict) and value:
        key = rng.choice(list(value))
        return f"{text[:-1]}, {json.dumps(str(key))}: {rng.choice(FOREIGN_YAML)}}}"
    return text


def mutate_hdf5(path: Path, rng: random.Random) -> None:
    """Changes one array of an HDF5 file to another kind, shape or content, or the file's bytes."""
    if rng.random() < 0.2:
        path.write_bytes(mutate_bytes(path.read_bytes(), rng))
        return
    with h5py.File(path, "a") as file:
        names: list[str] = []
        file.visit(names.append)
        arrays = [name for name in names if isinstance(file[name], h5py.Dataset)] or names
        name = rng.choice(arrays if rng.random() < 0.8 else names)
        old = file[name][()] if isinstance(file[name], h5py.Dataset) else np.zeros(3)
        attributes = dict(file[name].attrs)
        del file[name]
        rng.choice(_HDF5_CHANGES)(file, name, np.asarray(old), rng)
        if name in file and rng.random() < 0.7:
            for key, value in attributes.items():
                file[name].attrs[key] = value


def _other_array(old: np.ndarray, rng: random.Random) -> Any:
    number = np.asarray(rng.choice([float("nan"), float("inf"), 1e300, -1, 0]))
    changed = old.copy() if old.dtype.kind == "f" and old.size else np.zeros(3)
    changed.flat[rng.randrange(changed.size)] = number
    return rng.choice(
        [
            lambda: changed,
            lambda: old[: len(old) // 2] if old.ndim else old,
            lambda: old[:0] if old.ndim else old,
            lambda: old.T,
            lambda: old[None],
            lambda: old.reshape(-1),
            lambda: np.asarray(number),
            lambda: old.astype(complex) if old.dtype.kind in "fiub" else old,
            lambda: np.full(old.shape, b"x"),
            lambda: np.zeros(old.shape, dtype=[("a", "<f4"), ("b", "<f4")]),
            lambda: np.zeros(old.shape, dtype=bool),
            lambda: np.full(old.shape, 2**62, dtype=np.int64),
        ]
    )()


_HDF5_CHANGES: list[Callable[[h5py.File, str, np.ndarray, random.Random], object]] = [
    lambda file, name, old, rng: file.create_dataset(name, data=_other_array(old, rng)),
    lambda file, name, old, rng: file.create_dataset(name, data=_other_array(old, rng)),
    lambda file, name, old, rng: file.create_group(name),
    lambda file, name, old, rng: file.create_dataset(name, shape=(10**12, 2), dtype="f4", chunks=(1, 2)),
    lambda file, name, old, rng: file.create_dataset(name, shape=(10**9,), dtype="f8", chunks=(1024,)),
    lambda file, name, old, rng: file.create_dataset(name, data=[file.ref] * 3, dtype=h5py.ref_dtype),
    lambda file, name, old, rng: file.create_dataset(name, data=["x"] * 3, dtype=h5py.string_dtype()),
    lambda file, name, old, rng: file.__setitem__(name, h5py.SoftLink("/nowhere")),
    lambda file, name, old, rng: file.__setitem__(name, h5py.ExternalLink("/etc/hostname", "/x")),
    lambda file, name, old, rng: None,
]


def mutate_npz(path: Path, rng: random.Random) -> None:
    """Changes one array of an npz file, or the file's bytes."""
    if rng.random() < 0.3:
        path.write_bytes(mutate_bytes(path.read_bytes(), rng))
        return
    with np.load(path) as file:
        arrays = dict(file)
    name = rng.choice(list(arrays))
    if rng.random() < 0.2:
        arrays[name + "x"] = arrays.pop(name)
    else:
        arrays[name] = _other_array(arrays[name], rng)
    np.savez(path, **arrays)


def mutate_safetensors(path: Path, rng: random.Random) -> None:
    """Changes one tensor of a safetensors file, its header, or its bytes."""
    if rng.random() < 0.3:
        path.write_bytes(mutate_bytes(path.read_bytes(), rng))
        return
    if rng.random() < 0.3:
        data = path.read_bytes()
        size = int.from_bytes(data[:8], "little")
        header = json.dumps(mutate_value(json.loads(data[8 : 8 + size]), rng)).encode()
        path.write_bytes(len(header).to_bytes(8, "little") + header + data[8 + size :])
        return
    tensors = load_file(path)
    name = rng.choice(list(tensors))
    old = tensors[name]
    number = rng.choice([float("nan"), float("inf"), 1e30, -1e30, -1.0, 0.0])
    tensors[name] = rng.choice(
        [
            lambda: torch.full_like(old, number) if old.is_floating_point() else old * 0 - 1,
            lambda: old[: len(old) // 2] if old.ndim else old,
            lambda: old[:0] if old.ndim else old,
            lambda: old.unsqueeze(0),
            lambda: old.double() if old.is_floating_point() else old.float(),
            lambda: torch.tensor(number),
            lambda: torch.cat([old, old]) if old.ndim else old,
        ]
    )().contiguous()
    if rng.random() < 0.2:
        tensors[name + "x"] = tensors.pop(name)
    save_file(tensors, path)
