# SPDX-License-Identifier: Apache-2.0
"""DPPF: LeRobot's Diffusion Policy, guided at inference by a potential field (the paper's baseline in Section V)."""

from typing import Any

import torch
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.utils.constants import OBS_ENV_STATE, OBS_IMAGES, OBS_STATE
from torch import Tensor

from lerobot_pf2mp.flow_matching import Guide
from lerobot_pf2mp.policies.checked_loading import require_own_config
from lerobot_pf2mp.policies.dppf.configuration_dppf import DPPFConfig
from lerobot_pf2mp.policies.guided.field_guidance import FieldGuidance
from lerobot_pf2mp.policies.guided.guided_scheduler import guided_scheduler
from lerobot_pf2mp.policies.guided.integrated_actions import guide_for_rows
from lerobot_pf2mp.policies.image_sizes import check_image_sizes
from lerobot_pf2mp.policies.own_policy import OwnPolicy
from lerobot_pf2mp.policies.plans.plans import Plans


class DPPFPolicy(OwnPolicy, DiffusionPolicy):
    """`DiffusionPolicy` with a potential field. It adds to it what `PF2MPPolicy` adds to `FMPPolicy`.

    Training also adds its actions to the field, the guide changes every denoising step, and each chunk is checked, and
    drawn again if it leaves the demonstrated region. The weights are those of `DiffusionPolicy`, and with
    ``guidance_scale=0`` and ``max_plans=1`` so are the actions.

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
        require_own_config(self, config)
        # Before DiffusionPolicy.__init__, which calls `reset`.
        self.guidance = FieldGuidance(config, dataset_stats, dataset_meta)
        super().__init__(config, **kwargs)

    def forward(self, batch: dict[str, Any], *args: Any, **kwargs: Any) -> tuple[Tensor, None]:
        """The loss of `DiffusionPolicy`. In training it also adds the batch's actions to the potential field."""
        if self.training and torch.is_grad_enabled():
            self.guidance.observe(batch)
        check_image_sizes(self.config, batch)
        return super().forward(batch, *args, **kwargs)

    @torch.no_grad()
    def predict_action_chunk(
        self, batch: dict[str, Any], noise: Tensor | None = None, guide: Guide | None = None
    ) -> Tensor:
        """The chunk of `DiffusionPolicy` with a guide in every denoising step, chosen among up to ``max_plans``.

        Args:
            batch: Normalised observations, as for `DiffusionPolicy.predict_action_chunk`, with the potential field. Without
                past `select_action` calls, a single frame is repeated for the whole window.
            noise: ``(B, horizon, action_dim)`` the first plan's sample to denoise; drawn from N(0, I) if None.
            guide: The guide to use instead of the configured one; None for the configured one.

        Raises:
            ValueError: If there is guidance, or a check that was asked for, and the batch holds no field, one over other
                dimensions, or one without demonstrated plans; or if an action is not finite.
            UnsupportedPlanError: With ``on_unsupported=stop``, if no plan stays in the demonstrated region.
        """
        check_image_sizes(self.config, batch)
        self.guidance.begin()
        guide = guide or self.guidance.guide(batch, next(self.parameters()).device)
        window = self._with_window(batch)
        with guided_scheduler(self.diffusion, guide):
            chunk = super().predict_action_chunk(window, noise=noise)

        def draw_more(rows: Tensor, n: int) -> Tensor:
            observations = self._observations_of(window, rows, n)
            with guided_scheduler(self.diffusion, guide_for_rows(guide, rows, n)):
                return self.diffusion.generate_actions(observations)

        return self.guidance.choose(batch, chunk, draw_more)

    def select_action(self, batch: dict[str, Any], *args: Any, **kwargs: Any) -> Tensor:
        """The action of `DiffusionPolicy`, which the next plan's way begins with."""
        action = super().select_action(batch, *args, **kwargs)
        self.guidance.executed(action)
        return action

    def reset(self) -> None:
        """Forgets past observations and planned actions. Must be called at the start of an episode."""
        super().reset()
        self.guidance.reset()

    @property
    def plans(self) -> Plans | None:
        """What is known of the last plans; None if they were not checked."""
        return self.guidance.plans

    @property
    def support(self) -> Tensor | None:
        """``(B, T)`` how far the last chunk's way is inside the demonstrated region, see `FieldGuidance.support`."""
        return self.guidance.support

    def _observations_of(self, window: dict[str, Any], rows: Tensor, n: int) -> dict[str, Tensor]:
        """The observations that the network sees of some robots ``(F,)``, each n times, from queues or window."""
        seen = {**window, **{key: torch.stack(list(q), dim=1) for key, q in self._queues.items() if q}}
        if self.config.image_features and OBS_IMAGES not in seen:
            seen[OBS_IMAGES] = torch.stack([seen[key] for key in self.config.image_features], dim=-4)
        keys = [key for key in (OBS_STATE, OBS_ENV_STATE, OBS_IMAGES) if key in seen]
        return {key: seen[key][rows].repeat_interleave(n, dim=0) for key in keys}

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
