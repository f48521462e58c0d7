# SPDX-License-Identifier: Apache-2.0
"""A LeRobotDataset in memory. It returns the same samples, many times faster."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from lerobot.datasets.feature_utils import get_delta_indices
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor
from torch.utils.data._utils.collate import default_collate_fn_map
from tqdm import tqdm


class _Sample(dict[str, Any]):
    """A sample. PyTorch's default collation recognises a `SampleBatch` by this type."""


class SampleBatch(Sequence[dict[str, Any]]):
    """The samples of a batch. The batch is split into samples only when they are needed.

    A DataLoader asks for a batch and stacks its samples again, which takes several times longer than reading them. With
    its default collation it gets the batch unchanged.

    Args:
        tensors: Tensors ``(B, ...)`` by key.
        tasks: The task of each sample.
    """

    def __init__(self, tensors: dict[str, Tensor], tasks: list[str]) -> None:
        self._tensors = tensors
        self._tasks = tasks

    def __len__(self) -> int:
        return len(self._tasks)

    def __getitem__(self, number: Any) -> Any:
        """A sample; for a slice, a list of them."""
        if isinstance(number, slice):
            return [self[i] for i in range(*number.indices(len(self)))]
        sample = _Sample({key: value[number] for key, value in self._tensors.items()})
        sample["task"] = self._tasks[number]
        return sample

    def collated(self) -> dict[str, Any]:
        """The collated samples, as from PyTorch's default collation: tensors ``(B, ...)``, and the list of tasks."""
        return {**self._tensors, "task": self._tasks}


def _collate(samples: Sequence[dict[str, Any]], **kwargs: Any) -> dict[str, Any]:
    if isinstance(samples, SampleBatch):
        return samples.collated()
    return torch.utils.data.default_collate([dict(sample) for sample in samples])


# PyTorch's registry for the collation of further types.
default_collate_fn_map[_Sample] = _collate


class InMemoryDataset(torch.utils.data.Dataset):
    """Serves the samples of a LeRobotDataset from tensors in memory.

    All other attributes are those of the wrapped dataset.

    Args:
        dataset: A dataset with numeric features and videos. Videos are decoded once, here, with a progress bar.

    Raises:
        ValueError: If the dataset cannot be held in memory, see `fits_in_memory`.
    """

    def __init__(self, dataset: LeRobotDataset) -> None:
        if not _can_be_held(dataset):
            raise ValueError(
                f"an in-memory dataset must have numeric features and videos without image transforms, got "
                f"{dataset.meta.features}"
            )
        self._dataset = dataset
        table = dataset.hf_dataset.with_format("arrow")[:]
        features = dataset.meta.features
        self._columns = {
            key: _to_tensor(table.column(key), features[key]["shape"]) for key in table.column_names
        }
        self._columns |= _decoded_videos(dataset, self._columns["episode_index"], self._columns["timestamp"])
        self._tasks = list(dataset.meta.tasks.index)
        self._task_of_row = self._columns["task_index"].tolist()
        windows = get_delta_indices(dataset.delta_timestamps or {}, dataset.meta.fps)
        self._windows = {key: torch.tensor(deltas) for key, deltas in windows.items()}
        # Rows count from 0 also when episodes are selected; episodes stay contiguous.
        episodes = self._columns["episode_index"]
        first = torch.ones_like(episodes, dtype=torch.bool)
        first[1:] = episodes[1:] != episodes[:-1]
        starts = torch.cat([first.nonzero().flatten(), torch.tensor([len(episodes)])])
        episode_number = first.cumsum(0) - 1
        self._episode_start = starts[episode_number]  # (N,)
        self._episode_end = starts[episode_number + 1]  # (N,)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "_dataset":
            raise AttributeError(name)
        return getattr(self._dataset, name)

    def __len__(self) -> int:
        return len(self._episode_start)

    def __getitem__(self, row: int) -> dict[str, Any]:
        """The sample that the wrapped dataset returns for this row."""
        return self.__getitems__([int(row)])[0]

    def __getitems__(self, rows: list[int]) -> SampleBatch:
        """The samples of several rows. A DataLoader gets whole batches from this method."""
        index = torch.as_tensor(rows)
        index = torch.where(index < 0, index + len(self), index)
        batch = {key: column[index] for key, column in self._columns.items() if key not in self._windows}
        first, last = self._episode_start[index, None], self._episode_end[index, None] - 1
        for key, deltas in self._windows.items():
            wanted = index[:, None] + deltas  # (B, T)
            found = torch.maximum(torch.minimum(wanted, last), first)
            batch[f"{key}_is_pad"] = found != wanted
            # index_select takes half the time of indexing with a (B, T) tensor.
            values = self._columns[key].index_select(0, found.flatten())
            batch[key] = values.unflatten(0, found.shape)
            if key in self._dataset.meta.video_keys and len(deltas) == 1:
                batch[key] = batch[key].squeeze(1)  # as LeRobot's reader does for videos
        return SampleBatch(batch, [self._tasks[self._task_of_row[row]] for row in index.tolist()])


