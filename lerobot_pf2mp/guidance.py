# SPDX-License-Identifier: Apache-2.0
"""How a potential field bends one step of a generative process (Section IV-B of the paper).

Both guides share lambda (`guidance_scale`) and the limit of small lambda. Over a step of dt, one explicit step of
lambda Phi moves an action the fraction lambda dt / h^2 of the way to its local mean. `euler` takes that step as
printed; beyond a fraction of 1 it overshoots, the sensitivity to lambda that the paper reports. `proximal` solves the
same equation exactly over the step and cannot overshoot for any lambda.

They also differ in where they ask the field (`guidance_point`). `euler` asks at x_t, as printed, where the action still
carries the noise that the flow is about to remove, and removes it a second time. `proximal` asks at the end point that
the step predicts, which is as clean as the network can tell; with many small steps even the point after the step is
still mostly noise, and a strong guidance there takes the flow away from what the network knows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from lerobot_pf2mp.flow_matching import Guide
from lerobot_pf2mp.potential_field import PotentialField

GUIDANCE_INTEGRATORS = ("euler", "proximal")
GUIDANCE_POINTS = ("current", "end", "next")


@dataclass(frozen=True, eq=False)
class EulerGuide:
    """Algorithm 2 as printed: x_{t+dt} = x_t + [v + lambda Phi(x_t)] dt.

    Args:
        field: The potential field.
        scale: lambda >= 0.
        point: Where Phi is evaluated, one of `GUIDANCE_POINTS`.
    """

    field: PotentialField
    scale: float
    point: str = "current"

    def __call__(self, x_t: Tensor, x_next: Tensor, x_1: Tensor, dt: float) -> Tensor:
        """The guided step from the unguided one, all ``(..., D)`` [normalised]."""
        a = _choose(self.point, x_t, x_next, x_1)
        return x_next + self.scale * dt * self.field.potential_gradient(a)


@dataclass(frozen=True, eq=False)
class ProximalGuide:
    """The guidance solved exactly over the step, after the flow's own step.

    With the local mean m held fixed, dx/dt = lambda (m - x) / h^2 has the solution
    x = m + (x - m) exp(-lambda dt / h^2). The distance term pulls with constant strength lambda |alpha| and stops
    where it arrives. Both move the point at which the field is asked; the step is moved by as much.

    Args:
        field: The potential field.
        scale: lambda >= 0.
        point: Where the local mean is taken, one of `GUIDANCE_POINTS`.
    """

    field: PotentialField
    scale: float
    point: str = "end"

    def __call__(self, x_t: Tensor, x_next: Tensor, x_1: Tensor, dt: float) -> Tensor:
        """The guided step from the unguided one, all ``(..., D)`` [normalised]."""
        share = 1 - math.exp(-self.scale * dt / self.field.bandwidth**2)
        a = _choose(self.point, x_t, x_next, x_1)
        if self.field.alpha == 0:
            return x_next + share * self.field.mean_shift(a)
        return x_next + self.field.step_to_safety(a, share, reach=self.scale * -self.field.alpha * dt)


def make_guide(
    field: PotentialField,
    scale: float,
    integrator: str = "proximal",
    action_dims: Sequence[int] | None = None,
    point: str | None = None,
) -> Guide | None:
    """The guide for one integrator, or None for `scale` = 0, which is exactly the unguided process.

    Args:
        field: The potential field over the dimensions `action_dims`.
        scale: lambda, finite and at least 0.
        integrator: One of `GUIDANCE_INTEGRATORS`.
        action_dims: Which of the last dimension's entries the field covers; the others pass unchanged. None: all.
        point: Where the field is evaluated, one of `GUIDANCE_POINTS`: at x_t, at the end point that the step predicts,
            or after the step. None: the integrator's own, current for euler and end for proximal.

    Returns:
        The guide, or None.

    Raises:
        ValueError: If an argument breaks its rule.
    """
    if not (scale >= 0 and math.isfinite(scale)):
        raise ValueError(f"guidance_scale must be finite and at least 0, got {scale}")
    if integrator not in GUIDANCE_INTEGRATORS:
        raise ValueError(f"guidance_integrator must be one of {GUIDANCE_INTEGRATORS}, got {integrator!r}")
    if point is not None and point not in GUIDANCE_POINTS:
        raise ValueError(f"guidance_point must be one of {GUIDANCE_POINTS} or None, got {point!r}")
    if scale == 0:
        return None
    make = EulerGuide if integrator == "euler" else ProximalGuide
    guide = make(field, scale) if point is None else make(field, scale, point)
    return (
        guide
        if action_dims is None
        else _OnDimensions(guide, torch.tensor(action_dims).to(field.anchors.device))
    )


@dataclass(frozen=True, eq=False)
class _OnDimensions:
    """A guide that acts on some of the action dimensions."""

    guide: Guide
    dims: Tensor  # on the actions' device, as copying it there in each step would take longer than the rest

    def __call__(self, x_t: Tensor, x_next: Tensor, x_1: Tensor, dt: float) -> Tensor:
        a_t, a_next, a_1 = (x.index_select(-1, self.dims) for x in (x_t, x_next, x_1))
        guided = self.guide(a_t, a_next, a_1, dt)
        return x_next.index_copy(-1, self.dims, guided.to(x_next.dtype))


def _choose(point: str, x_t: Tensor, x_next: Tensor, x_1: Tensor) -> Tensor:
    return {"current": x_t, "end": x_1, "next": x_next}[point]
