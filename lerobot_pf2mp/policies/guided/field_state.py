# SPDX-License-Identifier: Apache-2.0
"""The tensors of a potential field's file."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from lerobot_pf2mp.density.bandwidth import check_bandwidth

# Points are normalised. Wrong values of sensors may be millions, but squares of points must stay numbers.
_LARGEST = 1e12

# The role of a point.
OUTLYING, ANCHOR, SAFE_ANCHOR = 0, 1, 2


@dataclass(frozen=True, eq=False)
class FieldState:
    """The sample and the fitted field, as they are saved.

    Args:
        points: ``(P, D)`` actions [normalised].
        ranks: ``(P,)`` int64, see `frame_ranks`.
        n_shown: Number of actions seen that had no frame number.
        dataset_id: ``(N,)`` uint8, identifies the frames and their normalisation.
        bandwidth: h, float64 [normalised].
        log_threshold: Log density that bounds the safe set, float64 [nats].
        episodes: ``(P,)`` int64 episode numbers, -1 if unknown.
        unit: ``(D,)`` one recorded unit [normalised]; empty if unknown.
        steps: ``(D,)`` uint8, see `steps_seen`; empty if unknown.
        role: ``(P,)`` uint8: `OUTLYING`, `ANCHOR` or `SAFE_ANCHOR`.
        places: ``(2, D)`` how states become actions, see `places_of_states`; empty if unknown.
        held_out: ``(N,)`` log densities of points without their own episodes [nats]; empty if unknown.
        plans: ``(E, T + 1, D)`` demonstrated plans, see `DemonstratedPlans`; empty if unknown.
        plan_episodes: ``(E,)`` int64, their episodes.
        plan_ranks: ``(E,)`` int64, the ranks of their first frames.
        plan_scores: ``(n,)`` the support of demonstrated plans [nats]; empty if unknown.
        n_executed: Number of their actions on whose way that is.
        integration: ``(5, D)`` how displacements become positions, see `Integration`; empty for a field over actions.
    """

    points: Tensor
    ranks: Tensor
    n_shown: Tensor
    dataset_id: Tensor
    bandwidth: Tensor
    log_threshold: Tensor
    episodes: Tensor
    unit: Tensor
    steps: Tensor
    role: Tensor
    places: Tensor
    held_out: Tensor
    plans: Tensor
    plan_episodes: Tensor
    plan_ranks: Tensor
    plan_scores: Tensor
    n_executed: Tensor
    integration: Tensor

    def tensors(self) -> dict[str, Tensor]:
        """The tensors by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @classmethod
    def read(cls, tensors: dict[str, Tensor]) -> FieldState:
        """The state in a file's tensors.

        Files of before 0.2 lack what was added since. Their episodes are unknown, none of their dimensions is an angle, all
        points are anchors, and there are no demonstrated plans.

        Raises:
            ValueError: If an entry is missing or of the wrong kind, as in a corrupted file.
        """
        added = {"episodes", "unit", "steps", "role", "places", "held_out", "n_executed"}
        added |= {"plans", "plan_episodes", "plan_ranks", "plan_scores", "integration"}
        wanted = {field.name for field in fields(cls)} - added
        if not wanted <= set(tensors):
            raise ValueError(
                f"a potential field file must hold {sorted(wanted)}, got {sorted(tensors)}: it is corrupted"
            )
        points, ranks = tensors["points"], tensors["ranks"]
        if points.ndim != 2 or ranks.shape != points.shape[:1] or not bool((points.abs() < _LARGEST).all()):
            raise ValueError(
                f"a potential field file must hold finite points (P, D), below {_LARGEST:g}, with P ranks, got points "
                f"{tuple(points.shape)} and ranks {tuple(ranks.shape)}: it is corrupted"
            )
        for name in ("n_shown", "bandwidth", "log_threshold"):
            if tensors[name].numel() != 1:
                raise ValueError(
                    f"{name} in a potential field file must be one number, got {tuple(tensors[name].shape)}: "
                    "it is corrupted"
                )
        check_bandwidth(tensors["bandwidth"].item(), "bandwidth in a potential field file")
        if not bool(tensors["log_threshold"].isfinite()):
            raise ValueError(
                f"log_threshold in a potential field file must be finite, got {tensors['log_threshold'].item()}: it is "
                "corrupted"
            )
        defaults = {
            "episodes": torch.full((len(points),), -1),
            "unit": torch.empty(0),
            "steps": torch.empty(0, dtype=torch.uint8),
            "role": torch.full((len(points),), ANCHOR, dtype=torch.uint8),
            "places": torch.empty(0, 0),
            "held_out": torch.empty(0),
            "plans": torch.empty(0, 0, 0),
            "plan_episodes": torch.empty(0, dtype=torch.int64),
            "plan_ranks": torch.empty(0, dtype=torch.int64),
            "plan_scores": torch.empty(0),
            "n_executed": torch.tensor(1),
            "integration": torch.empty(0, 0),
        }
        if len(tensors.get("unit", ())) not in (0, points.shape[1]):
            # Points of other dimensions than the policy's. The policy says so where it needs the field.
            about_dims = "unit", "steps", "places", "plans", "plan_episodes", "plan_ranks", "plan_scores"
            tensors = {name: value for name, value in tensors.items() if name not in about_dims}
        state = cls(**{name: {**defaults, **tensors}[name] for name in wanted | added})
        state._check_added()
        return state

    def _check_added(self) -> None:
        n_points, dim = self.points.shape
        for name, value, size, dtype in (
            ("episodes", self.episodes, n_points, torch.int64),
            ("role", self.role, n_points, torch.uint8),
            ("unit", self.unit, dim, torch.float32),
            ("steps", self.steps, dim, torch.uint8),
        ):
            is_unknown = size == dim and not len(value)
            if value.dtype != dtype or (value.shape != (size,) and not is_unknown):
                raise ValueError(
                    f"{name} in a potential field file must be {size} numbers of type {dtype}, got "
                    f"{tuple(value.shape)} of {value.dtype}: it is corrupted"
                )
        self._check_plans()
        if not bool((self.role != OUTLYING).any()) or bool((self.role > SAFE_ANCHOR).any()):
            raise ValueError(
                "role in a potential field file must be 0, 1 or 2 and not 0 for all: it is corrupted"
            )
        if not bool((self.unit >= 0).all()) or not bool(self.unit.isfinite().all()):
            raise ValueError(
                f"unit in a potential field file must be finite and at least 0, got {self.unit.tolist()}: it is corrupted"
            )

    def _check_plans(self) -> None:
        n_plans, dim = len(self.plan_ranks), self.points.shape[1]
        n_corners = self.plans.shape[1] if self.plans.ndim == 3 else 0
        wanted = (n_plans, n_corners, dim) if n_plans else (0, 0, 0)
        if self.plans.shape != wanted or n_corners == 1 or self.plan_episodes.shape != self.plan_ranks.shape:
            raise ValueError(
                "a potential field file must hold plans (E, T + 1, D) with E episodes and ranks, got plans "
                f"{tuple(self.plans.shape)}, {tuple(self.plan_episodes.shape)} episodes and {n_plans} ranks: it is corrupted"
            )
        if self.places.numel() and self.places.shape != (2, dim):
            raise ValueError(
                f"places in a potential field file must be 2 x {dim} numbers, got {tuple(self.places.shape)}: it is "
                "corrupted"
            )
        if self.integration.numel() and self.integration.shape != (5, dim):
            raise ValueError(
                f"integration in a potential field file must be 5 x {dim} numbers, got {tuple(self.integration.shape)}: it "
                "is corrupted"
            )
        for name in ("places", "held_out", "plans", "plan_scores", "integration"):
            value = getattr(self, name)
            if value.dtype != torch.float32 or not bool(value.isfinite().all()):
                raise ValueError(
                    f"{name} in a potential field file must be finite numbers of type {torch.float32}, got "
                    f"{value.dtype}: it is corrupted"
                )
        is_number = self.n_executed.numel() == 1 and self.n_executed.dtype == torch.int64
        if not is_number or int(self.n_executed) < 1:
            raise ValueError(
                f"n_executed in a potential field file must be one number of type {torch.int64} from 1 on, got "
                f"{self.n_executed.tolist()}: it is corrupted"
            )
