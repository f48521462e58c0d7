# SPDX-License-Identifier: Apache-2.0
"""Writes episodes with images as a LeRobotDataset v3, with LeRobot's own recorder."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.io_utils import write_stats

from lerobot_pf2mp.dataset_tools.writing.episode_stats import with_exact_constants
from lerobot_pf2mp.dataset_tools.writing.lerobot_writer import DatasetSpec
from lerobot_pf2mp.process.atomic_files import written_beside


def has_images(spec: DatasetSpec) -> bool:
    """Whether a dataset holds images."""
    return any(feature["dtype"] == "video" for feature in spec.features.values())


def write_video_dataset(
    root: Path, spec: DatasetSpec, episodes: Iterable[dict[str, np.ndarray]], overwrite: bool = False
) -> int:
    """Writes episodes with images; the arguments, the result and the errors are those of `write_dataset`.

    Statistics are those of LeRobot, except for what is constant in all episodes, which is exact as in `write_dataset`.
    Features of dtype ``video`` take ``(T, H, W, 3)`` uint8 images.
    """
    with written_beside(root, overwrite, kind="dataset", mark="meta/info.json", option="--root") as partial:
        dataset = LeRobotDataset.create(
            spec.repo_id,
            spec.fps,
            spec.features,
            robot_type=spec.robot_type,
            root=partial,
            streaming_encoding=True,
        )
        n_written = 0
        try:
            for episode in episodes:
                for frame in range(len(next(iter(episode.values())))):
                    values = {key: value[frame] for key, value in episode.items()}
                    dataset.add_frame({**values, "task": spec.task})
                dataset.save_episode()
                n_written += 1
            if not n_written:
                raise ValueError("a dataset must hold at least one episode, got none that is usable")
        except BaseException:
            # Otherwise the encoder continues to write into the folder after its removal.
            dataset.clear_episode_buffer()
            raise
        finally:
            dataset.finalize()
        write_stats({key: with_exact_constants(stats) for key, stats in dataset.meta.stats.items()}, partial)
        (partial / "README.md").write_text(spec.card, encoding="utf-8")
    return n_written
