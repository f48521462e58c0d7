# SPDX-License-Identifier: Apache-2.0
"""Potential-field-guided flow matching policies for LeRobot.

Importing this package registers the policies, their processor step and the environments with LeRobot and Gymnasium, as
soon as these are imported. It imports neither of them, nor torch. The names in `__all__` are imported at their first use.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from lerobot_pf2mp._autodiscover.registration import register

if TYPE_CHECKING:
    from lerobot_pf2mp.envs.configs.fetch import PF2MPFetchEnv
    from lerobot_pf2mp.envs.configs.handwriting import PF2MPHandwritingEnv
    from lerobot_pf2mp.envs.configs.maze import PF2MPMazeEnv
    from lerobot_pf2mp.loading import load_policy
    from lerobot_pf2mp.policies.dppf.configuration_dppf import DPPFConfig
    from lerobot_pf2mp.policies.fmp.configuration_fmp import FMPConfig
    from lerobot_pf2mp.policies.guarded.configuration_guarded import GuardedConfig
    from lerobot_pf2mp.policies.guided.potential_field_step import PotentialFieldProcessorStep
    from lerobot_pf2mp.policies.pf2mp.configuration_pf2mp import PF2MPConfig

__version__ = "0.1.0"

__all__ = [
    "DPPFConfig",
    "FMPConfig",
    "GuardedConfig",
    "PF2MPConfig",
    "PF2MPFetchEnv",
    "PF2MPHandwritingEnv",
    "PF2MPMazeEnv",
    "PotentialFieldProcessorStep",
    "load_policy",
]

_MODULES = {
    "DPPFConfig": "policies.dppf.configuration_dppf",
    "FMPConfig": "policies.fmp.configuration_fmp",
    "GuardedConfig": "policies.guarded.configuration_guarded",
    "PF2MPConfig": "policies.pf2mp.configuration_pf2mp",
    "PF2MPFetchEnv": "envs.configs.fetch",
    "PF2MPHandwritingEnv": "envs.configs.handwriting",
    "PF2MPMazeEnv": "envs.configs.maze",
    "PotentialFieldProcessorStep": "policies.guided.potential_field_step",
    "load_policy": "loading",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    # First, so that threads that need different names wait for one registration.
    import_module("lerobot")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register()
