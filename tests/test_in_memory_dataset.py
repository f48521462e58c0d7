# SPDX-License-Identifier: Apache-2.0
import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.sampler import EpisodeAwareSampler

from lerobot_pf2mp.dataset_tools.writing.lerobot_writer import DatasetSpec, image_feature, write_dataset
from lerobot_pf2mp.dataset_tools.writing.video_writer import write_video_dataset
from lerobot_pf2mp.training.in_memory_dataset import InMemoryDataset, fits_in_memory

FPS = 10
LENGTHS = [7, 1, 12, 5]
DTYPES = ["float32", "float64", "int64", "bool"]
OTHER_DTYPES = ["float16", "int8", "int16", "int32", "uint8", "uint16"]
FEATURES: dict[str, dict[str, Any]] = {
    "observation.state": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
    "observation.environment_state": {"dtype": "float32", "shape": (3,), "names": None},
    "action": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
    "gripper": {"dtype": "float32", "shape": (1,), "names": None},
    **{f"vector.{dtype}": {"dtype": dtype, "shape": (2,), "names": None} for dtype in DTYPES},
    **{f"number.{dtype}": {"dtype": dtype, "shape": (1,), "names": None} for dtype in DTYPES},
}
VIDEO_FEATURES = {"observation.images.front": image_feature((64, 80))}
WINDOWS = {
    "no_window": None,
    "actions": {"action": [i / FPS for i in range(8)]},
    "observations_and_actions": {
        "observation.state": [-0.2, -0.1, 0.0],
        "observation.environment_state": [-0.1, 0.0],
        "action": [i / FPS for i in range(-2, 6)],
    },
    "everything": {key: [-1.5, -0.3, 0.0, 0.4, 2.0] for key in FEATURES},
}
EPISODES = [None, [0, 2], [1, 3], [2]]


def random_values(rng: np.random.Generator, dtype: str, shape: tuple[int, ...]) -> np.ndarray:
    if dtype == "bool":
        return rng.random(shape) < 0.5
    if dtype.startswith("float"):
        return rng.standard_normal(shape).astype(dtype)
    return rng.integers(0, 200, shape).astype(dtype)


def write(folder: Path, features: dict[str, dict[str, Any]]) -> Path:
    rng = np.random.default_rng(0)
    episodes = [
        {key: random_values(rng, f["dtype"], (length, *f["shape"])) for key, f in features.items()}
        for length in LENGTHS
    ]
    write_dataset(folder, DatasetSpec("test/tiny", FPS, features, "Do it.", "A card."), episodes)
    return folder


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("datasets") / "tiny", FEATURES)


def stock(root: Path, windows: str = "no_window", episodes: list[int] | None = None) -> LeRobotDataset:
    return LeRobotDataset("test/tiny", root=root, delta_timestamps=WINDOWS[windows], episodes=episodes)


def assert_same(actual: dict[str, Any], expected: dict[str, Any]) -> None:
    assert set(actual) == set(expected)
    for key, value in expected.items():
        if isinstance(value, torch.Tensor):
            assert (actual[key].dtype, actual[key].shape) == (value.dtype, value.shape), key
            assert torch.equal(actual[key], value), key
        else:
            assert actual[key] == value, key


@pytest.mark.slow
@pytest.mark.parametrize("episodes", EPISODES, ids=str)
@pytest.mark.parametrize("windows", WINDOWS)
def test_every_sample_equals_that_of_lerobots_dataset(root, windows, episodes):
    dataset = stock(root, windows, episodes)
    in_memory = InMemoryDataset(dataset)
    assert len(in_memory) == len(dataset) == sum(LENGTHS[i] for i in episodes or range(4))
    for row in range(len(dataset)):
        assert_same(in_memory[row], dataset[row])


@pytest.mark.parametrize("dtype", OTHER_DTYPES)
def test_rarer_numbers_arrive_in_the_type_that_lerobots_dataset_gives_them(tmp_path, dtype):
    features = {
        "vector": {"dtype": dtype, "shape": (2,), "names": None},
        "number": {"dtype": dtype, "shape": (1,), "names": None},
    }
    windows = {"vector": [-0.1, 0.0, 0.1]}
    dataset = LeRobotDataset("test/tiny", write(tmp_path / "tiny", features), delta_timestamps=windows)
    assert_same(InMemoryDataset(dataset)[3], dataset[3])


