# SPDX-License-Identifier: Apache-2.0
"""How much of a demonstration that the field does not know lies outside its safe set.

Episodes are left out in ten parts (or one by one, if there are fewer). A field is fitted to at most 3000 actions of the
others, once with densities that leave out an action's own episode, once with the rule of before, which leaves out nothing.

    python tests/benchmarks/held_out.py '--datasets={maze_large: data/maze_large, fetch_push: data/fetch_push}' \
--recordings=RECORDINGS --output_dir=results/ablations/held_out

takes a minute for each dataset. RECORDINGS is a folder with recordings by others: panda_symbols/symbol_17.mat (Panda
guided along a symbol; AutoLabModena/Panda-Co-Manipulation-Dataset), panda_arm/trajectories.csv (Panda joints;
mesha0703/panda-arm-visualization), handwriting_tablet/signal.svc (a pen on a tablet; BDALab/handwriting-sample) and
omniglot/strokes_background_small1.zip (drawings by people; brendenlake/omniglot).
"""

from __future__ import annotations

import csv
import json
import math
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import draccus
import numpy as np
import scipy.io
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor
from tqdm import tqdm

from lerobot_pf2mp.potential_field import fit

N_POINTS = 3000
N_PARTS = 10
# Frames of held-out episodes that are looked at, for each part.
N_LOOKED_AT = 20_000


@dataclass
class HeldOutConfig:
    """Measures held-out support."""

    # LeRobotDatasets by name; a name that starts with handwriting is looked at in its first seven dimensions.
    datasets: dict[str, Path] = field(default_factory=dict)
    # Folder with recordings by others.
    recordings: Path | None = None
    # Folder to write table.md and held_out.json into.
    output_dir: Path = Path("results/ablations/held_out")
    # Quantile asked for.
    quantile: float = 0.01
    seed: int = 0


