# SPDX-License-Identifier: Apache-2.0
"""Writes trajectories as a LeRobotDataset, with a progress bar and a count of the trajectories left out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from itertools import islice
from pathlib import Path

import numpy as np
from tqdm import tqdm

from lerobot_pf2mp.dataset_tools.writing.episodes import Trajectory, check_n_steps, prepare
from lerobot_pf2mp.dataset_tools.writing.lerobot_writer import DatasetSpec, write_dataset
from lerobot_pf2mp.dataset_tools.writing.video_writer import has_images, write_video_dataset


def write_trajectories(
    trajectories: Iterable[Trajectory],
    *,
    root: Path,
    spec: DatasetSpec,
    n_steps: int,
    collides: Callable[[np.ndarray], bool],
    n_episodes: int | None = None,
    n_expected: int | None = None,
    overwrite: bool = False,
) -> tuple[int, Counter[str]]:
    """Writes the usable trajectories as a LeRobotDataset.

    Args:
        trajectories: The trajectories.
        root: The dataset's folder.
        spec: The metadata of the dataset. Only the features that it names are written.
        n_steps: Steps T that each trajectory is resampled to.
        collides: Whether a ``(T + 1, D)`` trajectory touches an obstacle; such trajectories are left out.
        n_episodes: Largest number of episodes to write; None writes all.
        n_expected: Number of trajectories, for the progress bar, if it is known.
        overwrite: Whether an existing dataset is replaced.

    Returns:
        The number of episodes written, and the number of those left out, by reason.

    Raises:
        ValueError: If an argument breaks its rule or no trajectory is usable.
        FileExistsError: If `root` exists and `overwrite` is false.
    """
    check_n_steps(n_steps)
    dropped: Counter[str] = Counter()
    prepared = prepare(trajectories, n_steps, collides, dropped)
    n_written = write_episodes(
        prepared, root=root, spec=spec, n_episodes=n_episodes, n_expected=n_expected, overwrite=overwrite
    )
    return n_written, dropped


def write_episodes(
    recorded: Iterable[dict[str, np.ndarray]],
    *,
    root: Path,
    spec: DatasetSpec,
    n_episodes: int | None = None,
    n_expected: int | None = None,
    overwrite: bool = False,
) -> int:
    """Writes the frames of episodes as they are, with a progress bar, and returns the number of episodes written.

    Args:
        recorded: For each episode its frames ``(T, ...)`` by feature, at least those that `spec` names.
        root: The other arguments and the errors are those of `write_trajectories`.
        spec: As there.
        n_episodes: As there.
        n_expected: As there.
        overwrite: As there.
    """
    if n_episodes is not None and n_episodes < 1:
        raise ValueError(f"n_episodes must be at least 1, got {n_episodes}")
    named = islice(({key: frames[key] for key in spec.features} for frames in recorded), n_episodes)
    # Closed here, not by the garbage collector, so that an interrupted bar is not drawn again at the end.
    with closing(_with_progress(named, n_episodes or n_expected)) as episodes:
        write = write_video_dataset if has_images(spec) else write_dataset
        return write(root, spec, episodes, overwrite=overwrite)


def _with_progress(
    episodes: Iterable[dict[str, np.ndarray]], total: int | None
) -> Generator[dict[str, np.ndarray]]:
    """The episodes, while a bar shows how many there were. `total` is their number, if it is known."""
    yield from tqdm(episodes, total=total, desc="Writing", unit="episode", mininterval=1.0)
