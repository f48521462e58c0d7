# SPDX-License-Identifier: Apache-2.0
"""The stock commands from end to end."""

import json
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from forked_commands import run, run_well
from lerobot.datasets import LeRobotDataset
from safetensors.torch import load_file

from lerobot_pf2mp.commands import cli
from lerobot_pf2mp.dataset_tools.maze.collect_maze import collect_maze
from lerobot_pf2mp.figures import policy_figures
from lerobot_pf2mp.loading import load_policy

pytestmark = pytest.mark.slow

FIELD_FILE = "policy_preprocessor_step_4_potential_field.safetensors"
TRAINING_OPTIONS = [
    "--policy.push_to_hub=false",
    "--policy.device=cpu",
    "--policy.horizon=16",
    "--policy.n_action_steps=16",
    "--policy.down_dims=[8,16]",
    "--policy.diffusion_step_embed_dim=16",
    "--batch_size=8",
    "--num_workers=0",
    "--log_freq=2",
    "--seed=3",
]


def train(command: str, data: Path, output: Path, *options: str, policy: str = "pf2mp") -> Path:
    if not any(option.startswith("--policy.path") for option in options):
        options = (f"--policy.type={policy}", *options)
    run_well(
        command,
        f"--dataset.repo_id=local/{data.name}",
        f"--dataset.root={data}",
        *TRAINING_OPTIONS,
        f"--output_dir={output}",
        *options,
    )
    return output / "checkpoints/last/pretrained_model"


@dataclass(frozen=True)
class Evaluation:
    """What lerobot-eval leaves of some episodes."""

    sum_rewards: list[float]
    successes: list[bool]
    videos: list[bytes]  # which show the ways, by the millimetre


def evaluate(checkpoint: Path, output: Path, *options: str) -> Evaluation:
    run_well(
        "lerobot-eval",
        f"--policy.path={checkpoint}",
        "--env.type=pf2mp_maze",
        "--env.task=MazeUMaze-v0",
        "--env.episode_length=16",
        "--eval.n_episodes=3",
        "--eval.batch_size=3",
        f"--output_dir={output}",
        *options,
    )
    metrics = json.loads((output / "eval_info.json").read_text())["per_task"][0]["metrics"]
    videos = [path.read_bytes() for path in sorted(output.rglob("*.mp4"))]
    return Evaluation(metrics["sum_rewards"], metrics["successes"], videos)


def all_actions(data: Path) -> np.ndarray:
    """The dataset's actions (N, 2) [m], in the order of its frames."""
    dataset = LeRobotDataset(f"local/{data.name}", root=data)
    return np.array(dataset.hf_dataset.with_format("numpy")["action"])


def field_points(checkpoint: Path) -> np.ndarray:
    """The field's points (P, 2) [m]."""
    _, _, postprocess = load_policy(checkpoint, device="cpu")
    return postprocess(load_file(checkpoint / FIELD_FILE)["points"]).numpy()


