# SPDX-License-Identifier: Apache-2.0
"""The obstacles that a policy knows of at a call."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from lerobot_pf2mp.obstacle_field import Obstacles
from lerobot_pf2mp.policies.obstacles.obstacle_options import ObstacleOptions

# ``(B, K, F)`` rows of `Obstacles.rows`. LeRobot's processors pass on what is named observation.*.
OBS_OBSTACLES = "observation.obstacles"


def known_obstacles(options: ObstacleOptions, batch: dict[str, Any], dim: int) -> Obstacles | None:
    """The obstacles of the options and of the observation, on the CPU or the observation's device.

    Args:
        options: The policy's configuration.
        batch: The observations. ``observation.obstacles`` is ``(B, K, F)``, or ``(K, F)`` for one robot.
        dim: Number of position dimensions of an action.

    Returns:
        K obstacles for each robot, or for one robot if they are the same for all; None without any, or if they are ignored.

    Raises:
        ValueError: If an obstacle is wrong, has other dimensions, or moves although obstacle_fps is not given.
    """
    if options.obstacle_rule == "ignore":
        return None
    given, seen = options.given_obstacles, batch.get(OBS_OBSTACLES)
    if isinstance(seen, Tensor):
        rows = (seen.unsqueeze(0) if seen.ndim == 2 else seen).float()
        seen_obstacles = Obstacles.from_rows(rows) if bool((rows[..., 0] > 0).any()) else None
    else:
        seen_obstacles = None
    for obstacles in (given, seen_obstacles):
        if obstacles is not None and obstacles.dim != dim:
            raise ValueError(
                f"obstacles must have as many dimensions as the positions that the field covers, {dim}, got "
                f"{obstacles.dim}: with field_action_dims, an action's other dimensions are left out"
            )
    if seen_obstacles is None:
        return given
    if options.obstacle_fps is None and seen_obstacles.moves():
        raise ValueError(
            "moving obstacles need obstacle_fps, the number of actions per second, got observed velocities and null"
        )
    if given is None:
        return seen_obstacles
    same = torch.zeros(len(seen_obstacles), dtype=torch.int64)
    return Obstacles.from_rows(given[same].rows.to(seen_obstacles.centre)).beside([seen_obstacles])
