# SPDX-License-Identifier: Apache-2.0
"""Any policy of LeRobot, guided and checked by a potential field."""

from lerobot_pf2mp.policies.guarded.configuration_guarded import GuardedConfig

__all__ = ["GuardedConfig"]
