# SPDX-License-Identifier: Apache-2.0
"""The command pf2mp-benchmark."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot.envs.configs import EnvConfig

from lerobot_pf2mp.envs.configs.maze import PF2MPMazeEnv

if TYPE_CHECKING:
    from lerobot_pf2mp.benchmark.spec import BenchmarkSpec


@dataclass
class BenchmarkConfig:
    """Compares policies on the same start-goal pairs and the same prior noise; writes CSV files and tables.

    Called again, it continues where it was interrupted, or adds new results. {seed} and {task} in the path of a checkpoint
    are replaced by the training seed and the task. Policies without guidance, also those of LeRobot itself, are evaluated
    once for each seed and repeat; pf2mp and dppf policies once for each kind of guidance. Those check all their plans, and
    without guidance they draw no other one for a flagged one, unless a variant names max_plans.

    Examples:
        pf2mp-benchmark --policies='{pf2mp: outputs/maze_large/checkpoints/last/pretrained_model}' \
--output_dir=outputs/benchmark
        pf2mp-benchmark --config_path=eval_configs/benchmark_maze.yaml --n_processes=2
        pf2mp-benchmark --policies='{pf2mp: you/your_pf2mp, act: you/your_act}' \
--guidance='[none, "proximal:0.08,0.8,8"]' --n_episodes=100 --output_dir=outputs/comparison
    """

    # Checkpoints by name: pretrained_model folders or repositories on the Hub, of any LeRobot policy.
    policies: dict[str, str] = field(default_factory=dict)
    # The environment and its options.
    env: EnvConfig = field(default_factory=PF2MPMazeEnv)
    # Tasks of the environment; by default its own one.
    tasks: list[str] = field(default_factory=list)
    # Kinds of guidance: none, or INTEGRATOR:LAMBDA,LAMBDA,...
    guidance: list[str] = field(default_factory=lambda: ["none", "proximal:0.8"])
    # Changes to the policies' options by name, for example {wide: {field_bandwidth: 0.1}}.
    variants: dict[str, dict[str, Any]] = field(default_factory=lambda: {"": {}})
    # Training seeds, for {seed} in the checkpoints' paths.
    seeds: list[int] = field(default_factory=lambda: [0])
    # Repeats with other prior noise.
    n_repeats: int = 3
    # Start-goal pairs, the same for every policy and every repeat.
    n_episodes: int = 500
    # Seed of the first pair; pair i has this seed + i.
    episode_seed: int = 100000
    # Number of parallel environments.
    batch_size: int = 50
    # Device on which the policies run.
    device: str = "cpu"
    # Number of parallel processes, with one thread each; 1 uses all threads in one process.
    n_processes: int = 1
    # Classes of processor steps of a checkpoint that may be imported although they are not registered, by full names.
    trust: list[str] = field(default_factory=list)
    # Folder of episodes.csv, summary.csv, table.md, table.tex and run.json.
    output_dir: Path = Path("outputs/benchmark")


def main(config: BenchmarkConfig) -> None:
    """Runs the command."""
    from lerobot_pf2mp.benchmark.run import run_benchmark

    output_dir = config.output_dir.expanduser()
    run_benchmark(make_spec(config), output_dir, n_processes=config.n_processes)
    print(f"{(output_dir / 'table.md').read_text(encoding='utf-8')}\nWrote {output_dir}.")


def make_spec(config: BenchmarkConfig) -> BenchmarkSpec:
    """The specification of the benchmark for `run_benchmark`."""
    from lerobot_pf2mp.benchmark.spec import BenchmarkSpec, Guidance

    return BenchmarkSpec(
        env=config.env,
        tasks=tuple(config.tasks or [str(config.env.task)]),
        policies=config.policies,
        guidances=tuple(guidance for text in config.guidance for guidance in Guidance.parse(text)),
        variants=config.variants,
        seeds=tuple(config.seeds),
        n_repeats=config.n_repeats,
        n_episodes=config.n_episodes,
        episode_seed=config.episode_seed,
        batch_size=config.batch_size,
        device=config.device,
    )