@pytest.mark.parametrize("shape", [(2, 3), (2, 3, 4)])
def test_matrices_equal_those_of_lerobots_dataset(tmp_path, shape):
    features = {"matrix": {"dtype": "float32", "shape": shape, "names": None}}
    recorder = LeRobotDataset.create("test/tiny", FPS, features, root=tmp_path / "tiny", use_videos=False)
    for _ in range(4):
        recorder.add_frame({"matrix": torch.randn(shape).numpy(), "task": "Do it."})
    recorder.save_episode()
    recorder.finalize()
    dataset = LeRobotDataset("test/tiny", tmp_path / "tiny", delta_timestamps={"matrix": [-0.1, 0.0, 0.1]})
    assert fits_in_memory(dataset, 1e9)
    assert_same(InMemoryDataset(dataset)[0], dataset[0])


@pytest.fixture(scope="module")
def video_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rng = np.random.default_rng(0)
    features = {**VIDEO_FEATURES, "action": FEATURES["action"]}
    episodes = [
        {
            "observation.images.front": rng.integers(0, 255, (length, 64, 80, 3), dtype=np.uint8),
            "action": random_values(rng, "float32", (length, 2)),
        }
        for length in (5, 3, 4)
    ]
    folder = tmp_path_factory.mktemp("datasets") / "video"
    write_video_dataset(folder, DatasetSpec("test/video", FPS, features, "Do it.", "A card."), episodes)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("return_uint8", [True, False], ids=["uint8", "float"])
@pytest.mark.parametrize("episodes", [None, [0, 2]], ids=str)
@pytest.mark.parametrize("images", [None, [0.0], [-0.1, 0.0]], ids=str)
def test_every_image_equals_that_of_lerobots_dataset(video_root, images, episodes, return_uint8):
    windows = {"action": [0.0, 0.1, 0.2]} | ({} if images is None else {"observation.images.front": images})
    dataset = LeRobotDataset(
        "test/video", video_root, delta_timestamps=windows, episodes=episodes, return_uint8=return_uint8
    )
    in_memory = InMemoryDataset(dataset)
    for row in range(len(dataset)):
        assert_same(in_memory[row], dataset[row])


@pytest.mark.slow
def test_a_video_counts_with_its_decoded_size_and_not_at_all_if_it_is_augmented(video_root):
    dataset = LeRobotDataset("test/video", video_root, return_uint8=True)
    decoded = len(dataset) * 64 * 80 * 3
    assert fits_in_memory(dataset, 2 * decoded)
    assert not fits_in_memory(dataset, decoded)
    dataset.set_image_transforms(lambda image: image)
    assert not fits_in_memory(dataset, 1e9)
    with pytest.raises(ValueError, match="without image transforms"):
        InMemoryDataset(dataset)


def test_windows_reach_beyond_the_episode_on_both_sides_and_say_so(root):
    in_memory = InMemoryDataset(stock(root, "observations_and_actions"))
    first, only = in_memory[0], in_memory[7]
    assert first["observation.state_is_pad"].tolist() == [True, True, False]
    assert first["action_is_pad"].tolist() == [True, True] + [False] * 6
    assert only["action_is_pad"].tolist() == [True, True, False] + [True] * 5
    assert (only["action"] == only["action"][2]).all()


def test_a_batch_of_rows_equals_the_rows_one_by_one(root):
    in_memory = InMemoryDataset(stock(root, "everything"))
    rows = [3, 24, 3, 0, 7, 11]
    for sample, row in zip(in_memory.__getitems__(rows), rows, strict=True):
        assert_same(sample, in_memory[row])


@pytest.mark.parametrize(
    "cut", [lambda batch: batch, lambda batch: batch[1:4], list], ids=["all", "slice", "list"]
)
def test_a_batch_is_collated_as_its_samples_are(root, cut):
    batch = cut(InMemoryDataset(stock(root, "everything")).__getitems__([3, 24, 3, 0, -1, 11]))
    plain = [dict(sample) for sample in batch]
    collated = torch.utils.data.default_collate(batch)
    assert type(collated) is dict
    assert len(collated["task"]) == len(plain)
    assert_same(collated, torch.utils.data.default_collate(plain))


def test_rows_may_be_numbers_of_other_types(root):
    in_memory = InMemoryDataset(stock(root, "actions"))
    for row in (np.int64(5), torch.tensor(5)):
        assert_same(in_memory[row], in_memory[5])


def test_a_row_that_does_not_exist_is_an_error(root):
    in_memory = InMemoryDataset(stock(root, "actions"))
    with pytest.raises(IndexError, match="out of bounds"):
        in_memory[25]


def test_negative_rows_count_from_the_end_as_in_lerobots_dataset(root):
    dataset = stock(root, "observations_and_actions")
    in_memory = InMemoryDataset(dataset)
    for row in (-1, -25):
        assert_same(in_memory[row], dataset[row])


