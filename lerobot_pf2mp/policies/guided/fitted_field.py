# SPDX-License-Identifier: Apache-2.0
"""The potential field that guides a policy, as it is in a batch."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from lerobot_pf2mp.policies.batch_keys import POTENTIAL_FIELD
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.potential_field import PotentialField

if TYPE_CHECKING:
    from lerobot_pf2mp.policies.dppf.configuration_dppf import DPPFConfig
    from lerobot_pf2mp.policies.guarded.configuration_guarded import GuardedConfig
    from lerobot_pf2mp.policies.pf2mp.configuration_pf2mp import PF2MPConfig

    type GuidedPolicyConfig = PF2MPConfig | DPPFConfig | GuardedConfig


def fitted_field(
    demonstrations: object, config: GuidedPolicyConfig, device: torch.device | str = "cpu"
) -> PotentialField:
    """The potential field that guides a policy.

    Args:
        demonstrations: The object that the policy's preprocessor puts into a batch under `POTENTIAL_FIELD`.
        config: The policy's configuration.
        device: The device on which the field is used.

    Raises:
        ValueError: If there is no field, it is not fitted, or it covers other dimensions than the policy's.
    """
    if not isinstance(demonstrations, DemonstratedActions):
        raise ValueError(
            f"guidance needs the potential field, which the policy's own preprocessor puts under {POTENTIAL_FIELD!r}; "
            "got a batch without it. Load the preprocessor from the checkpoint, or set guidance_scale=0, max_plans=1 and "
            "on_unsupported=ignore"
        )
    field = demonstrations.field(config.field_settings, device)
    dims = config.field_action_dims
    n_dims = config.action_feature.shape[0] if dims is None else len(dims)
    if field.dim != n_dims:
        raise ValueError(
            f"the potential field must cover {n_dims} action dimensions, got a field over {field.dim}: it belongs to "
            "another policy"
        )
    return field
