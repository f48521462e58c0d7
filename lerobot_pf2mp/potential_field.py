# SPDX-License-Identifier: Apache-2.0
"""The potential field of Section IV-B: the density of demonstrated actions, and the direction in which it rises.

Everything lives in the space in which the policy generates (normalised actions). With M anchors x_i, demonstrated
actions drawn at random, and a bandwidth h:

    density       p(a)   = 1/M sum_i N(a; x_i, h^2 I)                      Gaussian KDE, Eq. 6
    potential     phi(a) = log p(a) + alpha d(a, H),  alpha <= 0           Eq. 10; larger is safer
    safe set      H      = {a : log p(a) > log_threshold}                  a quantile of actions that p does not know
    gradient      Phi(a) = grad phi(a)                                     Eq. 11, points to safety

The score grad log p is closed form, (m(a) - a) / h^2 with the local mean m(a) = softmax_i(-|a - x_i|^2 / 2h^2) x_i
(see `KernelSums`), because LeRobot evaluates under ``torch.inference_mode()``, where autograd cannot run.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from lerobot_pf2mp.density.bandwidth import DEFAULT_BANDWIDTH, check_bandwidth, select_bandwidth
from lerobot_pf2mp.density.held_out import HeldOut, group_numbers
from lerobot_pf2mp.density.kernel_sums import KernelSums
from lerobot_pf2mp.density.kernel_tree import KernelTree
from lerobot_pf2mp.density.kernels import offsets_to_nearest

# Defaults of `fit`, and of the policies' options.
THRESHOLD_QUANTILE = 0.01
LEFT_OUT = ("episode", "nothing")

# The threshold of H lies this far below the quantile, absolutely and relative to it, so that actions whose density is
# exactly the quantile lie in H however their density is rounded.
_TIES = 1e-4, 1e-6

_TINY = torch.finfo(torch.float32).tiny


def check_alpha(alpha: float, name: str = "alpha") -> None:
    """Checks the weight of the distance term, which has the paper's sign.

    Args:
        alpha: The weight.
        name: Its name in the error message.

    Raises:
        ValueError: If it is not finite or above 0.
    """
    if not (alpha <= 0 and math.isfinite(alpha)):
        raise ValueError(f"{name} must be finite and at most 0, got {alpha}")


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


def check_periods(periods: Tensor, dim: int) -> None:
    """Checks the periods of a field's dimensions.

    Args:
        periods: ``(D,)`` periods.
        dim: The number of dimensions D.

    Raises:
        ValueError: If their number is another one, or one is negative or not finite.
    """
    if periods.shape != (dim,) or not bool(((periods >= 0) & periods.isfinite()).all()):
        raise ValueError(f"periods must be {dim} finite numbers of at least 0, got {periods.tolist()}")


@dataclass(frozen=True, eq=False)
class PotentialField:
    """A Gaussian KDE over demonstrated actions, and the potential built on it.

    All methods accept queries of any batch shape ``(..., D)`` on the anchors' device, compute in float32 with
    autocast off, need no autograd, are finite everywhere and hold O(anchors + queries) memory.

    Args:
        anchors: ``(M, D)`` demonstrated actions [normalised], M >= 1.
        bandwidth: Kernel standard deviation h [normalised], a positive number.
        log_threshold: Log density above which an action counts as safe.
        alpha: Weight of the distance term [1/normalised], at most 0; 0 leaves the term out.
        periods: ``(D,)`` periods of angles [normalised], 0 for other dimensions; None if there are no angles. In an angle
            x and x + period are the same, and differences are the short way round.
        anchor_is_safe: ``(M,)`` bool, the anchors that count as points of H; None for those whose density, with their
            own kernel, is above the threshold.

    Raises:
        ValueError: If an argument breaks one of these rules.
    """

    anchors: Tensor
    bandwidth: float
    log_threshold: float = -math.inf
    alpha: float = 0.0
    periods: Tensor | None = None
    anchor_is_safe: Tensor | None = None

    def __post_init__(self) -> None:
        if self.anchors.ndim != 2 or self.anchors.shape[0] < 1 or self.anchors.shape[1] < 1:
            raise ValueError(
                f"anchors must have shape (M, D) with M, D >= 1, got {tuple(self.anchors.shape)}"
            )
        if not torch.isfinite(self.anchors).all():
            raise ValueError("anchors must be finite, got NaN or infinite entries")
        check_bandwidth(self.bandwidth)
        if math.isnan(self.log_threshold):
            raise ValueError("log_threshold must be a number, got nan")
        check_alpha(self.alpha)
        object.__setattr__(self, "anchors", self.anchors.detach().float().contiguous())
        if self.periods is not None:
            check_periods(self.periods, self.anchors.shape[1])
            has_angles = bool((self.periods > 0).any())
            periods = self.periods.to(self.anchors) if has_angles else None
            object.__setattr__(self, "periods", periods)
        if self.anchor_is_safe is not None and self.anchor_is_safe.shape != self.anchors.shape[:1]:
            raise ValueError(
                f"anchor_is_safe must have shape ({len(self.anchors)},), got {tuple(self.anchor_is_safe.shape)}"
            )

    @property
    def dim(self) -> int:
        """The number of action dimensions D that the field covers."""
        return self.anchors.shape[1]

    def to(self, device: torch.device | str) -> PotentialField:
        """This field with its anchors on `device`."""
        anchors = self.anchors.to(device)
        if anchors is self.anchors:
            return self
        is_safe = None if self.anchor_is_safe is None else self.anchor_is_safe.to(device)
        return replace(self, anchors=anchors, anchor_is_safe=is_safe)

    @cached_property
    def prepared(self) -> PotentialField:
        """This field, after everything is computed that all evaluations share.

        Otherwise that is computed in the first evaluation. A graph of ``torch.compile`` that is traced before it would
        compute it in each call.
        """
        self.potential_gradient(self.anchors[:1])
        return self

    @torch.no_grad()
    def log_density(self, a: Tensor) -> Tensor:
        """The log density log p(a), normalised over R^D.

        Args:
            a: ``(..., D)`` actions [normalised].

        Returns:
            ``(...)`` log densities [nats], finite also far from all anchors.
        """
        return self.log_density_and_mean_shift(a)[0]

    @torch.no_grad()
    def mean_shift(self, a: Tensor) -> Tensor:
        """The vector m(a) - a to the kernel-weighted mean m(a) of the anchors, along which log p(a) rises.

        Args:
            a: ``(..., D)`` actions [normalised].

        Returns:
            ``(..., D)`` offsets [normalised]; m(a) lies in the convex hull of the anchors.
        """
        return self.log_density_and_mean_shift(a)[1]

    @torch.no_grad()
    def log_density_and_mean_shift(self, a: Tensor) -> tuple[Tensor, Tensor]:
        """`log_density` ``(...)`` and `mean_shift` ``(..., D)`` of actions ``(..., D)``, at the cost of one of them."""
        shifts, log_sums = self._sums(self._flatten(a))
        return (log_sums - self._log_normaliser).reshape(a.shape[:-1]), shifts.reshape(a.shape)

    def local_mean(self, a: Tensor) -> Tensor:
        """The kernel-weighted mean m(a) of the anchors, ``(..., D)`` for actions ``(..., D)`` [normalised]."""
        return a.float() + self.mean_shift(a)

    @torch.no_grad()
    def score(self, a: Tensor) -> Tensor:
        """The score grad log p(a) = (m(a) - a) / h^2.

        Args:
            a: ``(..., D)`` actions [normalised].

        Returns:
            ``(..., D)`` scores [1/normalised].
        """
        return self.mean_shift(a) / self.bandwidth**2

    @torch.no_grad()
    def is_safe(self, a: Tensor) -> Tensor:
        """Whether actions ``(..., D)`` lie in the safe set H, ``(...)`` bool."""
        return self.log_density(a) > self.log_threshold

    @torch.no_grad()
    def offset_to_safe_set(self, a: Tensor) -> Tensor:
        """The vector from a to the safe set H; zero inside H.

        The paper does not say how d(a, H) is measured. Outside H this is the vector to the nearest anchor that lies
        in H: it ends in H, never past it, and its length is an upper bound of the distance to H.

        Args:
            a: ``(..., D)`` actions [normalised].

        Returns:
            ``(..., D)`` offsets [normalised]; d(a, H) is their norm.
        """
        queries = self._flatten(a)
        if self._sums.has_tree:
            offsets = self._sums.tree.offsets_to(self._safe_tree, queries, self._log_sum_threshold)
        else:
            # For all queries: selecting the unsafe ones would have to wait for the GPU.
            nearest = offsets_to_nearest(queries, self._safe_anchors, self.bandwidth, self.periods)
            offsets = torch.where(self.is_safe(queries).unsqueeze(-1), 0.0, nearest)
        return offsets.reshape(a.shape)

    @torch.no_grad()
    def step_to_safety(self, a: Tensor, share: float, max_distance: float) -> Tensor:
        """The step that moves an action towards its local mean, and from there towards the safe set H.

        Args:
            a: ``(..., D)`` actions [normalised].
            share: Fraction of the mean shift that the step covers, in [0, 1].
            max_distance: Largest length of the second part, towards H [normalised].

        Returns:
            ``(..., D)`` steps [normalised].
        """
        queries = self._flatten(a)
        if self._sums.has_tree:
            tree, log_sum = self._sums.tree, self._log_sum_threshold
            steps = tree.steps_to(self._safe_tree, queries, log_sum, share, max_distance)
        else:
            steps = share * self.mean_shift(queries)
            offset = self.offset_to_safe_set(queries + steps)
            distance = offset.norm(dim=-1, keepdim=True).clamp_min(max(max_distance, _TINY))
            steps = steps.addcdiv_(offset, distance, value=max_distance)
        return steps.reshape(a.shape)

    def potential(self, a: Tensor) -> Tensor:
        """The potential phi(a) = log p(a) + alpha d(a, H); larger is safer.

        Args:
            a: ``(..., D)`` actions [normalised].

        Returns:
            ``(...)`` potentials [nats].
        """
        phi = self.log_density(a)
        if self.alpha != 0:
            phi = phi + self.alpha * self.offset_to_safe_set(a).norm(dim=-1)
        return phi

    def potential_gradient(self, a: Tensor) -> Tensor:
        """The potential field Phi(a) = grad phi(a) of Eq. 11, one row for each action.

        Args:
            a: ``(..., D)`` actions [normalised].

        Returns:
            ``(..., D)`` gradients [1/normalised], pointing to safety.
        """
        gradient = self.score(a)
        if self.alpha != 0:
            offset = self.offset_to_safe_set(a)
            direction = offset / offset.norm(dim=-1, keepdim=True).clamp_min(_TINY)
            gradient = gradient - self.alpha * direction
        return gradient

    @cached_property
    def _sums(self) -> KernelSums:
        return KernelSums(self.anchors, self.bandwidth, self.periods)

    @cached_property
    def _log_normaliser(self) -> float:
        count, dim = self.anchors.shape
        return math.log(count) + dim * (math.log(self.bandwidth) + 0.5 * math.log(2 * math.pi))

    @property
    def _log_sum_threshold(self) -> float:
        return self.log_threshold + self._log_normaliser

    @cached_property
    def safe_anchors(self) -> Tensor:
        """``(M,)`` bool, the anchors that count as points of H: at least one, as H could be empty otherwise."""
        is_safe = self.is_safe(self.anchors) if self.anchor_is_safe is None else self.anchor_is_safe
        if bool(is_safe.any()):
            return is_safe
        log_densities = self.log_density(self.anchors)
        return log_densities == log_densities.max()

    @cached_property
    def _safe_anchors(self) -> Tensor:
        return self.anchors[self.safe_anchors]

    @cached_property
    def _safe_tree(self) -> KernelTree:
        return KernelTree.of(self._safe_anchors, self.bandwidth, self.periods)

    def _flatten(self, a: Tensor) -> Tensor:
        if a.ndim < 1 or a.shape[-1] != self.dim:
            raise ValueError(
                f"the field covers {self.dim} action dimensions, got actions of shape {tuple(a.shape)}"
            )
        return a.reshape(-1, self.dim).float()  # (Q, D)


@dataclass(frozen=True, eq=False)
class JudgedFit:
    """A potential field, and what the points of other episodes say of each point it was fitted to.

    Args:
        field: The field. Its anchors are the points that are not outlying.
        is_outlying: ``(P,)`` bool, points far from all others, see `HeldOut.far_and_outlying`.
        log_density: ``(P,)`` log density of each point without its own episode [nats]; -inf if nothing else remains.
        distance: ``(P,)`` distance to the nearest point of another episode [normalised]; inf if nothing else remains.
    """

    field: PotentialField
    is_outlying: Tensor
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
        return JudgedFit(field, torch.zeros(len(points), dtype=torch.bool), -nothing, nothing)
    h = select_bandwidth(on_cpu, bandwidth, groups=groups, periods=periods)
    log_density, distance = held_out.judge(h)
    is_far, is_outlying = held_out.far_and_outlying(distance, h)
    if bool(is_outlying.any()):
        kept = HeldOut(on_cpu[~is_outlying], groups[~is_outlying], periods)
        log_density, distance = kept.judge(h, on_cpu, groups)
    # A way that only one episode went is no measure of what is usual.
    log_threshold = _just_below_quantile(log_density[~is_far], threshold_quantile)
    field = PotentialField(
        points[~is_outlying.to(points.device)],
        h,
        log_threshold,
        alpha,
        periods,
        (log_density[~is_outlying] > log_threshold).to(points.device),
    )
    return JudgedFit(field, is_outlying, log_density, distance)


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


def _fit_to_itself(
    points: Tensor, periods: Tensor | None, bandwidth: float | str, threshold_quantile: float, alpha: float
) -> PotentialField:
    field = PotentialField(points, select_bandwidth(points, bandwidth), alpha=alpha, periods=periods)
    return replace(
        field, log_threshold=_just_below_quantile(field.log_density(points).cpu(), threshold_quantile)
    )


def _just_below_quantile(log_densities: Tensor, quantile: float) -> float:
    """A number just below a quantile of finite log densities; `_TIES` says how far."""
    known = log_densities[log_densities.isfinite()]
    rank = max(1, math.ceil(quantile * len(known)))
    # kthvalue rather than torch.quantile, which refuses more than 2^24 elements.
    value = known.kthvalue(rank).values.item()
    absolute, relative = _TIES
    return value - absolute - relative * abs(value)


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
