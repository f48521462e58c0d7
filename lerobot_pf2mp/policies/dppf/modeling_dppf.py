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
from lerobot_pf2mp.policies.dppf.configuration_dppf import DPPFConfig
from lerobot_pf2mp.policies.guided.field_guidance import FieldGuidance
from lerobot_pf2mp.policies.model_card import WithModelCard
from lerobot_pf2mp.policies.without_peft import WithoutPEFT


class DPPFPolicy(WithoutPEFT, WithModelCard, DiffusionPolicy):
    """`DiffusionPolicy` with a potential field. It adds to it what `PF2MPPolicy` adds to `FMPPolicy`.

    Training also adds its actions to the field, the guide changes every denoising step, and each chunk is checked. The
    weights are those of `DiffusionPolicy`, and with ``guidance_scale=0`` so are the actions.

    Args:
        config: The policy's configuration.
        dataset_stats: Statistics of the training dataset; None at evaluation.
        dataset_meta: Its metadata, by which the field finds the episodes that are trained on.
    """

    config_class = DPPFConfig
    name = "dppf"
    config: DPPFConfig

    def __init__(
        self,
        config: DPPFConfig,
        dataset_stats: dict[str, dict[str, Any]] | None = None,
        dataset_meta: Any = None,
        **kwargs: Any,
    ) -> None:
        # Before DiffusionPolicy.__init__, which calls `reset`.
        self.guidance = FieldGuidance(config, dataset_stats, dataset_meta)
        super().__init__(config, **kwargs)

    def forward(self, batch: dict[str, Any], *args: Any, **kwargs: Any) -> tuple[Tensor, None]:
        """The loss of `DiffusionPolicy`. In training it also adds the batch's actions to the potential field."""
        if self.training and torch.is_grad_enabled():
            self.guidance.observe(batch)
        return super().forward(batch, *args, **kwargs)

    @torch.no_grad()
    def predict_action_chunk(
        self, batch: dict[str, Any], noise: Tensor | None = None, guide: Guide | None = None
    ) -> Tensor:
        """The chunk of `DiffusionPolicy` with a guide in every denoising step. The chunk is then checked.

        Args:
            batch: Normalised observations, as for `DiffusionPolicy.predict_action_chunk`, with the potential field. Without
                past `select_action` calls, a single frame is repeated for the whole window.
            noise: ``(B, horizon, action_dim)`` the sample to denoise; drawn from N(0, I) if None.
            guide: The guide to use instead of the configured one; None for the configured one.

        Raises:
            ValueError: If there is guidance, or a check, and the batch holds no field or one over other dimensions.
        """
        guide = guide or self.guidance.guide(batch, next(self.parameters()).device)
        with self._guided(guide):
            chunk = super().predict_action_chunk(self._with_window(batch), noise=noise)
        return self.guidance.check(batch, chunk)

    def reset(self) -> None:
        """Forgets past observations and planned actions. Must be called at the start of an episode."""
        super().reset()
        self.guidance.reset()

    @property
    def support(self) -> Tensor | None:
        """``(B, T)`` how far the last chunk's actions are inside the demonstrated region, see `FieldGuidance.support`."""
        return self.guidance.support

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
