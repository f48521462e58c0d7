# SPDX-License-Identifier: Apache-2.0
"""Recognises angles in recorded actions: their values jump by a whole turn from one frame to the next."""

from __future__ import annotations

import torch
from torch import Tensor

# What was seen in a dimension. It is an angle if there were jumps and no leaps.
JUMP, LEAP = 1, 2

# Largest deviation of a jump from the period, and smallest step that is a leap, relative to the period.
_JUMP_TOLERANCE, _LEAP = 0.1, 0.25


def steps_seen(actions: Tensor, is_pad: Tensor | None, periods: Tensor) -> Tensor:
    """The kinds of large steps between successive actions.

    A jump is a step of one period. A leap is another step of more than a quarter of it, or a range of values wider than
    the period: so moves no joint whose angle is recorded within one turn.

    Args:
        actions: ``(B, T, D)`` successive actions [normalised].
        is_pad: ``(B, T)`` true where an action does not follow the one before it; None if all do.
        periods: ``(D,)`` the period that each dimension has if it is an angle [normalised]; 0 if it cannot be one.

    Returns:
        ``(D,)`` uint8 on the CPU: the sum of `JUMP` and `LEAP`, where seen.
    """
    periods = periods.to(actions.device)
    sizes = actions.diff(dim=1).abs()  # (B, T - 1, D)
    if is_pad is not None:
        sizes = sizes.masked_fill(is_pad[:, 1:].unsqueeze(-1), 0.0)
    jumps = ((sizes - periods).abs() < _JUMP_TOLERANCE * periods).flatten(end_dim=1)
    leaps = (sizes > _LEAP * periods).flatten(end_dim=1) & ~jumps
    flat = actions.flatten(end_dim=1)  # (B T, D)
    is_wide = flat.amax(dim=0) - flat.amin(dim=0) > (1 + _JUMP_TOLERANCE) * periods
    seen = JUMP * jumps.any(dim=0).to(torch.uint8) + LEAP * (leaps.any(dim=0) | is_wide).to(torch.uint8)
    return seen.cpu()
