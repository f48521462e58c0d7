# SPDX-License-Identifier: Apache-2.0
"""Draws other plans for robots whose plan leaves the demonstrated region, and chooses one for each."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from lerobot_pf2mp.policies.plans.plans import Plans, UnsupportedPlanError
from lerobot_pf2mp.potential_field import PotentialField
from lerobot_pf2mp.potential_field.ways import way_log_density

logger = logging.getLogger(__name__)

# Draws n plans for each of some robots: maps ``(F,)`` their rows and n to ``(F n, T, A)``.
DrawMore = Callable[[Tensor, int], Tensor]


class WayCheck(Protocol):
    """Judges the ways of plans."""

    def __call__(self, places: Tensor, chunks: Tensor) -> Tensor:
        """The support ``(B, T)`` of each action, see `PlanCheck`."""

    def of_rows(self, rows: Tensor, n_each: int) -> WayCheck:
        """The check of `n_each` plans of some robots ``(F,)`` of the batch, one after the other."""


@dataclass(frozen=True, eq=False)
class PlanCheck:
    """Judges the ways of plans.

    Args:
        field: The potential field.
        log_threshold: The log density below which a way leaves the demonstrated region [nats].
        dims: Action dimensions that the field covers; None for all.
    """

    field: PotentialField
    log_threshold: float
    dims: tuple[int, ...] | None = None

    def __call__(self, places: Tensor, chunks: Tensor) -> Tensor:
        """The support of each action: the smallest log density on the way that leads to it, above the threshold.

        Args:
            places: ``(B, A)`` where the robots are [normalised].
            chunks: ``(B, T, A)`` planned actions [normalised].

        Returns:
            ``(B, T)`` [nats], negative outside; -inf for actions that are not finite.
        """
        ways = torch.cat([places.unsqueeze(1), chunks], dim=1).float()
        if self.dims is not None:
            ways = ways[..., list(self.dims)]
        is_finite = ways.isfinite().all(dim=-1)  # (B, T + 1)
        density = way_log_density(
            lambda points, _: self.field.log_density(points),
            ways.nan_to_num(0.0, 0.0, 0.0),
            self.field.bandwidth,
            self.field.periods,
        )
        is_known = is_finite[:, 1:] & is_finite[:, :-1]
        return torch.where(is_known, density - self.log_threshold, -torch.inf)

    def of_rows(self, rows: Tensor, n_each: int) -> PlanCheck:
        """The same check, as the field is the same for all robots."""
        return self


def choose_plans(
    check: WayCheck, places: Tensor, chunk: Tensor, max_plans: int, draw_more: DrawMore | None
) -> tuple[Tensor, Plans]:
    """Chooses a plan for each robot: the first one whose whole way is supported, in the order in which they are drawn.

    For the robots whose first plan is not, all others are drawn at once. If none of them is supported either, it is the
    one with the best support. The first supported plan is a sample of the policy, given that it is supported. The best
    supported one of several would prefer the beaten track.

    Args:
        check: Judges ways.
        places: ``(B, A)`` where the robots are [normalised].
        chunk: ``(B, T, A)`` the first plans [normalised].
        max_plans: Largest number of plans for a robot.
        draw_more: Draws the others; None if there is no time.

    Returns:
        ``(B, T, A)`` the chosen plans, and what is known of them.
    """
    support = check(places, chunk)  # (B, T)
    n_drawn = torch.ones(len(chunk), dtype=torch.int64, device=chunk.device)
    is_flagged = support.amin(dim=1) < 0
    if max_plans > 1 and draw_more is not None and bool(is_flagged.any()):
        rows, n_more = is_flagged.nonzero().squeeze(1), max_plans - 1
        others = draw_more(rows, n_more)  # (F n, T, A)
        their_support = check.of_rows(rows, n_more)(places[rows].repeat_interleave(n_more, dim=0), others)
        others, their_support = (
            torch.cat([first[rows].unsqueeze(1), more.unflatten(0, (len(rows), n_more))], dim=1)
            for first, more in ((chunk, others), (support, their_support))
        )  # (F, 1 + n, T, ...)
        smallest = their_support.amin(dim=2)  # (F, 1 + n)
        is_supported = smallest >= 0
        best = torch.where(is_supported.any(dim=1), is_supported.int().argmax(dim=1), smallest.argmax(dim=1))
        robots = torch.arange(len(rows), device=rows.device)
        chunk = chunk.index_copy(0, rows, others[robots, best].to(chunk.dtype))
        support = support.index_copy(0, rows, their_support[robots, best])
        n_drawn = n_drawn.index_fill(0, rows, max_plans)
    smallest = support.amin(dim=1)
    return chunk, Plans(n_drawn, smallest < 0, smallest, support)


def react(
    on_unsupported: str, plans: Plans, chunk: Tensor, places: Tensor | None, n_committed: int = 0
) -> Tensor:
    """The actions to execute of chosen plans, some of which may still leave the demonstrated region.

    Args:
        on_unsupported: ignore; warn (logs a line); hold (warns, and from the first action on to which the way is
            unsupported, repeats the action before it: where the robot is, if that is the first one); or stop.
        plans: The plans.
        chunk: ``(B, T, A)`` their actions [normalised].
        places: ``(B, A)`` where the robots are [normalised]; None if that is unknown.
        n_committed: Number of first actions that pass, as continuations of the last plan, until this one is there.

    Raises:
        UnsupportedPlanError: With stop, if a plan leaves the region; with hold, if already the first action does, and it is
            unknown where the robot is.
    """
    if on_unsupported == "ignore" or not bool(plans.is_flagged.any()):
        return chunk
    message = f"{_what_is_wrong(plans)}, the best of {int(plans.n_drawn.max())} drawn"
    if on_unsupported == "stop":
        raise UnsupportedPlanError(f"{message}; nothing of it is executed (on_unsupported=stop)")
    if places is None:
        if on_unsupported == "hold" and n_committed == 0 and bool((plans.action_support[:, 0] < 0).any()):
            raise UnsupportedPlanError(
                f"{message}, and already the first action does. Where the robot is, which hold needs, is not known"
            )
        places = chunk[:, 0]
    logger.warning(message)
    return chunk if on_unsupported == "warn" else hold(chunk, places, plans.action_support, n_committed)


def _what_is_wrong(plans: Plans) -> str:
    n_plans, said = len(plans.is_flagged), []
    hits = torch.zeros_like(plans.is_flagged) if plans.clearance is None else plans.clearance.amin(dim=1) < 0
    if plans.clearance is not None and bool(hits.any()):
        what = "The plan comes" if n_plans == 1 else f"{int(hits.sum())} of {n_plans} plans come"
        said.append(f"{what} too near an obstacle, by up to {-plans.clearance.min().item():.3g}")
    leaves = plans.is_flagged & ~hits
    if bool(leaves.any()):
        what = "The plan leaves" if n_plans == 1 else f"{int(leaves.sum())} of {n_plans} plans leave"
        said.append(f"{what} the demonstrated region by up to {-plans.support[leaves].min().item():.1f} nats")
    return ", and ".join(said)


def hold(chunk: Tensor, places: Tensor, action_support: Tensor, n_committed: int = 0) -> Tensor:
    """Chunks ``(B, T, A)`` up to the first action with negative support; then the action before it, or the place.

    The first `n_committed` actions are kept: the robot has passed them when the chunk is there, and must not go back.
    """
    is_supported = action_support >= 0
    is_supported[:, :n_committed] = True
    is_followed = is_supported.cumprod(dim=1).bool()  # (B, T)
    last = is_followed.sum(dim=1)  # 0: none
    stops = torch.cat([places.unsqueeze(1).to(chunk), chunk], dim=1)[
        torch.arange(len(chunk), device=chunk.device), last
    ]
    return torch.where(is_followed.unsqueeze(-1), chunk, stops.unsqueeze(1))


class LatencyBudget:
    """Whether another pass of the network would be too late, when a robot moves while its next plan is generated.

    With real-time chunking, the caller says after how many steps of the last plan it wants the next one. The duration of
    a step follows from the time between two calls, and from the steps that were executed in between.
    """

    def __init__(self) -> None:
        self._pass: float | None = None  # [s], of further plans
        self._step: float | None = None  # [s]
        self._began: float | None = None

    def begin(self, n_executed: int | None) -> None:
        """A call begins; `n_executed` steps were executed since the last one, None if that is unknown."""
        now = time.perf_counter()
        if self._began is not None and n_executed:
            self._step = (now - self._began) / n_executed
        self._began = now

    def allows_another_pass(self, n_steps: int | None, n_plans: int = 1) -> bool:
        """Whether another pass, for `n_plans` plans, ends within `n_steps` steps since the call began.

        With `n_steps` None the robot waits for the plan. Until a pass has been timed, it is expected to take as long for
        each of its plans as the first plan took.
        """
        if n_steps is None or self._began is None:
            return True
        if self._step is None:
            return False
        elapsed = time.perf_counter() - self._began
        expected = n_plans * elapsed if self._pass is None else self._pass
        return elapsed + expected <= n_steps * self._step

    def took(self, seconds: float) -> None:
        """Another pass took this long [s]."""
        self._pass = seconds
