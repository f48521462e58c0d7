# SPDX-License-Identifier: Apache-2.0
"""The dataset of a training run, and its episodes, found by the metadata that LeRobot gives to a policy."""

import gc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from accelerate import Accelerator
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.factory import make_train_eval_datasets
from lerobot.datasets.streaming_dataset import StreamingLeRobotDataset
from torch.utils.data import DataLoader

from lerobot_pf2mp import PF2MPConfig
from lerobot_pf2mp.dataset_tools.writing.lerobot_writer import DatasetSpec, write_dataset
from lerobot_pf2mp.errors import ConfigError
from lerobot_pf2mp.training.in_memory_dataset import InMemoryDataset
from lerobot_pf2mp.training.run_dataset import find_dataset, run_episodes

NAME = "local/tiny"
N_EPISODES = 5
FEATURES: dict[str, dict[str, Any]] = {
    key: {"dtype": "float32", "shape": (2,), "names": None} for key in ("observation.state", "action")
}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("datasets") / "tiny"
    rng = np.random.default_rng(0)
    episodes = [
        {key: rng.normal(size=(6, 2)).astype(np.float32) for key in FEATURES} for _ in range(N_EPISODES)
    ]
    write_dataset(root, DatasetSpec(NAME, 10, FEATURES, "Do it.", "A card."), episodes)
    return root


def run_on(root: Path, **options: Any) -> tuple[Any, Any]:
    """The datasets that lerobot-train makes."""
    config = DatasetConfig(NAME, root=str(root), **options)
    return make_train_eval_datasets(TrainPipelineConfig(config, policy=PF2MPConfig(device="cpu")))


def test_the_dataset_with_this_very_metadata_is_found_among_others(root):
    datasets = [LeRobotDataset(NAME, root=root, episodes=episodes) for episodes in (None, [1], [0, 3])]
    for dataset in datasets:
        assert find_dataset(dataset.meta) is dataset
    assert [run_episodes(dataset.meta) for dataset in datasets] == [None, [1], [0, 3]]


def test_a_named_selection_of_all_episodes_is_the_whole_dataset(root):
    dataset = LeRobotDataset(NAME, root=root, episodes=list(range(N_EPISODES)))
    assert run_episodes(dataset.meta) is None


def test_metadata_without_a_dataset_finds_none(root):
    dataset = LeRobotDataset(NAME, root=root, episodes=[2])
    meta = LeRobotDatasetMetadata(NAME, root=root)
    assert (find_dataset(meta), run_episodes(meta)) == (None, None)
    assert (find_dataset(None), run_episodes(None)) == (None, None)
    meta = dataset.meta
    del dataset
    gc.collect()
    assert find_dataset(meta) is None


def test_the_run_learns_from_the_episodes_that_evaluation_does_not_hold_out(root):
    train, held_out = run_on(root, eval_split=0.4)
    assert run_episodes(train.meta) == [0, 1, 2]
    assert run_episodes(held_out.meta) == [3, 4]
    train, held_out = run_on(root, eval_split=0.5, episodes=[1, 2, 4])
    assert (run_episodes(train.meta), run_episodes(held_out.meta)) == ([1], [2, 4])
    assert run_episodes(run_on(root, episodes=[4, 2])[0].meta) == [4, 2]


def test_a_streaming_dataset_is_found(root):
    dataset, _ = run_on(root, streaming=True)
    assert type(dataset) is StreamingLeRobotDataset
    assert find_dataset(dataset.meta) is dataset
    assert run_episodes(dataset.meta) is None


def test_episodes_of_a_streaming_dataset_are_refused_because_lerobot_reads_all_of_them(root):
    dataset = StreamingLeRobotDataset(NAME, root=root, episodes=[0, 1])
    with pytest.raises(
        ConfigError, match="dataset.episodes must be unset with --dataset.streaming=true.*got 2 of 5"
    ):
        run_episodes(dataset.meta)


def test_a_dataset_is_found_inside_pf2mp_trains_and_accelerates_wrappings(root):
    wrapped = InMemoryDataset(LeRobotDataset(NAME, root=root, episodes=[1, 3]))
    loader = Accelerator(cpu=True).prepare(DataLoader(wrapped, batch_size=2))
    assert type(find_dataset(wrapped.meta)) is LeRobotDataset
    assert run_episodes(wrapped.meta) == [1, 3]
    del loader


def test_other_objects_are_not_asked_for_their_class_or_attributes(root):
    class Touchy:
        def __getattribute__(self, name: str) -> Any:
            raise AssertionError(f"{name} was read")

    bystander = [Touchy()]
    dataset = LeRobotDataset(NAME, root=root, episodes=[2])
    assert find_dataset(dataset.meta) is dataset
    assert len(bystander) == 1
