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
from lerobot_pf2mp.density.kernels import log_kernels, wrap

# A recording without episodes is cut into this many blocks of time. With its two neighbours a block is 3 % of the
# recording: longer than noise and a rest last, short enough for the path before and after it to vouch for a frame.
N_BLOCKS = 100

# A point is far from all others if the next point is this many times farther than for nine in ten of the points.
_FAR = 5.0
_USUAL_QUANTILE = 0.9

# Points beyond a gap in one coordinate are far from all others if they are at most this share of all points.
_LARGEST_SHARE_BEYOND_GAP = 0.02

# A frame leads to the next one at most at this multiple of the speed that 95 % of the frames stay below.
_FASTEST = 3.0
_USUAL_SPEED_QUANTILE = 0.95

# Points are clamped to this many spreads around the median: float32 would not resolve the others beside a farther one.
_FARTHEST = 1e4

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


def robust_spread(points: Tensor, periods: Tensor | None) -> float:
    """The spread of points ``(P, D)`` that few of them cannot change [normalised]; 0 if all are equal.

    It is the root mean square, over the dimensions that vary, of half the range between the 5 % and 95 % quantiles. If
    that range is zero in all dimensions, it is that of the standard deviations.
    """
    ordered = points.double().sort(dim=0).values
    low, high = (ordered[round(share * (len(points) - 1))] for share in (0.05, 0.95))
    halves = (high - low) / 2
    if periods is not None:
        halves = torch.where(periods > 0, halves.minimum(periods / 4), halves)
    if not bool((halves > 0).any()):
        halves = points.double().std(dim=0, correction=0)
    return halves[halves > 0].square().mean().sqrt().item() if bool((halves > 0).any()) else 0.0


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Judges points by those of other groups.

    Args:
        points: ``(P, D)`` float32 points on the CPU [normalised].
        groups: ``(P,)`` their group numbers, see `group_numbers`.
        periods: ``(D,)`` periods of angles [normalised], 0 for other dimensions; None if there are no angles.
        times: ``(P,)`` int64 positions in time, see `group_numbers`; None for the order of the points.
    """

    points: Tensor
    groups: Tensor
    periods: Tensor | None = None
    times: Tensor | None = None

    def __post_init__(self) -> None:
        median = self.points.median(dim=0).values
        limit = _FARTHEST * robust_spread(self.points, self.periods)
        if limit > 0 and bool(((self.points - median).abs() > limit).any()):
            clamped = self.points.clamp(median - limit, median + limit)
            object.__setattr__(self, "points", clamped)

    def judge(
        self, bandwidth: float, queries: Tensor | None = None, groups: Tensor | None = None
    ) -> Judgement:
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

    def far_and_outlying(self, distance: Tensor, bandwidth: float) -> tuple[Tensor, Tensor]:
        """The points that are far from other episodes, and those of them that are outlying: wrong values of a sensor.

        Far means `_FAR` times the distance that 90 % of the points have to the nearest point of another episode, and
        `_FAR` bandwidths. A path on which no other episode went is not outlying: its frames lead there step by step. So
        what is joined to the other points is kept, by points that are not far, or by successive frames at the speed of
        the recordings. A few points beyond a gap of that size in one coordinate, the saturated values of a sensor for
        example, are outlying also where they are near one another.

        Args:
            distance: ``(P,)`` distance of each point to the nearest point of another episode [normalised].
            bandwidth: h [normalised].

        Returns:
            ``(P,)`` bool each.
        """
        known = distance[distance.isfinite()]
        if not len(known):
            nothing = torch.zeros(len(distance), dtype=torch.bool)
            return nothing, nothing
        usual = known.kthvalue(max(1, math.ceil(_USUAL_QUANTILE * len(known)))).values.item()
        limit = _FAR * max(usual, bandwidth)
        is_beyond = self._is_beyond_gap(limit)
        is_far = is_beyond | (distance > limit) & distance.isfinite()
        if not bool(is_far.any()):
            return is_far, is_far
        return is_far, is_far & ~self._joined_to(~is_far, limit)

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

    def _joined_to(self, is_start: Tensor, limit: float) -> Tensor:
        """The points to which steps lead from some start points: of at most `limit`, or from frame to frame, ``(P,)``."""
        is_joined, newly = is_start, is_start
        before, leads = self._frames_before()
        while bool(newly.any()):
            reached = torch.zeros_like(is_joined)
            reached[leads] = is_joined[before[leads]]
            reached[before[leads]] |= is_joined[leads]
            far = ~is_joined
            reached[far] |= self._has_neighbour(self.points[far], self.points[newly], limit)
            newly, is_joined = reached & far, is_joined | reached
        return is_joined

    def _frames_before(self) -> tuple[Tensor, Tensor]:
        """``(P,)`` the row of the frame before each point in its episode, and ``(L,)`` rows to which that frame leads.

        It leads there at most at `_FASTEST` times the usual speed, and in a step of at most the points' spread: farther
        apart, the frames between them are not known.
        """
        times = torch.arange(len(self.points)) if self.times is None else self.times
        episode = torch.zeros_like(self.groups) if self.is_one_recording else self.groups
        order = times.argsort(stable=True)
        order = order[episode[order].argsort(stable=True)]
        before = torch.arange(len(order))
        before[order[1:]] = order[:-1]
        rows = order[1:][episode[order[1:]] == episode[order[:-1]]]
        if not len(rows):
            return before, rows
        offsets = self.points[rows] - self.points[before[rows]]
        if self.periods is not None:
            offsets = wrap(offsets, self.periods)
        steps = offsets.double().norm(dim=1)
        durations = (times[rows] - times[before[rows]]).clamp_min(1).double()
        speeds = steps / durations
        usual = speeds.kthvalue(max(1, math.ceil(_USUAL_SPEED_QUANTILE * len(rows)))).values
        largest_step = robust_spread(self.points, self.periods)
        return before, rows[(speeds <= _FASTEST * usual) & (steps <= largest_step)]

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
