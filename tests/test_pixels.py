# SPDX-License-Identifier: Apache-2.0
"""Policies that observe images, from demonstrations to evaluation."""

import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
import torchvision
from forked_commands import run_well
from lerobot.datasets import LeRobotDataset
from lerobot.envs.utils import NEW_ROLLOUT_OPTION, env_to_policy_features

from lerobot_pf2mp import PF2MPFetchEnv, PF2MPHandwritingEnv, PF2MPMazeEnv, load_policy
from lerobot_pf2mp.dataset_tools.fetch.collect_fetch import collect_fetch
from lerobot_pf2mp.dataset_tools.handwriting.collect_handwriting import collect_handwriting
from lerobot_pf2mp.dataset_tools.maze.collect_maze import collect_maze
from lerobot_pf2mp.dataset_tools.writing.lerobot_writer import DatasetSpec, image_feature
from lerobot_pf2mp.dataset_tools.writing.video_writer import write_video_dataset
from lerobot_pf2mp.errors import ConfigError

WIDTH = 96
ENVS = {
    "maze": lambda **options: PF2MPMazeEnv(task="MazeUMaze-v0", **options),
    "fetch": PF2MPFetchEnv,
    "handwriting": lambda **options: PF2MPHandwritingEnv(task="HandwritingPen-v0", **options),
}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A few demonstrations with images of every environment."""
    folder = tmp_path_factory.mktemp("data")
    roots = {name: folder / name for name in ENVS}
    common = {"n_episodes": 3, "seed": 0, "overwrite": False, "image_width": WIDTH}
    collect_maze("umaze", root=roots["maze"], repo_id="local/maze", n_steps=20, action_noise=0.0, **common)
    collect_fetch(
        "reach",
        root=roots["fetch"],
        repo_id="local/fetch",
        n_steps=48,
        style="clear",
        scene_changes={},
        n_processes=1,
        **common,
    )
    # A picture of the arm takes 0.2 s without a graphics card.
    common["n_episodes"] = 1
    collect_handwriting(
        "pen", root=roots["handwriting"], repo_id="local/handwriting", n_steps=64, scene_options={}, **common
    )
    return roots


@pytest.mark.slow
@pytest.mark.parametrize("name", ENVS)
def test_an_environment_shows_what_it_renders_instead_of_its_state(name: str) -> None:
    config = ENVS[name](obs_type="pixels_agent_pos", render_size=WIDTH)
    assert list(env_to_policy_features(config)) == ["action", "observation.state", "observation.image"]
    (envs,) = config.create_envs(2)[config.type].values()
    observation, _ = envs.reset(seed=[0, 1], options={NEW_ROLLOUT_OPTION: True})
    assert set(observation) == {"agent_pos", "pixels"}
    assert observation["pixels"].shape[1:] == config.features["pixels"].shape
    assert np.ptp(observation["pixels"]) > 50  # something is to be seen
    for _ in range(2):
        observation, *_ = envs.step(envs.action_space.sample())
        assert np.array_equal(observation["pixels"], np.stack(envs.call("render")))
    assert not np.array_equal(*observation["pixels"])
    envs.close()


def test_an_unknown_kind_of_observation_is_an_error() -> None:
    for make in ENVS.values():
        with pytest.raises(
            ConfigError, match=r"obs_type must be one of \['state', 'pixels_agent_pos'\], got"
        ):
            make(obs_type="pixels")


@pytest.mark.slow
@pytest.mark.parametrize("name", ENVS)
def test_demonstrations_hold_the_images_of_their_environment_and_nothing_more(
    name: str, data: dict[str, Path]
) -> None:
    dataset = LeRobotDataset(f"local/{name}", root=data[name])
    seen = [key for key in dataset.features if key.startswith("observation.")]
    assert seen == ["observation.state", "observation.image"]
    height, width, _ = ENVS[name](obs_type="pixels_agent_pos", render_size=WIDTH).features["pixels"].shape
    picture = dataset[0]["observation.image"]
    assert picture.shape == (3, height, width)
    assert picture.max() - picture.min() > 0.2  # something is to be seen


@pytest.mark.slow
def test_a_maze_is_drawn_as_the_environment_shows_it(data: dict[str, Path]) -> None:
    dataset = LeRobotDataset("local/maze", root=data["maze"])
    env = gym.make(
        "lerobot_pf2mp/MazeUMaze-v0", render_mode="rgb_array", render_size=WIDTH, max_episode_steps=20
    )
    end = dataset[19]["action"].numpy()
    env.reset(seed=0, options={"start": dataset[0]["observation.state"].numpy(), "goal": end})
    pictures = [255 * dataset[i]["observation.image"].permute(1, 2, 0).numpy() for i in range(20)]
    for i in range(20):
        differs = [(np.abs(picture - env.render()).max(axis=-1) > 80).mean() for picture in pictures]
        # The goal of the demonstration is near its end, but not there.
        assert differs[i] < 0.005
        # The ball moves from the third picture on, and no picture of another moment shows it where it is now.
        assert i < 2 or np.argmin(differs) == i
        env.step(dataset[i]["action"].numpy())


def train(policy: str, data: Path, output: Path, *options: str) -> Path:
    run_well(
        "lerobot-train",
        f"--policy.type={policy}",
        f"--dataset.repo_id=local/{data.name}",
        f"--dataset.root={data}",
        f"--output_dir={output}",
        "--policy.push_to_hub=false",
        "--policy.device=cpu",
        "--policy.horizon=8",
        "--policy.n_action_steps=4",
        "--policy.down_dims=[8,16]",
        "--policy.diffusion_step_embed_dim=16",
        "--batch_size=4",
        "--num_workers=0",
        "--steps=2",
        *options,
    )
    return output / "checkpoints/last/pretrained_model"


def keys_that_matter(checkpoint: Path) -> list[str]:
    """The observations that change what the loaded policy plans with the same noise."""
    policy, preprocess, _ = load_policy(checkpoint, device="cpu")
    shapes = {key: feature.shape for key, feature in policy.config.input_features.items()}
    seen = {key: torch.rand(shape) for key, shape in shapes.items()}
    noise = torch.zeros(1, policy.config.horizon, *policy.config.output_features["action"].shape)

    def plan(changed: str | None) -> torch.Tensor:
        policy.reset()
        observation = {key: 1 - value if key == changed else value for key, value in seen.items()}
        with torch.inference_mode():
            chunk = policy.predict_action_chunk(preprocess(observation), noise=noise)
        assert torch.isfinite(chunk).all()
        return chunk

    unchanged = plan(None)
    assert torch.equal(plan(None), unchanged)
    return [key for key in seen if not torch.equal(plan(key), unchanged)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("policy", "name", "options"),
    [
        ("pf2mp", "maze", ["--policy.n_obs_steps=2", "--policy.crop_shape=[80,80]"]),
        ("fmp", "fetch", ["--policy.n_obs_steps=1", "--policy.resize_shape=[64,80]"]),
        (
            "dppf",
            "fetch",
            [
                "--policy.n_obs_steps=2",
                "--policy.crop_shape=[60,80]",
                "--policy.pretrained_backbone_weights=null",
            ],
        ),
        ("pf2mp", "handwriting", ["--policy.n_obs_steps=1", "--policy.crop_shape=[60,80]"]),
    ],
)
def test_a_policy_with_images_trains_saves_loads_and_evaluates(
    policy: str, name: str, options: list[str], data: dict[str, Path], tmp_path: Path
) -> None:
    checkpoint = train(policy, data[name], tmp_path / "out", *options)
    env = ENVS[name]()
    run_well(
        "lerobot-eval",
        f"--policy.path={checkpoint}",
        "--policy.device=cpu",
        f"--env.type={env.type}",
        f"--env.task={env.task}",
        "--env.obs_type=pixels_agent_pos",
        f"--env.render_size={WIDTH}",
        "--env.episode_length=6",
        "--eval.n_episodes=2",
        "--eval.batch_size=2",
        "--eval.use_async_envs=false",
        f"--output_dir={tmp_path / 'eval'}",
    )
    (metrics,) = (
        task["metrics"] for task in json.loads((tmp_path / "eval/eval_info.json").read_text())["per_task"]
    )
    assert set(metrics["sum_rewards"]) <= {0.0, -1.0}
    assert len(metrics["successes"]) == len(list((tmp_path / "eval").rglob("*.mp4"))) == 2
    assert keys_that_matter(checkpoint) == ["observation.state", "observation.image"]


@pytest.mark.slow
def test_a_policy_sees_every_camera_of_a_dataset(tmp_path: Path) -> None:
    cameras = ("observation.images.front", "observation.images.wrist")
    vector = {"dtype": "float32", "shape": (2,), "names": ["x", "y"]}
    features = {"observation.state": vector, "action": vector}
    features |= {camera: image_feature((64, 80)) for camera in cameras}
    rng = np.random.default_rng(0)
    episodes = [
        {
            key: rng.integers(0, 256, (12, 64, 80, 3), dtype=np.uint8)
            if key in cameras
            else rng.random((12, 2), dtype=np.float32)
            for key in features
        }
        for _ in range(2)
    ]
    root = tmp_path / "two"
    write_video_dataset(root, DatasetSpec("local/two", 10, features, "Do it.", "A card."), episodes)
    checkpoint = train("pf2mp", root, tmp_path / "out", "--policy.n_obs_steps=2")
    assert keys_that_matter(checkpoint) == ["observation.state", *cameras]


@pytest.mark.slow
def test_a_pretrained_backbone_is_torchvisions(data: dict[str, Path], tmp_path: Path) -> None:
    # What torchvision would have downloaded.
    torch.manual_seed(1)
    weights = torchvision.models.resnet18().state_dict()
    cache = tmp_path / "torch/hub/checkpoints"
    cache.mkdir(parents=True)
    torch.save(weights, cache / "resnet18-f37072fd.pth")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TORCH_HOME", str(tmp_path / "torch"))
        checkpoint = train(
            "pf2mp",
            data["maze"],
            tmp_path / "out",
            "--policy.use_group_norm=false",
            "--policy.pretrained_backbone_weights=ResNet18_Weights.IMAGENET1K_V1",
            "--policy.optimizer_lr=1e-9",
            "--policy.n_obs_steps=1",
        )
        policy, *_ = load_policy(checkpoint, device="cpu")
    filters = [
        value
        for key, value in policy.state_dict().items()
        if key.startswith("network.") and ".backbone." in key and value.ndim == 4
    ]
    expected = [value for value in weights.values() if value.ndim == 4]
    assert len(expected) == 20
    torch.testing.assert_close(filters, expected, atol=1e-5, rtol=0)
