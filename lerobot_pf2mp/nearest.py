# SPDX-License-Identifier: Apache-2.0
"""The nearest of many points, on the CPU."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class NearestPoints:
    """A k-d tree of points.

    Args:
        points: ``(K, D)`` on the CPU, K >= 1.
    """

    points: Tensor

    def __call__(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        """The squared distances ``(Q,)`` of queries ``(Q, D)`` to the point nearest to each, and its index ``(Q,)``."""
        distances, indices = self._tree.query(torch.nan_to_num(queries).numpy())
        return torch.from_numpy(distances).square(), torch.from_numpy(indices)

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.points.numpy())
