# SPDX-License-Identifier: Apache-2.0
"""What all policies of this package have in common."""

from lerobot_pf2mp.policies.checked_loading import CheckedLoading
from lerobot_pf2mp.policies.model_card import WithModelCard
from lerobot_pf2mp.policies.without_peft import WithoutPEFT


class OwnPolicy(CheckedLoading, WithoutPEFT, WithModelCard):
    """A mixin for policies of this package. It must come before LeRobot's policy class."""