def main(config: HeldOutConfig) -> None:
    """Measures all sets and writes the table."""
    torch.manual_seed(config.seed)
    rows = [measure(*some, config.quantile) for some in tqdm(list(all_sets(config)), unit="set")]
    config.output_dir.mkdir(parents=True, exist_ok=True)
    (config.output_dir / "held_out.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    (config.output_dir / "table.md").write_text(make_table(rows), encoding="utf-8")
    print(make_table(rows))


def all_sets(config: HeldOutConfig) -> Iterator[tuple[str, Tensor, Tensor]]:
    """The name, the actions ``(N, D)`` and the episode numbers ``(N,)`` of each set."""
    for name, root in config.datasets.items():
        table = LeRobotDataset(f"local/{name}", root=root).hf_dataset.with_format("numpy")
        actions = torch.from_numpy(np.asarray(table["action"][:], dtype=np.float32))
        episodes = torch.from_numpy(np.asarray(table["episode_index"][:]))
        yield name, actions[:, :7] if name.startswith("handwriting") else actions, episodes
    if config.recordings is not None:
        yield "Panda symbol, plane", *read_symbols(config.recordings / "panda_symbols/symbol_17.mat")
        yield "Panda joints, 20 parts", *read_joints(config.recordings / "panda_arm/trajectories.csv")
        yield "tablet, 20 parts", *read_tablet(config.recordings / "handwriting_tablet/signal.svc")
        for number in (0, 7, 30):
            path = config.recordings / "omniglot/strokes_background_small1.zip"
            yield f"drawing {number}, 20 people", *read_drawings(path, number)


def read_symbols(path: Path) -> tuple[Tensor, Tensor]:
    """Positions in the plane and recording numbers of a Panda guided by hand."""
    recordings = scipy.io.loadmat(path)["symbol_data"][0]
    positions = [np.asarray(one["pos"], dtype=np.float32) for one in recordings]
    positions = [one.T if one.shape[0] < one.shape[1] else one for one in positions]
    counts = torch.tensor([len(one) for one in positions])
    numbers = torch.arange(len(positions)).repeat_interleave(counts)
    return torch.from_numpy(np.concatenate(positions)[:, :2].copy()), numbers


def read_joints(path: Path) -> tuple[Tensor, Tensor]:
    """Joint positions of a Panda, one recording, in twenty parts."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader((line for line in file if line.strip()), delimiter=";"))
    joints = torch.tensor([[float(row[f"joint_{i}"]) for i in range(1, 8)] for row in rows])
    joints = joints[(joints != 0).any(dim=1)]
    return joints, torch.arange(len(joints)) * 20 // len(joints)


def read_tablet(path: Path) -> tuple[Tensor, Tensor]:
    """Positions of a pen on paper (x, y, time, status, ... after a first line), one recording, in twenty parts."""
    samples = torch.from_numpy(np.loadtxt(path, skiprows=1, dtype=np.float32))
    positions = samples[samples[:, 3] == 1, :2]
    return positions, torch.arange(len(positions)) * 20 // len(positions)


def read_drawings(path: Path, number: int) -> tuple[Tensor, Tensor]:
    """Positions of the pen and drawing numbers of the twenty drawings of one character."""
    characters: dict[str, list[str]] = {}
    with zipfile.ZipFile(path) as archive:
        for name in sorted(archive.namelist()):
            if name.endswith(".txt") and "MACOSX" not in name:
                characters.setdefault(name.rsplit("/", 1)[0], []).append(name)
        drawings = characters[sorted(characters)[number]]
        texts = [archive.read(name).decode() for name in drawings]
    points = [
        [[float(x) for x in line.split(",")[:2]] for line in text.splitlines() if "," in line]
        for text in texts
    ]
    counts = torch.tensor([len(one) for one in points])
    return torch.cat([torch.tensor(one) for one in points]), torch.arange(len(points)).repeat_interleave(
        counts
    )


def measure(name: str, actions: Tensor, episodes: Tensor, quantile: float) -> dict:
    """The shares of held-out actions outside H, in per cent, with both rules."""
    low, high = actions.amin(dim=0), actions.amax(dim=0)
    actions = 2 * (actions - low) / (high - low).clamp_min(1e-8) - 1
    numbers = episodes.unique()
    numbers = numbers[torch.randperm(len(numbers))]
    row: dict = {"set": name, "dimensions": actions.shape[1], "episodes": len(numbers), "quantile": quantile}
    shares: dict[str, list[float]] = {"episode": [], "nothing": []}
    bandwidths: dict[str, list[float]] = {"episode": [], "nothing": []}
    for part in numbers.chunk(min(N_PARTS, len(numbers))):
        is_held_out = torch.isin(episodes, part)
        rows = (~is_held_out).nonzero().flatten()
        rows = rows[torch.randperm(len(rows))[:N_POINTS]].sort().values
        looked_at = actions[is_held_out]
        looked_at = looked_at[torch.randperm(len(looked_at))[:N_LOOKED_AT]]
        for rule in shares:
            fitted = fit(
                actions[rows],
                episodes=episodes[rows],
                times=rows,
                threshold_quantile=quantile,
                leave_out=rule,
            )
            shares[rule].append(100 * (~fitted.is_safe(looked_at)).double().mean().item())
            bandwidths[rule].append(fitted.bandwidth)
    for rule, values in shares.items():
        row[f"outside_{rule}_percent"] = float(np.mean(values))
        row[f"range_{rule}_percent"] = [min(values), max(values)]
        row[f"bandwidth_{rule}"] = math.exp(float(np.mean(np.log(bandwidths[rule]))))
    return row


def make_table(rows: list[dict]) -> str:
    """The rows as a Markdown table."""
    lines = [
        "| demonstrations | dimensions | episodes | outside before [%] | outside now [%] | parts [%] | h before | h now |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        low, high = row["range_episode_percent"]
        lines.append(
            f"| {row['set']} | {row['dimensions']} | {row['episodes']} | {row['outside_nothing_percent']:.1f} | "
            f"{row['outside_episode_percent']:.2f} | {low:.1f} to {high:.1f} | {row['bandwidth_nothing']:.4f} | "
            f"{row['bandwidth_episode']:.4f} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main(draccus.parse(HeldOutConfig))