def test_iterating_yields_every_sample_once(root):
    in_memory = InMemoryDataset(stock(root, "actions", [1, 3]))
    assert [sample["index"].item() for sample in in_memory] == [7, *range(20, 25)]


def test_samples_may_be_modified_without_harm(root):
    in_memory = InMemoryDataset(stock(root, "actions"))
    before = {key: value.clone() for key, value in in_memory[3].items() if key != "task"}
    for value in in_memory[3].values():
        if isinstance(value, torch.Tensor):
            value.zero_()
    assert_same({key: value for key, value in in_memory[3].items() if key != "task"}, before)


@pytest.mark.slow
@pytest.mark.parametrize("episodes", [None, [0, 2]], ids=str)
def test_a_data_loader_gives_the_same_batches_in_the_same_order(root, episodes):
    epochs = []
    for wrap in (lambda dataset: dataset, InMemoryDataset):
        dataset = wrap(stock(root, "actions", episodes))
        sampler = EpisodeAwareSampler(
            dataset.meta.episodes["dataset_from_index"],
            dataset.meta.episodes["dataset_to_index"],
            episode_indices_to_use=dataset.episodes,
            drop_n_last_frames=2,
            shuffle=True,
            seed=3,
            absolute_to_relative_idx=dataset.absolute_to_relative_idx,
        )
        loader = torch.utils.data.DataLoader(dataset, batch_size=4, sampler=sampler, drop_last=False)
        epochs.append([batch for _ in range(2) for batch in loader])
    assert len(epochs[0]) == len(epochs[1]) > 2
    for expected, actual in zip(*epochs, strict=True):
        assert_same(actual, expected)
    orders = [batch["index"].tolist() for batch in epochs[1]]
    assert orders[: len(orders) // 2] != orders[len(orders) // 2 :]


def test_a_copy_gives_the_same_samples(root):
    in_memory = InMemoryDataset(stock(root, "actions", [0, 2]))
    duplicate = copy.deepcopy(in_memory)
    for row in range(len(in_memory)):
        assert_same(duplicate[row], in_memory[row])


@pytest.mark.parametrize("episodes", [None, [0, 2]], ids=str)
def test_everything_else_is_left_to_the_wrapped_dataset(root, episodes):
    dataset = stock(root, "actions", episodes)
    in_memory = InMemoryDataset(dataset)
    for name in ("meta", "absolute_to_relative_idx", "hf_dataset", "delta_timestamps"):
        assert getattr(in_memory, name) is getattr(dataset, name)
    for name in ("episodes", "num_frames", "num_episodes", "fps", "features", "repo_id", "root"):
        assert getattr(in_memory, name) == getattr(dataset, name)
    with pytest.raises(AttributeError, match="no_such_attribute"):
        _ = in_memory.no_such_attribute


def test_a_dataset_fits_up_to_the_limit(root):
    dataset = stock(root)
    numbers = sum(int(np.prod(feature["shape"])) for feature in dataset.meta.features.values())
    assert fits_in_memory(dataset, 25 * 8 * numbers)
    assert not fits_in_memory(dataset, 25 * 8 * numbers - 1)
    assert not fits_in_memory(dataset, 0)


def test_the_limit_counts_the_selected_episodes_only(root):
    whole, part = stock(root), stock(root, episodes=[1])
    limit = 1 + 8 * sum(int(np.prod(feature["shape"])) for feature in whole.meta.features.values())
    assert fits_in_memory(part, limit)
    assert not fits_in_memory(whole, limit)


@pytest.mark.parametrize("thing", [None, [], torch.utils.data.TensorDataset(torch.zeros(3))])
def test_other_datasets_do_not_fit(thing):
    assert not fits_in_memory(thing, 1e12)


@pytest.mark.parametrize(
    "feature",
    [
        {"dtype": "image", "shape": (8, 8, 3), "names": ["height", "width", "channels"]},
        {"dtype": "string", "shape": (1,), "names": None},
    ],
    ids=["images", "text"],
)
def test_datasets_that_are_not_numeric_do_not_fit_and_are_an_error(tmp_path, feature):
    dataset = LeRobotDataset.create(
        "test/other",
        FPS,
        {"action": FEATURES["action"], "observation.other": feature},
        root=tmp_path / "other",
    )
    assert not fits_in_memory(dataset, 1e12)
    with pytest.raises(ValueError, match="an in-memory dataset must have numeric features"):
        InMemoryDataset(dataset)
