# SPDX-License-Identifier: Apache-2.0
"""The command pf2mp-demo."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass
class DemoConfig:
    """Runs the whole pipeline: demonstrations, training, evaluation with guidance off and on, a table and a figure.

    Finished stages are skipped, so the command can be interrupted and called again.

    Examples:
        pf2mp-demo --output_dir=demo
        pf2mp-demo --output_dir=demo_medium --task=maze_medium --steps=1000
    """

    # Folder of all files that the demo writes.
    output_dir: Path = Path("demo")
    # maze_umaze, maze_medium or maze_large.
    task: str = "maze_large"
    # Number of demonstrations.
    n_demonstrations: int = 4000
    # Training steps of 64 trajectories.
    steps: int = 2000
    # Evaluation episodes for each policy.
    n_episodes: int = 500
    # Seed of demonstrations, training and evaluation.
    seed: int = 0


def main(config: DemoConfig) -> None:
    """Runs the command."""
    from lerobot_pf2mp.commands.demo_stages import run_demo
    from lerobot_pf2mp.process.claims import claimed

    output_dir = config.output_dir.expanduser()
    with claimed(output_dir):
        run_demo(
            output_dir,
            task=config.task,
            n_demonstrations=config.n_demonstrations,
            steps=config.steps,
            n_episodes=config.n_episodes,
            seed=config.seed,
        )
