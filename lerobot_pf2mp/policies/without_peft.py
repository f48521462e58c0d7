# SPDX-License-Identifier: Apache-2.0
"""Policies whose networks are trained whole."""

from __future__ import annotations

from typing import Any, NoReturn


class WithoutPEFT:
    """A policy that refuses the adapters of ``lerobot-train --peft.*``; to be mixed in before its own class.

    Adapters are for networks that are too large to be trained whole. A moving average of the weights, as in `fmp`, would
    average an adapter's two factors rather than their product.
    """

    name: str

    def wrap_with_peft(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Refuses, whatever the adapters.

        Raises:
            ValueError: Always.
        """
        raise ValueError(
            f"{self.name} must be trained whole, got --peft options: its network is small and has no adapters. "
            "Leave them out"
        )
