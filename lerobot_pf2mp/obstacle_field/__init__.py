# SPDX-License-Identifier: Apache-2.0
"""Obstacles that the demonstrations did not know, and ways that pass them. PyTorch alone.

obstacles    balls, capsules and boxes as one tensor: distance and gradient, also of a moving robot to a moving obstacle
bulges       the sideways bulge of a way that clears one obstacle
passing      ways past several obstacles, in turns with a density
"""

from lerobot_pf2mp.obstacle_field.obstacles import Obstacles, n_features
from lerobot_pf2mp.obstacle_field.passing import Passing
from lerobot_pf2mp.obstacle_field.shapes import obstacles_of

__all__ = ["Obstacles", "Passing", "n_features", "obstacles_of"]
