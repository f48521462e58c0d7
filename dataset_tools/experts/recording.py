# SPDX-License-Identifier: Apache-2.0
"""The observations of one episode of Fetch, whichever expert moves it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass
class Recording:
    """The observations of one episode.

    Args:
        goal: ``(3,)`` the goal [m].
        grips: ``(3,)`` positions of the gripper, the first before the first step, then one after each step [m].
        blocks: The same for the block; empty without a block.
        is_success: Whether the goal was reached at the end.
        is_collision: Whether the robot or the block touched the wall.
        images: ``(H, W, 3)`` uint8, one for each position; empty if the environment does not render.
    """

    goal: np.ndarray
    grips: list[np.ndarray] = field(default_factory=list)
    blocks: list[np.ndarray] = field(default_factory=list)
    is_success: bool = False
    is_collision: bool = False
    images: list[np.ndarray] = field(default_factory=list)

    def note(
        self, observation: dict[str, np.ndarray], info: dict[str, Any], image: np.ndarray | None = None
    ) -> None:
        """Adds an observation, with its information and its image."""
        if image is not None:
            self.images.append(image)
        self.grips.append(observation["agent_pos"].astype(float))
        if len(observation["environment_state"]) == 6:
            self.blocks.append(observation["environment_state"][:3].astype(float))
        self.is_success, self.is_collision = info["is_success"], info["is_collision"]
