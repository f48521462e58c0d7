# SPDX-License-Identifier: Apache-2.0
"""Rectified flow between noise x_0 at t = 0 and data x_1 at t = 1 (Section IV-A of the paper; Liu et al., 2022).

path       x_t = (1 - t) x_0 + t x_1
velocity   u_t = x_1 - x_0                                             Eq. 7
loss       E |v_theta(x_t, t; o) - u_t|^2                              Eq. 8, Algorithm 1
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

INTEGRATORS = ("euler", "midpoint")
TIME_SAMPLINGS = ("uniform", "beta")


@dataclass(frozen=True)
class PathSample:
    """A point on the straight path between noise and data, and the velocity there.

    Args:
        x_t: ``(B, ...)`` the point at time t.
        velocity: ``(B, ...)`` the regression target x_1 - x_0.
    """

    x_t: Tensor
    velocity: Tensor


Steer = Callable[[Tensor, Tensor, Tensor], Tensor]


class Guide(Protocol):
    """Changes one integration step."""

    def __call__(self, x_t: Tensor, x_next: Tensor, x_1: Tensor, dt: float) -> Tensor:
        """The guided x_{t+dt}, ``(B, ...)``.

        Args:
            x_t: ``(B, ...)`` the start of the step.
            x_next: ``(B, ...)`` the unguided x_{t+dt}.
            x_1: ``(B, ...)`` the end point that the step predicts.
            dt: Length of the step; the steps of one generation add up to 1.
        """


def sample_path(x_0: Tensor, x_1: Tensor, t: Tensor) -> PathSample:
    """The point x_t = (1 - t) x_0 + t x_1 and the velocity x_1 - x_0 (Eq. 7).

    Args:
        x_0: ``(B, ...)`` noise.
        x_1: ``(B, ...)`` data of the same shape.
        t: ``(B,)`` times in [0, 1], one for each sample.

    Returns:
        The path sample.

    Raises:
        ValueError: If the shapes do not match.
    """
    if x_0.shape != x_1.shape or t.shape != x_1.shape[:1]:
        raise ValueError(
            f"x_0 and x_1 must have one shape (B, ...) and t the shape (B,), got {tuple(x_0.shape)}, "
            f"{tuple(x_1.shape)} and {tuple(t.shape)}"
        )
    t = t.reshape(-1, *[1] * (x_1.ndim - 1))  # (B, 1, ...)
    return PathSample(x_t=(1 - t) * x_0 + t * x_1, velocity=x_1 - x_0)


def flow_matching_loss(
    velocity: Callable[[Tensor, Tensor], Tensor],
    x_0: Tensor,
    x_1: Tensor,
    t: Tensor,
    is_pad: Tensor | None = None,
) -> Tensor:
    """The loss |v_theta(x_t, t) - u_t|^2 of Eq. 8, averaged over action dimensions only.

    Args:
        velocity: Maps ``(B, T, A)`` points and ``(B,)`` times to ``(B, T, A)`` velocities.
        x_0: ``(B, T, A)`` noise.
        x_1: ``(B, T, A)`` demonstrated chunks.
        t: ``(B,)`` times in [0, 1].
        is_pad: ``(B, T)`` true where the chunk is padding: the loss is zero there and the padding's values are not used.

    Returns:
        ``(B, T)`` losses.
    """
    if is_pad is not None:
        # LeRobot pads with copies of the last action. From these the network could learn where the episode ends.
        x_1 = x_1.masked_fill(is_pad.unsqueeze(-1), 0.0)
    path = sample_path(x_0, x_1, t)
    loss = (velocity(path.x_t, t) - path.velocity).square().mean(dim=-1)  # (B, T)
    return loss if is_pad is None else loss.masked_fill(is_pad, 0.0)


def sample_time(
    batch_size: int,
    distribution: str = "uniform",
    *,
    device: torch.device | str = "cpu",
    generator: torch.Generator | None = None,
) -> Tensor:
    """Training times t in [0, 1].

    Args:
        batch_size: The number B of times.
        distribution: ``uniform``, as in Algorithm 1, or ``beta``: 1 - t ~ Beta(1.5, 1), which puts more weight on the
            noisy end, as pi0 does (Black et al., 2024; there t runs from data to noise).
        device: Device of the times.
        generator: Source of randomness.

    Returns:
        ``(B,)`` times.

    Raises:
        ValueError: If the distribution is unknown.
    """
    uniform = torch.rand(batch_size, device=device, generator=generator)
    if distribution == "uniform":
        return uniform
    if distribution == "beta":
        return 1 - uniform ** (1 / 1.5)  # the quantile function of Beta(1.5, 1) is u^(1/1.5)
    raise ValueError(f"time sampling must be one of {TIME_SAMPLINGS}, got {distribution!r}")


def integrate(
    velocity: Callable[[Tensor, Tensor], Tensor],
    x_0: Tensor,
    num_steps: int,
    *,
    integrator: str = "euler",
    guide: Guide | None = None,
    steer: Steer | None = None,
) -> Tensor:
    """The solution x_1 of dx/dt = v(x, t) from x_0 at t = 0, in `num_steps` steps of dt = 1/num_steps (Eq. 9).

    Args:
        velocity: Maps ``(B, ...)`` points and ``(B,)`` times to ``(B, ...)`` velocities. Called once for each step by
            ``euler`` and twice by ``midpoint``.
        x_0: ``(B, ...)`` starting points.
        num_steps: The number N >= 1 of steps.
        integrator: ``euler`` (first order) or ``midpoint`` (second order).
        guide: Changes every step; None leaves the flow unchanged.
        steer: Maps ``(B, ...)`` points, ``(B,)`` times and velocities to other velocities. The guide gets the end point
            that the original velocity predicts. The end point of a steered velocity may be far beyond it.

    Returns:
        ``(B, ...)`` end points.

    Raises:
        ValueError: If `num_steps` is not positive or the integrator is unknown.
    """
    if num_steps < 1:
        raise ValueError(f"num_steps must be at least 1, got {num_steps}")
    if integrator not in INTEGRATORS:
        raise ValueError(f"integrator must be one of {INTEGRATORS}, got {integrator!r}")
    dt = 1 / num_steps
    x = x_0
    for step in range(num_steps):
        t = torch.full(x_0.shape[:1], step * dt, dtype=x_0.dtype, device=x_0.device)
        slope = velocity(x, t)
        if integrator == "midpoint":
            slope = velocity(x + 0.5 * dt * slope, t + 0.5 * dt)
        predicted = slope
        if steer is not None:
            slope = steer(x, t, slope)
        x_next = torch.add(x, slope, alpha=dt)
        if guide is not None:
            x_1 = torch.add(x, predicted, alpha=1 - step * dt)
            x_next = guide(x, x_next, x_1, dt)
        x = x_next
    return x
