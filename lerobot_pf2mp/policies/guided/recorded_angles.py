# SPDX-License-Identifier: Apache-2.0
"""Angles in recorded actions: recognised by values that jump by a whole turn from one frame to the next, or named."""

from __future__ import annotations

import torch
from torch import Tensor

from lerobot_pf2mp.policies.guided.field_settings import FieldSettings

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


class RecordedAngles:
    """What is known of the angles among the dimensions of a field.

    Args:
        unit: ``(D,)`` what one unit of the recorded actions is in normalised actions; empty if it is unknown.
        steps: ``(D,)`` uint8 `steps_seen` so far; empty if unknown.
    """

    def __init__(self, unit: Tensor | None = None, steps: Tensor | None = None) -> None:
        self.unit = torch.empty(0) if unit is None else unit
        self.steps = torch.empty(0, dtype=torch.uint8) if steps is None else steps

    def see(self, actions: Tensor, is_pad: Tensor | None, unit: Tensor, period: float) -> bool:
        """Looks for jumps by a period in successive actions, and returns whether other dimensions are angles now.

        Args:
            actions: ``(B, T, D)`` successive actions [normalised].
            is_pad: ``(B, T)`` true where an action does not follow the one before it.
            unit: ``(D,)`` what one unit of the recorded actions is in normalised actions.
            period: The period of angles [recorded units].
        """
        before, self.unit = self.steps, unit.cpu()
        self.steps = steps_seen(actions, is_pad, self.unit * period)
        if len(before):
            self.steps |= before
        return not torch.equal(self.steps == JUMP, before == JUMP)

    def periods(self, dims: tuple[int, ...], settings: FieldSettings) -> Tensor | None:
        """``(D,)`` the periods of the field's dimensions [normalised], 0 for those that are no angles; None without any.

        Args:
            dims: The action dimensions that the field covers.
            settings: The settings of the field.

        Raises:
            ValueError: If angles are named, and the unit is unknown.
        """
        if settings.angle_dims is None:
            is_angle = self.steps == JUMP
        else:
            if settings.angle_dims and not len(self.unit):
                raise ValueError(
                    f"field_angle_dims must be empty or null, got {settings.angle_dims}: the field does not know how "
                    "the recorded actions were normalised. pf2mp-fit-field makes a field that does"
                )
            is_angle = torch.tensor([dim in settings.angle_dims for dim in dims])
        if not bool(is_angle.any()):
            return None
        return torch.where(is_angle, self.unit * settings.angle_period, 0.0)
