# SPDX-License-Identifier: Apache-2.0
"""Rows of results to begin with: a benchmark's episode, a repeat, and cells of repeats."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from lerobot_pf2mp.results.rows import EpisodeRow, SummaryRow
from lerobot_pf2mp.results.summary import Cell

GUIDED = {"policy": "pf2mp", "guidance_integrator": "proximal", "guidance_scale": 0.8}
UNGUIDED = {"policy": "fmp", "guidance_integrator": "none", "guidance_scale": 0.0}
EPISODE = EpisodeRow(
    task="MazeLarge-v0",
    **GUIDED,
    variant="",
    seed=0,
    repeat=0,
    episode=0,
    success=True,
    collision=False,
    plan_in_wall=None,
    min_clearance_m=0.25,
    path_length_m=4.0,
    stroke_error_mm=None,
    steps=80,
    chunk_latency_ms=2.5,
    checkpoint="outputs/policy",
    commit="0123456789",
)
SUMMARY = SummaryRow(
    task="MazeLarge-v0",
    **GUIDED,
    variant="",
    seed=0,
    repeat=0,
    n_episodes=50,
    successes=49,
    collisions=1,
    plans_in_wall=None,
    only_unguided_collides=None,
    only_guided_collides=None,
    min_clearance_m=0.25,
    path_length_m=4.0,
    stroke_error_mm=None,
    chunk_latency_ms=2.5,
    checkpoint="outputs/policy",
    commit="0123456789",
)


def episodes(collisions: Sequence[bool | None], **values: Any) -> list[EpisodeRow]:
    """One repeat, an episode for each collision or not."""
    return [
        replace(EPISODE, episode=i, collision=collision, **values) for i, collision in enumerate(collisions)
    ]


def cell(*repeats: dict[str, Any]) -> Cell:
    return Cell(tuple(replace(SUMMARY, **repeat) for repeat in repeats))
