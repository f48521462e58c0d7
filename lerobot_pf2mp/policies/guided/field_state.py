# SPDX-License-Identifier: Apache-2.0
"""The tensors of a potential field's file."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

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

    def tensors(self) -> dict[str, Tensor]:
        """The tensors by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @classmethod
    def read(cls, tensors: dict[str, Tensor]) -> FieldState:
        """The state in a file's tensors.

        Files of before 0.2 have no episodes, unit, steps and role. Their episodes are unknown, none of their dimensions
        is an angle, and all points are anchors.

        Raises:
            ValueError: If an entry is missing or of the wrong kind, as in a corrupted file.
        """
        added = {"episodes", "unit", "steps", "role"}
        wanted = {field.name for field in fields(cls)} - added
        if not wanted <= set(tensors):
            raise ValueError(
                f"a potential field file must hold {sorted(wanted)}, got {sorted(tensors)}: it is corrupted"
            )
        points, ranks = tensors["points"], tensors["ranks"]
        if points.ndim != 2 or ranks.shape != points.shape[:1] or not torch.isfinite(points).all():
            raise ValueError(
                "a potential field file must hold finite points (P, D) with P ranks, got points "
                f"{tuple(points.shape)} and ranks {tuple(ranks.shape)}: it is corrupted"
            )
        for name in ("n_shown", "bandwidth", "log_threshold"):
            if tensors[name].numel() != 1:
                raise ValueError(
                    f"{name} in a potential field file must be one number, got {tuple(tensors[name].shape)}: "
                    "it is corrupted"
                )
        defaults = {
            "episodes": torch.full((len(points),), -1),
            "unit": torch.empty(0),
            "steps": torch.empty(0, dtype=torch.uint8),
            "role": torch.full((len(points),), ANCHOR, dtype=torch.uint8),
        }
        if len(tensors.get("unit", ())) not in (0, points.shape[1]):
            # Points of other dimensions than the policy's. The policy says so where it needs the field.
            tensors = {name: value for name, value in tensors.items() if name not in ("unit", "steps")}
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
        if not bool((self.role != OUTLYING).any()) or bool((self.role > SAFE_ANCHOR).any()):
            raise ValueError(
                "role in a potential field file must be 0, 1 or 2 and not 0 for all: it is corrupted"
            )
        if not bool((self.unit >= 0).all()) or not bool(self.unit.isfinite().all()):
            raise ValueError(
                f"unit in a potential field file must be finite and at least 0, got {self.unit.tolist()}: it is corrupted"
            )
