# SPDX-License-Identifier: Apache-2.0
"""What every process of a training run on several devices has, put together in every one of them."""

from __future__ import annotations

import torch
import torch.distributed as dist
from torch import Tensor


def gather_rows(*tensors: Tensor | None) -> tuple[Tensor | None, ...]:
    """The rows of all processes, the same in each of them; in a single process the tensors themselves.

    Every process has to call this, as every one does in a training step. Processes may have different numbers of rows.

    Args:
        *tensors: ``(B, ...)`` each, B and device in common; the shape of a row and the type are those of all processes.
            None, in all processes, stays None.

    Returns:
        ``(B_1 + ... + B_n, ...)`` of each, in the order of the processes.
    """
    if not (dist.is_available() and dist.is_initialized() and dist.get_world_size() > 1):
        return tensors
    first = next(tensor for tensor in tensors if tensor is not None)
    counts = torch.cat(_gather(torch.tensor([len(first)], device=first.device))).tolist()
    return tuple(None if tensor is None else _gather_counted(tensor, counts) for tensor in tensors)


def _gather_counted(rows: Tensor, counts: list[int]) -> Tensor:
    """Collectives exchange equal shapes: rows are added up to the largest count, and taken away again."""
    padded = rows.new_zeros(max(counts), *rows.shape[1:])
    padded[: len(rows)] = rows
    return torch.cat([part[:count] for part, count in zip(_gather(padded), counts, strict=True)])


def _gather(tensor: Tensor) -> list[Tensor]:
    parts = [torch.empty_like(tensor) for _ in range(dist.get_world_size())]
    dist.all_gather(parts, tensor)
    return parts
