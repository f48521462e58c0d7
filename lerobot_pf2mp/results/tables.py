# SPDX-License-Identifier: Apache-2.0
"""Tables of benchmark results, as Markdown and LaTeX."""

from __future__ import annotations

import re
from collections.abc import Sequence

from lerobot_pf2mp.results.rate import Rate
from lerobot_pf2mp.results.rows import NO_GUIDANCE
from lerobot_pf2mp.results.summary import Cell

_COLUMNS = (
    "task",
    "policy",
    "guidance",
    "lambda",
    "collision rate [%]",
    "95 % interval",
    "p (McNemar)",
    "success rate [%]",
    "episodes",
)


def make_markdown(cells: Sequence[Cell]) -> str:
    """A Markdown table, one row for each cell.

    Rates are means, with the standard deviation over repeats and over training seeds if there are several. The 95 %
    interval is Wilson's over all episodes. p is the p-value of McNemar's exact test against the same weights without
    guidance.
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
    has_variants = any(cell.repeats[0].variant for cell in cells)
    has_plans = any(cell.plan_in_wall for cell in cells)
    has_strokes = any(cell.stroke_error is not None for cell in cells)
    columns = [*_COLUMNS[:4], *(["variant"] if has_variants else []), *_COLUMNS[4:]]
    if has_plans:
        columns.insert(-2, "plans in the wall [%]")
    if has_strokes:
        columns.insert(-1, "stroke error [mm]")
    return columns, [_row(cell, has_variants, has_plans, has_strokes) for cell in cells]


def _row(cell: Cell, has_variants: bool, has_plans: bool, has_strokes: bool) -> list[str]:
    first = cell.repeats[0]
    collision = cell.collision
    p = cell.mcnemar_p
    plan = cell.plan_in_wall
    stroke_error = cell.stroke_error
    return [
        first.task,
        first.policy,
        first.guidance_integrator,
        "" if first.guidance_integrator == NO_GUIDANCE else f"{first.guidance_scale:g}",
        *([first.variant] if has_variants else []),
        "" if collision is None else _rate(cell, collision, "collisions"),
        "" if collision is None else "{:.2f} to {:.2f}".format(*(100 * end for end in collision.interval)),
        "" if p is None else _p_value(p),
        *([] if not has_plans else [""] if plan is None else [_rate(cell, plan, "plans_in_wall")]),
        _rate(cell, cell.success, "successes"),
        *([] if not has_strokes else [""] if stroke_error is None else [f"{stroke_error:.2f}"]),
        _episodes(cell),
    ]


def _rate(cell: Cell, rate: Rate, count: str) -> str:
    text = f"{100 * rate.value:.2f}"
    over_repeats, over_seeds = cell.deviation(count, "repeat"), cell.deviation(count, "seed")
    if over_repeats is not None:
        text += f" ± {100 * over_repeats:.2f}"
    if over_seeds is not None:
        text += f" (seeds ± {100 * over_seeds:.2f})"
    return text


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


def _p_value(p: float) -> str:
    return f"{p:.2g}" if p >= 1e-4 else "< 1e-4"


def _escape(text: str) -> str:
    if text == "lambda":
        return r"$\lambda$"
    text = re.sub(r"([&%$#_{}])", r"\\\1", text)
    for plain, command in (("±", r"$\pm$"), (" x ", r" $\times$ "), ("<", "$<$")):
        text = text.replace(plain, command)
    return text
