# SPDX-License-Identifier: Apache-2.0
"""Checks whether planned actions stay in the demonstrated region, to protect the robot."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import torch
from torch import Tensor

from lerobot_pf2mp.potential_field import PotentialField

ON_UNSUPPORTED = ("ignore", "warn", "hold")

logger = logging.getLogger(__name__)


class SupportMonitor:
    """Measures how far planned actions leave the demonstrated region, and can hold the robot at the last action inside.

    An action is supported if its density is at least the field's threshold. Its value in `support` is then at least 0.

    Args:
        on_unsupported: ignore (the policy does not call the monitor), warn (log a line for each chunk that leaves the
            region) or hold (warn, and replace each unsupported action by the last supported one). It can be changed.
        action_dims: Action dimensions that the field covers; None covers all. They can be changed.
    """

    def __init__(self, on_unsupported: str, action_dims: Sequence[int] | None = None) -> None:
        self.on_unsupported = on_unsupported
        self.action_dims = action_dims
        self.reset()

    def reset(self) -> None:
        """Forgets the last chunk. Must be called at the start of an episode."""
        self.support: Tensor | None = None  # (B, T) log density above the threshold [nats] of the last chunk
        self._last_supported: Tensor | None = None  # (B, A)

    def __call__(self, chunk: Tensor, field: PotentialField) -> Tensor:
        """The actions to execute.

        Args:
            chunk: ``(B, T, A)`` planned actions [normalised].
            field: The potential field.

        Returns:
            ``(B, T, A)`` the same actions, except with hold. Then each unsupported action is replaced by the last supported
            action before it. If the chunk has none before it, that is the last supported action of earlier chunks; in the
            first chunk it is the first supported action of that chunk. A first chunk without supported actions stays
            unchanged.
        """
        covered = chunk if self.action_dims is None else chunk[..., list(self.action_dims)]
        self.support = field.log_density(covered) - field.log_threshold  # (B, T)
        is_supported = self.support >= 0
        if not is_supported.all():
            logger.warning(
                "%d of %d planned actions leave the demonstrated region, by up to %.1f nats",
                (~is_supported).sum().item(),
                is_supported.numel(),
                -self.support.min().item(),
            )
        return self._hold(chunk, is_supported) if self.on_unsupported == "hold" else chunk

    def _hold(self, chunk: Tensor, is_supported: Tensor) -> Tensor:
        steps = torch.arange(chunk.shape[1], device=chunk.device).expand_as(is_supported)
        last = torch.where(is_supported, steps, -1).cummax(dim=1).values  # (B, T)
        first = is_supported.int().argmax(dim=1)  # (B,)
        robots = torch.arange(len(chunk), device=chunk.device)
        before = chunk[robots, first] if self._last_supported is None else self._last_supported  # (B, A)
        held = chunk.gather(1, last.clamp_min(0).unsqueeze(-1).expand_as(chunk))
        held = torch.where((last >= 0).unsqueeze(-1), held, before.unsqueeze(1))
        has_any = (
            is_supported.any(dim=1)
            if self._last_supported is None
            else torch.ones_like(first, dtype=torch.bool)
        )
        held = torch.where(has_any.view(-1, 1, 1), held, chunk)
        if has_any.all():
            self._last_supported = held[:, -1]
        return held
