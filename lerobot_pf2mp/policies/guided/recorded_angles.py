# SPDX-License-Identifier: Apache-2.0
"""Recognises angles in recorded actions: their values jump by a whole turn from one frame to the next."""

from __future__ import annotations

import torch
from torch import Tensor

# Largest deviation of a jump from the period, relative to the period.
_TOLERANCE = 0.1


def jumps_by_a_period(actions: Tensor, is_pad: Tensor | None, periods: Tensor) -> Tensor:
    """The dimensions in which actions jump by a period between two frames.

    The values of such a dimension must also lie within one period, as those of wrapped angles do.

    Args:
        actions: ``(B, T, D)`` successive actions [normalised].
        is_pad: ``(B, T)`` true where a chunk reaches beyond its episode; None if none does.
        periods: ``(D,)`` the period that each dimension has if it is an angle [normalised]; 0 if it cannot be one.

    Returns:
        ``(D,)`` bool, on the CPU.
    """
    periods = periods.to(actions.device)
    differences = actions.diff(dim=1)  # (B, T - 1, D)
    if is_pad is not None:
        differences = differences.masked_fill(is_pad[:, 1:].unsqueeze(-1), 0.0)
    jumps = (differences.abs() - periods).abs() < _TOLERANCE * periods  # (B, T - 1, D)
    flat = actions.flatten(end_dim=1)  # (B T, D)
    fits = flat.amax(dim=0) - flat.amin(dim=0) < (1 + _TOLERANCE) * periods
    return (jumps.flatten(end_dim=1).any(dim=0) & fits).cpu()
