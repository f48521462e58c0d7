# SPDX-License-Identifier: Apache-2.0
"""Fits a potential field to demonstrated actions, each judged by other episodes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lerobot_pf2mp.density.bandwidth import DEFAULT_BANDWIDTH, select_bandwidth
from lerobot_pf2mp.density.held_out import HeldOut, group_numbers
from lerobot_pf2mp.potential_field.field import PotentialField, check_periods

# Defaults of `fit`, and of the policies' options.
THRESHOLD_QUANTILE = 0.01
LEFT_OUT = ("episode", "nothing")

# The threshold of H lies this far below the quantile, absolutely and relative to it, so that actions whose density is
# exactly the quantile lie in H however their density is rounded.
_TIES = 1e-4, 1e-6


def check_threshold_quantile(quantile: float, name: str = "threshold_quantile") -> None:
    """Checks the quantile that bounds the safe set.

    Args:
        quantile: The quantile.
        name: Its name in the error message.

    Raises:
        ValueError: If it does not lie in [0, 1].
    """
    if not 0 <= quantile <= 1:
        raise ValueError(f"{name} must lie in [0, 1], got {quantile}")


def check_left_out(leave_out: str, name: str = "leave_out") -> None:
    """Checks what is left out of a density where it judges its own points.

    Args:
        leave_out: The choice.
        name: Its name in the error message.

    Raises:
        ValueError: If it is not one of `LEFT_OUT`.
    """
    if leave_out not in LEFT_OUT:
        raise ValueError(f"{name} must be one of {LEFT_OUT}, got {leave_out!r}")


@dataclass(frozen=True, eq=False)
class JudgedFit:
    """A potential field, and what the points of other episodes say of each point it was fitted to.

    Args:
        field: The field. Its anchors are the points that are not outlying.
        is_outlying: ``(P,)`` bool, points far from all others, see `HeldOut.far_and_outlying`.
        is_far: ``(P,)`` bool, points far from those of other episodes, which do not count in quantiles.
        log_density: ``(P,)`` log density of each point without its own episode [nats]; -inf if nothing else remains.
        distance: ``(P,)`` distance to the nearest point of another episode [normalised]; inf if nothing else remains.
    """

    field: PotentialField
    is_outlying: Tensor
    is_far: Tensor
    log_density: Tensor
    distance: Tensor


def fit(
    points: Tensor,
    *,
    episodes: Tensor | None = None,
    times: Tensor | None = None,
    periods: Tensor | None = None,
    bandwidth: float | str = DEFAULT_BANDWIDTH,
    threshold_quantile: float = THRESHOLD_QUANTILE,
    alpha: float = 0.0,
    leave_out: str = "episode",
    n_anchors: int | None = None,
    generator: torch.Generator | None = None,
) -> PotentialField:
    """Fits a potential field to demonstrated actions.

    Wherever the density judges an action that it was made from, it does so without that action's own episode: in the
    choice of the bandwidth, in the quantile that bounds H, and in the choice of H's anchors. Outlying points are left out
    of the field; points far from other episodes do not count in the quantile (see `HeldOut.far_and_outlying`).

    Args:
        points: ``(P, D)`` demonstrated actions [normalised], P >= 1.
        episodes: ``(P,)`` the number of each point's episode. None: nothing is known of episodes, so the points are one
            recording, of which blocks of time are left out (see `group_numbers`).
        times: ``(P,)`` each point's position in time, such as its frame number, for blocks of time. None: their order.
        periods: ``(D,)`` periods of angles [normalised], 0 for other dimensions. None: no angles.
        bandwidth: A rule of `BANDWIDTH_RULES`, or h itself [normalised].
        threshold_quantile: The quantile in [0, 1] of the points' log densities, each without its own episode, that bounds
            the safe set H.
        alpha: Weight of the distance term, at most 0.
        leave_out: ``episode``, or ``nothing``: the likelihood of the bandwidth then leaves out the point itself only, the
            quantile is of densities that contain the point's own kernel, and no point is outlying.
        n_anchors: Number of points to keep, drawn without replacement; None keeps them all.
        generator: Source of randomness for that draw.

    Returns:
        The fitted field.

    Raises:
        ValueError: If the points are not a finite ``(P, D)`` tensor, or an argument breaks its rule.
    """
    check_threshold_quantile(threshold_quantile)
    check_left_out(leave_out)
    _check_points(points, episodes, times)
    if n_anchors is not None:
        if n_anchors < 1:
            raise ValueError(f"n_anchors must be at least 1, got {n_anchors}")
        if n_anchors < len(points):
            chosen = torch.randperm(len(points), generator=generator)[:n_anchors]
            points = points[chosen.to(points.device)]
            episodes = None if episodes is None else episodes[chosen.to(episodes.device)]
            # Blocks of time stay those of the whole recording.
            times = chosen if times is None else times[chosen.to(times.device)]
    if leave_out == "nothing":
        return _fit_to_itself(points, periods, bandwidth, threshold_quantile, alpha)
    return fit_judged(
        points,
        episodes=episodes,
        times=times,
        periods=periods,
        bandwidth=bandwidth,
        threshold_quantile=threshold_quantile,
        alpha=alpha,
    ).field


@torch.no_grad()
def fit_judged(
    points: Tensor,
    *,
    episodes: Tensor | None = None,
    times: Tensor | None = None,
    periods: Tensor | None = None,
    bandwidth: float | str = DEFAULT_BANDWIDTH,
    threshold_quantile: float = THRESHOLD_QUANTILE,
    alpha: float = 0.0,
) -> JudgedFit:
    """`fit` with ``leave_out="episode"``, and how each point is judged by the others. Arguments and errors as there."""
    check_threshold_quantile(threshold_quantile)
    _check_points(points, episodes, times)
    on_cpu = points.detach().cpu().float()
    if periods is not None:
        check_periods(periods, on_cpu.shape[1])
        periods = periods.cpu().float() if bool((periods > 0).any()) else None
    groups = group_numbers(
        len(points), None if episodes is None else episodes.cpu(), None if times is None else times.cpu()
    )
    held_out = HeldOut(on_cpu, groups, periods, None if times is None else times.cpu())
    if not held_out.can_judge:  # as few as one or two points
        field = _fit_to_itself(points, periods, bandwidth, threshold_quantile, alpha)
        nothing = torch.full((len(points),), math.inf)
        none = torch.zeros(len(points), dtype=torch.bool)
        return JudgedFit(field, none, none, -nothing, nothing)
    h = select_bandwidth(on_cpu, bandwidth, groups=groups, periods=periods)
    log_density, distance = held_out.judge(h)
    is_far, is_outlying = held_out.far_and_outlying(distance, h)
    if bool(is_outlying.any()):
        kept = HeldOut(on_cpu[~is_outlying], groups[~is_outlying], periods)
        log_density, distance = kept.judge(h, on_cpu, groups)
    # A way that only one episode went is no measure of what is usual.
    log_threshold = just_below_quantile(log_density[~is_far], threshold_quantile)
    field = PotentialField(
        points[~is_outlying.to(points.device)],
        h,
        log_threshold,
        alpha,
        periods,
        (log_density[~is_outlying] > log_threshold).to(points.device),
    )
    return JudgedFit(field, is_outlying, is_far, log_density, distance)


def _fit_to_itself(
    points: Tensor, periods: Tensor | None, bandwidth: float | str, threshold_quantile: float, alpha: float
) -> PotentialField:
    field = PotentialField(points, select_bandwidth(points, bandwidth), alpha=alpha, periods=periods)
    return replace(
        field, log_threshold=just_below_quantile(field.log_density(points).cpu(), threshold_quantile)
    )


def just_below_quantile(log_densities: Tensor, quantile: float) -> float:
    """A number just below a quantile of the finite ones of some log densities; `_TIES` says how far."""
    known = log_densities[log_densities.isfinite()]
    rank = max(1, math.ceil(quantile * len(known)))
    # kthvalue rather than torch.quantile, which refuses more than 2^24 elements.
    value = known.kthvalue(rank).values.item()
    return just_below(value)


def just_below(log_density: float) -> float:
    """A number just below a log density; `_TIES` says how far."""
    absolute, relative = _TIES
    return log_density - absolute - relative * abs(log_density)


def _check_points(points: Tensor, episodes: Tensor | None, times: Tensor | None) -> None:
    if points.ndim != 2 or points.shape[0] < 1 or points.shape[1] < 1:
        raise ValueError(f"points must have shape (P, D) with P, D >= 1, got {tuple(points.shape)}")
    if not torch.isfinite(points).all():
        raise ValueError("points must be finite, got NaN or infinite entries")
    for name, numbers in (("episodes", episodes), ("times", times)):
        if numbers is not None and (numbers.shape != points.shape[:1] or numbers.is_floating_point()):
            raise ValueError(
                f"{name} must be whole numbers of shape ({len(points)},), got {tuple(numbers.shape)} of {numbers.dtype}"
            )
