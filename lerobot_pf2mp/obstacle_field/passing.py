# SPDX-License-Identifier: Apache-2.0
"""Ways past obstacles: the whole chunk passes each of them on one side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from lerobot_pf2mp.obstacle_field.bulges import Bulges, bulges_past
from lerobot_pf2mp.obstacle_field.obstacles import Obstacles

# Rounds of a pull to the density and all bulges. A way that is not clear after them is left to the check of plans. On the
# large maze with three discs, more rounds changed nothing.
N_ROUNDS = 2

# A side whose bulge runs into another obstacle is worse than any density, the more so the deeper [nats].
_OTHER_OBSTACLE = 1e4
# That is, nearer to it than this share of the clearance. Bulges are clear within a few per cent.
_NEAR = 0.9


@dataclass(frozen=True, eq=False)
class Passing:
    """Bends ways around obstacles.

    For each obstacle that a way comes too near, a bulge to either side is tried, and the side is kept whose bulge the
    density supports better and which runs into no other obstacle. It is chosen once. Then a pull to the density and the
    bulges take turns, the bulges last: with the pull last, it would undo them.

    It is bounded: each round draws at most one bulge for each obstacle, each bulge is computed in a fixed number of steps,
    and there are at most `N_ROUNDS`. The bulges of a round are added, so where those of two obstacles overlap, a way bulges
    more than it must, or, on different sides, less. Between two obstacles that leave no room for the clearance, the bulges
    of one run into the other in every round. What is left of such a way is what the last round made of it, and the distance
    tells.

    Args:
        obstacles: K for each of B robots, in D dimensions.
        clearance: The distance to keep from their surfaces.
        log_density: Maps ``(Q, D)`` points to their log density ``(Q,)`` [nats]; None prefers the smaller bulge.
        pull: Maps ``(Q, D)`` points to offsets ``(Q, D)`` towards the density; None leaves it out.
    """

    obstacles: Obstacles
    clearance: float
    log_density: Callable[[Tensor], Tensor] | None = None
    pull: Callable[[Tensor], Tensor] | None = None

    def clearances(self, ways: Tensor, times: Tensor) -> Tensor:
        """``(B, C - 1)`` the distance to the nearest obstacle on each piece of ways ``(B, C, D)``, minus the clearance."""
        return self.obstacles.swept_distance(ways, times)[0].amin(dim=1) - self.clearance

    def __call__(self, ways: Tensor, times: Tensor, n_fixed: int = 1, n_rounds: int = N_ROUNDS) -> Tensor:
        """The ways, of which those that come too near an obstacle are bent; the others are returned as they are.

        Args:
            ways: ``(B, C, D)`` polylines. The first corner, where the robot is, stays.
            times: ``(C,)`` when the robot is at each corner [s].
            n_fixed: Number of first corners that stay, at least 1.
            n_rounds: Number of rounds, at least 1; the first one has no pull.
        """
        rows = (self.clearances(ways, times).amin(dim=1) < 0).nonzero().squeeze(1)
        if not len(rows):
            return ways
        bent = ways[rows]
        turn = _Turns(self, self.obstacles[rows], times, n_fixed, torch.zeros_like(bent[:, :, 0]))
        bent = turn.push(bent)
        for _ in range(n_rounds - 1):
            bent = turn.push(turn.pulled(bent))
        return ways.index_copy(0, rows, bent)


class _Turns:
    """The turns of a pull and of bulges on some ways, and the sides chosen for them.

    Args:
        passing: What they obey.
        obstacles: Those of the R ways.
        times: ``(C,)`` [s].
        n_fixed: Number of first corners that stay.
        is_moved: ``(R, C)`` zeros; becomes 1 where a bulge has moved a corner.
    """

    def __init__(
        self, passing: Passing, obstacles: Obstacles, times: Tensor, n_fixed: int, is_moved: Tensor
    ) -> None:
        self._passing, self._obstacles, self._times, self._n_fixed = passing, obstacles, times, n_fixed
        self._is_moved = is_moved
        self._sides = torch.zeros_like(obstacles.centre)  # (R, K, D); 0 where none is chosen

    def pulled(self, ways: Tensor) -> Tensor:
        """The ways after a pull of the corners that bulges have moved."""
        if self._passing.pull is None:
            return ways
        is_moved = self._is_moved > 0
        pulled = ways.clone()
        pulled[is_moved] += self._passing.pull(ways[is_moved])
        return pulled

    def push(self, ways: Tensor) -> Tensor:
        """The ways after a bulge past each obstacle that they come too near, all at once."""
        distance, _ = self._obstacles.swept_distance(ways, self._times)
        is_near = distance.amin(dim=2) < self._passing.clearance  # (R, K)
        is_chosen = self._sides.abs().amax(dim=-1) > 0
        pushed = ways
        for pairs, has_sides in ((is_near & is_chosen, True), (is_near & ~is_chosen, False)):
            rows, k = pairs.nonzero(as_tuple=True)
            if len(rows):
                shifts = self._shifts(ways[rows], rows, k, has_sides)
                pushed = pushed.index_add(0, rows, shifts)
        self._is_moved += ((pushed - ways).abs().amax(dim=-1) > 0).to(ways)
        return pushed

    def _shifts(self, ways: Tensor, rows: Tensor, k: Tensor, has_sides: bool) -> Tensor:
        """``(P, C, D)`` the bulges of ways past one obstacle each, on the side that is chosen, or chosen now."""
        passing = self._passing
        sides = self._sides[rows, k] if has_sides else None
        obstacle = self._obstacles.one_each(rows, k)
        bulges = bulges_past(obstacle, ways, self._times, passing.clearance, self._n_fixed, sides)
        if has_sides:
            return bulges.shifts[:, 0]
        best = self._scores(ways, rows, bulges).argmax(dim=1)  # (P,)
        pair = torch.arange(len(rows), device=rows.device)
        self._sides[rows, k] = bulges.sides[pair, best]
        return bulges.shifts[pair, best]

    def _scores(self, ways: Tensor, rows: Tensor, bulges: Bulges) -> Tensor:
        """``(P, S)`` how well each bulge is supported: the smallest log density of the corners that it moves [nats]."""
        n_sides = bulges.shifts.shape[1]
        bent = ways.unsqueeze(1) + bulges.shifts  # (P, S, C, D)
        density = self._passing.log_density
        if density is None:
            scores = -bulges.heights
        else:
            is_moved = bulges.shifts.abs().amax(dim=-1) > 0
            log_density = torch.full_like(bent[..., 0], torch.inf)
            log_density[is_moved] = density(bent[is_moved]).to(bent)
            scores = log_density.amin(dim=-1)
        others = self._obstacles[rows.repeat_interleave(n_sides)]
        distance, _ = others.swept_distance(bent.flatten(0, 1), self._times)
        clearance = self._passing.clearance
        depth = (_NEAR * clearance - distance).clamp_min(0.0).amax(dim=(1, 2)).view(-1, n_sides)
        return scores - _OTHER_OBSTACLE * depth / max(clearance, 1e-9)
