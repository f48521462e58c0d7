# SPDX-License-Identifier: Apache-2.0
"""Several processes, merged datasets, adapters and large fields, with the real commands."""

import importlib.util
import multiprocessing
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.distributed as dist
from forked_commands import BIN, SECONDS, run, run_well
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets import LeRobotDataset
from safetensors.torch import load_file
from scipy.spatial import cKDTree
from torch import Tensor

from lerobot_pf2mp import DPPFConfig, FMPConfig, PF2MPConfig, load_policy
from lerobot_pf2mp.dataset_tools.maze.collect_maze import collect_maze
from lerobot_pf2mp.dataset_tools.writing.lerobot_writer import DatasetSpec, write_dataset
from lerobot_pf2mp.policies.dppf.modeling_dppf import DPPFPolicy
from lerobot_pf2mp.policies.fmp.modeling_fmp import FMPPolicy
from lerobot_pf2mp.policies.pf2mp.modeling_pf2mp import PF2MPPolicy
from lerobot_pf2mp.training.gathering import gather_rows

FIELD_FILE = "policy_preprocessor_step_4_potential_field.safetensors"
# Without a GPU --multi_gpu still starts the processes, which then use gloo; --cpu alone starts only one.
LAUNCH = ["launch", "--multi_gpu", "--num_processes=2", "--num_machines=1"]
NETWORK = [
    "--policy.device=cpu",
    "--policy.push_to_hub=false",
    "--policy.horizon=4",
    "--policy.n_action_steps=4",
    "--policy.down_dims=[8,16]",
    "--policy.diffusion_step_embed_dim=16",
    "--policy.optimizer_lr=0.01",
    "--policy.scheduler_warmup_steps=0",
    "--policy.ema_decay=0.8",
    "--num_workers=0",
    "--seed=3",
]
# Half of an epoch: half of what is learned from is shown to one of two processes only.
HALF_AN_EPOCH = ["--steps=24", "--save_freq=12", "--eval_steps=4", "--dataset.eval_split=0.25"]


def in_two_processes(command: str, *options: str) -> str:
    """Trains as accelerate starts it; returns what was said."""
    finished = subprocess.run(
        [BIN / "accelerate", *LAUNCH, BIN / command, *options],
        capture_output=True,
        text=True,
        timeout=SECONDS,
        check=False,
    )
    output = finished.stdout + finished.stderr
    assert finished.returncode == 0, output[-6000:]
    return output


def options(data: Path, output: Path) -> list[str]:
    return [f"--dataset.repo_id=local/{data.name}", f"--dataset.root={data}", f"--output_dir={output}"]


def checkpoint_of(output: Path, step: str = "last") -> Path:
    return output / "checkpoints" / step / "pretrained_model"


def eval_losses(output: str) -> np.ndarray:
    """The losses (6,) on the held-out episodes, which the main process alone reports."""
    losses = [float(loss) for loss in re.findall(r"eval_loss=([\d.]+)", output)]
    assert len(losses) == 6
    return np.array(losses)


def normalised_actions(checkpoint: Path, data: Path) -> Tensor:
    """The dataset's actions (N, 2) as the checkpoint's policy sees them, in the order of its frames."""
    dataset = LeRobotDataset(f"local/{data.name}", root=data)
    actions = torch.from_numpy(np.array(dataset.hf_dataset.with_format("numpy")["action"]))
    stats = load_file(checkpoint / "policy_postprocessor_step_0_unnormalizer_processor.safetensors")
    low, high = stats["action.min"], stats["action.max"]
    return 2 * (actions - low) / (high - low) - 1


