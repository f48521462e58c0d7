# SPDX-License-Identifier: Apache-2.0
"""What wrong values among the demonstrations do to a guided policy.

The weights stay as they are. Of the actions that the checkpoint's field was fitted to, a share is replaced by wrong ones
of a given size: in one coordinate, chosen at random, plus or minus the size in units of half the range of the data. The
field is fitted again, with the rule of before and with that of now, and the policy is evaluated on the same episodes.

    python tests/benchmarks/glitches.py --checkpoint=CHECKPOINT --output_dir=results/ablations/glitches

takes a quarter of an hour for the 14 fields of the large maze with 500 episodes each, once with a single plan and once with
plans that are checked and drawn again.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import draccus
import torch
from tqdm import tqdm

from lerobot_pf2mp import PF2MPMazeEnv, load_policy
from lerobot_pf2mp.benchmark.run import run_benchmark
from lerobot_pf2mp.benchmark.spec import BenchmarkSpec, Guidance
from lerobot_pf2mp.policies.guided.potential_field_step import PotentialFieldProcessorStep

# Share of the actions, and size of the wrong values.
CASES = [(0.0, 0.0), (0.0003, 10.0), (0.001, 5.0), (0.01, 0.7), (0.01, 1.5), (0.01, 10.0), (0.01, 1000.0)]
RULES = {"before": "nothing", "now": "episode"}


@dataclass
class GlitchesConfig:
    """Evaluates a maze policy whose field was fitted to wrong values too."""

    # The pretrained_model folder of a pf2mp policy.
    checkpoint: Path = Path("outputs/MazeLarge-v0/pf2mp_0/checkpoints/last/pretrained_model")
    # Folder of the results.
    output_dir: Path = Path("results/ablations/glitches")
    # Folder for the checkpoints with the wrong values.
    work_dir: Path = Path("outputs/glitches")
    task: str = "MazeLarge-v0"
    n_episodes: int = 500
    n_processes: int = 2
    seed: int = 0


def main(config: GlitchesConfig) -> None:
    """Makes the fields and evaluates them."""
    policies = {}
    for share, size in tqdm(CASES, desc="Fields", unit="case"):
        for rule, leave_out in RULES.items():
            case = f"{100 * share:g} % of size {size:g}, {rule}" if share else f"clean, {rule}"
            folder = config.work_dir / f"{share}_{size}_{rule}"
            h = write_checkpoint(config, folder, share, size, leave_out)
            policies[f"{case}, h = {h:.4f}"] = str(folder)
    spec = BenchmarkSpec(
        env=PF2MPMazeEnv(task=config.task),
        tasks=(config.task,),
        policies=policies,
        guidances=tuple(Guidance.parse("proximal:0.8")),
        variants={  # what the field alone does, and with plans checked by that field
            "one plan": {"max_plans": 1, "guidance_region": "everywhere"},
            "checked plans": {},
        },
        seeds=(0,),
        n_repeats=1,
        n_episodes=config.n_episodes,
    )
    run_benchmark(spec, config.output_dir, n_processes=config.n_processes)
    print((config.output_dir / "table.md").read_text(encoding="utf-8"))


def write_checkpoint(
    config: GlitchesConfig, folder: Path, share: float, size: float, leave_out: str
) -> float:
    """Writes the checkpoint with a field fitted anew to actions of which a share is wrong; returns its bandwidth h."""
    _, preprocessor, _ = load_policy(config.checkpoint, device="cpu")
    shutil.copytree(config.checkpoint, folder, dirs_exist_ok=True)
    step = next(step for step in preprocessor.steps if isinstance(step, PotentialFieldProcessorStep))
    demonstrations = step.demonstrations
    generator = torch.Generator().manual_seed(config.seed)
    state = demonstrations.state_dict()
    points = state["points"].clone()
    wrong = torch.randperm(len(points), generator=generator)[: round(share * len(points))]
    coordinate = torch.randint(points.shape[1], (len(wrong),), generator=generator)
    sign = 2.0 * torch.randint(2, (len(wrong),), generator=generator) - 1
    points[wrong, coordinate] = sign * size
    demonstrations.load_state_dict({**state, "points": points})
    demonstrations.settings = replace(demonstrations.settings, leave_out=leave_out)
    demonstrations._forget_field()  # the state holds that of the right values
    preprocessor.save_pretrained(folder)
    written = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    written["field_leave_out"] = leave_out
    (folder / "config.json").write_text(json.dumps(written), encoding="utf-8")
    return demonstrations.field().bandwidth


if __name__ == "__main__":
    main(draccus.parse(GlitchesConfig))
