# SPDX-License-Identifier: Apache-2.0
"""The potential field of Section IV-B: where the demonstrations went, as a density, and which way is back there.

Everything lives in the space in which the policy generates (normalised actions). With M anchors x_i, demonstrated
actions drawn at random, and a bandwidth h:

    density       p(a)   = 1/M sum_i N(a; x_i, h^2 I)                      Gaussian KDE, Section III-B
    potential     phi(a) = log p(a) + alpha d(a, H),  alpha <= 0           Section IV-B; larger is safer
    safe set      H      = {a : log p(a) > log_threshold}
    gradient      Phi(a) = grad phi(a)                                     Eq. 9, points to safety

The score grad log p is closed form, (m(a) - a) / h^2 with the local mean m(a) = softmax_i(-|a - x_i|^2 / 2h^2) x_i
(one attention call), because LeRobot evaluates under ``torch.inference_mode()``, where autograd cannot run.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

BANDWIDTH_RULES = ("scott", "silverman", "likelihood")

# Pairs (query, anchor) held at once: 2^20 float32 numbers, 4 MB, stay in a core's cache.
_PAIRS_PER_BLOCK = 2**20

# The root of float32's largest number, with room for a sum of a thousand squares.
_LARGEST = 5e17

# Relative to the spread of the points. Below it a float32 kernel resolves nothing but duplicates.
_SMALLEST_BANDWIDTH = 1e-3


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

    Raises:
        ValueError: If an argument breaks one of these rules.
    """

    anchors: Tensor
    bandwidth: float
    log_threshold: float = -math.inf
    alpha: float = 0.0

    def __post_init__(self) -> None:
        if self.anchors.ndim != 2 or self.anchors.shape[0] < 1 or self.anchors.shape[1] < 1:
            raise ValueError(
                f"anchors must have shape (M, D) with M, D >= 1, got {tuple(self.anchors.shape)}"
            )
        if not torch.isfinite(self.anchors).all():
            raise ValueError("anchors must be finite, got NaN or infinite entries")
        _check_bandwidth(self.bandwidth)
        if math.isnan(self.log_threshold):
            raise ValueError("log_threshold must be a number, got nan")
        if not self.alpha <= 0 or math.isinf(self.alpha):
            raise ValueError(f"alpha must be finite and at most 0 (the paper's sign), got {self.alpha}")
        object.__setattr__(self, "anchors", self.anchors.detach().float().contiguous())

    @property
    def dim(self) -> int:
        """The number of action dimensions D that the field covers."""
        return self.anchors.shape[1]

    def to(self, device: torch.device | str) -> PotentialField:
        """This field with its anchors on `device`."""
        anchors = self.anchors.to(device)
        if anchors is self.anchors:
            return self
        return PotentialField(anchors, self.bandwidth, self.log_threshold, self.alpha)

    @torch.no_grad()
    def log_density(self, a: Tensor) -> Tensor:
        """The log density log p(a), normalised over R^D.

        Args:
            a: ``(..., D)`` actions [normalised].

        Returns:
            ``(...)`` log densities [nats], finite also far from all anchors.
        """
        queries = self._flatten(a)
        log_sums = [_log_sum_exp(self._log_kernels(block)) for block in self._blocks(queries)]
        return (torch.cat(log_sums) - self._log_normaliser).reshape(a.shape[:-1])

    @torch.no_grad()
    def mean_shift(self, a: Tensor) -> Tensor:
        """The vector m(a) - a to the kernel-weighted mean m(a) of the anchors, along which log p(a) rises.

        Args:
            a: ``(..., D)`` actions [normalised].

        Returns:
            ``(..., D)`` offsets [normalised]; m(a) lies in the convex hull of the anchors.
        """
        queries = self._flatten(a)
        # Autocast would multiply in bfloat16.
        with torch.autocast(device_type=queries.device.type, enabled=False):
            shifts = [
                torch.softmax(self._log_kernels(block), dim=-1) @ self._centred - (block - self._centre)
                for block in self._blocks(queries)
            ]
        return torch.cat(shifts).reshape(a.shape)

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
    def offset_to_safe_set(self, a: Tensor) -> Tensor:
        """The vector from a to the safe set H; zero inside H.

        The paper does not say how d(a, H) is measured. Outside H this is the vector to the nearest anchor that lies
        in H, an upper bound of the distance to H itself, exact to within about a bandwidth and never leading past H.

        Args:
            a: ``(..., D)`` actions [normalised].

        Returns:
            ``(..., D)`` offsets [normalised]; d(a, H) is their norm.
        """
        queries = self._flatten(a)
        offsets = torch.zeros_like(queries)
        is_unsafe = self.log_density(queries) <= self.log_threshold
        # Few actions are unsafe, least of all guided ones: only for them the nearest safe anchor is looked up.
        unsafe = queries[is_unsafe]
        if len(unsafe):
            safe_anchors = self._centred[self._anchor_is_safe]
            nearest = [
                safe_anchors[_log_kernels(block - self._centre, safe_anchors, self.bandwidth).argmax(dim=-1)]
                for block in self._blocks(unsafe)
            ]
            offsets[is_unsafe] = torch.cat(nearest) - (unsafe - self._centre)
        return offsets.reshape(a.shape)

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
        """The potential field Phi(a) = grad phi(a) of Eq. 9, one row for each action.

        Args:
            a: ``(..., D)`` actions [normalised].

        Returns:
            ``(..., D)`` gradients [1/normalised], pointing to safety.
        """
        gradient = self.score(a)
        if self.alpha != 0:
            offset = self.offset_to_safe_set(a)
            direction = offset / offset.norm(dim=-1, keepdim=True).clamp_min(torch.finfo(torch.float32).tiny)
            gradient = gradient - self.alpha * direction
        return gradient

    # Distances are taken after centring: float32 resolves differences between actions, not their common offset.

    @cached_property
    def _centre(self) -> Tensor:
        return _mean(self.anchors)  # (D,)

    @cached_property
    def _centred(self) -> Tensor:
        return self.anchors - self._centre  # (M, D)

    @cached_property
    def _log_normaliser(self) -> float:
        count, dim = self.anchors.shape
        return math.log(count) + dim * (math.log(self.bandwidth) + 0.5 * math.log(2 * math.pi))

    @cached_property
    def _anchor_is_safe(self) -> Tensor:
        log_densities = self.log_density(self.anchors)  # (M,)
        # H holds at least the densest anchor, so that every action has somewhere to go.
        return (log_densities > self.log_threshold) | (log_densities == log_densities.max())

    def _flatten(self, a: Tensor) -> Tensor:
        if a.ndim < 1 or a.shape[-1] != self.dim:
            raise ValueError(
                f"the field covers {self.dim} action dimensions, got actions of shape {tuple(a.shape)}"
            )
        return a.reshape(-1, self.dim).float()  # (Q, D)

    def _blocks(self, queries: Tensor) -> tuple[Tensor, ...]:
        return queries.split(max(1, _PAIRS_PER_BLOCK // self.anchors.shape[0]))

    def _log_kernels(self, queries: Tensor) -> Tensor:
        return _log_kernels(queries - self._centre, self._centred, self.bandwidth)  # (Q, M)


def fit(
    points: Tensor,
    *,
    bandwidth: float | str = "likelihood",
    threshold_quantile: float = 0.01,
    alpha: float = 0.0,
    n_anchors: int | None = None,
    generator: torch.Generator | None = None,
) -> PotentialField:
    """Fits a potential field to demonstrated actions.

    Args:
        points: ``(P, D)`` demonstrated actions [normalised], P >= 1.
        bandwidth: A rule of `BANDWIDTH_RULES`, or h itself [normalised].
        threshold_quantile: The quantile in [0, 1] of the anchors' own log densities that bounds the safe set H.
        alpha: Weight of the distance term, at most 0.
        n_anchors: How many of the points to keep, drawn without replacement; None keeps them all.
        generator: Source of randomness for that draw.

    Returns:
        The fitted field.

    Raises:
        ValueError: If the points are not a finite ``(P, D)`` tensor, or an argument breaks its rule.
    """
    if not 0 <= threshold_quantile <= 1:
        raise ValueError(f"threshold_quantile must lie in [0, 1], got {threshold_quantile}")
    if points.ndim != 2 or points.shape[0] < 1 or points.shape[1] < 1:
        raise ValueError(f"points must have shape (P, D) with P, D >= 1, got {tuple(points.shape)}")
    if not torch.isfinite(points).all():
        raise ValueError("points must be finite, got NaN or infinite entries")
    if n_anchors is not None:
        if n_anchors < 1:
            raise ValueError(f"n_anchors must be at least 1, got {n_anchors}")
        if n_anchors < len(points):
            chosen = torch.randperm(len(points), generator=generator)[:n_anchors]
            points = points[chosen.to(points.device)]
    field = PotentialField(points, select_bandwidth(points, bandwidth))
    log_densities = field.log_density(points)
    # kthvalue rather than torch.quantile, which refuses more than 2^24 elements.
    rank = max(1, math.ceil(threshold_quantile * len(points)))
    log_threshold = log_densities.cpu().kthvalue(rank).values.item()
    return PotentialField(points, field.bandwidth, log_threshold, alpha)


def select_bandwidth(points: Tensor, rule: float | str = "likelihood") -> float:
    """The kernel bandwidth h for a set of points.

    Args:
        points: ``(M, D)`` points [normalised].
        rule: ``scott`` (M^(-1/(D+4)) times the points' standard deviation), ``silverman`` (the same times
            (4/(D+2))^(1/(D+4))), ``likelihood`` (maximises the leave-one-out log likelihood), or h itself. The kernel
            is isotropic, so the standard deviation is the root mean square over the dimensions that vary.

    Returns:
        The bandwidth h > 0 [normalised].

    Raises:
        ValueError: If the rule is unknown, or a number that is not finite and positive.
    """
    if isinstance(rule, (int, float)) and not isinstance(rule, bool):
        _check_bandwidth(rule)
        return float(rule)
    if rule not in BANDWIDTH_RULES:
        raise ValueError(f"bandwidth must be one of {BANDWIDTH_RULES} or a positive number, got {rule!r}")
    variance = points.cpu().double().var(dim=0, correction=0)  # (D,)
    varying = variance > 0
    if not bool(varying.any()):
        return _SMALLEST_BANDWIDTH  # all points are the same one: there is no spread to measure
    spread = variance[varying].mean().sqrt().item()
    count, dim = len(points), int(varying.sum())
    scott = spread * count ** (-1 / (dim + 4))
    if rule == "scott":
        return scott
    if rule == "silverman":
        return scott * (4 / (dim + 2)) ** (1 / (dim + 4))
    return _most_likely_bandwidth(
        points.cpu()[:, varying], smallest=_SMALLEST_BANDWIDTH * spread, largest=3 * spread
    )


def leave_one_out_log_likelihood(points: Tensor, bandwidth: float) -> float:
    """The mean of log p_{-i}(x_i) over the points, p_{-i} being the density fitted without point i.

    Args:
        points: ``(M, D)`` distinct points, M >= 2.
        bandwidth: The kernel bandwidth h > 0.

    Returns:
        The mean leave-one-out log likelihood [nats].
    """
    count, dim = points.shape
    centred = points.float() - _mean(points)
    rows_per_block = max(1, _PAIRS_PER_BLOCK // count)
    total = 0.0
    for start in range(0, count, rows_per_block):
        log_kernels = _log_kernels(centred[start : start + rows_per_block], centred, bandwidth)
        log_kernels.diagonal(offset=start).fill_(-math.inf)
        total += _log_sum_exp(log_kernels).cpu().double().sum().item()
    log_normaliser = math.log(count - 1) + dim * (math.log(bandwidth) + 0.5 * math.log(2 * math.pi))
    return total / count - log_normaliser


@torch.no_grad()
def _most_likely_bandwidth(points: Tensor, smallest: float, largest: float, n_points: int = 3000) -> float:
    """The bandwidth of largest leave-one-out likelihood, to 1 %, by golden-section search on log h.

    Duplicated points are dropped first: with them the likelihood is unbounded as h tends to 0. For more than
    `n_points` points an even subset is used, and the h found is carried over by Scott's power of the count.
    """
    distinct = torch.unique(points.float(), dim=0)
    if len(distinct) < 2:
        return smallest
    subset = distinct[torch.linspace(0, len(distinct) - 1, min(n_points, len(distinct))).long()]
    golden = (math.sqrt(5) - 1) / 2
    low, high = math.log(smallest), math.log(largest)
    left, right = high - golden * (high - low), low + golden * (high - low)
    at_left = leave_one_out_log_likelihood(subset, math.exp(left))
    at_right = leave_one_out_log_likelihood(subset, math.exp(right))
    while high - low > 0.01:
        if at_left > at_right:
            high, right, at_right = right, left, at_left
            left = high - golden * (high - low)
            at_left = leave_one_out_log_likelihood(subset, math.exp(left))
        else:
            low, left, at_left = left, right, at_right
            right = low + golden * (high - low)
            at_right = leave_one_out_log_likelihood(subset, math.exp(right))
    return math.exp((low + high) / 2) * (len(subset) / len(distinct)) ** (1 / (points.shape[1] + 4))


def _log_kernels(queries: Tensor, anchors: Tensor, bandwidth: float) -> Tensor:
    """The exponents -|q - x|^2 / 2h^2 for all pairs, ``(Q, M)``.

    Differences first, squares after: the expansion |q|^2 - 2 q.x + |x|^2 would lose, for queries many bandwidths from
    the origin, the digits on which the softmax depends. Autocast must not turn them into bfloat16 either.
    """
    with torch.autocast(device_type=queries.device.type, enabled=False):
        scale = 1 / (math.sqrt(2) * bandwidth)
        # Beyond the limit squares would overflow, and the softmax with them; there the nearest anchor is unknowable.
        scaled_queries = (queries * scale).clamp(-_LARGEST, _LARGEST)
        scaled_anchors = (anchors * scale).clamp(-_LARGEST, _LARGEST)
        squares = torch.zeros(len(queries), len(anchors), dtype=torch.float32, device=queries.device)
        for q, x in zip(scaled_queries.unbind(-1), scaled_anchors.unbind(-1), strict=True):
            difference = q.unsqueeze(1) - x.unsqueeze(0)  # (Q, M)
            squares.addcmul_(difference, difference)
        return squares.neg_()


def _mean(points: Tensor) -> Tensor:
    """The mean ``(D,)`` of points ``(M, D)`` in double precision, which not every device has, as float32."""
    return points.cpu().double().mean(dim=0).float().to(points.device)


def _log_sum_exp(log_kernels: Tensor) -> Tensor:
    """The log-sum-exp over the last dimension, ``(Q, M)`` to ``(Q,)``.

    From the largest softmax weight, exp(max - lse): torch.softmax does not suffer from underflowing exponents, on
    which torch.logsumexp is several times slower on a CPU (denormal numbers).
    """
    largest_weight = torch.softmax(log_kernels, dim=-1).amax(dim=-1)
    return log_kernels.amax(dim=-1) - largest_weight.log()


def _check_bandwidth(bandwidth: float) -> None:
    if not (bandwidth > 0 and math.isfinite(bandwidth)):
        raise ValueError(f"bandwidth must be finite and positive, got {bandwidth}")
