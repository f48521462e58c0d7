# SPDX-License-Identifier: Apache-2.0
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset

from lerobot_pf2mp.dataset_tools.fetch.collect_fetch import collect_fetch
from lerobot_pf2mp.dataset_tools.fetch.fetch_dataset import fetch_spec
from lerobot_pf2mp.dataset_tools.fetch.fetch_expert import ScriptedFetchExpert
from lerobot_pf2mp.dataset_tools.writing.episodes import IMAGE_KEY, Trajectory, prepare
from lerobot_pf2mp.dataset_tools.writing.video_writer import has_images, write_video_dataset
from lerobot_pf2mp.envs.fetch.fetch_env import FetchEnv

SPEC = fetch_spec("reach", "local/reach", "Made up.", 6, image_size=(48, 64))


def episode(grey: int) -> dict[str, np.ndarray]:
    """Six frames whose images become brighter."""
    pictures = np.full((6, 48, 64, 3), grey, dtype=np.uint8) + 10 * np.arange(6, dtype=np.uint8).reshape(
        -1, 1, 1, 1
    )
    positions = np.random.default_rng(grey).random((6, 3), dtype=np.float32)
    positions[:, 2] = 4.1
    return {
        "observation.state": positions,
        "action": positions,
        IMAGE_KEY: pictures,
    }


@pytest.mark.slow
def test_images_and_numbers_read_back(tmp_path: Path) -> None:
    root = tmp_path / "new" / "d"
    assert write_video_dataset(root, SPEC, iter([episode(20), episode(120)])) == 2
    assert [path.name for path in root.parent.iterdir()] == ["d"]
    dataset = LeRobotDataset("local/reach", root=root)
    assert (dataset.num_episodes, len(dataset), dataset.fps) == (2, 12, 25)
    for number, grey in enumerate((20, 120)):
        expected = episode(grey)
        for frame in range(6):
            item = dataset[6 * number + frame]
            np.testing.assert_array_equal(item["action"], expected["action"][frame])
            assert item[IMAGE_KEY].shape == (3, 48, 64)
            assert 255 * float(item[IMAGE_KEY].mean()) == pytest.approx(grey + 10 * frame, abs=4)
    assert (root / "README.md").read_text() == SPEC.card
    assert dataset.meta.robot_type == "fetch"
    for key in ("action", "observation.state"):
        assert dataset.meta.stats[key]["std"][2] == 0
        assert dataset.meta.stats[key]["mean"][2] == np.float32(4.1)
        assert (dataset.meta.stats[key]["std"][:2] > 0.1).all()


def test_a_dataset_without_episodes_or_with_an_error_on_the_way_leaves_nothing(tmp_path: Path) -> None:
    def broken():
        yield episode(20)
        raise KeyboardInterrupt

    with pytest.raises(ValueError, match="at least one episode, got none"):
        write_video_dataset(tmp_path / "d", SPEC, iter([]))
    with pytest.raises(KeyboardInterrupt):
        write_video_dataset(tmp_path / "d", SPEC, broken())
    assert not list(tmp_path.iterdir())


def test_a_specification_has_images_only_if_asked_for() -> None:
    assert has_images(SPEC)
    assert not has_images(fetch_spec("reach", "local/reach", "Made up.", 6))


@pytest.mark.parametrize("n_steps", [3, 6, 12])
def test_each_frame_has_the_last_image_before_it(n_steps: int) -> None:
    pictures = np.arange(7, dtype=np.uint8).reshape(-1, 1, 1, 1) * np.ones((1, 2, 2, 3), dtype=np.uint8)
    trajectory = Trajectory(np.arange(21.0).reshape(7, 3), np.zeros(3), images=pictures)
    (frames,) = prepare([trajectory], n_steps, lambda way: False, Counter())
    taken = frames[IMAGE_KEY][:, 0, 0, 0]
    position = frames["observation.state"][:, 0] / 3  # in steps of the recording
    assert taken.tolist() == np.floor(position + 1e-6).tolist()


@pytest.mark.slow
def test_collected_images_are_those_of_the_environment(tmp_path: Path) -> None:
    n_written, _ = collect_fetch(
        "reach",
        root=tmp_path / "d",
        repo_id="local/reach",
        n_episodes=1,
        n_steps=48,
        style="clear",
        scene_changes={},
        seed=3,
        n_processes=1,
        overwrite=False,
        image_width=64,
    )
    assert n_written == 1
    dataset = LeRobotDataset("local/reach", root=tmp_path / "d")
    recording = ScriptedFetchExpert(
        FetchEnv("reach", render_mode="rgb_array", render_size=64), seed=3
    ).demonstrate(0)
    first, last = recording.images[0].astype(float), recording.images[-2].astype(float)
    for frame, picture, other in ((0, first, last), (47, last, first)):
        shown = 255 * dataset[frame][IMAGE_KEY].permute(1, 2, 0).numpy()
        assert np.abs(shown - picture).mean() < 0.5 * np.abs(shown - other).mean()
