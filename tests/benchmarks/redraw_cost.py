# SPDX-License-Identifier: Apache-2.0
"""What checking plans, and drawing flagged ones again, costs over the plans of many episodes.

    python tests/benchmarks/redraw_cost.py '--checkpoints={MazeLarge-v0: CHECKPOINT, MazeMedium-v0: CHECKPOINT}'

For the first plan of each episode, the same observation and prior noise, a call with one plan and no check and a call with
the checkpoint's own ``max_plans`` are timed in turns, for a single robot, on one thread. The ratio of the mean times says
what a user waits for on average; its interval is a bootstrap over the episodes. Starts and goals are those of
pf2mp-benchmark.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import torch
from lerobot.envs.utils import NEW_ROLLOUT_OPTION, preprocess_observation
from tqdm import tqdm

from lerobot_pf2mp import PF2MPMazeEnv, load_policy
from lerobot_pf2mp.process.atomic_files import file_written_beside

N_RESAMPLED = 10_000


@dataclass
class RedrawCostConfig:
    """Times plans of maze policies with and without check and redraw."""

    # The pretrained_model folders of guided policies by task.
    checkpoints: dict[str, Path] = field(default_factory=dict)
    # Folder of the results.
    output_dir: Path = Path("results/ablations/redraw_cost")
    n_episodes: int = 500
    # Seed of the first episode.
    episode_seed: int = 1000


def main(config: RedrawCostConfig) -> None:
    """Measures all tasks and writes the table."""
    torch.set_num_threads(1)
    rows = [measure(task, path, config) for task, path in config.checkpoints.items()]
    config.output_dir.mkdir(parents=True, exist_ok=True)
    for name, text in {
        "table.md": make_table(rows),
        "redraw_cost.json": json.dumps(rows, indent=1) + "\n",
    }.items():
        with file_written_beside(config.output_dir / name) as file:
            file.write_text(text, encoding="utf-8")
    print(make_table(rows))


def measure(task: str, checkpoint: Path, config: RedrawCostConfig) -> dict[str, Any]:
    """The mean times of a task's plans [ms], and their ratio."""
    policy, preprocessor, _ = load_policy(checkpoint, device="cpu")
    max_plans = policy.config.max_plans
    (env,) = next(iter(PF2MPMazeEnv(task=task).create_envs(1, use_async_envs=False).values())).values()
    times = {1: [], max_plans: []}
    n_redrawn = 0
    for episode in tqdm(range(config.n_episodes), desc=task, unit="episode"):
        observation, _ = env.reset(
            seed=[config.episode_seed + episode], options={NEW_ROLLOUT_OPTION: episode == 0}
        )
        batch = preprocessor({**preprocess_observation(observation), "task": [""]})
        order = (1, max_plans) if episode % 2 else (max_plans, 1)
        for n_plans in order:
            policy.config.max_plans = n_plans
            policy.reset()
            torch.manual_seed(episode)
            began = time.perf_counter()
            with torch.inference_mode():
                policy.select_action(dict(batch))
            times[n_plans].append(1000 * (time.perf_counter() - began))
            if n_plans > 1 and policy.plans is not None:
                n_redrawn += int((policy.plans.n_drawn > 1).sum())
    single, checked = (np.array(times[n]) for n in (1, max_plans))
    rng = np.random.default_rng(0)
    chosen = rng.integers(len(single), size=(N_RESAMPLED, len(single)))
    ratios = checked[chosen].mean(axis=1) / single[chosen].mean(axis=1)
    low, high = np.quantile(ratios, [0.025, 0.975])
    return {
        "task": task,
        "policy": policy.config.type,
        "max_plans": max_plans,
        "episodes": config.n_episodes,
        "redrawn_percent": 100 * n_redrawn / config.n_episodes,
        "one_plan_ms": float(single.mean()),
        "checked_ms": float(checked.mean()),
        "ratio": float(checked.mean() / single.mean()),
        "interval": [float(low), float(high)],
        "torch": torch.__version__,
    }


def make_table(rows: list[dict[str, Any]]) -> str:
    """The rows as Markdown."""
    lines = [
        "| task | policy | K | drawn again [%] | one plan, unchecked [ms] | with the check [ms] | ratio | 95 % interval |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        low, high = row["interval"]
        lines.append(
            f"| {row['task']} | {row['policy']} | {row['max_plans']} | {row['redrawn_percent']:.1f} | "
            f"{row['one_plan_ms']:.1f} | {row['checked_ms']:.1f} | {row['ratio']:.3f} | {low:.3f} to {high:.3f} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main(draccus.parse(RedrawCostConfig))
