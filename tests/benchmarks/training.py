# SPDX-License-Identifier: Apache-2.0
"""How fast training is: the loaders, the whole step of lerobot-train and pf2mp-train, and where a step's time goes.

The data are maze demonstrations of this package's collector. Steps are those of the real commands, run in this process.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from itertools import islice
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import torch
from accelerate import Accelerator
from accelerate.optimizer import AcceleratedOptimizer
from harness import Row, synchronise, threads, time_in_turns
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import EpisodeAwareSampler, LeRobotDataset
from lerobot.datasets.factory import make_train_eval_datasets
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.processor import DataProcessorPipeline
from lerobot.scripts import lerobot_train
from lerobot.utils.utils import cycle
from stopwatch import Stopwatch
from torch.utils.data import DataLoader
from torch.utils.data.dataloader import _BaseDataLoaderIter

from lerobot_pf2mp import PF2MPConfig
from lerobot_pf2mp.commands import train as pf2mp_train
from lerobot_pf2mp.dataset_tools.maze.collect_maze import collect_maze
from lerobot_pf2mp.policies.fmp.modeling_fmp import FMPPolicy
from lerobot_pf2mp.policies.guided.field_guidance import FieldGuidance
from lerobot_pf2mp.training.in_memory_dataset import InMemoryDataset

N_EPISODES = 300
HORIZON = 80
BATCH_SIZE = 64
N_WORKERS = 2
N_ROUNDS = 3  # of everything that is too slow for the harness's own number of rounds
N_WORKER_BATCHES = 12
N_WARM_UP_STEPS = 5
N_STOCK_STEPS = 10
N_STEPS = 40
LOADER_TARGET = 1.4
OUTSIDE_TARGET = 10.0

Data = LeRobotDataset | InMemoryDataset
Train = Callable[[], None]


@dataclass(frozen=True)
class Setting:
    """What is trained where.

    Args:
        name: What it is called in the table.
        device: The device.
        down_dims: Channels of the U-Net's levels.
        batch_size: Samples in a step.
    """

    name: str
    device: str
    down_dims: tuple[int, ...]
    batch_size: int


SMALL = Setting("small U-Net (32, 64, 128), batch 64", "cpu", (32, 64, 128), BATCH_SIZE)
PAPER = Setting("paper's U-Net (512, 256, 128), batch 256", "cuda", (512, 256, 128), 256)

NETWORK = ("forward", "backward", "gradient clipping", "optimiser")

# Every function of a training step that is timed, and under which name.
_WATCHED = (
    (_BaseDataLoaderIter, "__next__", "loader"),
    (DataProcessorPipeline, "__call__", "preprocessor"),
    (FieldGuidance, "observe", "potential field"),
    (FMPPolicy, "forward", "forward"),
    (DiffusionPolicy, "forward", "forward"),
    (Accelerator, "backward", "backward"),
    (Accelerator, "clip_grad_norm_", "gradient clipping"),
    (AcceleratedOptimizer, "step", "optimiser"),
    (AcceleratedOptimizer, "zero_grad", "optimiser"),
    (FMPPolicy, "update", "moving average"),
)


def measure() -> Iterator[Row]:
    """The rows of this part."""
    with TemporaryDirectory() as name:
        root = Path(name) / "maze"
        with redirect_stderr(StringIO()):
            collect_maze(
                "medium",
                root=root,
                repo_id="local/maze",
                n_episodes=N_EPISODES,
                n_steps=HORIZON,
                action_noise=0.0,
                seed=0,
                overwrite=False,
            )
        with threads(1):
            yield from _measure_loaders(root)
            yield from _measure_loaders_with_workers(root)
        yield from _measure_steps(root, SMALL)
        if torch.cuda.is_available():
            yield from _measure_steps(root, PAPER)


# (a), (b) The loaders.


def _measure_loaders(root: Path) -> Iterator[Row]:
    datasets: dict[str, Data] = {
        "pf2mp": _dataset(root, PF2MPConfig),
        "diffusion, 2 observations": _dataset(root, DiffusionConfig, n_obs_steps=2),
        "diffusion, 1 observation": _dataset(root, DiffusionConfig, n_obs_steps=1),
    }
    datasets["pf2mp-train"] = InMemoryDataset(_dataset(root, PF2MPConfig))
    batches = {name: cycle(_loader(dataset, n_workers=0)) for name, dataset in datasets.items()}
    times = time_in_turns({name: lambda it=it: next(it) for name, it in batches.items()}, n_rounds=9)
    case = f"loader, batch {BATCH_SIZE}, action window of {HORIZON}"
    for name in datasets:
        yield Row("training", case, f"samples/s, {name}", BATCH_SIZE / median(times[name]), "1/s")
    for name in ("diffusion, 2 observations", "diffusion, 1 observation"):
        value = median(other / ours for ours, other in zip(times["pf2mp"], times[name], strict=True))
        quantity = f"samples/s, pf2mp / {name}, both under lerobot-train"
        yield Row("training", case, quantity, value, "x", target=LOADER_TARGET, at_least=True)
    value = median(stock / ours for ours, stock in zip(times["pf2mp-train"], times["pf2mp"], strict=True))
    yield Row("training", case, "samples/s, pf2mp-train / lerobot-train", value, "x")


def _measure_loaders_with_workers(root: Path) -> Iterator[Row]:
    datasets = {
        "pf2mp": _dataset(root, PF2MPConfig),
        "diffusion": _dataset(root, DiffusionConfig, n_obs_steps=2),
    }
    times: dict[str, list[float]] = {name: [] for name in datasets}
    for _ in range(N_ROUNDS):
        for name, dataset in datasets.items():  # not in turns: workers read ahead
            batches = cycle(_loader(dataset, N_WORKERS))
            for _ in islice(batches, 4 * N_WORKERS + 1):  # what they had read ahead
                pass
            began = time.perf_counter()
            for _ in islice(batches, N_WORKER_BATCHES):
                pass
            times[name].append((time.perf_counter() - began) / N_WORKER_BATCHES)
            del batches
    case = f"loader with {N_WORKERS} workers, batch {BATCH_SIZE}, action window of {HORIZON}"
    for name in datasets:
        yield Row("training", case, f"samples/s, {name}", BATCH_SIZE / median(times[name]), "1/s")
    value = median(other / ours for ours, other in zip(times["pf2mp"], times["diffusion"], strict=True))
    quantity = "samples/s, pf2mp / diffusion, 2 observations, both under lerobot-train"
    yield Row("training", case, quantity, value, "x", target=LOADER_TARGET, at_least=True)


def _dataset(root: Path, policy: Callable[..., PreTrainedConfig], **options: Any) -> LeRobotDataset:
    """The dataset with the windows that lerobot-train asks for on behalf of a policy."""
    config = policy(horizon=HORIZON, n_action_steps=HORIZON // 2, device="cpu", push_to_hub=False, **options)
    dataset, _ = make_train_eval_datasets(
        TrainPipelineConfig(dataset=DatasetConfig(repo_id="local/maze", root=str(root)), policy=config)
    )
    return dataset


def _loader(dataset: Any, n_workers: int) -> DataLoader[Any]:
    """The loader that lerobot-train makes."""
    sampler = EpisodeAwareSampler(
        dataset.meta.episodes["dataset_from_index"],
        dataset.meta.episodes["dataset_to_index"],
        episode_indices_to_use=dataset.episodes,
        shuffle=True,
        seed=0,
        absolute_to_relative_idx=dataset.absolute_to_relative_idx,
    )
    return DataLoader(
        dataset,
        batch_size=BATCH_SIZE,
        sampler=sampler,
        num_workers=n_workers,
        prefetch_factor=4 if n_workers else None,
        persistent_workers=n_workers > 0,
        multiprocessing_context="spawn" if n_workers else None,
    )


# (b), (c) The steps.


@dataclass(frozen=True)
class Steps:
    """What the steps of a training run cost.

    Args:
        seconds: A step [s].
        parts: The time of each of its parts [s]; empty if only the whole was measured.
    """

    seconds: float
    parts: dict[str, float]


def _measure_steps(root: Path, setting: Setting) -> Iterator[Row]:
    n_threads = torch.get_num_threads() if setting.device == "cpu" else 0
    pf2mp, diffusion = ["--policy.type=pf2mp"], ["--policy.type=diffusion", "--policy.n_obs_steps=1"]
    runs: dict[str, Callable[[], Steps]] = {
        "pf2mp-train": lambda: train_steps(pf2mp_train.main, root, setting, pf2mp, N_STEPS),
        "lerobot-train": lambda: train_steps(lerobot_train.main, root, setting, pf2mp, N_STOCK_STEPS),
        "lerobot-train, diffusion": lambda: train_steps(
            lerobot_train.main, root, setting, diffusion, N_STOCK_STEPS
        ),
    }
    found: dict[str, list[Steps]] = {name: [] for name in runs}
    for _ in range(N_ROUNDS):
        for name, run in runs.items():
            found[name].append(run())
    for name, steps in found.items():
        value = 1 / median(step.seconds for step in steps)
        yield Row("training", setting.name, f"steps/s, {name}", value, "1/s", n_threads)
    for name in ("lerobot-train", "lerobot-train, diffusion"):
        value = median(
            stock.seconds / ours.seconds
            for ours, stock in zip(found["pf2mp-train"], found[name], strict=True)
        )
        yield Row("training", setting.name, f"steps/s, pf2mp-train / {name}", value, "x", n_threads)
    watched = train_steps(pf2mp_train.main, root, setting, pf2mp, N_STEPS, is_watched=True)
    yield from _shares(watched, setting.name, n_threads)


def _shares(steps: Steps, case: str, n_threads: int) -> Iterator[Row]:
    shares = {name: 100 * seconds / steps.seconds for name, seconds in steps.parts.items()}
    outside = 100 - sum(shares.get(name, 0.0) for name in NETWORK)
    yield Row(
        "training",
        case,
        "share of pf2mp-train's step outside network and optimiser",
        outside,
        "%",
        n_threads,
        target=OUTSIDE_TARGET,
    )
    shares["everything else"] = 100 - sum(shares.values())
    for name, share in sorted(shares.items(), key=lambda item: -item[1]):
        yield Row("training", case, f"share of {name} in pf2mp-train's step", share, "%", n_threads)


def train_steps(
    train: Train, root: Path, setting: Setting, options: list[str], n_steps: int, is_watched: bool = False
) -> Steps:
    """Trains for some steps with one of the commands, after a warm-up, and says what a step took.

    Args:
        train: The command's function.
        root: The dataset.
        setting: What is trained where.
        options: More of the command's options.
        n_steps: Steps that are timed.
        is_watched: Whether to measure the parts too; a GPU is then waited for after each of them.

    Returns:
        The cost of a step, from the beginning of one update of the weights to that of the next one.
    """
    stopwatch = _StepStopwatch(n_steps)
    with ExitStack() as stack:
        output_dir = Path(stack.enter_context(TemporaryDirectory())) / "run"
        arguments = [*_options(root, setting, N_WARM_UP_STEPS + n_steps + 1, output_dir), *options]
        stack.enter_context(patch.object(sys, "argv", ["train", *arguments]))
        # pf2mp-train replaces it for its own process, which this one is.
        make_datasets = lerobot_train.make_train_eval_datasets
        stack.enter_context(patch.object(lerobot_train, "make_train_eval_datasets", make_datasets))
        if is_watched:
            for owner, function, name in _WATCHED:
                stack.enter_context(stopwatch.on(owner, function, name))
        update = stopwatch.counting(lerobot_train.update_policy)
        stack.enter_context(patch.object(lerobot_train, "update_policy", update))
        for redirect in (redirect_stdout, redirect_stderr):
            stack.enter_context(redirect(StringIO()))
        train()
    return stopwatch.steps()


def _options(root: Path, setting: Setting, n_steps: int, output_dir: Path) -> list[str]:
    return [
        "--dataset.repo_id=local/maze",
        f"--dataset.root={root}",
        f"--policy.device={setting.device}",
        "--policy.push_to_hub=false",
        f"--policy.horizon={HORIZON}",
        f"--policy.n_action_steps={HORIZON}",
        f"--policy.drop_n_last_frames={HORIZON - 1}",
        f"--policy.down_dims={list(setting.down_dims)}",
        f"--batch_size={setting.batch_size}",
        "--num_workers=0",
        f"--steps={n_steps}",
        "--save_checkpoint=false",
        "--env_eval_freq=0",
        f"--output_dir={output_dir}",
    ]


class _StepStopwatch(Stopwatch):
    """A stopwatch for whole steps, which waits for the GPU at the end of everything it times.

    Args:
        n_steps: Steps that count, after the warm-up.
    """

    def __init__(self, n_steps: int) -> None:
        super().__init__()
        self._n_steps = n_steps
        self._n_updates = 0
        self._began = 0.0
        self._steps: Steps | None = None

    def counting(self, update: Callable[..., Any]) -> Callable[..., Any]:
        """The update of the weights, which begins and ends the measurement."""

        def counted(*args: Any, **kwargs: Any) -> Any:
            if self._n_updates in (N_WARM_UP_STEPS, N_WARM_UP_STEPS + self._n_steps):
                synchronise()
                now = time.perf_counter()
                if self._n_updates > N_WARM_UP_STEPS:
                    parts = {name: seconds / self._n_steps for name, seconds in self.seconds.items()}
                    self._steps = Steps((now - self._began) / self._n_steps, parts)
                self.seconds.clear()
                self._began = now
            self._n_updates += 1
            return update(*args, **kwargs)

        return counted

    def steps(self) -> Steps:
        """What was measured."""
        if self._steps is None:
            raise RuntimeError(f"training must take more than {self._n_steps} steps, got {self._n_updates}")
        return self._steps

    def _timed(self, function: Callable[..., Any], name: str) -> Callable[..., Any]:
        def synchronised(*args: Any, **kwargs: Any) -> Any:
            try:
                return function(*args, **kwargs)
            finally:
                synchronise()

        return super()._timed(synchronised, name)
