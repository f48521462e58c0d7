# SPDX-License-Identifier: Apache-2.0
"""LeRobot's Diffusion Policy with potential field guidance."""

from lerobot_pf2mp.policies.dppf.configuration_dppf import DPPFConfig

__all__ = ["DPPFConfig"]
