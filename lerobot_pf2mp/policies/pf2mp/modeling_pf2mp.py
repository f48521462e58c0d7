# SPDX-License-Identifier: Apache-2.0
"""PF2MP: the Flow Matching Policy, guided at inference by a potential field (Section IV-B of the paper)."""

from __future__ import annotations

from lerobot_pf2mp.policies.fmp.modeling_fmp import FMPPolicy
from lerobot_pf2mp.policies.guided.modeling_guided import GuidedPolicy
from lerobot_pf2mp.policies.pf2mp.configuration_pf2mp import PF2MPConfig


class PF2MPPolicy(GuidedPolicy, FMPPolicy):
    """Differs from `FMPPolicy` by a guide in the integration, and by showing the field what it learns from."""

    config_class = PF2MPConfig
    name = "pf2mp"
    config: PF2MPConfig
