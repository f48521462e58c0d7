# SPDX-License-Identifier: Apache-2.0
"""Keys of a batch for which LeRobot has no constant."""

from lerobot.utils.constants import ACTION

# ``(B, T)`` true where a chunk extends beyond the end of its episode.
ACTION_IS_PAD = f"{ACTION}_is_pad"

# The `DemonstratedActions` of the policy, from its preprocessor.
POTENTIAL_FIELD = "potential_field"
