# SPDX-License-Identifier: Apache-2.0
"""Gathers tensors of all processes of a training run on several devices."""

from __future__ import annotations

import torch
import torch.distributed as dist
from torch import Tensor


def gather_rows(*tensors: Tensor | None) -> tuple[Tensor | None, ...]:
    """Gathers the rows of all processes, with the same result in each of them. A single process gets its own tensors.

    Every process must call this, as in a training step. Processes may have different numbers of rows.

    Args:
        *tensors: ``(B, ...)`` each, with the same B and device. The shape of a row and the type must be the same in all
            processes. None stays None; it must be None in all processes.

    Returns:
        ``(B_1 + ... + B_n, ...)`` for each tensor, in the order of the processes.
    """
    if not (dist.is_available() and dist.is_initialized() and dist.get_world_size() > 1):
        return tensors
    first = next(tensor for tensor in tensors if tensor is not None)
    counts = torch.cat(_gather(torch.tensor([len(first)], device=first.device))).tolist()
    return tuple(None if tensor is None else _gather_counted(tensor, counts) for tensor in tensors)


def is_main_process() -> bool:
    """Whether this process is the only one of its training run, or the one that logs and saves."""
    return not (dist.is_available() and dist.is_initialized()) or dist.get_rank() == 0


def _gather_counted(rows: Tensor, counts: list[int]) -> Tensor:
    """Gathers different numbers of rows. Collectives need equal shapes, so rows are padded to the largest count."""
    padded = rows.new_zeros(max(counts), *rows.shape[1:])
    padded[: len(rows)] = rows
    return torch.cat([part[:count] for part, count in zip(_gather(padded), counts, strict=True)])


def _gather(tensor: Tensor) -> list[Tensor]:
    parts = [torch.empty_like(tensor) for _ in range(dist.get_world_size())]
    dist.all_gather(parts, tensor)
    return parts