def fits_in_memory(dataset: Any, limit_bytes: float) -> bool:
    """Whether a dataset can be served by `InMemoryDataset`: numeric features and videos, within a limit.

    Args:
        dataset: A map-style LeRobotDataset. Anything else does not fit.
        limit_bytes: Largest memory that its frames may take [bytes].
    """
    if not isinstance(dataset, LeRobotDataset) or not _can_be_held(dataset):
        return False
    videos = dataset.meta.video_keys
    sizes = {key: int(np.prod(feature["shape"])) for key, feature in dataset.meta.features.items()}
    bytes_a_value = 1 if dataset._return_uint8 else 4
    n_bytes = sum(size * (bytes_a_value if key in videos else 8) for key, size in sizes.items())
    return dataset.num_frames * n_bytes <= limit_bytes


def _can_be_held(dataset: LeRobotDataset) -> bool:
    """Whether every feature is numeric or a video of colours, and samples are always the same."""
    meta = dataset.meta
    if (
        dataset.image_transforms is not None
        or set(meta.camera_keys) != set(meta.video_keys)
        or meta.depth_keys
    ):
        return False
    return all(
        feature["dtype"].startswith(("float", "int", "bool", "uint"))
        for key, feature in meta.features.items()
        if key not in meta.video_keys
    )


def _decoded_videos(dataset: LeRobotDataset, episodes: Tensor, timestamps: Tensor) -> dict[str, Tensor]:
    """All frames ``(N, C, H, W)`` of each video, decoded by LeRobot's reader.

    Args:
        dataset: The dataset.
        episodes: ``(N,)`` the episode of each frame, in the order of the dataset.
        timestamps: ``(N,)`` the time of each frame in its episode [s].
    """
    keys = dataset.meta.video_keys
    if not keys:
        return {}
    frames: dict[str, Tensor] = {}
    numbers = episodes.unique_consecutive().tolist()
    for number in tqdm(numbers, desc="Decoding videos", unit="episode", mininterval=1.0):
        rows = (episodes == number).nonzero().flatten()
        times = timestamps[rows].tolist()
        decoded = dataset.reader._query_videos(dict.fromkeys(keys, times), number)
        for key, images in decoded.items():
            images = images.reshape(
                len(rows), *images.shape[-3:]
            )  # the reader drops the axis of a single frame
            if key not in frames:
                frames[key] = images.new_empty((len(episodes), *images.shape[1:]))
            frames[key][rows] = images
    return frames


def _to_tensor(column: Any, feature_shape: tuple[int, ...]) -> Tensor:
    """A column of an Arrow table as a tensor ``(N, *feature_shape)``, with the type that LeRobot's reader returns."""
    values = column.combine_chunks()
    n_rows = len(values)
    if isinstance(values.type, pa.ExtensionType):
        values = values.storage
    while pa.types.is_nested(values.type):
        values = values.flatten()
    array = torch.from_numpy(values.to_numpy(zero_copy_only=False).copy())
    if tuple(feature_shape) != (1,):  # LeRobot stores vectors of length one as numbers
        array = array.reshape(n_rows, *feature_shape)
    # LeRobot converts through Python numbers, so its tensors have the default precision.
    if array.dtype == torch.bool:
        return array
    return array.float() if array.is_floating_point() else array.long()
