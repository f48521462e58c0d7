# SPDX-License-Identifier: Apache-2.0
"""An animation of chunks that move from noise to trajectories."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor
from tqdm import tqdm

from lerobot_pf2mp.figures.field import draw_arrows, planar_field
from lerobot_pf2mp.figures.paths import mark_ends
from lerobot_pf2mp.figures.scene import Scene, draw_scene
from lerobot_pf2mp.figures.theme import THEMES, WIDTH, Theme, themed_figure
from lerobot_pf2mp.process.atomic_files import file_written_beside

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

_FPS = 15  # [frames per second]


def animate_flow(
    output: Path,
    *,
    scene: Scene,
    unguided: Tensor,
    guided: Tensor,
    starts: np.ndarray,
    goals: np.ndarray | None,
    background: str = "light",
) -> None:
    """Writes an animation of chunks that move from noise to trajectories, without and with guidance.

    The arrows of the potential field are in the background.

    Args:
        output: The GIF file to write.
        scene: The scene of the chunks; its field is drawn.
        unguided: ``(N + 1, B, T, 2)`` chunks after each step [normalised], starting with the noise.
        guided: ``(N + 1, B, T, 2)`` the same with guidance.
        starts: ``(B, 2)`` starts [m].
        goals: ``(B, 2)`` goals [m]; None if there are none.
        background: One of `THEMES`.
    """
    from matplotlib.animation import PillowWriter

    theme = THEMES[background]
    planar_field(scene)
    left, right, bottom, top = scene.extent
    size = WIDTH * 0.8, 0.4 * WIDTH * (top - bottom) / (right - left) + 0.7
    with themed_figure(None, theme, size) as figure:
        grid = figure.add_gridspec(1, 2, left=0.01, right=0.99, top=0.88, bottom=0.02, wspace=0.03)
        panels = []
        for column, (chunks, name) in enumerate(((unguided, "without guidance"), (guided, "with guidance"))):
            axis = figure.add_subplot(grid[column])
            _draw_background(axis, scene, starts, goals, theme)
            panels.append(_Panel.empty(axis, name, scene.to_metres(chunks).numpy()))
        writer = PillowWriter(fps=_FPS)
        with file_written_beside(output) as partial, writer.saving(figure, str(partial), dpi=80):
            for time in tqdm(_times(len(unguided) - 1), desc="Flow", unit="frame"):
                for panel in panels:
                    panel.show(time)
                writer.grab_frame()


@dataclass(frozen=True)
class _Panel:
    """One half of the animation.

    Args:
        axis: Axes of the panel.
        name: First words of its title.
        steps: ``(N + 1, B, T, 2)`` chunks after each step [m].
        lines: One for each of the B chunks.
    """

    axis: Axes
    name: str
    steps: np.ndarray
    lines: list[Line2D]

    @classmethod
    def empty(cls, axis: Axes, name: str, steps: np.ndarray) -> _Panel:
        """Makes the panel before the first frame."""
        lines = [
            axis.plot([], [], ".-", color=f"C{i}", markersize=5, markeredgewidth=0, zorder=5)[0]
            for i in range(steps.shape[1])
        ]
        return cls(axis, name, steps, lines)

    def show(self, time: float) -> None:
        """Shows the chunks after `time` steps. The number may be fractional: then they are interpolated."""
        n_steps = len(self.steps) - 1
        step = min(int(time), n_steps - 1)
        now = self.steps[step] + (time - step) * (self.steps[step + 1] - self.steps[step])
        for line, chunk in zip(self.lines, now, strict=True):
            line.set_data(chunk[:, 0], chunk[:, 1])
            # Lines between actions that are still noise would hide everything.
            line.set_linewidth(1.5 * (time / n_steps) ** 6)
        self.axis.set_title(f"{self.name}, t = {time / n_steps:.2f}", fontsize=11)


def _draw_background(
    axis: Axes, scene: Scene, starts: np.ndarray, goals: np.ndarray | None, theme: Theme
) -> None:
    draw_scene(axis, scene, theme)
    draw_arrows(axis, scene, theme, alpha=0.35)
    for i, start in enumerate(starts):
        mark_ends(axis, start, None if goals is None else goals[i], size=9)


def _times(n_steps: int) -> list[float]:
    """The time of each frame in the flow [steps]. The first and the last frame are repeated, to show noise and result."""
    n_between = max(1, round(30 / n_steps))
    return [0.0] * 6 + [*np.linspace(0, n_steps, n_steps * n_between + 1), *[n_steps] * 15]
