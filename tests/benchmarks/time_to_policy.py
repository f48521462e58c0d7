# SPDX-License-Identifier: Apache-2.0
"""How many minutes of training it takes from a dataset to FMP's final quality in the medium maze.

Three ways: FMP with pf2mp-train, FMP with lerobot-train, and LeRobot's diffusion policy with lerobot-train. Both commands
make the same weights from the same data bit for bit, so policies are trained and evaluated with pf2mp-train; with
lerobot-train some steps are trained, which tells its pace. Start-up and the writing of checkpoints count, evaluation does
not.

    python tests/benchmarks/time_to_policy.py

takes 20 minutes on two cores. ``make bench`` does it too.
"""

from __future__ import annotations

import logging
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import redirect_stderr
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory

import draccus
from harness import Row
from report import make_table, write_report
from tqdm import tqdm

from lerobot_pf2mp import PF2MPMazeEnv
from lerobot_pf2mp.benchmark.evaluation import evaluate_all
from lerobot_pf2mp.benchmark.spec import NONE, BenchmarkSpec, Job
from lerobot_pf2mp.dataset_tools.maze.collect_maze import collect_maze
from lerobot_pf2mp.results.rate import Rate

PART = "time to a policy"
HORIZON = 80
_POLICIES = {
    "fmp": ["--policy.type=fmp"],
    # As in eval_configs/train_maze_medium_small_diffusion.yaml.
    "diffusion": [
        "--policy.type=diffusion",
        "--policy.n_obs_steps=1",
        "--policy.normalization_mapping={STATE: MIN_MAX, ENV: MIN_MAX, ACTION: MIN_MAX}",
        "--policy.noise_scheduler_type=DDIM",
        "--policy.num_inference_steps=5",
        "--policy.prediction_type=sample",
        "--policy.scheduler_warmup_steps=200",
    ],
}


@dataclass
class TimeToPolicyConfig:
    """Measures the minutes of training from a dataset to FMP's final quality in the medium maze.

    Examples:
        python tests/benchmarks/time_to_policy.py --steps=3000 --diffusion_steps=6000 --every=500
    """

    # Demonstrations in the dataset.
    n_demonstrations: int = 1000
    # FMP's training steps; its quality after these is the one to reach.
    steps: int = 3000
    # Training steps of the diffusion policy.
    diffusion_steps: int = 6000
    # Steps between checkpoints, each of which is evaluated.
    every: int = 500
    # Steps with lerobot-train, which tell its pace.
    stock_steps: int = 40
    # Episodes for each checkpoint.
    n_episodes: int = 200
    # Samples in a step.
    batch_size: int = 64
    # Channels of the U-Net's levels.
    down_dims: tuple[int, ...] = (32, 64, 128)
    # Processes that evaluate.
    n_processes: int = 2
    # Folder of bench.csv, table.md and run.json, beside the other parts of the suite.
    output_dir: Path = Path(__file__).parents[2] / "results" / "bench"


@dataclass(frozen=True)
class Quality:
    """How a checkpoint drives.

    Args:
        collision: Episodes with a collision.
        success: Episodes that reach the goal.
    """

    collision: Rate
    success: Rate

    def reaches(self, other: Quality) -> bool:
        """Whether neither rate is worse than the 95 % interval of another one's allows."""
        return (
            self.collision.value <= other.collision.interval[1]
            and self.success.value >= other.success.interval[0]
        )


def measure() -> Iterator[Row]:
    """The rows of this part, with the default options."""
    return time_to_policy(TimeToPolicyConfig())


