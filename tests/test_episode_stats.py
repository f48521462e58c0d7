# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from lerobot.datasets.compute_stats import aggregate_stats, compute_episode_stats

from lerobot_pf2mp.dataset_tools.writing.episode_stats import aggregate_episodes, compute_stats

LENGTHS = np.array([80, 1, 2, 80, 3, 1, 300, 5, 64, 100, 129, 2])
KINDS = {
    "noise": lambda rng, shape: rng.normal(size=shape),
    "a way far from the origin": lambda rng, shape: rng.normal(size=shape).cumsum(axis=0) + 1e4,
    "a few values a rounding error apart": lambda rng, shape: 1 + 1e-7 * rng.integers(0, 3, size=shape),
    "values closer than the histogram's padding": lambda rng, shape: 1e-11 * rng.normal(size=shape),
    "whole numbers": lambda rng, shape: rng.integers(-3, 4, size=shape),
}


def of_lerobot(episode: np.ndarray) -> dict[str, np.ndarray]:
    """LeRobot's statistics of ``(T, D)`` frames; its recorder hands vectors of length one over as numbers."""
    frames = episode[:, 0] if episode.shape[1] == 1 else episode
    return compute_episode_stats({"x": frames}, {"x": {"dtype": str(frames.dtype)}})["x"]


def make_episodes(kind: str, dim: int, dtype: type) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [KINDS[kind](rng, (length, dim)).astype(dtype) for length in LENGTHS]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dim", [1, 2, 7, 16])
@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int64])
def test_the_statistics_of_each_episode_are_those_of_lerobot_to_the_last_bit(
    kind: str, dim: int, dtype: type
) -> None:
    episodes = make_episodes(kind, dim, dtype)
    stats = compute_stats(np.concatenate(episodes), LENGTHS)
    for number, episode in enumerate(episodes):
        expected = of_lerobot(episode)
        assert stats.keys() == expected.keys()
        for name, value in expected.items():
            np.testing.assert_array_equal(stats[name][number], value, err_msg=f"{name} of {number}")


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("value", [0.007, -2.3932, 4.1, 1e4])
def test_a_constant_has_its_value_as_mean_and_no_standard_deviation(value: float, dtype: type) -> None:
    # LeRobot's own standard deviation is a rounding error there.
    rng = np.random.default_rng(0)
    frames = np.column_stack([np.full(LENGTHS.sum(), value), rng.normal(size=LENGTHS.sum())]).astype(dtype)
    stats = compute_stats(frames, LENGTHS)
    for each in (stats, aggregate_episodes(stats)):
        assert (each["std"][..., 0] == 0).all()
        for name in ("mean", "min", "max"):
            assert (each[name][..., 0] == dtype(value)).all()
        np.testing.assert_allclose(each["q50"][..., 0], dtype(value), rtol=1e-6)
    for number, part in enumerate(np.split(frames, np.cumsum(LENGTHS)[:-1])):
        expected = of_lerobot(part)
        for name in expected:
            np.testing.assert_array_equal(stats[name][number][-1], expected[name][-1], err_msg=name)


@pytest.mark.parametrize("kind", KINDS)
def test_the_statistics_of_all_episodes_are_those_of_lerobot(kind: str) -> None:
    episodes = make_episodes(kind, 3, np.float32)
    aggregated = aggregate_episodes(compute_stats(np.concatenate(episodes), LENGTHS))
    expected = aggregate_stats([{"x": of_lerobot(episode)} for episode in episodes])["x"]
    assert aggregated.keys() == expected.keys()
    for name, value in expected.items():
        assert aggregated[name].shape == value.shape, name
        np.testing.assert_allclose(aggregated[name], value, rtol=1e-13, err_msg=name)


def test_the_order_and_the_company_of_episodes_do_not_change_their_statistics() -> None:
    episodes = make_episodes("noise", 2, np.float32)
    order = np.random.default_rng(1).permutation(len(episodes))
    stats = compute_stats(np.concatenate(episodes), LENGTHS)
    shuffled = compute_stats(np.concatenate([episodes[i] for i in order]), LENGTHS[order])
    for name in stats:
        np.testing.assert_array_equal(shuffled[name], stats[name][order], err_msg=name)
