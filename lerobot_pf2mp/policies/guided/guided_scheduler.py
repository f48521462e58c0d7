# SPDX-License-Identifier: Apache-2.0
"""Guidance in every denoising step of a diffusion policy."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from torch import Tensor

from lerobot_pf2mp.flow_matching import Guide


@contextmanager
def guided_scheduler(owner: Any, guide: Guide | None) -> Iterator[None]:
    """Puts a guide into every step of the noise scheduler of diffusers that a network denoises with.

    Args:
        owner: What holds the scheduler, as ``noise_scheduler``. It is unchanged after the block.
        guide: The guide; None leaves the scheduler as it is.
    """
    scheduler = owner.noise_scheduler
    if guide is not None:
        owner.noise_scheduler = _GuidedScheduler(scheduler, guide)
    try:
        yield
    finally:
        owner.noise_scheduler = scheduler


class _GuidedScheduler:
    """A noise scheduler of diffusers with a guide in every step.

    For the guidance, each of the N denoising steps has the length dt = 1/N, as in the flow.
    """

    def __init__(self, scheduler: Any, guide: Guide) -> None:
        self._scheduler = scheduler
        self._guide = guide

    def __getattr__(self, name: str) -> Any:
        return getattr(self._scheduler, name)

    def step(self, model_output: Tensor, timestep: int, sample: Tensor, **kwargs: Any) -> Any:
        output = self._scheduler.step(model_output, timestep, sample, **kwargs)
        dt = 1 / len(self._scheduler.timesteps)
        output.prev_sample = self._guide(sample, output.prev_sample, output.pred_original_sample, dt)
        return output
