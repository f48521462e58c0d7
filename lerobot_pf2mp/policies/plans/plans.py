# SPDX-License-Identifier: Apache-2.0
"""What a policy says of the plans that it checked, and the errors by which it refuses one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

ON_UNSUPPORTED = ("ignore", "warn", "hold", "stop")


@dataclass(frozen=True, eq=False)
class Plans:
    """The plans of one call, one for each robot of a batch.

    Args:
        n_drawn: ``(B,)`` int64 plans drawn for each robot, at least 1.
        is_flagged: ``(B,)`` bool, whether the chosen plan still leaves the demonstrated region.
        support: ``(B,)`` smallest log density on the way of the chosen plan, above the threshold for plans [nats]. Of a way
            too near an obstacle it is below -1e6.
        action_support: ``(B, T)`` the same for the piece of the way that leads to each action.
        clearance: ``(B, T)`` the distance on each piece to the nearest obstacle, above the one that is checked for [units of
            the dataset's actions]; None without known obstacles.
    """

    n_drawn: Tensor
    is_flagged: Tensor
    support: Tensor
    action_support: Tensor
    clearance: Tensor | None = None


class UnsupportedPlanError(RuntimeError):
    """A plan leaves the demonstrated region, no other one was found, and ``on_unsupported`` is ``stop``."""


def require_finite(chunk: Tensor, batch: dict[str, Any]) -> Tensor:
    """A chunk ``(B, T, A)`` itself.

    Args:
        chunk: The chunk.
        batch: The observations from which it was generated.

    Raises:
        ValueError: If an action is NaN or infinite. It names the observations that are too.
    """
    if torch.compiler.is_compiling():
        return _require_finite(chunk)
    if not bool(chunk.isfinite().all()):
        bad = [
            key
            for key, value in batch.items()
            if isinstance(value, Tensor) and value.is_floating_point() and not bool(value.isfinite().all())
        ]
        raise ValueError(_NOT_FINITE + (f": so are the observations {', '.join(bad)}" if bad else ""))
    return chunk


_NOT_FINITE = "planned actions must be finite, got NaN or infinite values, which are not executed"


# An operator, so that a compiled graph need not be interrupted.
@torch.library.custom_op("lerobot_pf2mp::require_finite", mutates_args=())
def _require_finite(chunk: Tensor) -> Tensor:
    if not bool(chunk.isfinite().all()):
        raise ValueError(_NOT_FINITE)
    return chunk.clone()


@_require_finite.register_fake
def _(chunk: Tensor) -> Tensor:
    return torch.empty_like(chunk)
