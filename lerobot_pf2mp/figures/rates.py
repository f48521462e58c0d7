# SPDX-License-Identifier: Apache-2.0
"""Collision and success rate against lambda."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_pf2mp.figures.theme import EULER, GUIDED, THEMES, WIDTH, Theme, themed_figure
from lerobot_pf2mp.results.rows import NO_GUIDANCE
from lerobot_pf2mp.results.summary import Cell

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def plot_lambda(output: Path, *, cells: Sequence[Cell], background: str = "light") -> None:
    """Draws collision and success rate against lambda, with 95 % Wilson intervals.

    Args:
        output: The PNG file to write.
        cells: Results of one task: guided policies with several values of lambda, and the same policies without guidance.
        background: One of `THEMES`.

    Raises:
        ValueError: If there is no guided result, or the results are of several tasks.
    """
    theme = THEMES[background]
    tasks = {cell.repeats[0].task for cell in cells}
    lines, unguided = _sorted_by_guidance(cells)
    if not lines or len(tasks) > 1:
        raise ValueError(f"results must be of one task and hold guided policies, got tasks {sorted(tasks)}")
    with themed_figure(output, theme, (WIDTH, 3.9), layout="constrained") as figure:
        axes = figure.subplots(1, 2)
        for axis, rate in zip(axes, ("collision", "success"), strict=True):
            _draw_panel(axis, rate, lines, unguided, theme)
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside lower center", ncols=3, frameon=False, labelcolor=theme.text
        )
        (task,) = tasks
        first = cells[0]
        figure.suptitle(
            f"{task}: {first.n_episodes} episodes for each point, bands are 95 % intervals", fontsize=11
        )


def _sorted_by_guidance(cells: Sequence[Cell]) -> tuple[dict[tuple[str, str], list[Cell]], dict[str, Cell]]:
    """Guided results by policy and integrator, each in ascending order of lambda, and unguided ones by policy."""
    lines: dict[tuple[str, str], list[Cell]] = {}
    unguided: dict[str, Cell] = {}
    for cell in sorted(cells, key=lambda cell: cell.repeats[0].guidance_scale):
        row = cell.repeats[0]
        if row.guidance_integrator == NO_GUIDANCE:
            unguided[row.policy] = cell
        else:
            lines.setdefault((row.policy, row.guidance_integrator), []).append(cell)
    return dict(sorted(lines.items())), unguided


def _draw_panel(
    axis: Axes, rate: str, lines: dict[tuple[str, str], list[Cell]], unguided: dict[str, Cell], theme: Theme
) -> None:
    """Draws one rate, `collision` or `success`, of all policies."""
    for number, (policy, cell) in enumerate(unguided.items()):
        _draw_level(axis, getattr(cell, rate), policy, theme.unguided, (":", "-.")[number % 2])
    policies = sorted({policy for policy, _ in lines})
    for number, ((policy, integrator), line) in enumerate(lines.items()):
        colour = EULER if integrator == "euler" else GUIDED
        style = ("-", "--")[policies.index(policy) % 2]
        _draw_line(axis, line, rate, f"{policy}, {integrator}", colour, style, "os^v"[number % 4])
    axis.set(xscale="log", xlabel=r"$\lambda$ (guidance_scale)", ylabel=f"{rate} rate [%]", ylim=(-2, 102))
    axis.grid(color=theme.grid, linewidth=0.6)


def _draw_level(axis: Axes, rate: Any, policy: str, colour: str, style: str) -> None:
    if rate is None:
        return
    axis.axhspan(*(100 * end for end in rate.interval), color=colour, alpha=0.25, linewidth=0)
    axis.axhline(
        100 * rate.value, color=colour, linestyle=style, linewidth=1.6, label=f"{policy}, no guidance"
    )


def _draw_line(
    axis: Axes, line: list[Cell], rate: str, label: str, colour: str, style: str, marker: str
) -> None:
    scales = [cell.repeats[0].guidance_scale for cell in line]
    rates = [getattr(cell, rate) for cell in line]
    low, high = zip(*(rate.interval for rate in rates), strict=True)
    axis.fill_between(
        scales, 100 * np.array(low), 100 * np.array(high), color=colour, alpha=0.25, linewidth=0
    )
    axis.plot(
        scales,
        [100 * rate.value for rate in rates],
        color=colour,
        linestyle=style,
        marker=marker,
        markersize=4.5,
        label=label,
    )
