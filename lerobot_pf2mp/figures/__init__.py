# SPDX-License-Identifier: Apache-2.0
"""Draws figures. This is the only package that uses matplotlib; `policy_figures.py` collects what is drawn.

Importing this package does not import matplotlib; drawing does.
"""

from lerobot_pf2mp.figures.animation import animate_flow
from lerobot_pf2mp.figures.field import plot_arrows, plot_density
from lerobot_pf2mp.figures.overview import plot_maze_overview
from lerobot_pf2mp.figures.paths import Path2D, PathPair
from lerobot_pf2mp.figures.rates import plot_lambda
from lerobot_pf2mp.figures.scene import Scene
from lerobot_pf2mp.figures.strokes import plot_strokes
from lerobot_pf2mp.figures.support import plot_dimensions, plot_support
from lerobot_pf2mp.figures.theme import ANCHOR, COLLISION, EULER, GOAL, GUIDED, START, THEMES, Theme
from lerobot_pf2mp.figures.trajectories import plot_trajectories

__all__ = [
    "ANCHOR",
    "COLLISION",
    "EULER",
    "GOAL",
    "GUIDED",
    "START",
    "THEMES",
    "Path2D",
    "PathPair",
    "Scene",
    "Theme",
    "animate_flow",
    "plot_arrows",
    "plot_density",
    "plot_dimensions",
    "plot_lambda",
    "plot_maze_overview",
    "plot_strokes",
    "plot_support",
    "plot_trajectories",
]
