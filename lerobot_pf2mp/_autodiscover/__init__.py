# SPDX-License-Identifier: Apache-2.0
"""What LeRobot imports, as ``lerobot_policy_pf2mp``, when it finds the distribution of that name; and the registration."""

# Importing any part of lerobot_pf2mp registers it.
from lerobot_pf2mp._autodiscover import registration  # noqa: F401
