# SPDX-License-Identifier: Apache-2.0
"""LeRobot's statistics of numeric features, for many episodes in one call."""

from __future__ import annotations

import numpy as np
from lerobot.datasets.compute_stats import DEFAULT_QUANTILES

_N_BINS = 5000  # bins of the histogram from which LeRobot computes its quantiles
_EDGE_PADDING = 1e-10


def compute_stats(values: np.ndarray, lengths: np.ndarray) -> dict[str, np.ndarray]:
    """The statistics of one feature in each of E episodes, equal to those of LeRobot's ``compute_episode_stats``.

    Except for a dimension that is constant in an episode: its standard deviation is 0 and its mean is its value. LeRobot's
    variance, the mean of the squares minus the square of the mean, is a rounding error of float32 there, which makes up to
    0.02 of the standard deviation of 1000 frames near 4.8.

    LeRobot's function builds a histogram of 5000 bins for each dimension of each episode. This one computes only the few
    entries of the histogram on which the quantiles depend, with the same rounding, for all episodes of one length together.

    Args:
        values: ``(N, D)`` the frames of all episodes, one after the other; finite.
        lengths: ``(E,)`` numbers of frames, at least 1 each, N in total.

    Returns:
        ``min``, ``max``, ``mean``, ``std`` and quantiles ``q01`` to ``q99`` ``(E, D)``, in the unit of the values, and
        ``count`` ``(E, 1)`` [frames].
    """
    values = values.astype(np.result_type(values.dtype, np.float32), copy=False)
    starts = np.cumsum(lengths) - lengths
    stats: dict[str, np.ndarray] = {}
    for n_frames in np.unique(lengths):
        chosen = np.flatnonzero(lengths == n_frames)
        frames = values[starts[chosen, None] + np.arange(n_frames)]  # (chosen, T, D)
        for name, value in _stats_of_equally_long(frames).items():
            shape = len(lengths), value.shape[1]
            stats.setdefault(name, np.empty(shape, value.dtype))[chosen] = value
    return stats


def aggregate_episodes(stats: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The statistics of one feature over all episodes, equal to those of LeRobot's ``aggregate_feature_stats``.

    Quantiles are the mean of the episodes' quantiles, as in LeRobot. A dimension that is constant in all episodes has its
    value as mean, and 0 as standard deviation.

    Args:
        stats: The result of `compute_stats`.

    Returns:
        The same entries, ``(D,)`` each and ``count`` ``(1,)``.
    """
    count = stats["count"]

    def weighted_mean(values: np.ndarray) -> np.ndarray:
        return (values * count).sum(axis=0) / count.sum()

    mean = weighted_mean(stats["mean"])
    return with_exact_constants(
        {
            **{name: weighted_mean(values) for name, values in stats.items() if name.startswith("q")},
            "min": stats["min"].min(axis=0),
            "max": stats["max"].max(axis=0),
            "mean": mean,
            "std": np.sqrt(weighted_mean(stats["std"] ** 2 + (stats["mean"] - mean) ** 2)),
            "count": count.sum(axis=0),
        }
    )


def with_exact_constants(stats: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """LeRobot's statistics ``(D,)`` of one feature, with the mean and the standard deviation that a constant has."""
    is_constant = stats["min"] == stats["max"]
    return {
        **stats,
        "mean": np.where(is_constant, stats["min"], stats["mean"]),
        "std": np.where(is_constant, 0.0, stats["std"]),
    }


def _stats_of_equally_long(frames: np.ndarray) -> dict[str, np.ndarray]:
    """The statistics of ``(E, T, D)`` frames."""
    n_episodes, n_frames, _ = frames.shape
    low, high, mean = frames.min(axis=1), frames.max(axis=1), frames.mean(axis=1)
    variance = (frames**2).mean(axis=1) - mean**2
    is_constant = low == high
    mean = np.where(is_constant, low, mean)
    stats = {
        "min": low,
        "max": high,
        "mean": mean,
        "std": np.sqrt(np.where(is_constant, 0, np.maximum(variance, 0))),
        "count": np.full((n_episodes, 1), n_frames),
    }
    names = [f"q{int(share * 100):02d}" for share in DEFAULT_QUANTILES]
    if n_frames == 1:  # without a histogram
        return stats | {name: mean.astype(np.float64) for name in names}
    quantiles = _quantiles(frames, low - _EDGE_PADDING, high + _EDGE_PADDING)
    return stats | {name: quantiles[:, i] for i, name in enumerate(names)}


def _quantiles(frames: np.ndarray, first_edge: np.ndarray, last_edge: np.ndarray) -> np.ndarray:
    """The quantiles (E, Q, D) of (E, T, D) frames, interpolated in a histogram between two edges (E, D)."""
    n_frames = frames.shape[1]
    targets = np.array(DEFAULT_QUANTILES) * n_frames
    # The bin in which the cumulative count reaches the target holds the value of that rank.
    reaching = np.sort(frames, axis=1)[:, np.ceil(targets).astype(int) - 1]  # (E, Q, D)
    first_edge, last_edge = first_edge[:, None], last_edge[:, None]  # (E, 1, D)
    width = (last_edge - first_edge) / _N_BINS

    def edge(number: np.ndarray) -> np.ndarray:
        return np.where(number == _N_BINS, last_edge, number.astype(frames.dtype) * width + first_edge)

    bins = np.zeros(reaching.shape, int)
    for stride in 2 ** np.arange(int(np.log2(_N_BINS)), -1, -1):  # bisection
        further = bins + stride
        bins = np.where((further < _N_BINS) & (edge(further) <= reaching), further, bins)

    def count_below(bound: np.ndarray) -> np.ndarray:
        return (frames[:, :, None] < bound[:, None]).sum(axis=1)  # (E, Q, D)

    left, right = edge(bins), edge(bins + 1)
    before = count_below(left)
    within = np.where(bins == _N_BINS - 1, n_frames, count_below(right)) - before  # the last bin is closed
    share = (targets[:, None] - before) / within
    return np.where(bins == 0, left, left + share * (right - left))
