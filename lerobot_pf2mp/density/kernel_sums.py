# SPDX-License-Identifier: Apache-2.0
"""Sums of Gaussian kernels over anchors: their logarithm, and the kernel-weighted mean of the anchors.

There are three implementations with equal results:
- on a CPU a search in a tree of the anchors (kernel_tree.py);
- on a CPU one attention call, where the C extension could not be built, or in a compiled graph if there is no tree yet;
- on other devices, and for angles, softmax and sum, block by block.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from lerobot_pf2mp.density import kernel_tree
from lerobot_pf2mp.density.kernel_tree import KernelTree
from lerobot_pf2mp.density.kernels import (
    PAIRS_PER_BLOCK,
    checked_periods,
    differences,
    log_kernels,
    log_sum_exp,
    mean,
    offsets_between,
    without_angles,
)

# Queries and anchors are clamped to this many bandwidths, because larger squares would overflow.
_FARTHEST = 5e17

# Largest exponent |q|^2 / 2h^2 for which float32 resolves differences of exponents to about 1e-5.
_LARGEST_SINGLE_EXPONENT = 64.0


@dataclass(frozen=True, eq=False)
class KernelSums:
    """Sums of Gaussian kernels over given anchors.

    Args:
        anchors: ``(M, D)`` float32 positions of the kernels, M >= 1.
        bandwidth: Standard deviation h > 0 of the kernels.
        periods: ``(D,)`` the period P > 0 of each dimension that is an angle, so that x and x + P are the same; 0 for the
            other dimensions. All differences x_i - q below lie in [-P/2, P/2]. None stands for zeros.
        groups: ``(M,)`` int64 group numbers of the anchors, for `sums_without_own_group`.

    Raises:
        ValueError: If the periods are not D finite numbers of at least 0, or the groups not M numbers that fit into
            32 bits.
    """

    anchors: Tensor
    bandwidth: float
    periods: Tensor | None = None
    groups: Tensor | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "periods", checked_periods(self.periods, self.anchors.shape[1]))
        if self.groups is not None:
            kernel_tree.check_groups(self.groups, len(self.anchors))

    def __call__(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        """The offsets to the local means, and the log sums, at queries. They are finite everywhere. Memory is O(M + Q).

        Args:
            queries: ``(Q, D)`` float32 on the anchors' device.

        Returns:
            ``(Q, D)`` the offsets sum_i w_i (x_i - q) to the local means, with w = softmax_i(-|q - x_i|^2 / 2h^2);
            ``(Q,)`` the log sums log sum_i exp(-|q - x_i|^2 / 2h^2).
        """
        if not len(queries):
            return queries, queries.new_empty(0)  # attention would crash on no queries
        if self.has_tree:
            return self.tree.sums(queries)
        # Autocast would multiply in bfloat16.
        with torch.autocast(device_type=queries.device.type, enabled=False):
            centred = queries - self._centre
            is_attention = queries.device.type == "cpu" and self.periods is None
            return (self._by_attention if is_attention else self._from_differences)(centred)

    def sums_without_own_group(self, queries: Tensor, groups: Tensor) -> tuple[Tensor, Tensor]:
        """Judges queries by the anchors of other groups. It cannot be compiled.

        The anchors whose group number differs by at most 1 from a query's are left out for it.

        Args:
            queries: ``(Q, D)`` float32 on the anchors' device.
            groups: ``(Q,)`` int64 group numbers of the queries.

        Returns:
            ``(Q,)`` the log sums of the kernels of the other anchors, -inf if there is none;
            ``(Q,)`` the distances to the nearest other anchor [normalised], inf if there is none.

        Raises:
            ValueError: If the anchors have no groups, or the groups are not Q numbers that fit into 32 bits.
        """
        if self.groups is None:
            raise ValueError("the anchors must have groups, got None")
        kernel_tree.check_groups(groups, len(queries))
        if self.has_tree:
            return self.tree.sums_without_own_group(queries, groups)
        log_sums, distances = queries.new_empty(len(queries)), queries.new_empty(len(queries))
        n_at_once = max(1, PAIRS_PER_BLOCK // len(self.anchors))
        for some, own, log_sum, distance in zip(
            *(x.split(n_at_once) for x in (queries - self._centre, groups, log_sums, distances)), strict=True
        ):
            exponents = log_kernels(some, self._centred, self.bandwidth, self.periods)  # (Q, M)
            exponents.masked_fill_((self.groups - own.unsqueeze(1)).abs() <= 1, -math.inf)
            largest, nearest = exponents.max(dim=-1)
            is_alone = largest == -math.inf
            log_sum.copy_(log_sum_exp(exponents).masked_fill_(is_alone, -math.inf))
            offsets = offsets_between(some, self._centred[nearest], self.periods)
            distance.copy_(offsets.norm(dim=-1).masked_fill_(is_alone, math.inf))
        return log_sums, distances

    @property
    def has_tree(self) -> bool:
        """Whether the sums come from `tree`."""
        is_possible = self.anchors.device.type == "cpu" and kernel_tree.is_available()
        return is_possible and ("tree" in vars(self) or not torch.compiler.is_compiling())

    @cached_property
    def tree(self) -> KernelTree:
        """The tree of the anchors; only valid if `has_tree`."""
        return KernelTree.of(self.anchors, self.bandwidth, self.periods, self.groups)

    def _from_differences(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        offsets, log_sums = torch.empty_like(queries), torch.empty_like(queries[:, 0])
        n_at_once = max(1, PAIRS_PER_BLOCK // len(self.anchors))
        for some, offset, log_sum in zip(
            *(x.split(n_at_once) for x in (queries, offsets, log_sums)), strict=True
        ):
            exponents = log_kernels(some, self._centred, self.bandwidth, self.periods)  # (Q, M)
            weights = torch.softmax(exponents, dim=-1)
            if self.periods is None:
                offset.copy_(weights @ self._centred - some)
            else:
                for d, difference in enumerate(differences(some, self._centred, self.periods)):
                    offset[:, d] = (weights * difference).sum(dim=-1)
            log_sum.copy_(log_sum_exp(exponents))
        return offsets, log_sums

    def _by_attention(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        # Whether single precision is enough depends on the values. Reading them would break a compiled graph.
        if torch.compiler.is_compiling() or not self._keys.are_resolved_in_single(queries):
            return self._double_keys.attend(queries)
        return self._keys.attend(queries)

    # Anchors and queries are centred first: float32 resolves differences between points, but not a large common offset.

    @cached_property
    def _centre(self) -> Tensor:
        return without_angles(mean(self.anchors), self.periods)  # (D,)

    @cached_property
    def _centred(self) -> Tensor:
        return self.anchors - self._centre  # (M, D)

    @cached_property
    def _keys(self) -> _Keys:
        return _Keys.of(self._centred, self.bandwidth)

    @cached_property
    def _double_keys(self) -> _Keys:
        return _Keys.of(self._centred.double(), self.bandwidth)


@dataclass(frozen=True, eq=False)
class _Keys:
    """Anchors in the form that an attention call needs, in float32 or float64.

    The call gets queries q / h, keys x / h, biases -|x|^2 / 2h^2 and values x. Its output is the local mean. The
    normaliser of its softmax is the sum of the kernels, except for the factor exp(-|q|^2 / 2h^2).

    Args:
        keys: ``(1, 1, M, D + 1)``, x / h and the bias.
        values: ``(1, 1, M, D + 1)``, x and a zero, because values must have the size of keys.
        bandwidth: h.
    """

    keys: Tensor
    values: Tensor
    bandwidth: float

    @classmethod
    def of(cls, anchors: Tensor, bandwidth: float) -> _Keys:
        scaled = (anchors / bandwidth).clamp(-_FARTHEST, _FARTHEST)
        bias = -0.5 * scaled.square().sum(dim=1, keepdim=True)
        return cls(
            torch.cat([scaled, bias], dim=1)[None, None], F.pad(anchors, (0, 1))[None, None], bandwidth
        )

    def are_resolved_in_single(self, queries: Tensor) -> bool:
        """Whether rounding the exponents to float32 changes the weights by only about 1e-5, relatively."""
        if self._largest_exponent > _LARGEST_SINGLE_EXPONENT:
            return False
        return bool((queries / self.bandwidth).square().sum(dim=1).max() <= 2 * _LARGEST_SINGLE_EXPONENT)

    @cached_property
    def _largest_exponent(self) -> float:
        return -self.keys[..., -1].min().item()

    def attend(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        """The offsets and log sums of `KernelSums`, for float32 queries ``(Q, D)``."""
        precise = queries.to(self.keys.dtype)
        scaled = (precise / self.bandwidth).clamp(-_FARTHEST, _FARTHEST)
        means, log_normalisers = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu(
            F.pad(scaled, (0, 1), value=1.0)[None, None], self.keys, self.values, scale=1.0
        )
        log_sums = log_normalisers[0, 0] - 0.5 * scaled.double().square().sum(dim=1)
        return (means[0, 0, :, :-1] - precise).float(), log_sums.float()
