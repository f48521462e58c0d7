# SPDX-License-Identifier: Apache-2.0
"""How well a way is supported: the polyline from where a robot is through the actions that it will execute.

Two supported actions may have an obstacle between them. So a way is judged by the smallest density on all of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from lerobot_pf2mp.density.kernels import wrap

# A piece of a way is judged at this many points at most, so that a wild plan costs bounded time and memory. At a bandwidth
# of 1 % of a dimension's range, that is a piece across the whole range. On a longer one, points are farther apart than h.
_MOST_POINTS = 128


def way_log_density(
    log_density: Callable[[Tensor, Tensor], Tensor],
    ways: Tensor,
    bandwidth: float,
    periods: Tensor | None = None,
) -> Tensor:
    """The smallest log density on each piece of some ways.

    A piece is judged at its ends and between them, at points at most a bandwidth h apart. So no point of the way is
    farther than h/2 from a judged one. Over h/2, the kernel of an anchor at a distance of 2h changes by a factor of 3, so
    what lies between judged points is missed by about one nat at the edge of the demonstrated region. The number of points
    grows with the length of the way, not with the number of its actions.

    Args:
        log_density: Maps ``(Q, D)`` points and the ``(Q,)`` numbers of their pieces, counted over all ways, to ``(Q,)`` log
            densities [nats]. It is called once.
        ways: ``(B, K + 1, D)`` the corners of each way: where the robot is, then K >= 1 actions [normalised].
        bandwidth: h [normalised].
        periods: ``(D,)`` periods of angles [normalised], 0 for other dimensions; None if there are no angles. A piece goes
            the short way round.

    Returns:
        ``(B, K)`` for each action the smallest log density on the piece that leads to it, with both its ends [nats].
    """
    n_ways, n_corners, dim = ways.shape
    starts, steps = ways[:, :-1].reshape(-1, dim), ways.diff(dim=1).reshape(-1, dim)  # (P, D), P pieces
    if periods is not None:
        steps = wrap(steps, periods)
    n_points = (steps.norm(dim=-1) / bandwidth).ceil().clamp(1, _MOST_POINTS).long()
    piece = torch.repeat_interleave(torch.arange(len(steps), device=ways.device), n_points)  # (Q,)
    number = torch.arange(len(piece), device=ways.device) - (n_points.cumsum(0) - n_points)[piece]
    share = (number + 1) / n_points[piece]
    points = starts[piece] + share.unsqueeze(-1) * steps[piece]
    # The robot's place is the one corner at which no piece ends.
    first_pieces = torch.arange(n_ways, device=ways.device) * (n_corners - 1)
    density = log_density(torch.cat([ways[:, 0], points]), torch.cat([first_pieces, piece]))
    at_places, density = density.split([n_ways, len(piece)])
    smallest = density.new_full((len(steps),), math.inf).scatter_reduce(0, piece, density, "amin")
    at_ends = density[n_points.cumsum(0) - 1].view(n_ways, -1)  # of pieces
    at_starts = torch.cat([at_places.unsqueeze(1), at_ends[:, :-1]], dim=1)
    return torch.minimum(smallest.view(n_ways, -1), at_starts)


def conformal_threshold(scores: Tensor, false_alarm_rate: float) -> tuple[float, float]:
    """The threshold below which a new score falls with at most a given probability (split-conformal prediction).

    If the new score is exchangeable with the n known ones, it is below the k-th smallest of them with a probability of at
    most k/(n + 1) (Vovk et al., Algorithmic Learning in a Random World, 2005). k is the largest number for which that is
    within the rate; at least 1, so the rate cannot be below 1/(n + 1).

    Args:
        scores: ``(n,)`` known scores, n >= 1.
        false_alarm_rate: The probability wanted, in (0, 1).

    Returns:
        The threshold, and the rate that it keeps: k/(n + 1).
    """
    k = max(1, math.floor(false_alarm_rate * (len(scores) + 1) * (1 + 1e-12)))
    return scores.kthvalue(min(k, len(scores))).values.item(), k / (len(scores) + 1)
