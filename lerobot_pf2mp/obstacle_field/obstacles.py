# SPDX-License-Identifier: Apache-2.0
"""Balls, capsules and boxes in two or three dimensions, as one shape: a box with rounded edges, in a frame of its own.

    ball       half sides 0, radius r
    capsule    half sides (half its length, 0, ...), radius r, the axis along it
    box        half sides, radius 0 or that of its edges

With p a point in that frame and h the half sides, the signed distance is

    |max(|p| - h, 0)| + min(max_i(|p_i| - h_i), 0) - r.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import torch
from torch import Tensor

DIMS = (2, 3)
_TINY = 1e-12


def n_features(dim: int) -> int:
    """The number F = 4 D + 2 of features of an obstacle in D dimensions, see `Obstacles.rows`."""
    return 4 * dim + 2


@dataclass(frozen=True, eq=False)
class Obstacles:
    """K obstacles for each of B robots. All lengths are in the units of the actions, unnormalised.

    Args:
        centre: ``(B, K, D)`` their centres at time 0, D = 2 or 3.
        half_sides: ``(B, K, D)`` of the box inside the rounding, in the obstacle's own frame.
        axis: ``(B, K, D)`` the direction of the frame's first axis, of length 1.
        velocity: ``(B, K, D)`` how the centre moves, per second.
        radius: ``(B, K)`` of the rounding.
        is_present: ``(B, K)`` bool; absent ones are infinitely far.
    """

    centre: Tensor
    half_sides: Tensor
    axis: Tensor
    velocity: Tensor
    radius: Tensor
    is_present: Tensor

    @property
    def dim(self) -> int:
        """The number D of dimensions."""
        return self.centre.shape[-1]

    def __len__(self) -> int:
        return self.centre.shape[0]

    @property
    def n_each(self) -> int:
        """The number K of obstacles of a robot."""
        return self.centre.shape[1]

    @property
    def rows(self) -> Tensor:
        """``(B, K, 4 D + 2)``: 1 (0: absent), centre, half sides, axis, velocity, radius. `from_rows` reads it."""
        numbers = self.is_present.unsqueeze(-1).to(self.centre), self.radius.unsqueeze(-1)
        return torch.cat(
            [numbers[0], self.centre, self.half_sides, self.axis, self.velocity, numbers[1]], dim=-1
        )

    @classmethod
    def from_rows(cls, rows: Tensor) -> Obstacles:
        """Reads ``(B, K, F)`` rows of features, as of `rows`. In a row whose first number is not positive, nothing is read.

        Raises:
            ValueError: If the shape is another one, or a present obstacle has a feature that is not finite, a negative size,
                or an axis of another length than 1.
        """
        dim = next((d for d in DIMS if rows.ndim == 3 and rows.shape[-1] == n_features(d)), None)
        if dim is None:
            wanted = " or ".join(f"{n_features(d)} (in {d} dimensions)" for d in DIMS)
            raise ValueError(
                f"obstacles must have the shape (B, K, F) with F = {wanted}, got {tuple(rows.shape)}"
            )
        is_present = rows[..., 0] > 0
        first_axis = torch.zeros_like(rows[..., 1:])
        first_axis[..., 2 * dim] = 1.0
        values = torch.where(is_present.unsqueeze(-1), rows[..., 1:], first_axis)
        parts = values.split([dim, dim, dim, dim, 1], dim=-1)
        centre, half_sides, axis, velocity, radius = parts
        made = cls(centre, half_sides, axis, velocity, radius.squeeze(-1), is_present)
        is_sized = (made.half_sides >= 0).all(-1) & (made.radius >= 0)
        is_valid = values.isfinite().all(-1) & is_sized & ((made.axis.norm(dim=-1) - 1).abs() < 1e-3)
        if not bool(is_valid.all()):
            raise ValueError(
                "an obstacle's features must be finite, its sizes at least 0 and its axis of length 1, got "
                f"{rows[~is_valid][0].tolist()} (present, centre, half sides, axis, velocity, radius)"
            )
        return made

    def __getitem__(self, index: Tensor | slice) -> Obstacles:
        """Those of some robots."""
        return Obstacles(*(getattr(self, field.name)[index] for field in fields(self)))

    def to(self, device: torch.device | str) -> Obstacles:
        """The same on a device."""
        return Obstacles(*(getattr(self, field.name).to(device) for field in fields(self)))

    def only(self, k: int) -> Obstacles:
        """The k-th obstacle of each robot."""
        return self.one_each(slice(None), k)

    def one_each(self, robots: Tensor | slice, k: Tensor | int) -> Obstacles:
        """One obstacle (K = 1) for each of some robots ``(P,)``: their k-th ``(P,)`` ones."""
        return Obstacles(*(getattr(self, field.name)[robots, k].unsqueeze(1) for field in fields(self)))

    def beside(self, others: Sequence[Obstacles]) -> Obstacles:
        """These and others, of the same robots."""
        return Obstacles(
            *(torch.cat([getattr(o, field.name) for o in (self, *others)], dim=1) for field in fields(self))
        )

    def moves(self) -> bool:
        """Whether an obstacle that is present moves."""
        return bool((self.velocity.abs().amax(dim=-1) > 0)[self.is_present].any())

    def mirrored(self, vectors: Tensor) -> Tensor:
        """Vectors ``(B, K, ..., D)`` from the world into each obstacle's frame, or back.

        The frame is the world's, mirrored so that its first axis is the obstacle's (a Householder reflection, its own
        inverse).
        """
        mirror = self._mirror.reshape(*self._mirror.shape[:2], *[1] * (vectors.ndim - 3), self.dim)
        return vectors - mirror * (mirror * vectors).sum(dim=-1, keepdim=True)

    def relative(self, points: Tensor, times: Tensor) -> Tensor:
        """Points as seen from each obstacle's centre, in its frame.

        Args:
            points: ``(B, P, D)`` or ``(B, K, P, D)``.
            times: ``(P,)`` when the robot is there [s].

        Returns:
            ``(B, K, P, D)``.
        """
        if points.ndim == 3:
            points = points.unsqueeze(1)
        centres = self.centre.unsqueeze(2) + self.velocity.unsqueeze(2) * times.to(points).unsqueeze(-1)
        return self.mirrored(points - centres)

    def distance(self, points: Tensor, times: Tensor) -> Tensor:
        """Signed distances ``(B, K, P)`` of points to each obstacle, negative inside. Arguments as for `relative`."""
        return self._masked(rounded_box_distance(self.relative(points, times), self.half_sides.unsqueeze(2)))

    def gradient(self, points: Tensor, times: Tensor) -> Tensor:
        """The gradients ``(B, K, P, D)`` of `distance`, of length 1; zero for absent obstacles. Arguments as there.

        Where the distance has no gradient (a ball's centre) it is one of the directions out.
        """
        local = self.relative(points, times)
        excess = local.abs() - self.half_sides.unsqueeze(2)
        outside = excess.clamp_min(0.0)
        length = outside.norm(dim=-1, keepdim=True)
        nearest_face = torch.nn.functional.one_hot(excess.argmax(dim=-1), self.dim).to(local)
        direction = torch.where(length > _TINY, outside / length.clamp_min(_TINY), nearest_face)
        direction = torch.where(local < 0, -direction, direction)
        return self.mirrored(direction) * self.is_present[:, :, None, None]

    def swept_distance(self, ways: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
        """The smallest distance on each piece of polylines, and where on it that is, both in closed form.

        Robot and obstacle move evenly during a piece, so the robot's way relative to the obstacle is straight.

        Args:
            ways: ``(B, C, D)`` the corners of the polylines.
            times: ``(C,)`` when the robot is there [s].

        Returns:
            ``(B, K, C - 1)`` signed distances, inf for absent obstacles. They are exact as long as a piece stays out of the
            box inside the rounding. On a piece that crosses this box it is the distance half-way through, at most -radius.
            And ``(B, K, C - 1)`` the shares of the pieces, in [0, 1], at which they are taken.
        """
        local = self.relative(ways, times)  # (B, K, C, D)
        starts, steps = local[:, :, :-1], local.diff(dim=2)
        half_sides = self.half_sides.unsqueeze(2)
        share = nearest_share(starts, steps, half_sides)
        nearest = starts + share.unsqueeze(-1) * steps
        return self._masked(rounded_box_distance(nearest, half_sides)), share

    def _masked(self, distance: Tensor) -> Tensor:
        distance = distance - self.radius.unsqueeze(-1)
        return distance.masked_fill(~self.is_present.unsqueeze(-1), math.inf)

    @cached_property
    def _mirror(self) -> Tensor:
        """``(B, K, D)`` m with v -> v - m (m v) the reflection; 0 where the frame is the world's."""
        first = torch.zeros_like(self.axis)
        first[..., 0] = 1.0
        normal = first - self.axis
        length = normal.norm(dim=-1, keepdim=True)
        return torch.where(length > 1e-6, math.sqrt(2) * normal / length.clamp_min(1e-6), 0.0)


def rounded_box_distance(local: Tensor, half_sides: Tensor) -> Tensor:
    """Signed distances ``(...)`` of points ``(..., D)`` to boxes around the origin, without their rounding."""
    excess = local.abs() - half_sides
    return excess.clamp_min(0.0).norm(dim=-1) + excess.amax(dim=-1).clamp_max(0.0)


def nearest_share(starts: Tensor, steps: Tensor, half_sides: Tensor) -> Tensor:
    """Where segments come nearest to boxes around the origin, as shares of the segments in [0, 1].

    The squared distance of start + s step is convex in s. Its slope is piecewise linear, with kinks only where a coordinate
    passes +h or -h. So its zero lies between two neighbouring kinks, where a straight line gives it exactly. Where the zero
    is an interval, as inside the box, it is the middle of that.

    Args:
        starts: ``(..., D)`` in the boxes' frames.
        steps: ``(..., D)`` from start to end.
        half_sides: ``(..., D)`` of the boxes.

    Returns:
        ``(...)``.
    """
    safe_steps = torch.where(steps == 0, 1.0, steps)
    kinks = torch.cat([(half_sides - starts) / safe_steps, (-half_sides - starts) / safe_steps], dim=-1)
    kinks = torch.where(torch.cat([steps, steps], dim=-1) == 0, 0.0, kinks.clamp(0.0, 1.0))
    ends = torch.zeros_like(kinks[..., :2])
    ends[..., 1] = 1.0
    shares = torch.cat([kinks, ends], dim=-1).sort(dim=-1).values  # (..., 2 D + 2)
    points = starts.unsqueeze(-2) + shares.unsqueeze(-1) * steps.unsqueeze(-2)
    sides = half_sides.unsqueeze(-2)
    slopes = ((points - points.clamp(-sides, sides)) * steps.unsqueeze(-2)).sum(dim=-1)
    first = _crossing(shares, slopes, (slopes < 0).sum(dim=-1))
    last = _crossing(shares, slopes, (slopes <= 0).sum(dim=-1))
    return 0.5 * (first + last)


def _crossing(shares: Tensor, slopes: Tensor, n_before: Tensor) -> Tensor:
    """Where slopes, of which the first `n_before` are below a zero, cross it."""
    ends = torch.stack([n_before - 1, n_before], dim=-1).clamp(0, shares.shape[-1] - 1)
    (s_0, s_1), (g_0, g_1) = (x.gather(-1, ends).unbind(-1) for x in (shares, slopes))
    rise = g_1 - g_0
    return s_0 + (s_1 - s_0) * torch.where(rise > 0, -g_0 / torch.where(rise > 0, rise, 1.0), 0.0)
