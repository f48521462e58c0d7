# SPDX-License-Identifier: Apache-2.0
"""Obstacles in one call of a policy: on its finished plans, and in their check.

Bulges on the end point that each integration step predicts were measured too. On the large maze with three discs on the
way (150 episodes, one plan), 18 plans hit a wall with them, and 9 with bulges on the finished plan alone, for half the time.
What is bent in one step, the network sends another way in the next.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lerobot_pf2mp.obstacle_field import Obstacles, Passing
from lerobot_pf2mp.policies.obstacles.obstacle_options import ObstacleOptions
from lerobot_pf2mp.policies.obstacles.recorded_units import RecordedUnits
from lerobot_pf2mp.policies.plans.plan_choice import DrawMore, WayCheck
from lerobot_pf2mp.potential_field import PotentialField

# The share of the mean shift that a pull between two rounds of bulges takes. On the large maze with three discs, 0.1 to 0.3
# left the fewest plans flagged; larger ones make the bulges ragged.
_PULL = 0.2

# A way that comes too near an obstacle is worse than any density, the more so the nearer [nats].
_HIT = 1e6

# Moving each action alone out of several obstacles takes turns.
_N_PROJECTIONS = 4


@dataclass(frozen=True, eq=False)
class ObstacleGuidance:
    """What a policy does about obstacles in one call. Chunks are normalised, all geometry is in recorded units.

    Args:
        options: The policy's configuration.
        obstacles: Those of B robots, or of one for all.
        units: Those of the D action dimensions that are positions.
        dims: These dimensions; None for all.
        places: ``(B, D)`` where the robots are [recorded]; None if that is unknown: at their first actions.
        potential_field: What the sides are chosen by, and what pulls between the rounds; None without.
        n_committed: Number of first actions that are executed before a chunk is there.
    """

    options: ObstacleOptions
    obstacles: Obstacles
    units: RecordedUnits
    dims: tuple[int, ...] | None
    places: Tensor | None
    potential_field: PotentialField | None
    n_committed: int = 0

    def of_rows(self, rows: Tensor, n_each: int) -> ObstacleGuidance:
        """The same for some robots ``(F,)``, each of which has `n_each` chunks, one after the other."""
        chosen = rows.repeat_interleave(n_each)
        return replace(
            self,
            obstacles=self.obstacles if len(self.obstacles) == 1 else self.obstacles[chosen],
            places=None if self.places is None else self.places[chosen],
        )

    def drawn_past(self, draw_more: DrawMore | None) -> DrawMore | None:
        """A function that draws further plans, which pass the obstacles too."""
        if draw_more is None:
            return None
        return lambda rows, n_each: self.of_rows(rows, n_each).finished(draw_more(rows, n_each))

    def finished(self, chunk: Tensor) -> Tensor:
        """Chunks ``(N, T, A)`` that pass the obstacles; those that are clear are returned as they are."""
        ways, times = self._ways(chunk)
        bent = self._passing(len(chunk))(ways, times, n_fixed=1 + self.n_committed)
        return chunk if bent is ways else chunk + self._as_shifts((bent - ways)[:, 1:], chunk)

    def projected(self, chunk: Tensor) -> Tensor:
        """Chunks ``(N, T, A)`` of which each action alone is moved out of the obstacles."""
        ways, times = self._ways(chunk)
        points, times = ways[:, 1:], times[1:]
        obstacles = self._obstacles_of(len(chunk))
        moved = points
        for _ in range(_N_PROJECTIONS):
            for k in range(obstacles.n_each):
                obstacle = obstacles.only(k)
                depth = (self.options.clearance - obstacle.distance(moved, times)[:, 0]).clamp_min(0.0)
                moved = moved + depth.unsqueeze(-1) * obstacle.gradient(moved, times)[:, 0]
        return chunk + self._as_shifts(moved - points, chunk)

    def clearances(self, chunk: Tensor) -> Tensor:
        """``(N, T)`` the distance to the nearest obstacle on the way to each action, above the one that is checked for."""
        passing = replace(self._passing(len(chunk)), clearance=self.options.checked_clearance)
        return passing.clearances(*self._ways(chunk))

    def _as_shifts(self, offsets: Tensor, chunk: Tensor) -> Tensor:
        offsets = (offsets * self.units.factors).to(chunk)
        if self.dims is None:
            return offsets
        dims = torch.tensor(self.dims, device=chunk.device)
        return torch.zeros_like(chunk).index_copy(-1, dims, offsets)

    def _ways(self, chunk: Tensor) -> tuple[Tensor, Tensor]:
        """The corners ``(N, T + 1, D)`` of the ways of chunks [recorded], and when robots are there [s]."""
        positions = chunk if self.dims is None else chunk[..., list(self.dims)]
        positions = self.units.recorded(positions.float())
        places = positions[:, 0] if self.places is None else self.places
        times = torch.arange(positions.shape[1] + 1, device=chunk.device) / (self.options.obstacle_fps or 1.0)
        return torch.cat([places.unsqueeze(1), positions], dim=1), times

    def _passing(self, n: int) -> Passing:
        obstacles = self._obstacles_of(n)
        if self.potential_field is None:
            return Passing(obstacles, self.options.clearance)
        density, units = self.potential_field, self.units

        def pull(points: Tensor) -> Tensor:
            return density.step_to_safety(units.normalised(points), _PULL, 0.0) / units.factors

        return Passing(
            obstacles,
            self.options.clearance,
            lambda points: density.log_density(units.normalised(points)),
            pull,
        )

    def _obstacles_of(self, n: int) -> Obstacles:
        if len(self.obstacles) == n:
            return self.obstacles
        if len(self.obstacles) != 1:
            raise ValueError(f"obstacles must be given for each of {n} robots, got {len(self.obstacles)}")
        return self.obstacles[torch.zeros(n, dtype=torch.int64, device=self.units.factors.device)]


@dataclass(frozen=True, eq=False)
class ObstacleCheck:
    """Judges the ways of plans also by their distance to obstacles.

    Args:
        guidance: The obstacles of this call.
        density: Judges them by the density; None without.
    """

    guidance: ObstacleGuidance
    density: WayCheck | None

    def of_rows(self, rows: Tensor, n_each: int) -> ObstacleCheck:
        """The check of `n_each` plans of some robots."""
        density = None if self.density is None else self.density.of_rows(rows, n_each)
        return ObstacleCheck(self.guidance.of_rows(rows, n_each), density)

    def __call__(self, places: Tensor, chunks: Tensor) -> Tensor:
        """The support ``(B, T)`` of each action, see `PlanCheck`. On the way to an obstacle it is far below any other."""
        clearances = self.guidance.clearances(chunks)
        density = torch.zeros_like(clearances) if self.density is None else self.density(places, chunks)
        return torch.where(clearances < 0, _HIT * (clearances.clamp_min(-1e3) - 1), density)
