# SPDX-License-Identifier: Apache-2.0
"""What LeRobot imports when it finds the distribution ``lerobot_policy_pf2mp``; and the registration."""

import lerobot_pf2mp  # noqa: F401
