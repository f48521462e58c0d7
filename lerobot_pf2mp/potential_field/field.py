# SPDX-License-Identifier: Apache-2.0
"""The potential field of Section IV-B: the density of demonstrated actions, and the direction in which it rises.

Everything lives in the space in which the policy generates (normalised actions). With M anchors x_i, demonstrated
actions drawn at random, and a bandwidth h:

    density       p(a)   = 1/M sum_i N(a; x_i, h^2 I)                      Gaussian KDE, Eq. 6
    potential     phi(a) = log p(a) + alpha d(a, H),  alpha <= 0           Eq. 10; larger is safer (see `PotentialField`)
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

from lerobot_pf2mp.density.bandwidth import check_bandwidth
from lerobot_pf2mp.density.kernel_sums import KernelSums
from lerobot_pf2mp.density.kernel_tree import KernelTree
from lerobot_pf2mp.density.kernels import offsets_to_nearest
from lerobot_pf2mp.density.pull import Pull

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

    The potential is phi(a) = psi(log p(a)) + alpha d(a, H). By default psi(l) is l, as in the paper. With `log_full_pull`
    and `log_no_pull` the density pulls only where support is missing: psi rises with slope 1 up to the first, ever less
    from there to the second, and no further (see `Pull`). `log_density`, `mean_shift` and `score` know nothing of that.

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
        log_full_pull: Log density up to which the density pulls fully [nats].
        log_no_pull: Log density from which on it does not pull [nats]; in between the pull falls linearly in log p. Both
            infinite: it pulls fully everywhere.

    Raises:
        ValueError: If an argument breaks one of these rules.
    """

    anchors: Tensor
    bandwidth: float
    log_threshold: float = -math.inf
    alpha: float = 0.0
    periods: Tensor | None = None
    anchor_is_safe: Tensor | None = None
    log_full_pull: float = math.inf
    log_no_pull: float = math.inf

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
        _ = self._pull
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
    def without_own_group(
        self, a: Tensor, groups: Tensor, groups_of_anchors: Tensor
    ) -> tuple[Tensor, Tensor]:
        """What the anchors of other groups, for example episodes, say of actions. It cannot be compiled.

        Args:
            a: ``(Q, D)`` actions [normalised].
            groups: ``(Q,)`` int64 their group numbers, see `group_numbers`.
            groups_of_anchors: ``(M,)`` int64 those of the anchors.

        Returns:
            ``(Q,)`` the log density if the kernels of the own group were zero [nats], -inf if nothing else remains;
            ``(Q,)`` the distance to the nearest anchor of another group [normalised], inf if nothing else remains.
        """
        sums = KernelSums(self.anchors, self.bandwidth, self.periods, groups_of_anchors)
        log_sums, distances = sums.sums_without_own_group(self._flatten(a), groups)
        return log_sums - self._log_normaliser, distances

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
        """The step share w(log p(a)) (m(a) - a) towards the local mean, and from its end towards the safe set H.

        Args:
            a: ``(..., D)`` actions [normalised].
            share: Fraction of the mean shift that the step covers where the pull is full (w = 1), in [0, 1].
            max_distance: Largest length of the second part, towards H [normalised]; 0 leaves it out.

        Returns:
            ``(..., D)`` steps [normalised].
        """
        queries = self._flatten(a)
        if self._sums.has_tree:
            tree, log_sum = self._sums.tree, self._log_sum_threshold
            targets = self._safe_tree if max_distance > 0 else tree
            steps = tree.steps_to(
                targets, queries, log_sum, share, max_distance, self._pull, self._log_normaliser
            )
        else:
            log_density, shifts = self.log_density_and_mean_shift(queries)
            steps = share * self._pull.weighted(shifts, log_density)
            if max_distance > 0:
                offset = self.offset_to_safe_set(queries + steps)
                distance = offset.norm(dim=-1, keepdim=True).clamp_min(max(max_distance, _TINY))
                steps = steps.addcdiv_(offset, distance, value=max_distance)
        return steps.reshape(a.shape)

    def potential(self, a: Tensor) -> Tensor:
        """The potential phi(a) = psi(log p(a)) + alpha d(a, H); larger is safer.

        Args:
            a: ``(..., D)`` actions [normalised].

        Returns:
            ``(...)`` potentials [nats].
        """
        phi = self._pull.integral(self.log_density(a))
        if self.alpha != 0:
            phi = phi + self.alpha * self.offset_to_safe_set(a).norm(dim=-1)
        return phi

    def potential_gradient(self, a: Tensor) -> Tensor:
        """The potential field Phi(a) = grad phi(a) = w(log p(a)) grad log p(a) + alpha grad d(a, H) of Eq. 11.

        Args:
            a: ``(..., D)`` actions [normalised].

        Returns:
            ``(..., D)`` gradients [1/normalised], pointing to safety.
        """
        log_density, shifts = self.log_density_and_mean_shift(a)
        gradient = self._pull.weighted(shifts, log_density) / self.bandwidth**2
        if self.alpha != 0:
            offset = self.offset_to_safe_set(a)
            direction = offset / offset.norm(dim=-1, keepdim=True).clamp_min(_TINY)
            gradient = gradient - self.alpha * direction
        return gradient

    @cached_property
    def _sums(self) -> KernelSums:
        return KernelSums(self.anchors, self.bandwidth, self.periods)

    @cached_property
    def _pull(self) -> Pull:
        return Pull(self.log_full_pull, self.log_no_pull)

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
