# SPDX-License-Identifier: Apache-2.0
"""Time of density and score against the number of anchors, drawn from the suite's own rows."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from harness import Row

from lerobot_pf2mp.figures.theme import ANCHOR, EULER, GOAL, GUIDED, START, THEMES, WIDTH, themed_figure

N_QUERIES = "1e4"
_CASE = re.compile(r"D = (\d+), (\S+) anchors, (\S+) queries")
_STYLES = {
    "ours": (GUIDED, "o"),
    "torch (cdist, logsumexp, autograd)": (GOAL, "s"),
    "attention (score alone)": (START, "^"),
    "pykeops": (EULER, "v"),
    "scikit-learn": ("#8c6bb1", "D"),
    "scipy": ("#8c8c8c", "P"),
    "torch-kde": (ANCHOR, "X"),
}


def plot_density(output: Path, rows: Sequence[Row], background: str = "light") -> None:
    """Draws the milliseconds of one call on one thread, a panel for each dimension, to a PNG file.

    Args:
        output: The file.
        rows: Those of the suite.
        background: One of `THEMES`.
    """
    theme = THEMES[background]
    lines: dict[int, dict[str, list[tuple[float, float]]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        found = _CASE.fullmatch(row.case)
        name = row.quantity.split(", from ")[0]
        if found and row.threads == 1 and found[3] == N_QUERIES and name in _STYLES and row.unit == "ms":
            lines[int(found[1])][name].append((float(found[2]), row.value))
    with themed_figure(output, theme, (WIDTH, 3.6), layout="constrained") as figure:
        axes = figure.subplots(1, len(lines), sharey=True)
        for axis, (dim, by_name) in zip(axes, sorted(lines.items()), strict=True):
            for name, points in by_name.items():
                colour, marker = _STYLES[name]
                axis.plot(
                    *zip(*sorted(points), strict=True), color=colour, marker=marker, markersize=5, label=name
                )
            axis.set(xscale="log", yscale="log", xlabel="anchors", title=f"D = {dim}", xlim=(1.5e3, 2e6))
            axis.grid(color=theme.grid, linewidth=0.6)
        axes[0].set_ylabel("one call [ms]")
        handles = {
            label: handle
            for axis in axes
            for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
        }
        figure.legend(
            handles.values(),
            handles,
            loc="outside lower center",
            ncols=4,
            frameon=False,
            labelcolor=theme.text,
        )
        figure.suptitle("Log density and score of 10 000 queries, one CPU thread", fontsize=11)
