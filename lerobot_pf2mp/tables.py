# SPDX-License-Identifier: Apache-2.0
"""Tables of benchmark results, as Markdown and LaTeX."""

from __future__ import annotations

import re
from collections.abc import Sequence

from lerobot_pf2mp.rate import Rate
from lerobot_pf2mp.results import NO_GUIDANCE, Cell

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

    Rates are means, with the standard deviation over repeats and, with several training seeds, over those too. The 95 %
    interval is Wilson's over all episodes, p that of McNemar's exact test against the same weights without guidance.
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
    columns = [*_COLUMNS[:4], *(["variant"] if has_variants else []), *_COLUMNS[4:]]
    return columns, [_row(cell, has_variants) for cell in cells]


def _row(cell: Cell, has_variants: bool) -> list[str]:
    first = cell.repeats[0]
    collision = cell.collision
    n_repeats = len({row.repeat for row in cell.repeats})
    n_episodes = cell.n_episodes // len(cell.repeats)
    p = cell.mcnemar_p
    return [
        first.task,
        first.policy,
        first.guidance_integrator,
        "" if first.guidance_integrator == NO_GUIDANCE else f"{first.guidance_scale:g}",
        *([first.variant] if has_variants else []),
        "" if collision is None else _rate(cell, collision, "collisions"),
        "" if collision is None else "{:.2f} to {:.2f}".format(*(100 * end for end in collision.interval)),
        "" if p is None else _p_value(p),
        _rate(cell, cell.success, "successes"),
        " x ".join(map(str, [*([cell.n_seeds] if cell.n_seeds > 1 else []), n_repeats, n_episodes])),
    ]


def _rate(cell: Cell, rate: Rate, count: str) -> str:
    text = f"{100 * rate.value:.2f} ± {100 * cell.deviation(count, 'repeat'):.2f}"
    return f"{text} (seeds ± {100 * cell.deviation(count, 'seed'):.2f})" if cell.n_seeds > 1 else text


def _p_value(p: float) -> str:
    return f"{p:.2g}" if p >= 1e-4 else "< 1e-4"


def _escape(text: str) -> str:
    if text == "lambda":
        return r"$\lambda$"
    text = re.sub(r"([&%$#_{}])", r"\\\1", text)
    for plain, command in (("±", r"$\pm$"), (" x ", r" $\times$ "), ("<", "$<$")):
        text = text.replace(plain, command)
    return text