def time_to_policy(config: TimeToPolicyConfig) -> Iterator[Row]:
    """The minutes to FMP's final quality for each way; those of all its steps where it is not reached."""
    case = (
        f"medium maze, {config.n_demonstrations} demonstrations, U-Net {tuple(config.down_dims)}, "
        f"batch {config.batch_size}"
    )
    with TemporaryDirectory() as name:
        folder = Path(name)
        with redirect_stderr(StringIO()):
            collect_maze(
                "medium",
                root=folder / "data",
                repo_id="local/maze_medium",
                n_episodes=config.n_demonstrations,
                n_steps=HORIZON,
                action_noise=0.0,
                seed=0,
                overwrite=False,
            )
        minutes: dict[str, dict[int, float]] = {}
        for policy in _POLICIES:
            run = folder / policy
            steps = config.steps if policy == "fmp" else config.diffusion_steps
            minutes[policy] = _train("pf2mp-train", policy, config, folder / "data", run, steps)
            half = max(1, config.stock_steps // 2)
            stock = _train(
                "lerobot-train", policy, config, folder / "data", folder / f"{policy}_stock", 2 * half, half
            )
            minutes[f"{policy} stock"] = _extrapolated(stock, list(minutes[policy]))
        qualities = {policy: _evaluate(folder / policy, config) for policy in _POLICIES}
    goal = qualities["fmp"][config.steps]
    for policy, by_step in qualities.items():
        for step, quality in by_step.items():
            for what, rate in (("collisions", quality.collision), ("successes", quality.success)):
                quantity = f"{policy}, {what} after {step} steps"
                yield Row(PART, case, quantity, 100 * rate.value, "%", threads=config.n_processes)
    for way, policy, times in (
        ("fmp, pf2mp-train", "fmp", minutes["fmp"]),
        ("fmp, lerobot-train", "fmp", minutes["fmp stock"]),
        ("diffusion, lerobot-train", "diffusion", minutes["diffusion stock"]),
        ("diffusion, pf2mp-train", "diffusion", minutes["diffusion"]),
    ):
        reached = [step for step, quality in qualities[policy].items() if quality.reaches(goal)]
        step = min(reached, default=max(times))
        quantity = f"time to FMP's final quality, {way}" if reached else f"time without reaching it, {way}"
        yield Row(PART, case, f"{quantity}, {step} steps", times[step], "min", threads=config.n_processes)


def _train(
    command: str,
    policy: str,
    config: TimeToPolicyConfig,
    data: Path,
    output_dir: Path,
    steps: int,
    every: int | None = None,
) -> dict[int, float]:
    """Trains with a command as a user calls it; the time from its start to each checkpoint, by step [min]."""
    began = time.time()
    subprocess.run(
        [
            str(Path(sys.executable).with_name(command)),
            "--dataset.repo_id=local/maze_medium",
            f"--dataset.root={data}",
            *_POLICIES[policy],
            "--policy.device=cpu",
            "--policy.push_to_hub=false",
            f"--policy.horizon={HORIZON}",
            f"--policy.n_action_steps={HORIZON}",
            f"--policy.drop_n_last_frames={HORIZON - 1}",
            f"--policy.down_dims={list(config.down_dims)}",
            "--policy.optimizer_lr=0.001",
            f"--batch_size={config.batch_size}",
            "--num_workers=0",
            f"--steps={steps}",
            f"--save_freq={every or config.every}",
            "--env_eval_freq=0",
            "--seed=0",
            f"--output_dir={output_dir}",
        ],
        check=True,
        capture_output=True,
    )
    return {
        step: ((path / "training_state/training_step.json").stat().st_mtime - began) / 60
        for step, path in _checkpoints(output_dir).items()
    }


def _checkpoints(output_dir: Path) -> dict[int, Path]:
    return {
        int(path.name): path for path in sorted((output_dir / "checkpoints").iterdir()) if path.name != "last"
    }


def _extrapolated(minutes: dict[int, float], steps: list[int]) -> dict[int, float]:
    """The time to other steps, at the pace between the first and the last checkpoint."""
    first, last = min(minutes), max(minutes)
    pace = (minutes[last] - minutes[first]) / (last - first)
    return {step: minutes[first] + pace * (step - first) for step in steps}


def _evaluate(output_dir: Path, config: TimeToPolicyConfig) -> dict[int, Quality]:
    policies = {str(step): str(path / "pretrained_model") for step, path in _checkpoints(output_dir).items()}
    spec = BenchmarkSpec(
        env=PF2MPMazeEnv(),
        tasks=("MazeMedium-v0",),
        policies=policies,
        guidances=(NONE,),
        variants={"": {}},
        n_repeats=1,
        n_episodes=config.n_episodes,
    )
    jobs = [Job("MazeMedium-v0", step, path, NONE, "", 0, 0) for step, path in policies.items()]
    found = {}
    for rows in evaluate_all(spec, jobs, config.n_processes):
        found[int(rows[0].policy)] = Quality(
            collision=Rate(sum(bool(row.collision) for row in rows), len(rows)),
            success=Rate(sum(row.success for row in rows), len(rows)),
        )
    return found


def main() -> None:
    """Runs the measurement."""
    config = draccus.parse(TimeToPolicyConfig)
    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore")
    rows = list(time_to_policy(config))
    write_report(config.output_dir, rows)
    tqdm.write(make_table(rows))


if __name__ == "__main__":
    main()
