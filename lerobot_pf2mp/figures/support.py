# SPDX-License-Identifier: Apache-2.0
"""How each episode lies in the safe set of the others, and which dimensions carry the distances."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lerobot_pf2mp.field_report.report import EpisodeSupport, FieldReport
from lerobot_pf2mp.figures.theme import COLLISION, THEMES, WIDTH, Theme, themed_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Up to this many episodes get a bar each. More are drawn as a curve, the worst first.
_MOST_BARS = 40

# Supports beyond this are cut off: much farther in or out makes no difference to the reader [nats].
_SUPPORT_RANGE = 20.0


def plot_support(output: Path, *, report: FieldReport, background: str = "light") -> None:
    """Draws for each episode its share of actions outside the safe set H of the others, and its smallest support.

    Args:
        output: The PNG file to write.
        report: The numbers.
        background: One of `THEMES`.
    """
    theme = THEMES[background]
    shares = [100 * episode.outside_share for episode in report.episodes]
    supports = [episode.smallest_support for episode in report.episodes]
    is_cut = max(map(abs, supports), default=0.0) > _SUPPORT_RANGE
    supports = np.clip(supports, -_SUPPORT_RANGE, _SUPPORT_RANGE).tolist()
    with themed_figure(output, theme, (WIDTH, 4.0), layout="constrained") as figure:
        left, right = figure.subplots(1, 2)
        _draw_episodes(left, report.episodes, shares, shares, theme)
        left.axhline(100 * report.threshold_quantile, color=theme.text, linestyle="--", linewidth=1)
        left.set(ylabel="actions outside the safe set [%]", ylim=(0, max(5.0, 1.05 * max(shares, default=0))))
        left.set_title("Share outside (dashed: as asked for)", fontsize=11)
        _draw_episodes(right, report.episodes, supports, [-value for value in supports], theme)
        right.axhline(0, color=theme.text, linestyle="--", linewidth=1)
        cut = f", cut at {_SUPPORT_RANGE:.0f}" if is_cut else ""
        ends = 1.05 * min(supports, default=0.0), 1.05 * max(supports, default=0.0)
        right.set(ylabel=f"smallest support [nats{cut}]", ylim=(min(ends[0], -1.0), max(ends[1], 1.0)))
        right.set_title("Worst action (dashed: border of the safe set)", fontsize=11)
        judged = "each judged by the others" if len(supports) > 1 else "judged by its other frames"
        figure.suptitle(f"{count_of_episodes(report)}, {judged}", fontsize=12)


def count_of_episodes(report: FieldReport) -> str:
    """The number of episodes, in words."""
    if any(episode.episode is None for episode in report.episodes):
        return "unknown episodes"
    return f"{len(report.episodes)} episode{'' if len(report.episodes) == 1 else 's'}"


def plot_dimensions(output: Path, *, report: FieldReport, background: str = "light") -> None:
    """Draws each dimension's share of the mean squared distance between nearest actions of different episodes.

    Args:
        output: The PNG file to write.
        report: The numbers.
        background: One of `THEMES`.
    """
    theme = THEMES[background]
    size = (WIDTH, 1.1 + 0.32 * len(report.dimensions))
    with themed_figure(output, theme, size, layout="constrained") as figure:
        axis = figure.add_subplot()
        shares = [100 * dimension.share for dimension in report.dimensions]
        places = range(len(shares))
        axis.barh(places, shares, color=theme.arrow, height=0.65)
        axis.set_yticks(places, [dimension.name for dimension in report.dimensions], parse_math=False)
        axis.set_ylim(len(shares) - 0.5, -0.5)
        for place, dimension, share in zip(places, report.dimensions, shares, strict=True):
            kind = "" if dimension.kind == "continuous" else f" {dimension.kind}"
            axis.annotate(
                f"{share:.0f} %{kind}", (share, place), (4, 0), textcoords="offset points", va="center"
            )
        axis.set(xlabel="share of the squared distance to the nearest action of another episode [%]")
        axis.set_xlim(0, 1.25 * max(*shares, 1.0))
        _finish(axis, theme)


def _draw_episodes(
    axis: Axes,
    episodes: Sequence[EpisodeSupport],
    values: Sequence[float],
    badness: Sequence[float],
    theme: Theme,
) -> None:
    """Draws a value of each episode: a bar each, or a curve with the worst first."""
    is_outside = [episode.outside_share > 0.5 for episode in episodes]
    if len(episodes) <= _MOST_BARS:
        colours = [COLLISION if outside else theme.arrow for outside in is_outside]
        axis.bar(range(len(values)), values, color=colours, width=0.7)
        labels = ["all" if episode.episode is None else str(episode.episode) for episode in episodes]
        step = 1 if len(labels) <= 20 else 2
        axis.set_xticks(range(0, len(labels), step), labels[::step])
        if len(labels) > 12:
            axis.tick_params(axis="x", labelsize=8)
        margin = 0.6 + max(0, 6 - len(values)) / 2
        axis.set(xlabel="episode", xlim=(-margin, len(values) - 1 + margin))
    else:
        order = np.argsort(badness, kind="stable")[::-1]
        rank = np.arange(1, len(values) + 1)
        ordered, outside = np.array(values)[order], np.array(is_outside)[order]
        axis.plot(rank, ordered, color=theme.arrow, linewidth=2)
        axis.plot(rank[outside], ordered[outside], ".", color=COLLISION, label="alone")
        if outside.any():
            axis.legend(frameon=False, labelcolor=theme.text)
        axis.set(xscale="log", xlabel="episodes, the worst first", xlim=(0.9, 1.1 * len(values)))
        axis.xaxis.set_major_formatter("{x:.0f}")
    _finish(axis, theme)


def _finish(axis: Axes, theme: Theme) -> None:
    axis.grid(color=theme.grid, linewidth=0.6)
    axis.set_axisbelow(True)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)
