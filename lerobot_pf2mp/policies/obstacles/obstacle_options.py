# SPDX-License-Identifier: Apache-2.0
"""The options of obstacles that the demonstrations did not know."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from lerobot_pf2mp.obstacle_field import Obstacles, obstacles_of

OBSTACLE_RULES = ("pass", "project", "ignore")

# A way is flagged if it comes nearer than the robot's radius and this share of the margin. Bulges keep the whole margin up
# to a few per cent, and what a pull or a straight piece takes of it is no reason for another plan.
_CHECKED_SHARE = 0.5


@dataclass
class ObstacleOptions:
    """The options of obstacles, in the units of the dataset's actions, which must be positions in two or three dimensions.

    Args:
        obstacles: Obstacles that stay where they are, see `obstacles_of`. Others, also moving ones, may come with each
            observation as ``observation.obstacles``, ``(B, K, F)`` rows of `Obstacles.rows`.
        obstacle_rule: What is done about obstacles: pass (the whole chunk passes them on one side, and the check of plans
            knows them), project (each finished action alone is moved out of them, as a filter behind the policy would) or
            ignore.
        obstacle_margin: Distance that is kept between robot and obstacles.
        robot_radius: Size of what moves around the position that an action names.
        obstacle_fps: Actions per second; needed for moving obstacles only.
    """

    obstacles: list[dict[str, Any]] | None = None
    obstacle_rule: str = "pass"
    obstacle_margin: float = 0.03
    robot_radius: float = 0.0
    obstacle_fps: float | None = None

    @property
    def given_obstacles(self) -> Obstacles | None:
        """Those of the options, for one robot; None without any."""
        return _parsed(json.dumps(self.obstacles)) if self.obstacles else None

    @property
    def clearance(self) -> float:
        """The distance that ways keep from the surfaces of obstacles."""
        return self.robot_radius + self.obstacle_margin

    @property
    def checked_clearance(self) -> float:
        """The distance below which a way is flagged."""
        return self.robot_radius + _CHECKED_SHARE * self.obstacle_margin

    def _validate_obstacles(self) -> None:
        if self.obstacle_rule not in OBSTACLE_RULES:
            raise ValueError(f"obstacle_rule must be one of {OBSTACLE_RULES}, got {self.obstacle_rule!r}")
        for name in ("obstacle_margin", "robot_radius"):
            value = getattr(self, name)
            if not (value >= 0 and math.isfinite(value)):
                raise ValueError(f"{name} must be finite and at least 0, got {value}")
        if self.obstacle_fps is not None and not (self.obstacle_fps > 0 and math.isfinite(self.obstacle_fps)):
            raise ValueError(f"obstacle_fps must be finite and positive, got {self.obstacle_fps}")
        if self.obstacles and obstacles_of(self.obstacles).moves():
            raise ValueError(
                "obstacles of the options must not have a velocity, as nothing says when they are there: give moving ones "
                "with each observation, as observation.obstacles"
            )


@lru_cache(maxsize=64)
def _parsed(text: str) -> Obstacles:
    return obstacles_of(json.loads(text))
