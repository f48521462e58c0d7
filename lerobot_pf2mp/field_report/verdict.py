# SPDX-License-Identifier: Apache-2.0
"""The verdict on demonstrations, in one sentence."""

from __future__ import annotations

from collections.abc import Sequence

from lerobot_pf2mp.field_report.report import EpisodeSupport

# An episode is alone if more than this share of its actions are outside the safe set of the others.
_ALONE = 0.5

# Episodes with fewer actions than this are not called alone.
_FEWEST_ACTIONS = 5

# Largest share of a held-out demonstration's actions outside the safe set of the others, relative to the quantile of it
# that was asked for, and smallest quantile that counts.
_LARGEST_SHARE, _SMALLEST_QUANTILE = 3, 0.01

# Demonstrations are too far apart if H reaches farther from a lone action than this share of the actions' spread.
_LARGEST_REACH = 0.5

_N_NAMED = 6  # episodes in a verdict


def judge_demonstrations(
    episodes: Sequence[EpisodeSupport], quantile: float, reach: float, spread: float
) -> tuple[bool | None, str]:
    """Whether demonstrations are enough for a field, and why, in one sentence.

    Each of these is a reason why they are not:

    - Episodes are alone: more than half of their actions are outside the safe set H of the others. A share of the episodes
      up to the quantile may be; the sentence names them too.
    - More than three times the quantile of a held-out demonstration's actions are outside H, on average.
    - H reaches more than half the actions' spread from a lone action. A few demonstrations that have nothing in common make
      such a wide H, in which all of them lie, and the obstacles too.

    Args:
        episodes: The episodes.
        quantile: Share of the demonstrated actions that H was asked to leave out.
        reach: How far H reaches from a lone action [normalised].
        spread: Spread of the actions [normalised].

    Returns:
        Whether they are enough, None if it cannot be told from one episode or unknown ones, and the sentence.
    """
    if any(episode.episode is None for episode in episodes):
        return None, (
            "Whether the demonstrations are enough cannot be told: the field does not know which episodes its actions are "
            "of; pf2mp-fit-field makes one that does."
        )
    if len(episodes) < 2:
        return None, "Whether the demonstrations are enough cannot be told from one episode: record several."
    alone = [e for e in episodes if e.outside_share > _ALONE and e.n_actions >= _FEWEST_ACTIONS]
    share = sum(e.outside_share for e in episodes) / len(episodes)
    enough = max(quantile, _SMALLEST_QUANTILE)
    outside = (
        f"{_percent(share)} of a held-out demonstration's actions are outside the safe set of the others "
        f"(mean of {len(episodes)})"
    )
    if len(alone) > enough * len(episodes) and 2 * len(alone) < len(episodes):
        return False, (
            f"{_named(alone)} of {len(episodes)} {_are(alone)} alone: most of their actions are where no other episode "
            "went; record more demonstrations like them, or leave them out with --dataset.episodes."
        )
    if share > _LARGEST_SHARE * enough:
        return False, f"More demonstrations are needed: {outside}."
    if spread > 0 and reach > _LARGEST_REACH * spread:
        return False, (
            "More demonstrations are needed: they are so far apart that the safe set reaches "
            f"{_percent(reach / spread)} of their spread from each of them."
        )
    but = f", but {_named(alone).lower()} {_are(alone)} alone" if alone else ", and no demonstration is alone"
    return True, f"The demonstrations are enough: {outside}{but}."


def _named(episodes: Sequence[EpisodeSupport]) -> str:
    names = [str(episode.episode) for episode in episodes[:_N_NAMED]]
    if len(episodes) > _N_NAMED:
        names.append(f"{len(episodes) - _N_NAMED} more")
    if len(names) == 1:
        return f"Episode {names[0]}"
    return f"Episodes {', '.join(names[:-1])} and {names[-1]}"


def _are(episodes: Sequence[EpisodeSupport]) -> str:
    return "is" if len(episodes) == 1 else "are"


def _percent(share: float) -> str:
    return f"{100 * share:.1f}".removesuffix(".0") + " %"
