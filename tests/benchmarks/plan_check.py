# SPDX-License-Identifier: Apache-2.0
"""What the check of plans and guidance do to perfect plans: demonstrations that the field does not know.

    pf2mp-collect --task=maze_large --n_episodes=500 --seed=12345 --root=data/fresh/maze_large
    python tests/benchmarks/plan_check.py --checkpoints='{maze: CHECKPOINT}' --fresh='{maze: data/fresh/maze_large}'

For each name it measures on how many fresh demonstrations the way is flagged, and how far guidance moves them: a velocity
that leads from noise exactly to a demonstration, a perfect network, is integrated with the guide of the checkpoint in each
region. Distances are in the units of the actions.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor
from tqdm import tqdm

from lerobot_pf2mp import load_policy
from lerobot_pf2mp.fit_field import _normalise
from lerobot_pf2mp.flow_matching import integrate
from lerobot_pf2mp.guidance import make_guide
from lerobot_pf2mp.loading import loaded_demonstrations
from lerobot_pf2mp.policies.plans.plan_choice import PlanCheck
from lerobot_pf2mp.process.atomic_files import file_written_beside
from lerobot_pf2mp.results.rate import Rate

RATES = (0.01, 0.05, 0.1)
REGIONS = (
    ("everywhere", 0.5),
    ("unsupported", 0.05),
    ("unsupported", 0.5),
    ("unsupported", 0.8),
    ("unsupported", 0.95),
    ("fading", 0.5),
    ("fading", 0.8),
)


@dataclass
class PlanCheckConfig:
    """Measures the check of plans, and guidance, on fresh demonstrations."""

    # Checkpoints by name.
    checkpoints: dict[str, Path] = field(default_factory=dict)
    # Datasets that the checkpoints have not seen, by the same names.
    fresh: dict[str, Path] = field(default_factory=dict)
    output_dir: Path = Path("results/ablations/plan_check")


def main(config: PlanCheckConfig) -> None:
    """Measures, and writes the tables."""
    found = {
        name: measure(path, config.fresh[name])
        for name, path in tqdm(config.checkpoints.items(), desc="Tasks", unit="task")
    }
    config.output_dir.mkdir(parents=True, exist_ok=True)
    tables = {"flagged.md": flagged_table(found), "moved.md": moved_table(found)}
    for name, text in {**tables, "plan_check.json": json.dumps(found, indent=1) + "\n"}.items():
        with file_written_beside(config.output_dir / name) as file:
            file.write_text(text, encoding="utf-8")
    print(*tables.values(), sep="\n")


def measure(checkpoint: Path, data: Path) -> dict[str, Any]:
    """The numbers of one checkpoint."""
    policy, preprocessor, _ = load_policy(checkpoint, device="cpu")
    config, demonstrations = policy.config, loaded_demonstrations(preprocessor)
    settings, n_actions = config.field_settings, config.n_action_steps
    flagged = {}
    for rate in RATES:
        threshold = demonstrations.plan_threshold(settings, n_actions, rate)
        flagged[rate] = {"kept": threshold.false_alarm_rate, "n_plans": threshold.n_plans}
    states, chunks = plans_of(data, n_actions, preprocessor.steps)
    dims = settings.action_dims
    covered = chunks if dims is None else chunks[..., list(dims)]
    places = demonstrations.place_of(states) if demonstrations.starts_at_state(settings) else covered[:, 0]
    for rate in RATES:
        threshold = demonstrations.plan_threshold(settings, n_actions, rate)
        support = PlanCheck(demonstrations.field(settings), threshold.log_density)(places, covered)
        flagged[rate]["flagged"] = int((support.amin(dim=1) < 0).sum())
    noise = torch.randn(covered.shape, generator=torch.Generator().manual_seed(0))
    moved = {}
    for region, quantile in REGIONS:
        pulling = demonstrations.field(replace(settings, region=region, quantile=quantile))
        guide = make_guide(pulling, replace(config.guidance_settings, action_dims=None))
        ends = integrate(
            lambda x, t: (covered - x) / (1 - t.view(-1, 1, 1)),
            noise,
            config.num_inference_steps,
            guide=guide,
        )
        distance = ((ends - covered) / demonstrations._angles.unit).norm(dim=-1)
        moved[f"{region} {quantile:g}" if region != "everywhere" else region] = {
            "mean": distance.mean().item(),
            "last": distance[:, -1].mean().item(),
            "largest": distance.max().item(),
        }
    n_anchors = len(demonstrations.field(settings).anchors)
    return {"n_fresh": len(chunks), "n_anchors": n_anchors, "flagged": flagged, "moved": moved}


def plans_of(data: Path, n_actions: int, steps: Any) -> tuple[Tensor, Tensor]:
    """The first state ``(E, A)`` of each episode and the actions ``(E, n_actions, A)`` from it on [normalised]."""
    table = LeRobotDataset(f"local/{data.name}", root=data).hf_dataset.with_format("numpy")
    episodes = np.asarray(table["episode_index"][:]).reshape(-1)
    starts = np.flatnonzero(np.diff(episodes, prepend=-1))
    ends = np.append(starts[1:], len(episodes))
    starts = starts[ends - starts >= n_actions]
    actions, states = (
        _normalise(steps, torch.from_numpy(np.asarray(table[key][:], dtype=np.float32)), key)
        for key in (ACTION, OBS_STATE)
    )
    return states[starts], torch.stack([actions[start : start + n_actions] for start in starts])


def flagged_table(found: dict[str, Any]) -> str:
    """How many fresh demonstrations are flagged, as Markdown."""

    def rows() -> Iterator[str]:
        yield (
            "| task | anchors | demonstrated plans | rate wanted [%] | rate kept [%] | fresh demonstrations flagged [%] |"
        )
        yield "|---|---|---|---|---|---|"
        for name, task in found.items():
            for rate, one in task["flagged"].items():
                share = Rate(one["flagged"], task["n_fresh"])
                low, high = (100 * end for end in share.interval)
                yield (
                    f"| {name} | {task['n_anchors']} | {one['n_plans']} | {100 * rate:g} | {100 * one['kept']:.2g} | "
                    f"{100 * share.value:.1f} ({low:.1f} to {high:.1f}) of {task['n_fresh']} |"
                )

    return "\n".join(rows()) + "\n"


def moved_table(found: dict[str, Any]) -> str:
    """How far guidance moves perfect plans in thousandths of their units: mean, at the last action, largest."""

    def rows() -> Iterator[str]:
        yield f"| region | {' | '.join(found)} |"
        yield f"|---|{'---|' * len(found)}"
        for region in next(iter(found.values()))["moved"]:
            cells = [
                ", ".join(
                    f"{float(f'{1000 * task["moved"][region][key]:.2g}'):g}"
                    for key in ("mean", "last", "largest")
                )
                for task in found.values()
            ]
            yield f"| {region} | {' | '.join(cells)} |"

    return "\n".join(rows()) + "\n"


if __name__ == "__main__":
    main(draccus.parse(PlanCheckConfig))
