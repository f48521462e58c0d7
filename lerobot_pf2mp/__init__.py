# SPDX-License-Identifier: Apache-2.0
"""Potential-field-guided flow matching policies for LeRobot.

Importing this package registers the policies, their processor step and the environments with LeRobot and Gymnasium.
"""

from lerobot_pf2mp.envs import PF2MPFetchEnv, PF2MPHandwritingEnv, PF2MPMazeEnv
from lerobot_pf2mp.loading import load_policy
from lerobot_pf2mp.policies.dppf.configuration_dppf import DPPFConfig
from lerobot_pf2mp.policies.fmp.configuration_fmp import FMPConfig
from lerobot_pf2mp.policies.guided.potential_field_step import PotentialFieldProcessorStep
from lerobot_pf2mp.policies.pf2mp.configuration_pf2mp import PF2MPConfig

__version__ = "0.1.0"

__all__ = [
    "DPPFConfig",
    "FMPConfig",
    "PF2MPConfig",
    "PF2MPFetchEnv",
    "PF2MPHandwritingEnv",
    "PF2MPMazeEnv",
    "PotentialFieldProcessorStep",
    "load_policy",
]
