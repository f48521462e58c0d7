# SPDX-License-Identifier: Apache-2.0
"""The potential field in the plane: the density of the demonstrations, and arrows along its gradient."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from lerobot_pf2mp.figures.scene import Scene, draw_scene
from lerobot_pf2mp.figures.theme import ANCHOR, THEMES, WIDTH, Theme, themed_figure
from lerobot_pf2mp.potential_field import PotentialField

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# The density is not drawn where it is this far below its peak [nats], in the tails of the kernels.
_DENSITY_RANGE = 12.0


def plot_density(output: Path, *, scene: Scene, background: str = "light") -> None:
    """Draws the log density of the demonstrated actions, and its anchors."""
    theme = THEMES[background]
    field = planar_field(scene)
    with themed_figure(output, theme, _panel_size(scene, 0.75), layout="constrained") as figure:
        axis = figure.add_subplot()
        draw_scene(axis, scene, theme, with_ticks=True)
        mesh = draw_density(axis, scene)
        bar = figure.colorbar(mesh, ax=axis, fraction=0.04, pad=0.02)
        bar.set_label("log density [nats]")
        axis.set_title(f"Density of {len(field.anchors)} demonstrated actions, h = {field.bandwidth:.3g}")


def plot_arrows(output: Path, *, scene: Scene, background: str = "light") -> None:
    """Draws the direction of the potential's gradient, which points towards the demonstrations."""
    theme = THEMES[background]
    planar_field(scene)
    with themed_figure(output, theme, _panel_size(scene, 0.75), layout="constrained") as figure:
        axis = figure.add_subplot()
        draw_scene(axis, scene, theme, with_ticks=True)
        draw_arrows(axis, scene, theme, per_metre=4)
        axis.set_title("Direction in which guidance moves an action")


def planar_field(scene: Scene) -> PotentialField:
    """The scene's potential field.

    Raises:
        ValueError: If the scene has no field, or one that is not over two action dimensions.
    """
    if scene.field is None or scene.field.dim != 2:
        found = "none" if scene.field is None else f"one over {scene.field.dim}"
        raise ValueError(f"this figure needs a potential field over 2 action dimensions, got {found}")
    return scene.field


def draw_density(axis: Axes, scene: Scene) -> Any:
    """Draws the log density [nats] and the anchors. Returns matplotlib's mesh for a colour bar."""
    field = planar_field(scene)
    left, right, *_ = scene.extent
    x, y, actions, _ = _grid(scene, per_metre=240 / (right - left))
    log_density = field.log_density(actions).numpy()
    shown = np.ma.masked_less(log_density, log_density.max() - _DENSITY_RANGE)
    mesh = axis.pcolormesh(
        x, y, shown, cmap="viridis", shading="nearest", alpha=0.85, zorder=2, rasterized=True
    )
    anchors = scene.to_metres(field.anchors).numpy()
    axis.plot(*anchors.T, linestyle="none", marker=".", markersize=0.9, color=ANCHOR, zorder=3)
    return mesh


def draw_arrows(
    axis: Axes, scene: Scene, theme: Theme, per_metre: float | None = None, alpha: float = 1.0
) -> None:
    """Draws arrows of equal length in the direction of the potential's gradient.

    Args:
        axis: Axes to draw on.
        scene: A scene with a field over two action dimensions.
        theme: The colours.
        per_metre: Number of arrows per metre; by default 36 over the scene's width.
        alpha: Their opacity.
    """
    field = planar_field(scene)
    left, right, *_ = scene.extent
    per_metre = per_metre or 36 / (right - left)
    x, y, actions, metres_per_unit = _grid(scene, per_metre)
    log_density = field.log_density(actions).numpy()
    # Phi is a gradient in normalised units. As a step in metres it is multiplied by metres per unit.
    steps = field.potential_gradient(actions).numpy() * metres_per_unit
    directions = steps / np.linalg.norm(steps, axis=-1, keepdims=True).clip(min=1e-9)
    shown = log_density > log_density.max() - 4 * _DENSITY_RANGE
    grid_x, grid_y = np.meshgrid(x, y)
    axis.quiver(
        grid_x[shown],
        grid_y[shown],
        *directions[shown].T,
        color=theme.arrow,
        alpha=alpha,
        angles="xy",
        scale_units="xy",
        scale=1.2 * per_metre,
        width=0.0032,
        headwidth=3,
        headlength=3.5,
        headaxislength=3,
        pivot="middle",
        zorder=4,
    )


def _panel_size(scene: Scene, share: float) -> tuple[float, float]:
    left, right, bottom, top = scene.extent
    return share * WIDTH, share * WIDTH * 0.9 * (top - bottom) / (right - left) + 0.6


def _grid(scene: Scene, per_metre: float) -> tuple[np.ndarray, np.ndarray, Tensor, np.ndarray]:
    """A grid of positions over the scene: x and y [m], their normalised actions, and metres per normalised unit."""
    left, right, bottom, top = scene.extent
    x = left + (np.arange(round((right - left) * per_metre)) + 0.5) / per_metre
    y = bottom + (np.arange(round((top - bottom) * per_metre)) + 0.5) / per_metre
    zero = scene.to_metres(torch.zeros(1, 2)).double().numpy()[0]
    metres_per_unit = scene.to_metres(torch.ones(1, 2)).double().numpy()[0] - zero
    positions = np.stack(np.meshgrid(x, y), axis=-1)
    return x, y, torch.from_numpy((positions - zero) / metres_per_unit).float(), metres_per_unit
