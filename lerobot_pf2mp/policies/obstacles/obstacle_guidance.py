# SPDX-License-Identifier: Apache-2.0
"""Obstacles in one call of a policy: in the guide, on the finished chunk, and in the check of its plans."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from lerobot_pf2mp.flow_matching import Guide
from lerobot_pf2mp.obstacle_field import Obstacles, Passing
from lerobot_pf2mp.policies.obstacles.obstacle_options import ObstacleOptions
from lerobot_pf2mp.policies.obstacles.recorded_units import RecordedUnits
from lerobot_pf2mp.policies.plans.plan_choice import DrawMore, WayCheck
from lerobot_pf2mp.potential_field import PotentialField

# The share of the mean shift that a pull between two rounds of bulges takes.
_PULL = 0.5

# A way that comes too near an obstacle is worse than any density, the more so the nearer [nats].
_HIT = 1e6

# Moving each action alone out of several obstacles takes turns.
_N_PROJECTIONS = 4


@dataclass(eq=False)
class ObstacleGuidance:
    """What a policy does about obstacles in one call. Chunks are normalised, all geometry is in recorded units.

    Args:
        options: The policy's configuration.
        obstacles: Those of B robots, or of one for all.
        units: Those of the D action dimensions that are positions.
        dims: These dimensions; None for all.
        places: ``(B, D)`` where the robots are [recorded]; None if that is unknown: at their first actions.
        potential_field: What the sides are chosen by, and what pulls between the rounds; None without.
        n_past: Number of actions of a generated chunk that lie before the current step.
        n_committed: Number of first actions that are executed before a chunk is there.
    """

    options: ObstacleOptions
    obstacles: Obstacles
    units: RecordedUnits
    dims: tuple[int, ...] | None
    places: Tensor | None
    potential_field: PotentialField | None
    n_past: int = 0
    n_committed: int = 0
    _rows: Tensor | None = field(default=None, init=False)  # of the batch, whose plans are drawn now

    @contextmanager
    def drawing(self, rows: Tensor | None, n_each: int = 1) -> Iterator[None]:
        """A block in which chunks of some robots ``(F,)`` come, `n_each` of each one after the other; None for all."""
        before, self._rows = self._rows, None if rows is None else rows.repeat_interleave(n_each)
        try:
            yield
        finally:
            self._rows = before

    def guided(self, guide: Guide | None) -> Guide:
        """A guide after which the end point that each step predicts also passes the obstacles."""

        def guided(x_t: Tensor, x_next: Tensor, x_1: Tensor, dt: float) -> Tensor:
            bent = x_next if guide is None else guide(x_t, x_next, x_1, dt)
            end = x_1 + (bent - x_next)
            shifts = self._shifts(end[:, self.n_past :], n_rounds=1)
            return (
                bent
                if shifts is None
                else torch.cat([bent[:, : self.n_past], bent[:, self.n_past :] + shifts], dim=1)
            )

        return guided

    def drawn_past(self, draw_more: DrawMore | None) -> DrawMore | None:
        """A function that draws further plans, which pass the obstacles too."""
        if draw_more is None:
            return None

        def draw(rows: Tensor, n_each: int) -> Tensor:
            with self.drawing(rows, n_each):
                return self.finished(draw_more(rows, n_each))

        return draw

    def finished(self, chunk: Tensor) -> Tensor:
        """Chunks ``(N, T, A)`` that pass the obstacles; those that are clear are returned as they are."""
        shifts = self._shifts(chunk)
        return chunk if shifts is None else chunk + shifts

    def projected(self, chunk: Tensor) -> Tensor:
        """Chunks ``(N, T, A)`` of which each action alone is moved out of the obstacles."""
        ways, times = self._ways(chunk)
        points, times = ways[:, 1:], times[1:]
        obstacles = self._of_rows(self.obstacles, len(chunk))
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

    def _shifts(self, chunk: Tensor, n_rounds: int | None = None) -> Tensor | None:
        """``(N, T, A)`` what is added to chunks so that they pass the obstacles [normalised]; None for nothing."""
        ways, times = self._ways(chunk)
        rounds = {} if n_rounds is None else {"n_rounds": n_rounds}
        bent = self._passing(len(chunk))(ways, times, n_fixed=1 + self.n_committed, **rounds)
        return None if bent is ways else self._as_shifts((bent - ways)[:, 1:], chunk)

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
        places = positions[:, 0] if self.places is None else self._of_rows(self.places, len(chunk))
        times = torch.arange(positions.shape[1] + 1, device=chunk.device) / (self.options.obstacle_fps or 1.0)
        return torch.cat([places.unsqueeze(1), positions], dim=1), times

    def _passing(self, n: int) -> Passing:
        obstacles = self._of_rows(self.obstacles, n)
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

    def _of_rows[Rows: (Tensor, Obstacles)](self, values: Rows, n: int) -> Rows:
        """Those of the robots whose n chunks come."""
        if self._rows is not None and len(self._rows) == n and len(values) > 1:
            return values[self._rows]
        if len(values) == n:
            return values
        if len(values) != 1:
            raise ValueError(f"obstacles must be known of each of {n} robots, got those of {len(values)}")
        return values[torch.zeros(n, dtype=torch.int64, device=self.units.factors.device)]


@dataclass(frozen=True, eq=False)
class ObstacleCheck:
    """Judges the ways of plans also by their distance to obstacles.

    Args:
        guidance: The obstacles of this call.
        density: Judges them by the density; None without.
        rows: ``(N,)`` the robots whose plans are judged; None for all.
    """

    guidance: ObstacleGuidance
    density: WayCheck | None
    rows: Tensor | None = None

    def of_rows(self, rows: Tensor, n_each: int) -> ObstacleCheck:
        """The check of `n_each` plans of some robots."""
        return replace(self, rows=rows.repeat_interleave(n_each))

    def __call__(self, places: Tensor, chunks: Tensor) -> Tensor:
        """The support ``(B, T)`` of each action, see `PlanCheck`. On the way to an obstacle it is far below any other."""
        with self.guidance.drawing(self.rows):
            clearances = self.guidance.clearances(chunks)
        density = torch.zeros_like(clearances) if self.density is None else self.density(places, chunks)
        return torch.where(clearances < 0, _HIT * (clearances.clamp_min(-1e3) - 1), density)
