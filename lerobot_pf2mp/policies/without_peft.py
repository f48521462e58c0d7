# SPDX-License-Identifier: Apache-2.0
"""Policies that are trained without adapters (PEFT)."""

from __future__ import annotations

from typing import Any, NoReturn


class WithoutPEFT:
    """A mixin that refuses the adapters of ``lerobot-train --peft.*``. It must come before LeRobot's policy class.

    Adapters are for networks that are too large to train all weights. A moving average of the weights, as in `fmp`, would
    average the two factors of an adapter and not their product.
    """

    name: str

    def wrap_with_peft(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Refuses all adapters.

        Raises:
            ValueError: Always.
        """
        raise ValueError(
            f"{self.name} must be trained whole, got --peft options: its network is small and has no adapters. "
            "Leave them out"
        )
