# SPDX-License-Identifier: Apache-2.0
"""How a potential field changes one step of a generative process (Section IV-B of the paper).

Both guides use lambda (`guidance_scale`) and agree in the limit of small lambda. Over a step of dt, one explicit step of
lambda Phi moves an action by the share lambda dt / h^2 of its mean shift. `euler` takes that step as printed. With a
share above 1 it overshoots: this is the sensitivity to lambda that the paper reports. From 2 on it diverges, which is an
error. `proximal` solves the same equation exactly over the step and cannot overshoot for any lambda.

Where the field pulls only where support is missing (`PotentialField`), the share is that times the weight w(log p).

They also differ in the point at which they evaluate the field (`guidance_point`). `euler` evaluates it at x_t, as
printed. There the action still contains the noise that the flow will remove, so the guidance removes it a second time.
`proximal` evaluates it at the end point that the step predicts. That point has as little noise as the network can
predict. With many small steps even the point after the step is mostly noise, and strong guidance there overrides what
the network predicts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from lerobot_pf2mp.flow_matching import Guide
from lerobot_pf2mp.potential_field import PotentialField

GUIDANCE_INTEGRATORS = ("euler", "proximal")
GUIDANCE_POINTS = ("current", "end", "next")

# The explicit step at its stability limit is one beyond it, however the two are rounded.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class GuidanceSettings:
    """The settings with which a field guides a process.

    Args:
        scale: lambda, finite and at least 0; 0 is exactly the unguided process.
        integrator: One of `GUIDANCE_INTEGRATORS`.
        point: The point at which the field is evaluated, one of `GUIDANCE_POINTS`: x_t (current), the end point that the
            step predicts (end), or the point after the step (next). None: the integrator's own, current for euler and
            end for proximal.
        action_dims: The dimensions of an action that the field covers; the others stay unchanged. None: all.

    Raises:
        ValueError: If a value breaks its rule. The message names the option of the policy's configuration.
    """

    scale: float = 0.8
    integrator: str = "proximal"
    point: str | None = None
    action_dims: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        if not (self.scale >= 0 and math.isfinite(self.scale)):
            raise ValueError(f"guidance_scale must be finite and at least 0, got {self.scale}")
        if self.integrator not in GUIDANCE_INTEGRATORS:
            raise ValueError(
                f"guidance_integrator must be one of {GUIDANCE_INTEGRATORS}, got {self.integrator!r}"
            )
        if self.point is not None and self.point not in GUIDANCE_POINTS:
            raise ValueError(f"guidance_point must be one of {GUIDANCE_POINTS} or null, got {self.point!r}")


@dataclass(frozen=True, eq=False)
class EulerGuide:
    """Algorithm 2 as printed: x_{t+dt} = x_t + [v + lambda Phi(x_t)] dt.

    It is stable for lambda dt / h^2 < 2. A call beyond that raises a ValueError, because its result would be far from
    all demonstrations.

    Args:
        field: The potential field.
        scale: lambda >= 0.
        point: The point at which Phi is evaluated, one of `GUIDANCE_POINTS`.
    """

    field: PotentialField
    scale: float
    point: str = "current"

    def __call__(self, x_t: Tensor, x_next: Tensor, x_1: Tensor, dt: float) -> Tensor:
        """The guided step from the unguided one, all ``(..., D)`` [normalised]."""
        _check_stability(self.scale, dt, self.field.bandwidth)
        a = _choose(self.point, x_t, x_next, x_1)
        return x_next + self.scale * dt * self.field.potential_gradient(a)


@dataclass(frozen=True, eq=False)
class ProximalGuide:
    """The guidance solved exactly over the step, after the flow's own step.

    With the local mean m held fixed, dx/dt = lambda (m - x) / h^2 has the solution
    x = m + (x - m) exp(-lambda dt / h^2). The weight w(log p(x)) of a field that pulls only where support is missing
    multiplies that step. The distance term pulls with constant strength lambda |alpha| and stops
    at the safe set. Both are computed for the point at which the field is evaluated. Their offset is added to the step.

    Args:
        field: The potential field.
        scale: lambda >= 0.
        point: The point at which the local mean is taken, one of `GUIDANCE_POINTS`.
    """

    field: PotentialField
    scale: float
    point: str = "end"

    def __call__(self, x_t: Tensor, x_next: Tensor, x_1: Tensor, dt: float) -> Tensor:
        """The guided step from the unguided one, all ``(..., D)`` [normalised]."""
        share = 1 - math.exp(-self.scale * dt / self.field.bandwidth**2)
        a = _choose(self.point, x_t, x_next, x_1)
        max_distance = self.scale * -self.field.alpha * dt
        return x_next + self.field.step_to_safety(a, share, max_distance)


def make_guide(field: PotentialField, settings: GuidanceSettings) -> Guide | None:
    """The guide of a field, or None for a scale of 0, which is exactly the unguided process.

    Args:
        field: The potential field, over the dimensions ``settings.action_dims``.
        settings: The settings of the guidance.
    """
    if settings.scale == 0:
        return None
    make = EulerGuide if settings.integrator == "euler" else ProximalGuide
    point = {} if settings.point is None else {"point": settings.point}
    guide = make(field, settings.scale, **point)
    if settings.action_dims is None:
        return guide
    return _OnDimensions(guide, torch.tensor(settings.action_dims).to(field.anchors.device))


@dataclass(frozen=True, eq=False)
class _OnDimensions:
    """A guide that acts on some of the action dimensions."""

    guide: Guide
    # On the actions' device. Copying it there in each step would take longer than the rest of the call.
    dims: Tensor

    def __call__(self, x_t: Tensor, x_next: Tensor, x_1: Tensor, dt: float) -> Tensor:
        a_t, a_next, a_1 = (x.index_select(-1, self.dims) for x in (x_t, x_next, x_1))
        guided = self.guide(a_t, a_next, a_1, dt)
        return x_next.index_copy(-1, self.dims, guided.to(x_next.dtype))


def _check_stability(scale: float, dt: float, bandwidth: float) -> None:
    if _is_stable(scale, dt, bandwidth):
        return
    limit = 2 * bandwidth**2 / dt
    digit = 10.0 ** (math.floor(math.log10(limit)) - 2)  # the last of three
    largest = math.floor(limit / digit) * digit
    if not _is_stable(float(f"{largest:.3g}"), dt, bandwidth):  # the limit itself
        largest -= digit
    raise ValueError(
        "guidance_integrator=euler diverges unless guidance_scale * dt / bandwidth^2 is below 2, got "
        f"{scale:g} * {dt:g} / {bandwidth:g}^2 = {scale * dt / bandwidth**2:g}: set guidance_scale to at most "
        f"{largest:.3g}, or guidance_integrator=proximal, which is stable for every scale"
    )


def _is_stable(scale: float, dt: float, bandwidth: float) -> bool:
    return scale * dt < 2 * bandwidth**2 * (1 - _ROUNDING)


def _choose(point: str, x_t: Tensor, x_next: Tensor, x_1: Tensor) -> Tensor:
    return {"current": x_t, "end": x_1, "next": x_next}[point]
