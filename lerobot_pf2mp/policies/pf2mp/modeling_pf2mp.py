# SPDX-License-Identifier: Apache-2.0
"""PF2MP: the Flow Matching Policy, guided at inference by a potential field (Section IV-B of the paper)."""

from typing import Any

import torch
from torch import Tensor

from lerobot_pf2mp.flow_matching import Guide
from lerobot_pf2mp.policies.checked_loading import require_own_config
from lerobot_pf2mp.policies.fmp.modeling_fmp import FMPPolicy
from lerobot_pf2mp.policies.guided.field_guidance import FieldGuidance
from lerobot_pf2mp.policies.pf2mp.configuration_pf2mp import PF2MPConfig
from lerobot_pf2mp.policies.plans.plans import Plans


class PF2MPPolicy(FMPPolicy):
    """`FMPPolicy` with a potential field.

    Training also adds its actions to the field, the guide changes every integration step, and each chunk is checked, and
    drawn again if it leaves the demonstrated region. The weights are those of `FMPPolicy`, and with ``guidance_scale=0`` and
    ``max_plans=1`` so are the actions. The calls for an observation are

        select_action -> predict_action_chunk (below: guide, choice)
            -> integrate (each step: velocity, guide) -> VelocityNetwork

    Args:
        config: The policy's configuration.
        dataset_stats: Statistics of the training dataset; None at evaluation.
        dataset_meta: Its metadata, by which the field finds the episodes that are trained on.
    """

    config_class = PF2MPConfig
    name = "pf2mp"
    config: PF2MPConfig

    def __init__(
        self,
        config: PF2MPConfig,
        dataset_stats: dict[str, dict[str, Any]] | None = None,
        dataset_meta: Any = None,
        **kwargs: Any,
    ) -> None:
        require_own_config(self, config)
        # Before FMPPolicy.__init__, which calls `reset`.
        self.guidance = FieldGuidance(config, dataset_stats, dataset_meta)
        super().__init__(config, dataset_stats, dataset_meta, **kwargs)

    def forward(self, batch: dict[str, Any], reduction: str = "mean") -> tuple[Tensor, None]:
        """The loss of `FMPPolicy`. In training it also adds the batch's actions to the potential field."""
        if self.training and torch.is_grad_enabled():
            self.guidance.observe(batch)
        return super().forward(batch, reduction)

    @torch.no_grad()
    def predict_action_chunk(
        self,
        batch: dict[str, Any],
        noise: Tensor | None = None,
        generator: torch.Generator | None = None,
        guide: Guide | None = None,
        **options: Any,
    ) -> Tensor:
        """The chunk of `FMPPolicy` with a guide in every integration step, chosen among up to ``max_plans``.

        Args:
            batch: As for `FMPPolicy.predict_action_chunk`, with the potential field.
            noise: As there, for the first plan. Others are drawn from the same generator.
            generator: As there.
            guide: The guide to use instead of the configured one; None for the configured one.
            **options: Options of real-time chunking, as there. No plan is drawn again that would come too late.

        Raises:
            ValueError: If there is guidance, or a check that was asked for, and the batch holds no field, one over other
                dimensions, or one without demonstrated plans; or if an action is not finite.
            UnsupportedPlanError: With ``on_unsupported=stop``, if no plan stays in the demonstrated region.
        """
        if guide is None or not torch.compiler.is_compiling():  # with a guide, a compiled plan is one graph
            self.guidance.begin(options.get("prev_chunk_left_over"), options.get("inference_delay", 0))
        guide = guide or self.guidance.guide(batch, next(self.parameters()).device)
        draw = self._drawing(batch, guide, **options)
        return self.guidance.choose(
            batch,
            draw(noise, generator),
            lambda rows, n: draw(generator=generator, rows=rows, n_each=n),
        )

    def select_action(self, batch: dict[str, Any], *args: Any, **kwargs: Any) -> Tensor:
        """The action of `FMPPolicy`, which the next plan's way begins with."""
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
