# SPDX-License-Identifier: Apache-2.0
"""How a potential field bends one step of a generative process (Section IV-B of the paper).

Both guides share lambda (`guidance_scale`) and the limit of small lambda. Over a step of dt, one explicit step of
lambda Phi moves an action the fraction lambda dt / h^2 of the way to its local mean. `euler` takes that step as
printed; beyond a fraction of 1 it overshoots, the sensitivity to lambda that the paper reports. `proximal` solves the
same equation exactly over the step and cannot overshoot for any lambda.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from lerobot_pf2mp.flow_matching import Guide
from lerobot_pf2mp.potential_field import PotentialField

_TINY = torch.finfo(torch.float32).tiny

GUIDANCE_INTEGRATORS = ("euler", "proximal")


@dataclass(frozen=True)
class EulerGuide:
    """Algorithm 2 as printed: x_{t+dt} = x_t + [v + lambda Phi(x_t)] dt.

    Args:
        field: The potential field.
        scale: lambda >= 0.
    """

    field: PotentialField
    scale: float

    def __call__(self, x_t: Tensor, x_next: Tensor, dt: float) -> Tensor:
        """The guided step from the unguided one, all ``(..., D)`` [normalised]."""
        return x_next + self.scale * dt * self.field.potential_gradient(x_t)


@dataclass(frozen=True)
class ProximalGuide:
    """The guidance solved exactly over the step, after the flow's own step.

    With the local mean m held fixed, dx/dt = lambda (m - x) / h^2 has the solution
    x = m + (x - m) exp(-lambda dt / h^2). The distance term pulls with constant strength lambda |alpha| and stops
    where it arrives. Where the paper evaluates Phi at x_t, this evaluates it after the flow's step, when the noise
    that the flow removes is gone; at x_t the guidance would remove it a second time.

    Args:
        field: The potential field.
        scale: lambda >= 0.
    """

    field: PotentialField
    scale: float

    def __call__(self, x_t: Tensor, x_next: Tensor, dt: float) -> Tensor:
        """The guided step from the unguided one, all ``(..., D)`` [normalised]."""
        decay = math.exp(-self.scale * dt / self.field.bandwidth**2)
        guided = x_next + (1 - decay) * self.field.mean_shift(x_next)
        if self.field.alpha != 0:
            offset = self.field.offset_to_safe_set(guided)
            distance = offset.norm(dim=-1, keepdim=True)
            reach = self.scale * -self.field.alpha * dt
            guided = guided + offset * (reach / distance.clamp_min(max(reach, _TINY)))
        return guided


def make_guide(
    field: PotentialField,
    scale: float,
    integrator: str = "proximal",
    action_dims: Sequence[int] | None = None,
) -> Guide | None:
    """The guide for one integrator, or None for `scale` = 0, which is exactly the unguided process.

    Args:
        field: The potential field over the dimensions `action_dims`.
        scale: lambda, finite and at least 0.
        integrator: One of `GUIDANCE_INTEGRATORS`.
        action_dims: Which of the last dimension's entries the field covers; the others pass unchanged. None: all.

    Returns:
        The guide, or None.

    Raises:
        ValueError: If an argument breaks its rule.
    """
    if not (scale >= 0 and math.isfinite(scale)):
        raise ValueError(f"guidance_scale must be finite and at least 0, got {scale}")
    if integrator not in GUIDANCE_INTEGRATORS:
        raise ValueError(f"guidance_integrator must be one of {GUIDANCE_INTEGRATORS}, got {integrator!r}")
    if scale == 0:
        return None
    guide = EulerGuide(field, scale) if integrator == "euler" else ProximalGuide(field, scale)
    return guide if action_dims is None else _OnDimensions(guide, tuple(action_dims))


@dataclass(frozen=True)
class _OnDimensions:
    """A guide that acts on some of the action dimensions."""

    guide: Guide
    dims: tuple[int, ...]

    def __call__(self, x_t: Tensor, x_next: Tensor, dt: float) -> Tensor:
        dims = torch.tensor(self.dims, device=x_next.device)
        guided = self.guide(x_t.index_select(-1, dims), x_next.index_select(-1, dims), dt)
        return x_next.index_copy(-1, dims, guided.to(x_next.dtype))