def distance_to_nearest(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - others[None], axis=-1).min(axis=1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("training")
    for name, maze, seed in (("umaze", "umaze", 0), ("medium", "medium", 1)):
        collect_maze(
            maze,
            root=folder / name,
            repo_id=f"local/{name}",
            n_episodes=12,
            n_steps=16,
            action_noise=0.0,
            seed=seed,
            overwrite=False,
        )
    return folder


@pytest.fixture(scope="module")
def checkpoint(folder: Path) -> Path:
    return train("lerobot-train", folder / "umaze", folder / "stock", "--steps=4", "--save_freq=1")


def test_stock_training_writes_weights_processors_and_field(checkpoint: Path, folder: Path) -> None:
    names = {path.name for path in checkpoint.iterdir()}
    assert {
        "config.json",
        "model.safetensors",
        "train_config.json",
        "policy_preprocessor.json",
        "policy_postprocessor.json",
        FIELD_FILE,
    } <= names
    points = field_points(checkpoint)
    assert distance_to_nearest(points, all_actions(folder / "umaze")).max() < 1e-4
    assert len(np.unique(points, axis=0)) > 100  # 4 batches of 8 chunks of up to 16 actions


@pytest.fixture(scope="module")
def evaluations(checkpoint: Path, folder: Path) -> dict[str, Evaluation]:
    """The checkpoint in the same three episodes: guided, twice, and with guidance off."""
    return {
        name: evaluate(checkpoint, folder / f"eval_{name}", *options)
        for name, options in {
            "sync": ["--eval.use_async_envs=false"],
            "async": ["--eval.use_async_envs=true"],
            "unguided": ["--eval.use_async_envs=false", "--policy.guidance_scale=0", "--policy.max_plans=1"],
        }.items()
    }


@pytest.mark.parametrize("kind", ["sync", "async"])
def test_stock_evaluation_needs_no_option_to_be_guided(evaluations: dict[str, Evaluation], kind: str) -> None:
    guided, unguided = evaluations[kind], evaluations["unguided"]
    assert len(guided.successes) == len(guided.videos) == 3
    assert set(guided.sum_rewards) <= {0.0, -1.0}
    # The same starts, goals and noise, and in each episode another way.
    assert not set(guided.videos) & set(unguided.videos)


def test_sync_and_async_evaluation_agree(evaluations: dict[str, Evaluation]) -> None:
    assert evaluations["sync"] == evaluations["async"]


def test_a_reloaded_checkpoint_acts_like_the_policy_that_was_saved(checkpoint: Path, tmp_path: Path) -> None:
    batch = {
        "observation.state": torch.rand(4, 2),
        "observation.environment_state": torch.rand(4, 2),
    }
    noise = torch.randn(4, 16, 2)
    policy, preprocess, postprocess = load_policy(checkpoint, device="cpu", max_plans=1)
    in_memory = postprocess(policy.predict_action_chunk(preprocess(dict(batch)), noise=noise))
    for part in (policy, preprocess, postprocess):
        part.save_pretrained(tmp_path)
    policy, preprocess, postprocess = load_policy(tmp_path, device="cpu")
    reloaded = postprocess(policy.predict_action_chunk(preprocess(dict(batch)), noise=noise))
    assert torch.equal(in_memory, reloaded)
    unguided, preprocess, postprocess = load_policy(checkpoint, device="cpu", guidance_scale=0, max_plans=1)
    assert not torch.equal(
        in_memory, postprocess(unguided.predict_action_chunk(preprocess(dict(batch)), noise=noise))
    )


def test_guidance_scale_zero_on_the_command_line_is_fmp(
    checkpoint: Path, folder: Path, evaluations: dict[str, Evaluation]
) -> None:
    as_fmp = folder / "as_fmp"
    shutil.copytree(checkpoint, as_fmp)
    config = json.loads((as_fmp / "config.json").read_text())
    kept = {
        k: v
        for k, v in config.items()
        if not k.startswith(
            (
                "guidance_",
                "field_",
                "n_field_",
                "max_plans",
                "false_alarm_rate",
                "on_unsupported",
                "obstacle",
                "robot_radius",
            )
        )
    }
    (as_fmp / "config.json").write_text(json.dumps({**kept, "type": "fmp"}))
    batch = {"observation.state": torch.rand(4, 2), "observation.environment_state": torch.rand(4, 2)}
    noise = torch.randn(4, 16, 2)
    chunks = []
    for path, overrides in ((as_fmp, {}), (checkpoint, {"guidance_scale": 0, "max_plans": 1})):
        policy, preprocess, _ = load_policy(path, device="cpu", **overrides)
        chunks.append(policy.predict_action_chunk(preprocess(dict(batch)), noise=noise))
    assert torch.equal(*chunks)
    fmp = evaluate(as_fmp, folder / "eval_fmp", "--eval.use_async_envs=false")
    assert fmp == evaluations["unguided"]


def test_resuming_restores_field_and_average_bit_for_bit(checkpoint: Path, folder: Path) -> None:
    resumed = folder / "resumed"
    shutil.copytree(folder / "stock", resumed, symlinks=True)
    shutil.rmtree(resumed / "checkpoints/000004")
    before = resumed / "checkpoints/000003/pretrained_model"
    run_well(
        "lerobot-train",
        f"--config_path={before / 'train_config.json'}",
        "--resume=true",
        f"--output_dir={resumed}",
    )
    after = resumed / "checkpoints/000004/pretrained_model"
    # The field saw the same frames in the same order as in the uninterrupted run.
    expected, found = load_file(checkpoint / FIELD_FILE), load_file(after / FIELD_FILE)
    assert [key for key in expected if not torch.equal(expected[key], found[key])] == []
    # LeRobot's loader draws one number from the restored generator, so the noise of the step differs; but the average
    # must be that of the third checkpoint, moved once towards the weights after the fourth step.
    old, new = load_file(before / "model.safetensors"), load_file(after / "model.safetensors")
    assert (old["ema.n_averaged"], new["ema.n_averaged"]) == (3, 4)
    names = [key.removeprefix("network.") for key in new if key.startswith("network.")]
    averages = [old[f"ema.module.{name}"] for name in names]
    torch._foreach_lerp_(averages, [new[f"network.{name}"] for name in names], 1 - 4 / 13)
    assert all(
        torch.equal(average, new[f"ema.module.{name}"]) for average, name in zip(averages, names, strict=True)
    )


def test_in_memory_training_equals_stock_training_bit_for_bit(checkpoint: Path, folder: Path) -> None:
    in_memory = train("pf2mp-train", folder / "umaze", folder / "in_memory", "--steps=4", "--save_freq=2")
    for name in ("model.safetensors", FIELD_FILE):
        stock, ours = load_file(checkpoint / name), load_file(in_memory / name)
        assert [key for key in stock if not torch.equal(stock[key], ours[key])] == []


def test_fine_tuning_replaces_the_field_in_the_new_normalisation(checkpoint: Path, folder: Path) -> None:
    tuned = train(
        "lerobot-train", folder / "medium", folder / "tuned", "--steps=2", f"--policy.path={checkpoint}"
    )
    points = field_points(tuned)
    assert distance_to_nearest(points, all_actions(folder / "medium")).max() < 1e-4
    assert distance_to_nearest(points, all_actions(folder / "umaze")).max() > 0.5
    normalised = load_file(tuned / FIELD_FILE)["points"]
    assert normalised.abs().max() <= 1 + 1e-5


def test_held_out_actions_never_enter_the_field(folder: Path) -> None:
    split = train(
        "pf2mp-train",
        folder / "umaze",
        folder / "split",
        "--steps=6",
        "--dataset.eval_split=0.5",
        "--eval_steps=2",
    )
    actions = all_actions(folder / "umaze")
    learned, held_out = actions[: len(actions) // 2], actions[len(actions) // 2 :]
    points = field_points(split)
    assert distance_to_nearest(points, learned).max() < 1e-4
    assert distance_to_nearest(held_out, points).max() > 0.05
    is_held_out = distance_to_nearest(points, held_out) < 1e-5
    also_learned = distance_to_nearest(points, learned) < 1e-5
    assert not (is_held_out & ~also_learned).any()


def test_streaming_and_fmp_train(folder: Path) -> None:
    # LeRobot streams one shard for each worker.
    streamed = train(
        "pf2mp-train",
        folder / "umaze",
        folder / "streamed",
        "--steps=2",
        "--dataset.streaming=true",
        "--num_workers=1",
    )
    assert distance_to_nearest(field_points(streamed), all_actions(folder / "umaze")).max() < 1e-4
    assert load_file(streamed / FIELD_FILE)["n_shown"] == 0  # frames are told apart by their index here too
    plain = train(
        "lerobot-train",
        folder / "umaze",
        folder / "fmp",
        "--steps=2",
        "--policy.use_ema=false",
        "--policy.use_amp=true",
        "--policy.n_obs_steps=2",
        "--policy.n_action_steps=8",
        policy="fmp",
    )
    assert not (plain / FIELD_FILE).exists()
    assert not any(key.startswith("ema.") for key in load_file(plain / "model.safetensors"))
    evaluate(plain, folder / "eval_plain", "--eval.use_async_envs=false")


@pytest.mark.parametrize(
    ("damage", "message"),
    [("truncated", "header|deserializ|incomplete"), ("missing", FIELD_FILE), ("other", "corrupted")],
)
def test_a_damaged_field_is_an_error_and_never_silence(
    checkpoint: Path, tmp_path: Path, damage: str, message: str
) -> None:
    import safetensors.torch

    broken = tmp_path / "broken"
    shutil.copytree(checkpoint, broken)
    file = broken / FIELD_FILE
    if damage == "truncated":
        file.write_bytes(file.read_bytes()[:100])
    elif damage == "missing":
        file.unlink()
    else:
        safetensors.torch.save_file({"weights": torch.zeros(3)}, file)
    with pytest.raises(Exception, match=f"(?i){message}"):
        load_policy(broken, device="cpu")


def test_bad_options_end_in_one_message_and_write_nothing(folder: Path, checkpoint: Path) -> None:
    for options, message in (
        (["--policy.n_action_steps=17"], "n_action_steps must be at most"),
        (["--policy.field_bandwidth=-1"], "field_bandwidth must be finite and positive"),
    ):
        finished = run(
            "lerobot-train",
            f"--dataset.root={folder / 'umaze'}",
            "--dataset.repo_id=local/umaze",
            "--policy.type=pf2mp",
            *TRAINING_OPTIONS,
            f"--output_dir={folder / 'bad'}",
            *options,
        )
        assert finished.returncode != 0
        assert message in finished.stderr
        assert not (folder / "bad").exists()
    finished = run(
        "lerobot-eval",
        f"--policy.path={checkpoint}",
        "--env.type=pf2mp_maze",
        "--policy.guidance_scale=-1",
        f"--output_dir={folder / 'bad'}",
    )
    assert finished.returncode != 0
    assert "guidance_scale must be finite and at least 0" in finished.stderr


def test_an_evaluation_config_works_with_the_stock_command(checkpoint: Path, folder: Path) -> None:
    configs = Path(__file__).parents[1] / "eval_configs"
    output = folder / "from_yaml"
    run_well(
        "lerobot-eval",
        f"--config_path={configs / 'maze_large_pf2mp_euler.yaml'}",
        f"--policy.path={checkpoint}",
        "--eval.n_episodes=2",
        "--eval.batch_size=2",
        f"--output_dir={output}",
    )
    assert (output / "eval_info.json").exists()


def test_the_demo_runs_resumes_and_refuses_other_options(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    options = [
        f"--output_dir={tmp_path / 'demo'}",
        "--task=maze_umaze",
        "--n_demonstrations=40",
        "--steps=3",
        "--n_episodes=4",
    ]
    with monkeypatch.context() as patch:
        patch.setattr(policy_figures, "_N_SEARCHED", 4)  # episodes played for the figure
        patch.setattr(sys, "argv", ["pf2mp-demo", *options])
        cli.demo()
    first = capfd.readouterr().out
    assert "| fmp |" in first
    assert "| pf2mp |" in first
    assert (tmp_path / "demo/overview.png").stat().st_size > 10_000
    assert (tmp_path / "demo/results.csv").read_text().count("\n") == 3
    again = run_well("pf2mp-demo", *options)
    assert again.count("done already") == 4
    refused = run("pf2mp-demo", *options, "--seed=1")
    assert refused.returncode == 1
    assert "holds a demo with other options" in refused.stderr
    assert "Traceback" not in refused.stderr
