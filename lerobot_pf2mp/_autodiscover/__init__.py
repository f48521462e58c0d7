# SPDX-License-Identifier: Apache-2.0
"""The module ``lerobot_policy_pf2mp``, which LeRobot imports when it finds the distribution of that name."""

# Importing any part of lerobot_pf2mp registers it.
from lerobot_pf2mp._autodiscover import registration  # noqa: F401
