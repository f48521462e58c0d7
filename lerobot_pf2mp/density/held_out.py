# SPDX-License-Identifier: Apache-2.0
"""Points judged by the points of other episodes.

A density that judges the points it was made from flatters them: each point finds its own kernel, and in a recording
also the frames just before and after it. Here a point is judged by the other episodes alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from lerobot_pf2mp.density.kernel_sums import KernelSums
from lerobot_pf2mp.density.kernels import log_kernels

# A recording without episodes is cut into this many blocks of time. With its two neighbours a block is 3 % of the
# recording: longer than noise and a rest last, short enough for the path before and after it to vouch for a frame.
N_BLOCKS = 100

# A point is far from all others if the next point is this many times farther than for nine in ten of the points.
_FAR = 5.0
_USUAL_QUANTILE = 0.9

# Points beyond a gap in one coordinate are far from all others if they are at most this share of all points.
_LARGEST_SHARE_BEYOND_GAP = 0.02

_PAIRS_AT_ONCE = 2**22


class Judgement(NamedTuple):
    """What the other episodes say of a point.

    Args:
        log_density: ``(Q,)`` log density without the point's own episode [nats]; -inf if nothing else remains.
        distance: ``(Q,)`` distance to the nearest point of another episode [normalised]; inf if nothing else remains.
    """

    log_density: Tensor
    distance: Tensor


def group_numbers(n_points: int, episodes: Tensor | None, times: Tensor | None = None) -> Tensor:
    """The number of each point's group. Points whose numbers differ by at most 1 do not judge each other.

    Args:
        n_points: Number of points P.
        episodes: ``(P,)`` int64 episode numbers; None if nothing is known of episodes.
        times: ``(P,)`` int64 positions in time, for example frame numbers; None for the order of the points.

    Returns:
        ``(P,)`` int64. Episodes get numbers 2 apart. A single episode is cut into `N_BLOCKS` blocks of equal time with
        successive numbers, so a point is judged without its block and the two blocks beside it.
    """
    if episodes is not None:
        distinct, number = torch.unique(episodes, return_inverse=True)
        if len(distinct) > 1:
            return 2 * number
    if times is None:
        times = torch.arange(n_points)
    first = times.min()
    return (times - first) * N_BLOCKS // (times.max() - first + 1)


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Judges points by those of other groups.

    Args:
        points: ``(P, D)`` float32 points on the CPU [normalised].
        groups: ``(P,)`` their group numbers, see `group_numbers`.
        periods: ``(D,)`` periods of angles [normalised], 0 for other dimensions; None if there are no angles.
    """

    points: Tensor
    groups: Tensor
    periods: Tensor | None = None

    def judge(self, bandwidth: float, queries: Tensor | None = None, groups: Tensor | None = None) -> Judgement:
        """The judgement over some points.

        Args:
            bandwidth: The kernel bandwidth h > 0 [normalised].
            queries: ``(Q, D)`` points to judge; None for all points.
            groups: ``(Q,)`` their group numbers.
        """
        queries = self.points if queries is None else queries
        groups = self.groups if groups is None else groups
        sums = KernelSums(self.points, bandwidth, self.periods, self.groups)
        log_sums, distances = sums.sums_without_own_group(queries, groups)
        log_normaliser = self.points.shape[1] * (math.log(bandwidth) + 0.5 * math.log(2 * math.pi))
        return Judgement(log_sums - self._n_others(groups).log() - log_normaliser, distances)

    @cached_property
    def is_one_recording(self) -> bool:
        """Whether the groups are blocks of one recording, not episodes, whose numbers are even."""
        return bool((self.groups % 2 == 1).any())

    @cached_property
    def can_judge(self) -> bool:
        """Whether there is a point that others can judge."""
        return bool((self._n_others(self.groups) > 0).any())

    def outlying(self, distance: Tensor, bandwidth: float) -> Tensor:
        """The points that are far from all others, such as single wrong values of a sensor.

        Far means `_FAR` times the distance that 90 % of the points have to the nearest point of another episode, and
        `_FAR` bandwidths. A path on which no other episode went is not outlying: its frames lead there step by step. So
        what a chain of such steps joins to the other points is kept. A few points beyond a gap of that size in one
        coordinate, the saturated values of a sensor for example, are outlying also where they are near one another.

        Args:
            distance: ``(P,)`` distance of each point to the nearest point of another episode [normalised].
            bandwidth: h [normalised].

        Returns:
            ``(P,)`` bool.
        """
        known = distance[distance.isfinite()]
        if not len(known):
            return torch.zeros(len(distance), dtype=torch.bool)
        usual = known.kthvalue(max(1, math.ceil(_USUAL_QUANTILE * len(known)))).values.item()
        limit = _FAR * max(usual, bandwidth)
        is_beyond = self._is_beyond_gap(limit)
        is_far = is_beyond | (distance > limit) & distance.isfinite()
        is_far[is_far.clone()] = ~self._is_joined(self.points[is_far], self.points[~is_far], limit)
        return is_far

    def _is_beyond_gap(self, limit: float) -> Tensor:
        """Whether a gap wider than `limit` in one coordinate separates a point, with few others, from the rest."""
        n_points = len(self.points)
        n_most = int(_LARGEST_SHARE_BEYOND_GAP * n_points)
        is_beyond = torch.zeros(n_points, dtype=torch.bool)
        if n_most == 0:
            return is_beyond
        for d, coordinate in enumerate(self.points.unbind(1)):
            if self.periods is not None and self.periods[d] > 0:
                continue
            ordered, order = coordinate.sort()
            gaps = ordered.diff() > limit
            low = gaps[:n_most].nonzero().flatten()
            high = gaps[len(gaps) - n_most :].nonzero().flatten()
            if len(low):
                is_beyond[order[: low[-1] + 1]] = True
            if len(high):
                is_beyond[order[n_points - n_most + high[0] :]] = True
        return is_beyond

    def _is_joined(self, far: Tensor, others: Tensor, limit: float) -> Tensor:
        """Whether steps of at most `limit` lead from each far point to the others, ``(F,)``."""
        is_joined = self._has_neighbour(far, others, limit)
        newly = is_joined
        while newly.any():
            reached = torch.zeros_like(is_joined)
            reached[~is_joined] = self._has_neighbour(far[~is_joined], far[newly], limit)
            newly, is_joined = reached, is_joined | reached
        return is_joined

    def _has_neighbour(self, points: Tensor, others: Tensor, limit: float) -> Tensor:
        if not len(points) or not len(others):
            return torch.zeros(len(points), dtype=torch.bool)
        blocks = points.split(max(1, _PAIRS_AT_ONCE // len(others)))
        # The kernel of a neighbour at the limit, with h = limit, is exp(-1/2).
        return torch.cat(
            [(log_kernels(block, others, limit, self.periods) >= -0.5).any(dim=1) for block in blocks]
        )

    @cached_property
    def _n_of_group(self) -> Tensor:
        """``(G + 2,)`` number of points of groups -1 to G."""
        return torch.nn.functional.pad(torch.bincount(self.groups), (1, 1))

    def _n_others(self, groups: Tensor) -> Tensor:
        """``(Q,)`` number of points that judge a point of each of these groups."""
        n_of_group = self._n_of_group
        left_out = n_of_group[groups] + n_of_group[groups + 1] + n_of_group[groups + 2]
        return (len(self.points) - left_out).double()
