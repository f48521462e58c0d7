# SPDX-License-Identifier: Apache-2.0
"""Looks up the actions of each episode in the field that the other episodes make."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from lerobot_pf2mp.density.held_out import HeldOut, group_numbers, robust_spread
from lerobot_pf2mp.field_report.other_episodes import OtherEpisodes, Thresholds, reach_of
from lerobot_pf2mp.field_report.report import DimensionShare, EpisodeSupport, FieldReport, OutlyingFrame
from lerobot_pf2mp.field_report.verdict import judge_demonstrations
from lerobot_pf2mp.policies.guided.action_kind import ActionKind
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.policies.guided.field_settings import FieldSettings
from lerobot_pf2mp.policies.guided.remarks import remarks_on_dimensions


class Frames(NamedTuple):
    """Actions of a dataset.

    Args:
        actions: ``(Q, D)`` actions in the field's dimensions [normalised].
        episodes: ``(Q,)`` int64 episode numbers; None if they are unknown.
        numbers: ``(Q,)`` int64 indices of the frames in the dataset.
    """

    actions: Tensor
    episodes: Tensor | None
    numbers: Tensor


def make_field_report(
    demonstrations: DemonstratedActions,
    *,
    source: str,
    settings: FieldSettings | None = None,
    frames: Frames | None = None,
    names: Sequence[str] | None = None,
    action_kind: ActionKind | None = None,
) -> FieldReport:
    """The report on a field.

    Args:
        demonstrations: The sample to which the field is fitted.
        source: What it is a sample of, for the reader.
        settings: The settings of the field; None for those of the sample.
        frames: The actions to look at; None for the sample itself.
        names: ``(A,)`` names of the dataset's action dimensions; None if they are unknown.
        action_kind: How the recorded actions go along with the state.

    Raises:
        ValueError: If there are no demonstrations, or a setting breaks its rule.
    """
    settings = settings or demonstrations.settings
    field = demonstrations.field(settings)
    judged = demonstrations.judged(replace(settings, bandwidth=field.bandwidth))
    n_points = len(judged.is_outlying)
    episodes = None if demonstrations.episodes is None else demonstrations.episodes[:n_points]
    sample = Frames(demonstrations.points[:n_points], episodes, demonstrations.frames[:n_points])
    frames = frames or sample
    kept = ~judged.is_outlying
    groups, frame_groups = _common_groups(sample, frames)
    periods = judged.field.periods
    others = OtherEpisodes(sample.actions[kept], groups[kept], field.bandwidth, periods)
    log_density, distance = others(frames.actions, frame_groups)
    _, is_outlying = HeldOut(frames.actions, frame_groups, periods, frames.numbers).far_and_outlying(
        distance, field.bandwidth
    )
    thresholds = Thresholds(
        judged.log_density[kept], groups[kept], settings.threshold_quantile, field.log_threshold
    )
    supports = _supports(frames, frame_groups, log_density, ~is_outlying, thresholds)
    dims = settings.action_dims or tuple(range(field.dim))
    reach = reach_of(field.bandwidth, field.log_threshold, *field.anchors.shape)
    spread = robust_spread(sample.actions[kept], periods)
    is_enough, verdict = judge_demonstrations(supports, settings.threshold_quantile, reach, spread)
    return FieldReport(
        source=source,
        bandwidth=field.bandwidth,
        log_threshold=field.log_threshold,
        threshold_quantile=settings.threshold_quantile,
        reach=reach,
        spread=spread,
        n_frames=len(frames.actions),
        n_anchors=len(field.anchors),
        effective_anchors=others.effective_anchors(),
        episodes=supports,
        outlying=_outlying_frames(frames, is_outlying, distance, field.bandwidth),
        dimensions=_dimensions(others, dims, names),
        remark=remarks_on_dimensions(sample.actions[kept], field.bandwidth, dims),
        action_kind=action_kind,
        is_enough=is_enough,
        verdict=verdict,
    )


def _supports(
    frames: Frames, groups: Tensor, log_density: Tensor, is_kept: Tensor, thresholds: Thresholds
) -> tuple[EpisodeSupport, ...]:
    numbers = torch.zeros_like(groups) if frames.episodes is None else frames.episodes
    order = numbers.argsort(stable=True)
    distinct, counts = torch.unique_consecutive(numbers[order], return_counts=True)
    supports = []
    for number, rows in zip(distinct.tolist(), order.split(counts.tolist()), strict=True):
        rows = rows[is_kept[rows]]
        if not len(rows):
            continue
        # A single recording is cut into blocks, which have a threshold each.
        support = torch.cat(
            [
                log_density[rows[groups[rows] == group]] - thresholds.without(group)
                for group in torch.unique(groups[rows]).tolist()
            ]
        )
        supports.append(
            EpisodeSupport(
                None if frames.episodes is None else number,
                len(rows),
                (support < 0).double().mean().item(),
                support.min().item(),
            )
        )
    return tuple(supports)


def _common_groups(sample: Frames, frames: Frames) -> tuple[Tensor, Tensor]:
    """The group numbers of the sample's actions, and of those to be judged."""
    episodes = None
    if sample.episodes is not None and frames.episodes is not None:
        episodes = torch.cat([sample.episodes, frames.episodes])
    numbers = torch.cat([sample.numbers, frames.numbers])
    groups = group_numbers(len(numbers), episodes, numbers)
    return groups[: len(sample.numbers)], groups[len(sample.numbers) :]


def _outlying_frames(
    frames: Frames, is_outlying: Tensor, distance: Tensor, bandwidth: float
) -> tuple[OutlyingFrame, ...]:
    rows = is_outlying.nonzero().flatten()
    rows = rows[distance[rows].argsort(descending=True, stable=True)]
    return tuple(
        OutlyingFrame(
            None if frames.episodes is None else int(frames.episodes[row]),
            int(frames.numbers[row]),
            float(distance[row]),
            float(distance[row]) / bandwidth,
        )
        for row in rows.tolist()
    )


def _dimensions(
    judge: OtherEpisodes, dims: Sequence[int], names: Sequence[str] | None
) -> tuple[DimensionShare, ...]:
    squares = judge.squares_to_nearest()
    shares = squares / squares.sum() if squares.sum() > 0 else torch.zeros_like(squares)
    found = []
    for d, (dim, share) in enumerate(zip(dims, shares.tolist(), strict=True)):
        n_values = len(torch.unique(judge.anchors[:, d]))
        kind = {1: "constant", 2: "two values"}.get(n_values, "continuous")
        if judge.periods is not None and judge.periods[d] > 0:
            kind = "angle"
        name = str(names[dim]) if names is not None and dim < len(names) else f"dimension {dim}"
        found.append(DimensionShare(dim, name, share, kind))
    return tuple(found)
