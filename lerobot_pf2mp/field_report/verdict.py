# SPDX-License-Identifier: Apache-2.0
"""The verdict on demonstrations, in one sentence."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

from lerobot_pf2mp.field_report.report import EpisodeSupport

# An episode is alone if more than this share of its actions are outside the safe set of the others.
_ALONE = 0.5

# Episodes with fewer actions than this are not called alone.
_FEWEST_ACTIONS = 5

# Demonstrations are too far apart if H reaches farther from a lone action than this share of the actions' spread.
_LARGEST_REACH = 0.5

_N_NAMED = 6  # episodes in a verdict


def judge_demonstrations(
    episodes: Sequence[EpisodeSupport], quantile: float, reach: float, spread: float
) -> tuple[bool | None, str]:
    """Whether demonstrations are enough for a field, and why, in one sentence.

    They are enough if no episode is alone (more than half of its actions outside the safe set H of the others), the median
    episode has at most twice the quantile of its actions outside it, and H reaches at most half the actions' spread from a
    lone action. The last rule is needed because a few demonstrations that have nothing in common make a wide H, in which
    all of them lie, and all obstacles. One episode cannot be judged by others.

    Args:
        episodes: The episodes.
        quantile: Share of the demonstrated actions that H was asked to leave out.
        reach: How far H reaches from a lone action [normalised].
        spread: Spread of the actions [normalised].

    Returns:
        Whether they are enough, None if it cannot be told, and the sentence.
    """
    if len(episodes) < 2:
        return None, "Whether the demonstrations are enough cannot be told from one episode: record several."
    alone = [e for e in episodes if e.outside_share > _ALONE and e.n_actions >= _FEWEST_ACTIONS]
    share = median(e.outside_share for e in episodes)
    if alone and 2 * len(alone) < len(episodes):
        named = ", ".join(str(e.episode) for e in alone[:_N_NAMED])
        more = f" and {len(alone) - _N_NAMED} more" if len(alone) > _N_NAMED else ""
        some, are = ("Episode", "is") if len(alone) == 1 else ("Episodes", "are")
        return False, (
            f"{some} {named}{more} of {len(episodes)} {are} alone: most of their actions are where no other episode went. "
            "Record more demonstrations like them, or leave them out with --dataset.episodes."
        )
    if alone or share > 2 * quantile:
        return False, (
            f"More demonstrations are needed: {_percent(share)} of a held-out demonstration's actions (median) are outside "
            f"the safe set of the others, which leaves out {_percent(quantile)} of their own."
        )
    if spread > 0 and reach > _LARGEST_REACH * spread:
        return False, (
            "More demonstrations are needed: they are so far apart that the safe set reaches "
            f"{_percent(reach / spread)} of their spread from each of them."
        )
    return True, (
        f"The demonstrations are enough: {_percent(share)} of a held-out demonstration's actions (median of "
        f"{len(episodes)}) are outside the safe set of the others, and no demonstration is alone."
    )


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"
