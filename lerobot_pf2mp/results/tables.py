# SPDX-License-Identifier: Apache-2.0
"""Tables of benchmark results, as Markdown and LaTeX."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from lerobot_pf2mp.results.rate import Rate
from lerobot_pf2mp.results.rows import NO_GUIDANCE
from lerobot_pf2mp.results.summary import Cell

# The text of each column; empty where a cell has nothing to show.
_COLUMNS: dict[str, Callable[[Cell], str]] = {
    "task": lambda cell: cell.repeats[0].task,
    "policy": lambda cell: cell.repeats[0].policy,
    "guidance": lambda cell: cell.repeats[0].guidance_integrator,
    "lambda": lambda cell: _scale(cell),
    "variant": lambda cell: cell.repeats[0].variant,
    "collision rate [%]": lambda cell: _rate(cell, cell.collision, "collisions"),
    "95 % interval": lambda cell: _interval(cell.collision),
    "p (McNemar)": lambda cell: _p_value(cell.mcnemar_p),
    "obstacle hit [%]": lambda cell: _with_interval(cell.obstacle_collision),
    "plans in the wall [%]": lambda cell: _rate(cell, cell.plan_in_wall, "plans_in_wall"),
    "success rate [%]": lambda cell: _rate(cell, cell.success, "successes"),
    "stroke error [mm]": lambda cell: _number(cell.stroke_error),
    "plans": lambda cell: _number(cell.plans_drawn_each),
    "flagged [%]": lambda cell: _with_interval(cell.flagged),
    "collisions among the unflagged [%]": lambda cell: _with_interval(cell.unflagged_collision),
    "colliding episodes flagged [%]": lambda cell: _with_interval(cell.collision_flagged),
    "episodes": lambda cell: _episodes(cell),
}

# Columns that are left out if no cell has something to show there.
_OPTIONAL = (
    "variant",
    "obstacle hit [%]",
    "plans in the wall [%]",
    "stroke error [mm]",
    "plans",
    "flagged [%]",
    "collisions among the unflagged [%]",
    "colliding episodes flagged [%]",
)


def make_markdown(cells: Sequence[Cell]) -> str:
    """A Markdown table, one row for each cell.

    Rates are means, with the standard deviation over repeats and over training seeds if there are several. The 95 %
    interval is Wilson's over all episodes. p is the p-value of McNemar's exact test against the same weights without
    guidance. "plans" is the mean number of plans drawn for each one that is executed; an episode is flagged if one of the
    executed plans still left the demonstrated region. The rates of flagged episodes have their interval in brackets.
    """
    columns, rows = _rows(cells)
    lines = [f"| {' | '.join(columns)} |", f"|{'---|' * len(columns)}"]
    return "\n".join(lines + [f"| {' | '.join(row)} |" for row in rows]) + "\n"


def make_latex(cells: Sequence[Cell]) -> str:
    """The same table for LaTeX, with the rules of booktabs."""
    columns, rows = _rows(cells)
    lines = [
        rf"\begin{{tabular}}{{{'l' * len(columns)}}}",
        r"\toprule",
        rf"{' & '.join(map(_escape, columns))} \\",
        r"\midrule",
        *(rf"{' & '.join(map(_escape, row))} \\" for row in rows),
        r"\bottomrule",
        r"\end{tabular}",
    ]
    return "\n".join(lines) + "\n"


def _rows(cells: Sequence[Cell]) -> tuple[list[str], list[list[str]]]:
    rows = [{column: text(cell) for column, text in _COLUMNS.items()} for cell in cells]
    columns = [column for column in _COLUMNS if column not in _OPTIONAL or any(row[column] for row in rows)]
    return columns, [[row[column] for column in columns] for row in rows]


def _scale(cell: Cell) -> str:
    first = cell.repeats[0]
    return "" if first.guidance_integrator == NO_GUIDANCE else f"{first.guidance_scale:g}"


def _rate(cell: Cell, rate: Rate | None, count: str) -> str:
    if rate is None:
        return ""
    text = f"{100 * rate.value:.2f}"
    over_repeats, over_seeds = cell.deviation(count, "repeat"), cell.deviation(count, "seed")
    if over_repeats is not None:
        text += f" ± {100 * over_repeats:.2f}"
    if over_seeds is not None:
        text += f" (seeds ± {100 * over_seeds:.2f})"
    return text


def _interval(rate: Rate | None) -> str:
    return "" if rate is None else "{:.2f} to {:.2f}".format(*(100 * end for end in rate.interval))


def _with_interval(rate: Rate | None) -> str:
    """A rate with its interval, such as 0.40 (0.12 to 1.2)."""
    if rate is None:
        return ""
    value, low, high = (
        f"{100 * share:.{1 if share >= 0.01 else 2}f}" for share in (rate.value, *rate.interval)
    )
    return f"{value} ({low} to {high})"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _episodes(cell: Cell) -> str:
    """Training seeds x repeats x episodes of each, or their total if some have fewer repeats than others."""
    n_repeats = len({row.repeat for row in cell.repeats})
    n_each = cell.repeats[0].n_episodes
    if cell.n_seeds * n_repeats * n_each != cell.n_episodes:
        return str(cell.n_episodes)
    counts = [cell.n_seeds, n_repeats, n_each]
    while counts[0] == 1 < len(counts):
        del counts[0]
    return " x ".join(map(str, counts))


def _p_value(p: float | None) -> str:
    if p is None:
        return ""
    return f"{p:.2g}" if p >= 1e-4 else "< 1e-4"


def _escape(text: str) -> str:
    if text == "lambda":
        return r"$\lambda$"
    text = re.sub(r"([&%$#_{}])", r"\\\1", text)
    for plain, command in (("±", r"$\pm$"), (" x ", r" $\times$ "), ("<", "$<$")):
        text = text.replace(plain, command)
    return text
