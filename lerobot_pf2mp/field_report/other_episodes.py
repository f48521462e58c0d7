# SPDX-License-Identifier: Apache-2.0
"""Judges actions by the other episodes alone: the density, and the threshold of the safe set H."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from lerobot_pf2mp.density.kernel_sums import KernelSums
from lerobot_pf2mp.density.kernels import log_kernels, wrap

_N_COMPARED = 1000  # anchors whose neighbours and kernel weights are looked at


@dataclass(frozen=True, eq=False)
class OtherEpisodes:
    """The anchors of a field, which judge actions of other episodes.

    Args:
        anchors: ``(M, D)`` float32 actions on the CPU [normalised].
        groups: ``(M,)`` their group numbers, see `group_numbers`.
        bandwidth: The kernel bandwidth h [normalised].
        periods: ``(D,)`` periods of angles [normalised], 0 for other dimensions; None if there are no angles.
    """

    anchors: Tensor
    groups: Tensor
    bandwidth: float
    periods: Tensor | None

    def __call__(self, actions: Tensor, groups: Tensor) -> tuple[Tensor, Tensor]:
        """The judgement without each action's own group.

        Args:
            actions: ``(Q, D)`` actions [normalised].
            groups: ``(Q,)`` their group numbers.

        Returns:
            ``(Q,)`` log densities [nats] and ``(Q,)`` distances to the nearest anchor [normalised]; -inf and inf where no
            anchor is left.
        """
        sums = KernelSums(self.anchors, self.bandwidth, self.periods, self.groups)
        log_sums, distances = sums.sums_without_own_group(actions, groups)
        counts = torch.bincount(self.groups, minlength=int(groups.max()) + 2)
        counts = torch.nn.functional.pad(counts, (1, 0))
        n_others = len(self.anchors) - counts[groups] - counts[groups + 1] - counts[groups + 2]
        return log_sums - n_others.log() - _log_normaliser(self.bandwidth, self.anchors.shape[1]), distances

    def effective_anchors(self) -> tuple[float, float, float]:
        """Quantiles of 1 / sum w^2 at anchors, of the kernel weights w of other groups."""
        rows = self._chosen()
        weights = self._log_kernels_of_others(rows).softmax(dim=1)  # (C, M)
        numbers = (1 / weights.square().sum(dim=1)).double()
        numbers = numbers[numbers.isfinite()]
        if not len(numbers):
            return math.nan, math.nan, math.nan
        low, median, high = numbers.quantile(torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64)).tolist()
        return low, median, high

    def squares_to_nearest(self) -> Tensor:
        """``(D,)`` mean squared offset from anchors to the nearest anchor of another group, in each dimension."""
        rows = self._chosen()
        exponents = self._log_kernels_of_others(rows)
        has_other = exponents.amax(dim=1).isfinite()
        offsets = (self.anchors[exponents.argmax(dim=1)] - self.anchors[rows])[has_other]  # (C, D)
        if self.periods is not None:
            offsets = wrap(offsets, self.periods)
        return offsets.double().square().sum(dim=0) / max(len(offsets), 1)

    def _chosen(self) -> Tensor:
        return torch.linspace(0, len(self.anchors) - 1, min(_N_COMPARED, len(self.anchors))).long()

    def _log_kernels_of_others(self, rows: Tensor) -> Tensor:
        exponents = log_kernels(self.anchors[rows], self.anchors, self.bandwidth, self.periods)
        exponents[(self.groups[rows].unsqueeze(1) - self.groups).abs() <= 1] = -math.inf
        return exponents


class Thresholds:
    """The threshold of H without a group, if the threshold is a quantile of held-out log densities.

    Args:
        log_density: ``(M,)`` held-out log densities of the anchors [nats].
        groups: ``(M,)`` their group numbers.
        quantile: The quantile in [0, 1].
        log_threshold: The field's threshold [nats]. If it follows another rule, it holds for all groups.
    """

    def __init__(self, log_density: Tensor, groups: Tensor, quantile: float, log_threshold: float) -> None:
        self._ordered, order = log_density.sort()
        self._groups = groups[order]
        self._quantile = quantile
        self._log_threshold = log_threshold
        of_all = self._at(torch.ones(len(groups), dtype=torch.bool))
        self._is_quantile = abs(of_all - log_threshold) < 0.01

    def without(self, group: int) -> float:
        """The threshold of the other groups [nats]."""
        is_other = (self._groups - group).abs() > 1
        return self._at(is_other) if self._is_quantile and bool(is_other.any()) else self._log_threshold

    def _at(self, is_chosen: Tensor) -> float:
        chosen = self._ordered[is_chosen & self._ordered.isfinite()]
        if not len(chosen):
            return -math.inf
        value = chosen[max(1, math.ceil(self._quantile * len(chosen))) - 1].item()
        return value - 1e-4 - 1e-6 * abs(value)  # equal densities, rounded, are inside


def reach_of(bandwidth: float, log_threshold: float, n_anchors: int, dim: int) -> float:
    """How far H reaches from a lone anchor.

    Args:
        bandwidth: h [normalised].
        log_threshold: Log density that bounds H [nats].
        n_anchors: Number of anchors M.
        dim: Number of dimensions D.

    Returns:
        The distance [normalised] at which the lone anchor's kernel is as dense as the border of H; at least h.
    """
    nats = -math.log(n_anchors) - _log_normaliser(bandwidth, dim) - log_threshold
    return bandwidth * math.sqrt(2 * max(nats, 0.5))


def _log_normaliser(bandwidth: float, dim: int) -> float:
    return dim * (math.log(bandwidth) + 0.5 * math.log(2 * math.pi))
