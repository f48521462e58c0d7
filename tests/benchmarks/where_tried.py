# SPDX-License-Identifier: Apache-2.0
"""Makes the table of where guidance was tried from the published results: one row for each policy and task.

python tests/benchmarks/where_tried.py
"""

from __future__ import annotations

from pathlib import Path

from lerobot_pf2mp.process.atomic_files import file_written_beside
from lerobot_pf2mp.results.rate import Rate
from lerobot_pf2mp.results.rows import SummaryRow, read_rows
from lerobot_pf2mp.results.summary import Cell, group_cells

ROOT = Path(__file__).parents[2]
OUTPUT = ROOT / "results/where_tried.md"
# Folder below results/: the task's name in the table, and who made the environment and the demonstrations.
TRIED = {
    "maze": ("{task}", "maze of gymnasium-robotics, our expert"),
    "fetch": ("{task}", "Fetch of gymnasium-robotics, our wall and expert"),
    "fetch_ppo": ("{task}, expert trained by PPO", "the same, Stable-Baselines3"),
    "handwriting": ("letter S, joints of a Panda", "ours"),
    "handwriting_genesis": ("the same checkpoint in Genesis", "Genesis and its Panda"),
    "handwriting_pen": ("letter S, pen of a Panda", "ours"),
    "handwriting_z1": ("letter S, pen of a Unitree Z1", "arm of Unitree, our scene"),
    "recordings": ("symbol, recorded with a real Panda", "AutoLabModena; simulated execution"),
    "so101": ("SO-101, cube over a wall", "so101-nexus, our wall and expert"),
    "guarded_so101": ("SO-101, cube over a wall, camera", "so101-nexus, our wall and expert"),
    "metaworld/reach_wall": ("{task}", "Meta-World and its expert"),
    "metaworld/push_wall": ("{task}", "Meta-World and its expert"),
    "guarded_maze": ("{task}", "maze of gymnasium-robotics, our expert"),
    "guarded_fetch": ("{task}", "Fetch of gymnasium-robotics, our wall and expert"),
    "guarded_handwriting": ("letter S, joints of a Panda", "ours"),
}
COLUMNS = (
    "task",
    "made by",
    "policy",
    "collisions [%], unguided → guided",
    "success [%], unguided → guided",
    "episodes",
    "p (McNemar)",
)


def main() -> None:
    """Writes the table."""
    lines = [f"| {' | '.join(COLUMNS)} |", "|" + "---|" * len(COLUMNS)]
    for folder, (task, origin) in TRIED.items():
        cells = group_cells(read_rows(ROOT / "results" / folder / "summary.csv", SummaryRow))
        lines += [
            f"| {' | '.join((task.format(task=guided.repeats[0].task), origin, *_compared(unguided, guided)))} |"
            for unguided, guided in _pairs(cells)
        ]
    with file_written_beside(OUTPUT) as partial:
        partial.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _pairs(cells: list[Cell]) -> list[tuple[Cell, Cell]]:
    """The unguided and the guided cell, with the default guidance, of each policy, without variants."""
    found = {}
    for cell in cells:
        first = cell.repeats[0]
        if not first.variant and first.guidance_integrator in ("none", "proximal"):
            found[first.task, first.checkpoint.split("/checkpoints")[0], first.guidance_integrator] = cell
    return [
        (found[task, checkpoint, "none"], cell)
        for (task, checkpoint, integrator), cell in found.items()
        if integrator == "proximal"
    ]


def _compared(unguided: Cell, guided: Cell) -> list[str]:
    p = guided.mcnemar_p
    return [
        guided.repeats[0].policy,
        _change(unguided.collision, guided.collision),
        _change(unguided.success, guided.success),
        str(guided.n_episodes),
        "" if p is None else f"{p:.2g}" if p >= 1e-4 else "< 1e-4",
    ]


def _change(before: Rate | None, after: Rate | None) -> str:
    assert before is not None
    assert after is not None
    return f"{100 * before.value:.1f} → {100 * after.value:.1f}"


if __name__ == "__main__":
    main()
