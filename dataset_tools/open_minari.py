# SPDX-License-Identifier: Apache-2.0
"""Opens Minari datasets (https://minari.farama.org) in a local folder."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import h5py

from lerobot_pf2mp.dataset_tools.array_size import check_size
from lerobot_pf2mp.dataset_tools.hdf5_file import array_in, holds, opened_hdf5
from lerobot_pf2mp.errors import explained

if TYPE_CHECKING:
    from minari import MinariDataset
    from minari.dataset.episode_data import EpisodeData

_HDF5 = "main_data.hdf5"
_SPACES = ("observation_space", "action_space")


def open_minari(path: Path) -> MinariDataset:
    """Opens the Minari dataset in a folder.

    Args:
        path: The dataset's folder, for example ``~/.minari/datasets/D4RL/pointmaze/large-v2``, or the folder ``data`` in it.

    Raises:
        FileNotFoundError: If there is no such folder.
        ValueError: If it does not hold a whole Minari dataset, or one with something else in the place of its arrays.
    """
    import minari

    data = _data_folder(path)
    if not data.is_dir():
        raise FileNotFoundError(
            f"source.path must be the folder of a Minari dataset, got {path}, which does not exist"
        )
    try:
        _check_complete(data)
        dataset = minari.MinariDataset(data)
    except Exception as error:  # the storage formats raise a dozen types
        raise ValueError(
            f"{path} must hold a Minari dataset, got one that cannot be read: {str(error) or type(error).__name__}"
        ) from error
    if (data / _HDF5).is_file():
        with opened_hdf5(data / _HDF5) as file:
            for number in dataset.episode_indices:
                _check_episode(file[f"episode_{number}"], dataset, path)
    return dataset


def episodes_in(dataset: MinariDataset, path: Path) -> Iterator[EpisodeData]:
    """The episodes of a Minari dataset from `open_minari`.

    Raises:
        OSError, ValueError: If one cannot be read.
    """
    episodes = iter(dataset.iterate_episodes())
    for _ in range(dataset.total_episodes):
        with explained(f"the episodes of {path} cannot be read"):
            episode = next(episodes)
        yield episode


def env_spec_of(path: Path) -> dict[str, Any]:
    """The specification of the environment in which a Minari dataset was recorded; empty if it holds none."""
    try:
        spec = json.loads(_metadata(_data_folder(path))["env_spec"])
    except (OSError, KeyError, ValueError, TypeError, RecursionError):  # `open_minari` tells what is wrong
        return {}
    return spec if isinstance(spec, dict) else {}


def _data_folder(path: Path) -> Path:
    folder = Path(path).expanduser()
    return folder / "data" if (folder / "data").is_dir() else folder


def _metadata(data: Path) -> dict[str, Any]:
    if not (data / "metadata.json").is_file() and (data / _HDF5).is_file():
        raise ValueError("it holds no metadata.json: Minari before 0.5 wrote it, or its copy is incomplete")
    content = json.loads((data / "metadata.json").read_text(encoding="utf-8"))
    if not isinstance(content, dict):
        raise ValueError("its metadata.json holds no table")
    return content


def _check_complete(data: Path) -> None:
    """Checks that the files hold what the metadata promise, before anything is made of the promises."""
    metadata = _metadata(data)
    missing = [name for name in _SPACES if name not in metadata]
    if missing:  # Minari would make the environment, that is, run what the file names
        raise ValueError(f"its metadata.json holds no {missing[0]}")
    n_promised, found = metadata.get("total_episodes"), _episode_names(data)
    if not isinstance(n_promised, int) or n_promised < 1:
        raise ValueError(f"its metadata.json must promise at least one episode, got {n_promised}")
    for number in range(n_promised):  # ends at the first that is missing
        if number not in found:
            raise ValueError(
                f"its metadata.json promises {n_promised} episodes, got {len(found)}, without episode_{number}: its copy is "
                "incomplete"
            )


def _episode_names(data: Path) -> set[int]:
    """The numbers of the episodes that are there."""
    if not (data / _HDF5).is_file():  # as Arrow files, in a folder for each
        return {int(folder.name) for folder in data.iterdir() if folder.name.isdecimal()}
    with opened_hdf5(data / _HDF5) as file:
        names = [name.removeprefix("episode_") for name in file if isinstance(file.get(name), h5py.Group)]
    return {int(name) for name in names if name.isdecimal()}


def _check_episode(episode: h5py.Group, dataset: MinariDataset, path: Path) -> None:
    _check_space(episode, "observations", dataset.observation_space, path)
    _check_space(episode, "actions", dataset.action_space, path)
    for column in ("rewards", "terminations", "truncations"):
        array_in(episode, column, path)
    if holds(episode, "infos"):
        _check_sizes(episode, "infos", path)


def _check_space(group: h5py.Group, name: str, space: gym.Space, path: Path) -> None:
    """Checks what is stored of the elements of a space before it is read."""
    if isinstance(space, gym.spaces.Dict | gym.spaces.Tuple):
        parts = space.items() if isinstance(space, gym.spaces.Dict) else enumerate(space)
        if not isinstance(group.get(name), h5py.Group):
            raise ValueError(
                f"{group.name[1:]}/{name} must be a group of arrays, got something else in {path}"
            )
        for key, part in parts:
            _check_space(group[name], key if isinstance(key, str) else f"_index_{key}", part, path)
    elif isinstance(space, gym.spaces.Text) or (isinstance(space, gym.spaces.Box) and len(space.shape) == 3):
        _check_sizes(group, name, path)  # images, which may be compressed, and texts are no arrays of numbers
    else:
        array_in(group, name, path)


def _check_sizes(group: h5py.Group, name: str, path: Path) -> None:
    def check(inner: str, entry: object) -> None:
        if isinstance(entry, h5py.Dataset):
            check_size(
                f"{name}/{inner}".rstrip("/"), entry.shape, entry.nbytes, entry.id.get_storage_size(), path
            )

    entry = group.get(name)
    check("", entry)
    if isinstance(entry, h5py.Group):
        entry.visititems(check)
