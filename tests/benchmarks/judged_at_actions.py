# SPDX-License-Identifier: Apache-2.0
"""What the check of plans misses if it looks at the actions alone, not at the way between them.

    python tests/benchmarks/judged_at_actions.py --checkpoint=CHECKPOINT

The threshold is calibrated in the same way, on actions alone too. The rows compare with those of
eval_configs/ablations/plans.yaml. It takes a minute for the four rows of the large maze with 500 episodes each.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import draccus
import torch
from torch import Tensor

from lerobot_pf2mp import PF2MPMazeEnv
from lerobot_pf2mp.benchmark.run import run_benchmark
from lerobot_pf2mp.benchmark.spec import BenchmarkSpec, Guidance
from lerobot_pf2mp.policies.plans.calibration import PlanCalibration


@dataclass
class JudgedAtActionsConfig:
    """Evaluates a maze policy whose plans are checked at their actions alone."""

    # The pretrained_model folder of a pf2mp policy.
    checkpoint: Path = Path("outputs/MazeLarge-v0/pf2mp_0/checkpoints/last/pretrained_model")
    # Folder of the results.
    output_dir: Path = Path("results/ablations/judged_at_actions")
    task: str = "MazeLarge-v0"
    n_episodes: int = 500


def density_at_actions(
    log_density: Callable[[Tensor, Tensor], Tensor],
    ways: Tensor,
    bandwidth: float,
    periods: Tensor | None = None,
) -> Tensor:
    """The log density of each action; arguments and shape as of `way_log_density`."""
    del bandwidth, periods
    n_ways, n_corners, dim = ways.shape
    pieces = torch.arange(n_ways * (n_corners - 1), device=ways.device)
    return log_density(ways[:, 1:].reshape(-1, dim), pieces).view(n_ways, -1)


def main(config: JudgedAtActionsConfig) -> None:
    """Evaluates the policy."""
    spec = BenchmarkSpec(
        env=PF2MPMazeEnv(task=config.task),
        tasks=(config.task,),
        policies={"pf2mp": str(config.checkpoint)},
        guidances=tuple(guidance for text in ("none", "proximal:0.8") for guidance in Guidance.parse(text)),
        variants={f"K = {k}, actions alone": {"max_plans": k} for k in (1, 8)},
        seeds=(0,),
        n_repeats=1,
        n_episodes=config.n_episodes,
    )
    restore = PlanCalibration.restore

    def restore_plans(self: PlanCalibration, *arguments: object) -> None:
        restore(self, *arguments)  # type: ignore[arg-type]
        self.forget_scores()  # those of the file are of the ways

    plans = "lerobot_pf2mp.policies.plans"
    with (
        patch(f"{plans}.plan_choice.way_log_density", density_at_actions),
        patch(f"{plans}.demonstrated_plans.way_log_density", density_at_actions),
        patch.object(PlanCalibration, "restore", restore_plans),
    ):
        run_benchmark(spec, config.output_dir, n_processes=1)
    print((config.output_dir / "table.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main(draccus.parse(JudgedAtActionsConfig))
