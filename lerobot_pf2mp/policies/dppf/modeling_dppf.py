# SPDX-License-Identifier: Apache-2.0
"""DPPF: LeRobot's Diffusion Policy, guided at inference by a potential field (the paper's baseline in Section V)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from torch import Tensor

from lerobot_pf2mp.flow_matching import Guide
from lerobot_pf2mp.hub.model_card import WithModelCard
from lerobot_pf2mp.policies.dppf.configuration_dppf import DPPFConfig
from lerobot_pf2mp.policies.guided.modeling_guided import GuidedPolicy
from lerobot_pf2mp.policies.without_peft import WithoutPEFT


class DPPFPolicy(GuidedPolicy, WithoutPEFT, WithModelCard, DiffusionPolicy):
    """Differs from `DiffusionPolicy` by a guide in the denoising loop, and by showing the field what it learns from."""

    config_class = DPPFConfig
    name = "dppf"
    config: DPPFConfig

    @torch.no_grad()
    def predict_action_chunk(
        self, batch: dict[str, Any], noise: Tensor | None = None, guide: Guide | None = None
    ) -> Tensor:
        """The next `n_action_steps` actions, ``(B, n_action_steps, action_dim)`` [normalised].

        Args:
            batch: Normalised observations, as for `DiffusionPolicy.predict_action_chunk`, with the potential field. Without
                past `select_action` calls, a single frame stands for the whole window.
            noise: ``(B, horizon, action_dim)`` the sample to denoise; drawn from N(0, I) if None.
            guide: Bends every denoising step, in place of the configured guidance; None for that.
        """
        with self._guided(guide or self.make_guide(batch)):
            chunk = super().predict_action_chunk(self._with_window(batch), noise=noise)
        return self.check_chunk(batch, chunk)

    def _with_window(self, batch: dict[str, Any]) -> dict[str, Any]:
        if any(self._queues.values()):
            return batch  # the window is in the queues
        window = dict(batch)
        n_dims = {OBS_STATE: 3, OBS_ENV_STATE: 3, **dict.fromkeys(self.config.image_features, 5)}
        for key, wanted in n_dims.items():
            if isinstance(batch.get(key), Tensor) and batch[key].ndim == wanted - 1:
                frame = batch[key].unsqueeze(1)
                window[key] = frame.expand(-1, self.config.n_obs_steps, *frame.shape[2:])
        return window

    @contextmanager
    def _guided(self, guide: Guide | None) -> Iterator[None]:
        scheduler = self.diffusion.noise_scheduler
        if guide is not None:
            self.diffusion.noise_scheduler = _GuidedScheduler(scheduler, guide)
        try:
            yield
        finally:
            self.diffusion.noise_scheduler = scheduler


class _GuidedScheduler:
    """A noise scheduler of diffusers, every step of which is bent by a guide.

    Each of the N denoising steps counts as dt = 1/N of the guidance, as the flow's do.
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
