# SPDX-License-Identifier: Apache-2.0
"""The sideways bulge of a way that clears one obstacle.

An obstacle that lies on the way cannot be avoided action by action: those before it would go back, those after it forward,
and the polyline between them would still cross it. So all actions around it move to the same side, by

    A cos^2(pi/2 (a - a*)/L),    |a - a*| < L,

with a the length along the way and a* where the way comes nearest. A is the smallest number with which each of these actions
is clear, enlarged for the straight pieces between them. All of this is seen from the obstacle, so a moving one is where it
will be at the time of each action.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from lerobot_pf2mp.obstacle_field.obstacles import Obstacles, nearest_share, rounded_box_distance

# Half the length of a bulge, in half lengths of what it passes. Shorter ones are higher, and nearer to walls: on the large
# maze with three discs on the way, 31 % of plans hit a wall with 1.6, 12 % with 3.
_LENGTH = 3.0

# And at least this many of the nearest piece of the way, so that the actions at its ends move.
_PIECES = 2.0

# An action at the foot of a bulge, below this share of its height, does not make the bulge higher.
_FOOT = 0.15

# In three dimensions a side is one of this many directions around the way.
_N_AROUND = 8

# By how much a bulge stretches the pieces of a way, at most. A chord of this length must be clear between its ends.
_STRETCH = 1.3

# Newton's method on a convex function, from its far side: from 5 steps on the rest is below 1 % of the radius.
_N_NEWTON = 5
_GRAZING = 0.05
_TINY = 1e-9


@dataclass(frozen=True, eq=False)
class Bulges:
    """Bulges of R ways, S for each.

    Args:
        shifts: ``(R, S, C, D)`` what is added to the corners of the ways.
        sides: ``(R, S, D)`` their directions, of length 1.
        heights: ``(R, S)``.
    """

    shifts: Tensor
    sides: Tensor
    heights: Tensor


def bulges_past(
    obstacle: Obstacles,
    ways: Tensor,
    times: Tensor,
    clearance: float,
    n_fixed: int = 1,
    sides: Tensor | None = None,
) -> Bulges:
    """The bulges that clear an obstacle, one for each side.

    Args:
        obstacle: One obstacle for each way (K = 1).
        ways: ``(R, C, D)`` the corners of the ways, which come nearer than the clearance.
        times: ``(C,)`` when the robot is there [s].
        clearance: The distance to keep from the obstacle's surface.
        n_fixed: Number of first corners that stay where they are, at least 1.
        sides: ``(R, D)`` the directions to take (S = 1); None for both sides, or directions all around in three dimensions.
    """
    local = obstacle.relative(ways, times)[:, 0]  # (R, C, D)
    half_sides = obstacle.half_sides[:, 0]  # (R, D)
    reach = obstacle.radius[:, 0] + clearance  # (R,)
    along = _Along.of(local, half_sides, n_fixed)
    tangent = along.tangent(reach + half_sides.norm(dim=-1))  # (R, D)
    if sides is None:
        directions = _sideways(tangent)  # (R, S, D)
    else:
        directions = _across(obstacle.mirrored(sides[:, None])[:, 0], tangent).unsqueeze(1)
    is_blocked = rounded_box_distance(local, half_sides.unsqueeze(1)) < reach.unsqueeze(1)  # (R, C)
    extent = along.extent(reach + (tangent.abs() * half_sides).sum(dim=-1), is_blocked)
    is_blocked_at_end = is_blocked[:, -1]
    half_length = torch.maximum(_LENGTH * extent, _PIECES * along.nearest_length)
    shape = along.bump(half_length, is_blocked_at_end)  # (R, C)
    longest = torch.where(shape[:, 1:] > 0, along.lengths, 0.0).amax(dim=-1)
    reach = (reach.square() + (_STRETCH * 0.5 * longest).square()).sqrt()
    needed = _exit_distances(local, directions, half_sides, reach)  # (R, S, C)
    is_foot = (shape < _FOOT).unsqueeze(1)
    heights = (needed / shape.clamp_min(_FOOT).unsqueeze(1)).masked_fill(is_foot, 0.0).amax(dim=-1)
    shifts = (heights.unsqueeze(-1) * shape.unsqueeze(1)).unsqueeze(-1) * directions.unsqueeze(2)
    world = obstacle.mirrored(torch.cat([shifts, directions.unsqueeze(2)], dim=2).unsqueeze(1))[:, 0]
    return Bulges(world[:, :, :-1], world[:, :, -1], heights)


@dataclass(frozen=True, eq=False)
class _Along:
    """Lengths along ways, as seen from an obstacle.

    Args:
        steps: ``(R, C - 1, D)`` the pieces.
        lengths: ``(R, C - 1)`` theirs.
        at: ``(R, C)`` the lengths to the corners.
        nearest: ``(R,)`` the length to where the way is nearest.
        nearest_length: ``(R,)`` that of the piece which is.
        n_fixed: Number of first corners that stay.
    """

    steps: Tensor
    lengths: Tensor
    at: Tensor
    nearest: Tensor
    nearest_length: Tensor
    n_fixed: int

    @classmethod
    def of(cls, local: Tensor, half_sides: Tensor, n_fixed: int) -> _Along:
        steps = local.diff(dim=1)
        lengths = steps.norm(dim=-1)
        at = torch.nn.functional.pad(lengths.cumsum(dim=-1), (1, 0))
        sides = half_sides.unsqueeze(1)
        share = nearest_share(local[:, :-1], steps, sides)
        distance = rounded_box_distance(local[:, :-1] + share.unsqueeze(-1) * steps, sides)
        piece = distance.argmin(dim=-1, keepdim=True)
        nearest = (at[:, :-1] + share * lengths).gather(1, piece).squeeze(1)
        return cls(steps, lengths, at, nearest, lengths.gather(1, piece).squeeze(1), n_fixed)

    def tangent(self, width: Tensor) -> Tensor:
        """``(R, D)`` the direction of the way within some lengths ``(R,)`` of where it is nearest."""
        middle = 0.5 * (self.at[:, 1:] + self.at[:, :-1])
        weight = (1 - (middle - self.nearest.unsqueeze(1)).abs() / width.unsqueeze(1)).clamp_min(1e-3)
        mean = (weight.unsqueeze(-1) * self.steps).sum(dim=1)
        length = mean.norm(dim=-1, keepdim=True)
        first = torch.zeros_like(mean)
        first[:, 0] = 1.0
        return torch.where(length > _TINY, mean / length.clamp_min(_TINY), first)

    def extent(self, length: Tensor, is_blocked: Tensor) -> Tensor:
        """``(R,)`` at least the lengths ``(R,)``, and up to the last blocked corner within twice of them, to either side."""
        offset = (self.at - self.nearest.unsqueeze(1)).abs()
        is_near = is_blocked & (offset < 2 * length.unsqueeze(1))
        return torch.maximum(length, torch.where(is_near, offset, 0.0).amax(dim=1))

    def bump(self, half_length: Tensor, is_blocked_at_end: Tensor) -> Tensor:
        """``(R, C)`` the shape of bulges of a half length ``(R,)``, at most 1, and 0 where the way must not move.

        The fixed corners stay, and so does the last one unless it is blocked, as it may be a goal.
        """
        nearest = self.nearest.unsqueeze(1)
        n_fixed = min(self.n_fixed, self.at.shape[1])
        before = torch.minimum(half_length, (nearest - self.at[:, n_fixed - 1 : n_fixed]).squeeze(1))
        after = torch.where(
            is_blocked_at_end,
            half_length,
            torch.minimum(half_length, self.at[:, -1] - self.nearest),
        )
        offset = self.at - nearest
        length = torch.where(offset < 0, before.unsqueeze(1), after.unsqueeze(1)).clamp_min(_TINY)
        share = offset.abs() / length
        shape = torch.cos(0.5 * math.pi * share).square().masked_fill(share >= 1, 0.0)
        shape[:, :n_fixed] = 0.0
        return shape


def _sideways(tangent: Tensor) -> Tensor:
    """``(R, S, D)`` directions across ways: both sides in two dimensions, `_N_AROUND` of them in three."""
    if tangent.shape[-1] == 2:
        left = torch.stack([-tangent[:, 1], tangent[:, 0]], dim=-1)
        return torch.stack([left, -left], dim=1)
    # Of the axes, the one least along the way is never parallel to it.
    other = torch.nn.functional.one_hot(tangent.abs().argmin(dim=-1), 3).to(tangent)
    first = torch.nn.functional.normalize(torch.linalg.cross(tangent, other), dim=-1)
    second = torch.linalg.cross(tangent, first)
    angles = 2 * math.pi * torch.arange(_N_AROUND, device=tangent.device) / _N_AROUND
    return torch.cos(angles).view(1, -1, 1) * first.unsqueeze(1) + torch.sin(angles).view(
        1, -1, 1
    ) * second.unsqueeze(1)


def _across(sides: Tensor, tangent: Tensor) -> Tensor:
    """Directions ``(R, D)`` without their part along the ways; some direction across for those along them."""
    across = sides - (sides * tangent).sum(dim=-1, keepdim=True) * tangent
    length = across.norm(dim=-1, keepdim=True)
    return torch.where(length > 0.1, across / length.clamp_min(_TINY), _sideways(tangent)[:, 0])


def _exit_distances(local: Tensor, directions: Tensor, half_sides: Tensor, reach: Tensor) -> Tensor:
    """How far points must move in some directions to be beyond a box, rounded by a reach; 0 if they need not.

    Newton's method starts at the box's supporting plane, which is outside. The distance is convex along a line, so every
    iterate stays outside, and what remains after the last one is on the safe side.

    Args:
        local: ``(R, C, D)`` the points, in the box's frame.
        directions: ``(R, S, D)`` of length 1.
        half_sides: ``(R, D)``.
        reach: ``(R,)`` the radius of the rounding.

    Returns:
        ``(R, S, C)``, at least 0.
    """
    sides = half_sides[:, None, None]
    points, direction = local.unsqueeze(1), directions.unsqueeze(2)  # (R, 1, C, D), (R, S, 1, D)
    support = (directions.abs() * half_sides.unsqueeze(1)).sum(dim=-1) + reach.unsqueeze(1)  # (R, S)
    distance = support.unsqueeze(-1) - (points * direction).sum(dim=-1)
    is_missed = torch.zeros_like(distance, dtype=torch.bool)
    for _ in range(_N_NEWTON):
        moved = points + distance.unsqueeze(-1) * direction
        out = moved - moved.clamp(-sides, sides)
        length = out.norm(dim=-1).clamp_min(_TINY)
        slope = (out * direction).sum(dim=-1) / length
        is_missed |= slope < _GRAZING
        distance = distance - (length - reach[:, None, None]) / slope.clamp_min(_GRAZING)
    return distance.clamp_min(0.0).masked_fill(is_missed, 0.0)
