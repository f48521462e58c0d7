# SPDX-License-Identifier: Apache-2.0
"""Publishes a dataset on the Hugging Face Hub."""

from __future__ import annotations

from pathlib import Path

from huggingface_hub import DatasetCard
from lerobot.datasets.dataset_metadata import CODEBASE_VERSION

from lerobot_pf2mp.hub.publishing import publish

_FOLDERS = ("data", "meta", "videos")
_FRAMES = [{"config_name": "default", "data_files": "data/*/*.parquet"}]


def publish_dataset(root: Path, repo_id: str, *, private: bool | None = None) -> str:
    """Publishes a LeRobotDataset with its card, in one commit with the tag that LeRobot looks up.

    Frames and videos of an earlier state of the repository are removed, because LeRobot would read them too.

    Args:
        root: The dataset's folder.
        repo_id: The repository, ``user/name``.
        private: Whether a new repository is private; None for the Hub's default.

    Returns:
        The repository's address.

    Raises:
        OSError: If the Hub cannot be reached or refuses; the dataset in `root` stays as it is.
        ValueError: If the repository is to be private and is public already.
    """
    files: dict[str, Path | bytes] = {
        path.relative_to(root).as_posix(): path
        for folder in _FOLDERS
        for path in sorted((root / folder).rglob("*"))
        if path.is_file()
    }
    card = DatasetCard((root / "README.md").read_text(encoding="utf-8"))
    card.data["configs"] = _FRAMES  # the files that the Hub shows as a table
    files["README.md"] = str(card).encode()
    return publish(
        repo_id,
        "dataset",
        files,
        message="Upload dataset",
        private=private,
        tag=CODEBASE_VERSION,
        owned_folders=_FOLDERS,
    )
