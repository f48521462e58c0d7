# SPDX-License-Identifier: Apache-2.0
"""The Potential Field-Guided Flow Matching Policy."""

from lerobot_pf2mp.policies.pf2mp.configuration_pf2mp import PF2MPConfig

__all__ = ["PF2MPConfig"]
