# SPDX-License-Identifier: Apache-2.0
"""Recordings of a real Panda: the scene around them, the check of plans on the recording left out, and the figure.

    pf2mp-convert --source.type=handwriting --source.path=symbol_17.mat --n_regions=0 --task=handwriting_pen \
--root=data/panda_symbol
    for k in 0 1 2 3 4 5; do
        pf2mp-train --config_path=eval_configs/train_panda_symbol.yaml --dataset.root=data/panda_symbol \
--dataset.episodes=ALL_BUT_$k --output_dir=outputs/PandaSymbol/without_$k
    done
    python tests/benchmarks/recordings.py
    pf2mp-benchmark --config_path=eval_configs/benchmark_panda_symbol.yaml

Forbidden is everything within 2 cm of the recordings' bounding box that is more than 8 mm away from all six of them: where
no recording was. 8 mm is the distance of a letter's regions. The stroke to write is the recording nearest to the others.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import shapely
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, OBS_STATE
from plan_check import plans_of
from recordings_figure import plot_recordings
from shapely import MultiLineString

from lerobot_pf2mp import PF2MPHandwritingEnv, load_policy
from lerobot_pf2mp.benchmark.spec import BenchmarkSpec
from lerobot_pf2mp.envs.handwriting.sheet import REGION_GAP
from lerobot_pf2mp.envs.handwriting.writing_scene import read_writing_scene
from lerobot_pf2mp.figures.policy_figures import GuidedPolicyFigures
from lerobot_pf2mp.loading import loaded_demonstrations
from lerobot_pf2mp.policies.plans.plan_choice import PlanCheck
from lerobot_pf2mp.process.atomic_files import file_written_beside
from lerobot_pf2mp.results.rate import Rate

MARGIN = 0.02  # around the recordings [m]
TOLERANCE = 0.0002  # of the regions' outlines [m]
SMALLEST = 1e-5  # area of a region [m^2]


@dataclass
class RecordingsConfig:
    """Judges each recording by a policy that was trained on the others."""

    # The converted recordings.
    data: Path = Path("data/panda_symbol")
    # Folder of the checkpoints without_0, without_1, ...
    outputs: Path = Path("outputs/PandaSymbol")
    output_dir: Path = Path("results/recordings")
    # The recording left out, and the number of episodes, in the figure.
    shown: int = 0
    n_episodes: int = 20


def main(config: RecordingsConfig) -> None:
    """Writes the scene, the table and the figures."""
    torch.set_num_threads(1)
    config.output_dir.mkdir(parents=True, exist_ok=True)
    ways = recorded_ways(config.data)
    scene_file = config.output_dir / "panda_symbol.json"
    write_text(scene_file, json.dumps(scene_of(ways), indent=1) + "\n")
    read_writing_scene(scene_file)  # refuses regions that block the stroke
    found = [judge(config, number) for number in range(len(ways))]
    write_text(config.output_dir / "held_out.json", json.dumps(found, indent=1) + "\n")
    write_text(config.output_dir / "held_out.md", table(found))
    print(table(found))
    checkpoint = checkpoint_without(config, config.shown)
    env = PF2MPHandwritingEnv(task="HandwritingPen-v0", scene_file=str(scene_file))
    figures = GuidedPolicyFigures(checkpoint, env, seed=BenchmarkSpec.episode_seed)
    pairs = figures.path_pairs(0, range(config.n_episodes))
    for background in ("light", "dark"):
        plot_recordings(
            config.output_dir.parent / f"recordings_{background}.png",
            scene=figures.scene(),
            ways=ways,
            left_out=config.shown,
            pairs=pairs,
            background=background,
        )


def recorded_ways(data: Path) -> list[np.ndarray]:
    """The first position and all others ``(T + 1, 2)`` of each recording [m]."""
    table = LeRobotDataset(f"local/{data.name}", root=data).hf_dataset.with_format("numpy")
    episodes = np.asarray(table["episode_index"][:]).reshape(-1)
    states, actions = (np.asarray(table[key][:], dtype=np.float64) for key in (OBS_STATE, ACTION))
    return [
        np.concatenate([states[episodes == number][:1], actions[episodes == number]])
        for number in np.unique(episodes)
    ]


def scene_of(ways: list[np.ndarray]) -> dict[str, Any]:
    """The scene file: the most usual recording as stroke, and the regions that no recording comes near."""
    means = [
        np.mean([shapely.distance(shapely.points(way), shapely.LineString(other)).mean() for other in ways])
        for way in ways
    ]
    stroke = ways[int(np.argmin(means))]
    regions = [{"corners": np.round(corners, 5).tolist()} for corners in forbidden(ways)]
    return {"stroke": np.round(stroke, 5).tolist(), "regions": regions}


def forbidden(ways: list[np.ndarray]) -> list[np.ndarray]:
    """The corners ``(N, 2)`` of the regions that no way comes near [m]."""
    points = np.concatenate(ways)
    low, high = points.min(axis=0) - MARGIN, points.max(axis=0) + MARGIN
    free = MultiLineString([*ways]).buffer(REGION_GAP)
    # In two halves, because a region has no holes.
    middle = float(np.mean(free.exterior.xy[0]))
    halves = [shapely.box(low[0], low[1], middle, high[1]), shapely.box(middle, low[1], high[0], high[1])]
    parts = [
        part for half in halves for part in shapely.get_parts(half.difference(free)) if part.area > SMALLEST
    ]
    assert not any(part.interiors for part in parts)
    return [np.array(part.simplify(TOLERANCE).exterior.coords)[:-1] for part in parts]


def judge(config: RecordingsConfig, number: int) -> dict[str, Any]:
    """What the policy that does not know a recording says of it."""
    policy, preprocessor, _ = load_policy(checkpoint_without(config, number), device="cpu")
    settings, n_actions = policy.config.field_settings, policy.config.n_action_steps
    demonstrations = loaded_demonstrations(preprocessor)
    threshold = demonstrations.plan_threshold(settings, n_actions, policy.config.false_alarm_rate)
    states, chunks = plans_of(config.data, n_actions, preprocessor.steps)
    places = demonstrations.place_of(states) if demonstrations.starts_at_state(settings) else chunks[:, 0]
    support = PlanCheck(demonstrations.field(settings), threshold.log_density)(places, chunks)
    mine = support[number]
    return {
        "left_out": number,
        "n_demonstrations": threshold.n_plans,
        "false_alarm_rate": threshold.false_alarm_rate,
        "support": mine.min().item(),
        "is_flagged": bool(mine.min() < 0),
        "unsupported_steps": int((mine < 0).sum()),
        "known_flagged": int((support.amin(dim=1) < 0).sum()) - int(mine.min() < 0),
    }


def table(found: list[dict[str, Any]]) -> str:
    """The numbers as Markdown."""
    n_flagged = sum(one["is_flagged"] for one in found)
    n_known = sum(one["known_flagged"] for one in found)
    largest = max(one["false_alarm_rate"] for one in found)
    lines = [
        "| recording left out | smallest support on its way [nats] | flagged | steps outside, of 64 |",
        "|---|---|---|---|",
        *(
            f"| {one['left_out']} | {one['support']:.2f} | {'yes' if one['is_flagged'] else 'no'} | "
            f"{one['unsupported_steps']} |"
            for one in found
        ),
    ]
    rate = Rate(n_flagged, len(found))
    return (
        "\n".join(lines)
        + f"\n\n{n_flagged} of {len(found)} left-out recordings are flagged ({rate}); "
        + f"at most {100 * largest:.1f} % are expected. "
        + f"Of the {len(found) - 1} x {len(found)} recordings that a policy was trained on, {n_known} are.\n"
    )


def checkpoint_without(config: RecordingsConfig, number: int) -> Path:
    """The checkpoint that was trained without a recording."""
    return config.outputs / f"without_{number}" / "checkpoints" / "last" / "pretrained_model"


def write_text(path: Path, text: str) -> None:
    """Writes a file whole or not at all."""
    with file_written_beside(path) as file:
        file.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(draccus.parse(RecordingsConfig))
