# SPDX-License-Identifier: Apache-2.0
"""Draws the collisions that remain: each episode from above, and below it the place of contact."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from lerobot_pf2mp.envs.maze.point_maze import parse_maze_map
from lerobot_pf2mp.envs.tasks import MAZE_TASKS
from lerobot_pf2mp.figures.paths import mark_ends
from lerobot_pf2mp.figures.scene import Scene, draw_scene
from lerobot_pf2mp.figures.theme import COLLISION, GOAL, GUIDED, START, THEMES, WIDTH, Theme, themed_figure

if TYPE_CHECKING:
    from remaining_collisions import Episode

# Maps ``(..., D)`` positions [m] to ``(..., 2)`` places on axes.
ToAxes = Callable[[np.ndarray], np.ndarray]

BLOCK = "#8c6bb1"
N_DEMONSTRATIONS = 60  # from above; all of them in the close-ups
SAME_HEIGHT = 0.015  # what is farther above or below the part that touches is left out of a close-up [m]
MAZE_CLOSE_UP = 1.6  # side of a close-up of the maze [m]
N_GRID = 60

TITLES = {
    "reach": "(a) Reach: the plan cuts the edge",
    "push": "(b) Push: the block slips aside",
    "maze": "(c) Maze: two ways joined",
}


def plot_collisions(
    output: Path, *, episodes: dict[str, Episode], facts: dict[str, dict[str, float]], background: str
) -> None:
    """Draws the episodes to a PNG file.

    Args:
        output: The file.
        episodes: The episodes by name, a key of `TITLES` each.
        facts: Their numbers, as `remaining_collisions.measure` returns them.
        background: One of `THEMES`.
    """
    theme = THEMES[background]
    with themed_figure(output, theme, (WIDTH, 7.4), layout="constrained") as figure:
        axes = figure.subplots(2, len(episodes))
        for (above, close), (name, episode) in zip(axes.T, episodes.items(), strict=True):
            above.set_title(TITLES[name], fontsize=11)
            if name == "maze":
                _draw_maze(above, episode, theme)
                _draw_maze(close, episode, theme)
                corner, side = episode.contact - MAZE_CLOSE_UP / 2, MAZE_CLOSE_UP
                ends = np.stack([corner, corner + side], axis=1)
                close.set(xlabel="x [m]", ylabel="y [m]", xlim=ends[0], ylim=ends[1])
                close.set(xticks=[-1.5, -1, -0.5], yticks=[-1.5, -1, -0.5])
            else:
                _draw_fetch(above, episode, theme)
                corner, side = _draw_touch(close, episode, theme)
            frame = Rectangle(
                corner, side, side, facecolor="none", edgecolor=theme.text, linewidth=1, zorder=5
            )
            above.add_patch(frame)
            close.tick_params(labelsize=9)
            close.set_title(_caption(name, facts[name]), fontsize=9.5, loc="left", linespacing=1.25)
        _add_legend(figure, theme)


def _caption(name: str, facts: dict[str, float]) -> str:
    if name == "reach":
        return (
            f"hand {facts['depth']:.1f} mm in the wall (plan: {facts['depth_of_plan']:.1f});\n"
            f"arm {facts['off_plan']:.1f} mm off the plan; nearest\n"
            f"demonstration {facts['nearest_demonstration']:.0f} mm away"
        )
    if name == "push":
        return (
            f"block {facts['depth']:.1f} mm in the wall;\narm {facts['off_plan']:.1f} mm off the plan; nearest\n"
            f"demonstrated block {facts['nearest_demonstration']:.0f} mm away"
        )
    return (
        f"one step of {facts['longest_step'] / 1000:.2f} m through the\nwall; none of {facts['n_plans']:.0f} plans is\n"
        "supported: flagged"
    )


def _draw_fetch(axis: Any, episode: Episode, theme: Theme) -> None:
    """The whole episode from above."""
    _draw_wall(axis, episode)
    _draw_ways(axis, episode.demonstrations[:N_DEMONSTRATIONS], theme)
    _draw_plan(axis, episode.plan, episode.path, theme)
    if len(episode.block_path):
        axis.plot(*episode.block_path[:, :2].T, color=BLOCK, linewidth=1.8, zorder=4)
    mark_ends(axis, episode.plan[0, :2], episode.goal[:2], size=10)
    _mark_contact(axis, episode.contact)
    axis.set(xlim=(1.04, 1.56), ylim=(0.49, 1.01), aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axis.tick_params(labelsize=9)


def _draw_touch(axis: Any, episode: Episode, theme: Theme) -> tuple[np.ndarray, float]:
    """The place of contact from above; returns the corner and the side of what is shown [m]."""
    touch = episode.touch
    assert touch is not None  # of an episode in Fetch
    wall = episode.env.wall
    is_block = touch.part == "block"
    ways = episode.block_demonstrations if is_block else episode.demonstrations
    corners = np.array([[x, y] for x in (wall.low[0], wall.high[0]) for y in (wall.low[1], wall.high[1])])
    edge = corners[np.linalg.norm(corners - touch.point[:2], axis=1).argmin()]
    is_block = touch.part == "block"
    ways = episode.block_demonstrations if is_block else episode.demonstrations
    shown = np.stack([touch.centre[:2], touch.point[:2], touch.gripper[:2]])
    centre, side = (shown.max(axis=0) + shown.min(axis=0)) / 2, 0.04 + np.ptp(shown, axis=0).max()
    sides = [np.linspace(c - side / 2, c + side / 2, N_GRID) for c in centre]
    x, y = np.meshgrid(*sides)
    positions = np.stack([x, y, np.full_like(x, touch.centre[2])], axis=-1).reshape(-1, 3)
    scaled = [1000 * (values - origin) for values, origin in zip(sides, edge, strict=True)]

    def in_mm(way: np.ndarray) -> np.ndarray:
        return 1000 * (way[..., :2] - edge)

    colour = BLOCK if is_block else GUIDED
    _draw_wall(axis, episode, in_mm)
    _draw_ways(axis, [_at_height(way, touch.centre[2]) for way in ways], theme, in_mm, alpha=0.9)
    clearances = touch.clearances(positions).reshape(x.shape)
    axis.contour(*scaled, clearances, levels=[0], colors=COLLISION, linestyles="dashed", linewidths=1.2)
    axis.fill(*in_mm(touch.outline(wall.high[2])).T, facecolor=colour, edgecolor="none", alpha=0.22)
    if is_block:
        axis.plot(*in_mm(episode.block_path).T, color=BLOCK, linewidth=2.2, zorder=4)
    _draw_plan(
        axis,
        _at_height(episode.plan, touch.gripper[2]),
        _at_height(episode.path, touch.gripper[2]),
        theme,
        in_mm,
    )
    style: dict[str, Any] = {"markersize": 7, "markeredgecolor": "white", "zorder": 6}
    axis.plot(*in_mm(touch.gripper), "o", color=GUIDED, **style)
    axis.plot(*in_mm(touch.centre), "o", color=colour, **style)
    _mark_contact(axis, in_mm(touch.point))
    axis.set(aspect="equal", xlabel="x from the wall's edge [mm]", ylabel="y [mm]")
    axis.set(xlim=(scaled[0][0], scaled[0][-1]), ylim=(scaled[1][0], scaled[1][-1]))
    return centre - side / 2, side


def _draw_maze(axis: Any, episode: Episode, theme: Theme) -> None:
    scene = Scene(lambda actions: actions, maze_map=parse_maze_map(MAZE_TASKS[episode.env.task]))
    draw_scene(axis, scene, theme)
    _draw_ways(axis, episode.demonstrations[:N_DEMONSTRATIONS], theme)
    for other in episode.other_plans:
        axis.plot(*other.T, color=theme.text, linewidth=0.8, linestyle=(0, (4, 2)), zorder=3)
    _draw_plan(axis, episode.plan, episode.path, theme)
    for step in np.flatnonzero(~episode.is_supported):
        axis.plot(*episode.plan[step : step + 2].T, color=COLLISION, linewidth=2.2, zorder=5)
    mark_ends(axis, episode.plan[0], episode.goal, size=10)
    _mark_contact(axis, episode.contact)


def _in_metres(way: np.ndarray) -> np.ndarray:
    return way[..., :2]


def _draw_wall(axis: Any, episode: Episode, to_axes: ToAxes = _in_metres) -> None:
    low, high = to_axes(episode.env.wall.low), to_axes(episode.env.wall.high)
    for face, edge in ((to_rgba(COLLISION, 0.25), "none"), ("none", COLLISION)):
        axis.add_patch(Rectangle(low, *(high - low), facecolor=face, edgecolor=edge, linewidth=1.2))


def _draw_ways(
    axis: Any, ways: Sequence[np.ndarray], theme: Theme, to_axes: ToAxes = _in_metres, alpha: float = 0.35
) -> None:
    lines = LineCollection(
        [to_axes(way) for way in ways], colors=theme.unguided, linewidths=0.6, alpha=alpha, zorder=1
    )
    axis.add_collection(lines, autolim=False)


def _draw_plan(
    axis: Any, plan: np.ndarray, path: np.ndarray, theme: Theme, to_axes: ToAxes = _in_metres
) -> None:
    """The plan, and on it where the robot went."""
    for way, colour, width in ((plan, theme.arrow, 4.0), (path, GUIDED, 1.6)):
        axis.plot(*to_axes(way).T, color=colour, linewidth=width, zorder=4, solid_capstyle="round")


def _at_height(way: np.ndarray, height: float) -> np.ndarray:
    """A way ``(T, 3)``, with NaN where it is not at a height [m], which leaves a gap in its line."""
    is_there = np.abs(way[:, 2:3] - height) < SAME_HEIGHT
    return np.where(is_there, way, np.nan)


def _mark_contact(axis: Any, place: np.ndarray) -> None:
    axis.plot(*place[:2], "x", color=COLLISION, markersize=10, markeredgewidth=2.6, zorder=8)


def _add_legend(figure: Any, theme: Theme) -> None:
    mark: dict[str, Any] = {"linestyle": "none", "markersize": 9}
    handles = [
        Line2D([], [], color=theme.unguided, linewidth=0.9, label="demonstrations"),
        Line2D([], [], color=theme.arrow, linewidth=4, label="plan"),
        Line2D([], [], color=GUIDED, linewidth=1.6, label="where the robot went"),
        Line2D([], [], color=BLOCK, linewidth=1.8, label="where the block went"),
        Line2D([], [], color=theme.text, linewidth=0.8, linestyle=(0, (4, 2)), label="the other plans"),
        Line2D([], [], color=COLLISION, linewidth=2.2, label="unsupported step"),
        Line2D([], [], color=COLLISION, linewidth=1.2, linestyle="dashed", label="touches if ● is inside"),
        Line2D([], [], color=COLLISION, marker="x", markeredgewidth=2.6, label="contact", **mark),
        Line2D([], [], color=START, marker="*", markeredgecolor="white", label="start", **mark),
        Line2D([], [], color=GOAL, marker="X", markeredgecolor="white", label="goal", **mark),
    ]
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=4,
        frameon=False,
        labelcolor=theme.text,
        fontsize=9.5,
    )