def nearest(points: Tensor, others: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """For each point (P, 2) how far its nearest other is, and which one (P,)."""
    return cKDTree(others.numpy()).query(points.numpy())


def frames_of(points: Tensor, actions: Tensor) -> np.ndarray:
    """The frame (P,) whose action each point (P, 2) is."""
    distances, frames = nearest(points, actions)
    assert distances.max() < 1e-5
    return frames


def differing_keys(one: Path, other: Path) -> list[str]:
    a, b = load_file(one), load_file(other)
    assert set(a) == set(b)
    return [key for key in a if not torch.equal(a[key], b[key])]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scale")
    for maze, seed in (("umaze", 0), ("medium", 1)):
        collect_maze(
            maze,
            root=folder / maze,
            repo_id=f"local/{maze}",
            n_episodes=12,
            n_steps=80,
            action_noise=0.0,
            seed=seed,
            overwrite=False,
        )
    return folder


@pytest.fixture(scope="module")
def one(folder: Path) -> tuple[Path, str]:
    """The output folder of training in one process with batches of 16, and what the command said."""
    output = folder / "one"
    said = run_well(
        "lerobot-train",
        "--policy.type=pf2mp",
        *options(folder / "umaze", output),
        *NETWORK,
        *HALF_AN_EPOCH,
        "--batch_size=16",
    )
    return output, said


@pytest.fixture(scope="module")
def two(folder: Path) -> tuple[Path, str]:
    """The same with two processes and batches of 8."""
    output = folder / "two"
    said = in_two_processes(
        "lerobot-train",
        "--policy.type=pf2mp",
        *options(folder / "umaze", output),
        *NETWORK,
        *HALF_AN_EPOCH,
        "--batch_size=8",
    )
    return output, said


# --- Several processes ---


@pytest.mark.slow
def test_two_processes_write_one_checkpoint_whose_field_is_that_of_one_process(
    one: tuple[Path, str], two: tuple[Path, str]
) -> None:
    assert "Effective batch size: 8 x 2 = 16" in two[1]
    assert sorted(path.name for path in (two[0] / "checkpoints").iterdir()) == ["000012", "000024", "last"]
    for step in ("000012", "000024"):
        files = [checkpoint_of(output, step) / FIELD_FILE for output, _ in (one, two)]
        assert differing_keys(*files) == []


@pytest.mark.slow
def test_the_field_of_two_processes_is_an_even_sample_of_the_actions_learned_from(
    two: tuple[Path, str], folder: Path
) -> None:
    field = load_file(checkpoint_of(two[0]) / FIELD_FILE)
    assert torch.isfinite(field["log_threshold"])
    assert 0 < field["bandwidth"] < 1
    actions = normalised_actions(checkpoint_of(two[0]), folder / "umaze")
    frames = frames_of(field["points"], actions)
    # 9 of 12 episodes are learned from, 3 are held out.
    assert len(frames) > 500
    assert frames.max() < 720
    counts = np.bincount(frames // 80, minlength=9)
    chi_square = ((counts - counts.mean()) ** 2 / counts.mean()).sum()
    assert chi_square < 26  # 0.1 % of the chi-square distribution with 8 degrees of freedom


@pytest.mark.slow
def test_two_processes_learn_as_well_as_one(one: tuple[Path, str], two: tuple[Path, str]) -> None:
    # Same actions, other noise and times.
    losses = [eval_losses(said) for _, said in (one, two)]
    for loss in losses:
        assert loss[0] - loss[-1] > 0.15
    assert np.abs(losses[0] - losses[1]).max() < 0.2


@pytest.mark.slow
def test_in_memory_training_resumes_in_two_processes(two: tuple[Path, str], folder: Path) -> None:
    resumed = folder / "resumed"
    shutil.copytree(two[0], resumed, symlinks=True)
    shutil.rmtree(resumed / "checkpoints/000024")
    said = in_two_processes(
        "pf2mp-train",
        f"--config_path={checkpoint_of(resumed, '000012') / 'train_config.json'}",
        "--resume=true",
        f"--output_dir={resumed}",
    )
    assert "Keeping 720 frames in memory." in said
    # The same frames in the same order as when it is not interrupted and LeRobot's loader reads them.
    files = [checkpoint_of(output, "000024") / FIELD_FILE for output in (two[0], resumed)]
    assert differing_keys(*files) == []


@pytest.mark.slow
def test_a_guarded_policy_of_two_processes_has_the_field_of_one_process(folder: Path) -> None:
    act = ("chunk_size=4", "n_action_steps=4", "dim_model=16", "dim_feedforward=16", "n_heads=2")
    shared = [
        "--policy.type=guarded",
        "--policy.base.type=act",
        *(f"--policy.base.{option}" for option in act),
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        "--num_workers=0",
        "--seed=3",
        "--steps=12",
    ]
    outputs = [folder / "one_guarded", folder / "two_guarded"]
    run_well("lerobot-train", *options(folder / "umaze", outputs[0]), *shared, "--batch_size=16")
    in_two_processes("lerobot-train", *options(folder / "umaze", outputs[1]), *shared, "--batch_size=8")
    files = [next(checkpoint_of(output).glob("*potential_field.safetensors")) for output in outputs]
    assert differing_keys(*files) == []
    policy, *_ = load_policy(checkpoint_of(outputs[1]), device="cpu")
    assert policy.config.type == "guarded"


def _gather_in_a_process(rank: int, n_processes: int, folder: Path) -> None:
    store = dist.FileStore(str(folder / "store"), n_processes)
    dist.init_process_group("gloo", store=store, rank=rank, world_size=n_processes)
    n_rows = (3, 0, 1)[rank]
    actions = torch.full((n_rows, 2, 2), float(rank))
    is_pad = torch.full((n_rows, 2), rank == 2)
    torch.save(gather_rows(actions, is_pad, None), folder / f"{rank}.pt")
    dist.destroy_process_group()


@pytest.mark.slow
def test_every_process_gets_the_rows_of_all_however_many_each_has(tmp_path: Path) -> None:
    context = multiprocessing.get_context("forkserver")
    processes = [context.Process(target=_gather_in_a_process, args=(rank, 3, tmp_path)) for rank in range(3)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(300)
        assert process.exitcode == 0
    for rank in range(3):
        actions, is_pad, absent = torch.load(tmp_path / f"{rank}.pt", weights_only=True)
        assert absent is None
        assert torch.equal(actions[:, 0, 0], torch.tensor([0.0, 0.0, 0.0, 2.0]))
        assert is_pad.dtype == torch.bool
        assert torch.equal(is_pad, torch.tensor([False, False, False, True])[:, None].expand(4, 2))


def test_a_single_process_gathers_its_own_rows_untouched() -> None:
    rows = torch.randn(3, 2)
    gathered, absent = gather_rows(rows, None)
    assert gathered is rows
    assert absent is None


# --- Merged datasets ---


@pytest.mark.slow
def test_the_field_of_merged_datasets_covers_both(folder: Path) -> None:
    names = ("umaze", "medium")
    run_well(
        "lerobot-edit-dataset",
        "--new_repo_id=local/merged",
        f"--new_root={folder / 'merged'}",
        "--operation.type=merge",
        f"--operation.repo_ids=[{','.join(f'local/{name}' for name in names)}]",
        f"--operation.roots=[{','.join(str(folder / name) for name in names)}]",
    )
    output = folder / "trained_on_merged"
    run_well(
        "pf2mp-train",
        "--policy.type=pf2mp",
        *options(folder / "merged", output),
        *NETWORK,
        "--steps=30",
        "--batch_size=64",
    )
    checkpoint = checkpoint_of(output)
    points = load_file(checkpoint / FIELD_FILE)["points"]
    assert points.abs().max() <= 1 + 1e-5  # the statistics of both are those of the normalisation
    frames = frames_of(points, normalised_actions(checkpoint, folder / "merged"))
    # A whole epoch of both: frames keep an index of their own when datasets are merged.
    assert len(frames) == 2 * 12 * 80
    for name in names:
        distances, _ = nearest(normalised_actions(checkpoint, folder / name), points)
        assert distances.max() < 1e-5


# --- Adapters ---


@pytest.mark.parametrize(
    ("config_class", "policy_class"),
    [(FMPConfig, FMPPolicy), (PF2MPConfig, PF2MPPolicy), (DPPFConfig, DPPFPolicy)],
)
def test_adapters_are_refused_by_every_policy(config_class: type, policy_class: type) -> None:
    config = config_class(
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (2,)),
            "observation.environment_state": PolicyFeature(FeatureType.ENV, (2,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
        horizon=8,
        n_action_steps=4,
        down_dims=(8, 16),
        diffusion_step_embed_dim=8,
        device="cpu",
    )
    policy = policy_class(config)
    with pytest.raises(ValueError, match=f"{config.type} must be trained whole, got --peft options"):
        policy.wrap_with_peft(peft_cli_overrides={"method_type": "LORA", "target_modules": "all-linear"})


@pytest.mark.slow
def test_fine_tuning_adapters_ends_in_one_line_and_writes_nothing(
    one: tuple[Path, str], folder: Path, tmp_path: Path
) -> None:
    # LeRobot looks for the library before it asks the policy.
    message = (
        "ValueError: pf2mp must be trained whole, got --peft options"
        if importlib.util.find_spec("peft")
        else "ImportError: 'peft' is required but not installed"
    )
    output = tmp_path / "adapters"
    finished = run(
        "lerobot-train",
        f"--policy.path={checkpoint_of(one[0])}",
        *options(folder / "umaze", output),
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        "--peft.method_type=LORA",
        "--peft.target_modules=all-linear",
        "--steps=2",
        "--num_workers=0",
    )
    assert finished.returncode == 1
    assert finished.stderr.strip().splitlines()[-1].startswith(message)
    assert not output.exists()


# --- Large fields ---


@pytest.mark.slow
def test_a_field_of_100_000_anchors_is_fitted_saved_and_used(
    one: tuple[Path, str], folder: Path, tmp_path: Path
) -> None:
    features = {
        key: {"dtype": "float32", "shape": (2,), "names": ["x", "y"]}
        for key in ("observation.state", "observation.environment_state", "action")
    }
    rng = np.random.default_rng(0)
    episodes = (dict.fromkeys(features, rng.uniform(-1, 1, (1100, 2)).astype(np.float32)) for _ in range(100))
    data = tmp_path / "large"
    write_dataset(data, DatasetSpec("local/large", 10, features, "Move.", "A card."), episodes)
    output = tmp_path / "fitted"
    run_well(
        "pf2mp-fit-field",
        f"--policy.path={checkpoint_of(one[0])}",
        "--policy.n_field_points=100000",
        *options(data, output),
    )
    file = load_file(output / FIELD_FILE)
    assert file["points"].shape == (100_000, 2)
    assert len(np.unique(frames_of(file["points"], normalised_actions(output, data)))) == 100_000
    assert torch.isfinite(file["log_threshold"])

    batch = {"observation.state": torch.rand(2, 2), "observation.environment_state": torch.rand(2, 2)}
    noise = torch.randn(2, 4, 2)
    chunks = []
    for scale in (0.8, 0.0):
        policy, preprocess, _ = load_policy(output, device="cpu", guidance_scale=scale)
        chunks.append(policy.predict_action_chunk(preprocess(dict(batch)), noise=noise))
    assert torch.isfinite(chunks[0]).all()
    assert not torch.equal(*chunks)
