# SPDX-License-Identifier: Apache-2.0
"""The numbers of a report."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from lerobot_pf2mp.policies.guided.action_kind import ActionKind


@dataclass(frozen=True)
class EpisodeSupport:
    """How an episode lies in the safe set H of the other episodes.

    Args:
        episode: Its number; None if nothing is known of episodes.
        n_actions: Number of its actions that were looked at, without outlying ones.
        outside_share: Share of them outside H, in [0, 1].
        smallest_support: Smallest log density above the threshold of H [nats], negative outside.
    """

    episode: int | None
    n_actions: int
    outside_share: float
    smallest_support: float


@dataclass(frozen=True)
class OutlyingFrame:
    """An action that is far from all others, such as a single wrong value of a sensor.

    Args:
        episode: The number of its episode; None if unknown.
        frame: Its index in the dataset.
        distance: Distance to the nearest action of another episode [normalised].
        bandwidths: The same distance in bandwidths h.
    """

    episode: int | None
    frame: int
    distance: float
    bandwidths: float


@dataclass(frozen=True)
class DimensionShare:
    """What an action dimension contributes to distances.

    Args:
        dim: Its number.
        name: Its name in the dataset, or its number.
        share: Its share of the mean squared distance between nearest actions of different episodes, in [0, 1].
        kind: continuous, constant, two values or angle.
    """

    dim: int
    name: str
    share: float
    kind: str


@dataclass(frozen=True)
class FieldReport:
    """The numbers of a report. Lengths are in normalised action units.

    Args:
        source: The dataset or checkpoint.
        bandwidth: Kernel bandwidth h.
        log_threshold: Log density that bounds the safe set H [nats].
        threshold_quantile: Share of the demonstrated actions that H was asked to leave out.
        reach: How far H reaches from a demonstrated action that is far from all others.
        spread: Robust spread of the actions: half the range between their 5 % and 95 % quantiles.
        n_frames: Number of frames looked at.
        n_anchors: Number of actions that make up the field.
        effective_anchors: 10 %, 50 % and 90 % quantiles of the number of anchors that count at an action, 1 / sum w^2 of
            the kernel weights w of other episodes.
        episodes: The episodes.
        outlying: The outlying frames, the farthest first.
        dimensions: The dimensions that the field covers.
        remark: A line about dimensions that the field cannot serve, or an empty string.
        action_kind: How the recorded actions go along with the state; None if unknown.
        is_enough: Whether the verdict is good; None if it cannot be told.
        verdict: One sentence, see `judge_demonstrations`.
    """

    source: str
    bandwidth: float
    log_threshold: float
    threshold_quantile: float
    reach: float
    spread: float
    n_frames: int
    n_anchors: int
    effective_anchors: tuple[float, float, float]
    episodes: tuple[EpisodeSupport, ...]
    outlying: tuple[OutlyingFrame, ...]
    dimensions: tuple[DimensionShare, ...]
    remark: str
    action_kind: ActionKind | None
    is_enough: bool | None
    verdict: str

    def as_json(self) -> dict[str, Any]:
        """The numbers for a JSON file; those that are not finite are None."""
        return _without_infinities(asdict(self))


def _without_infinities(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_infinities(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_infinities(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
