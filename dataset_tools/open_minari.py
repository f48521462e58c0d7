# SPDX-License-Identifier: Apache-2.0
"""Opens Minari datasets (https://minari.farama.org) in a local folder."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from minari import MinariDataset


def open_minari(path: Path) -> MinariDataset:
    """Opens the Minari dataset in a folder.

    Args:
        path: The dataset's folder, for example ``~/.minari/datasets/D4RL/pointmaze/large-v2``, or the folder ``data`` in it.

    Raises:
        FileNotFoundError: If there is no such folder.
        ValueError: If it does not hold a Minari dataset.
    """
    import minari

    data = Path(path).expanduser()
    data = data / "data" if (data / "data").is_dir() else data
    if not data.is_dir():
        raise FileNotFoundError(
            f"source.path must be the folder of a Minari dataset, got {path}, which does not exist"
        )
    try:
        return minari.MinariDataset(data)
    except Exception as error:  # the storage formats raise a dozen types
        raise ValueError(
            f"{path} must hold a Minari dataset, got one that cannot be read: {error}"
        ) from error
