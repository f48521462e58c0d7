# SPDX-License-Identifier: Apache-2.0
"""How often plans as good as a demonstration are flagged when a field has few of them, over many draws of those few.

    python tests/benchmarks/few_demonstrations.py '--checkpoints={maze: CHECKPOINT}' '--datasets={maze: data/maze_large}'

The promise of the check, at most 1/(n + 1) with n demonstrations, is one of the mean over draws: which n were recorded is
part of the luck. Each draw takes n episodes of a dataset at random, fits a field and its calibration to them, and judges 300
others. The checkpoint gives the normalisation and the length of plans only. The datasets' episodes must be single plans.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import torch
from plan_check import plans_of
from tqdm import tqdm

from lerobot_pf2mp import load_policy
from lerobot_pf2mp.loading import loaded_demonstrations
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.policies.plans.plan_choice import PlanCheck
from lerobot_pf2mp.process.atomic_files import file_written_beside

N_JUDGED = 300


@dataclass
class FewDemonstrationsConfig:
    """Measures the check of plans with few demonstrations."""

    # Checkpoints by name, for their normalisation.
    checkpoints: dict[str, Path] = field(default_factory=dict)
    # Datasets by the same names.
    datasets: dict[str, Path] = field(default_factory=dict)
    # Demonstrations of a field.
    n_demonstrations: int = 20
    n_draws: int = 40
    seed: int = 0
    output_dir: Path = Path("results/ablations/few_demonstrations")


def main(config: FewDemonstrationsConfig) -> None:
    """Measures, and writes the table."""
    torch.set_num_threads(1)
    found = {name: measure(path, config.datasets[name], config) for name, path in config.checkpoints.items()}
    lines = [
        "| task | demonstrations | at most [%] | flagged, mean of the draws [%] | largest of a draw [%] | draws |",
        "|---|---|---|---|---|---|",
        *(
            f"| {name} | {config.n_demonstrations} | {100 / (config.n_demonstrations + 1):.1f} | "
            f"{100 * np.mean(shares):.1f} ± {100 * np.std(shares) / len(shares) ** 0.5:.1f} | {100 * max(shares):.1f} | "
            f"{len(shares)} |"
            for name, shares in found.items()
        ),
    ]
    config.output_dir.mkdir(parents=True, exist_ok=True)
    table = "\n".join(lines) + "\n"
    for name, text in {"table.md": table, "few_demonstrations.json": json.dumps(found) + "\n"}.items():
        with file_written_beside(config.output_dir / name) as file:
            file.write_text(text, encoding="utf-8")
    print(table)


def measure(checkpoint: Path, data: Path, config: FewDemonstrationsConfig) -> list[float]:
    """The share of flagged plans of each draw."""
    policy, preprocessor, _ = load_policy(checkpoint, device="cpu")
    n_actions = policy.config.n_action_steps
    places = loaded_demonstrations(preprocessor).calibration.places
    states, chunks = plans_of(data, n_actions, preprocessor.steps)
    settings = replace(policy.config.field_settings, n_points=config.n_demonstrations * n_actions)
    rng = np.random.default_rng(config.seed)
    shares = []
    for _ in tqdm(range(config.n_draws), desc=data.name, unit="draw"):
        drawn = rng.choice(len(chunks), config.n_demonstrations + N_JUDGED, replace=False)
        shown, judged = np.sort(drawn[: config.n_demonstrations]), drawn[config.n_demonstrations :]
        demonstrations = DemonstratedActions(settings)
        demonstrations.observe(
            chunks[shown],
            None,
            torch.from_numpy(shown * n_actions),
            torch.from_numpy(shown),
            settings=settings,
            n_executed=n_actions,
            states=states[shown],
            places=places,
        )
        threshold: Any = demonstrations.plan_threshold(settings, n_actions, 1e-6)
        starts = (
            demonstrations.place_of(states[judged])
            if demonstrations.starts_at_state(settings)
            else chunks[judged][:, 0]
        )
        check = PlanCheck(demonstrations.field(settings), threshold.log_density)
        shares.append((check(starts, chunks[judged]).amin(dim=1) < 0).double().mean().item())
    return shares


if __name__ == "__main__":
    main(draccus.parse(FewDemonstrationsConfig))
