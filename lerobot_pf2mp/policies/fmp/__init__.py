# SPDX-License-Identifier: Apache-2.0
"""The Flow Matching Policy."""

from lerobot_pf2mp.policies.fmp.configuration_fmp import FMPConfig

__all__ = ["FMPConfig"]
