# SPDX-License-Identifier: Apache-2.0
"""Colours, and figures in these colours."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_pf2mp.process.atomic_files import file_written_beside

if TYPE_CHECKING:
    from matplotlib.figure import Figure

START = "#3b82d0"
GOAL = "#ff7f0e"
GUIDED = "#2e9e62"
EULER = "#d1495b"
COLLISION = "#d62020"
ANCHOR = "#d62728"
REGION = "#e2746c"

WIDTH = 9.0  # [inches]; 900 pixels, the width of a README
_DPI = 100


@dataclass(frozen=True)
class Theme:
    """Colours that depend on the background.

    Args:
        background: Colour of the figure's background.
        text: Colour of text, ticks and frames.
        grid: Colour of grid lines.
        floor: Colour of free space.
        wall: Colour of obstacles.
        unguided: Colour of trajectories and results without guidance.
        arrow: Colour of the arrows of the potential field.
    """

    background: str
    text: str
    grid: str
    floor: str
    wall: str
    unguided: str
    arrow: str


THEMES = {
    "light": Theme("#ffffff", "#1f2328", "#d9dee3", "#faf7f2", "#a67b5b", "#7f7f7f", "#1f77b4"),
    "dark": Theme("#0d1117", "#e6edf3", "#30363d", "#161b22", "#7a5a43", "#a8a8a8", "#6cb6ff"),
}


@contextmanager
def themed_figure(
    output: Path | None, theme: Theme, size: tuple[float, float], layout: Any = None
) -> Iterator[Figure]:
    """A figure in the theme's colours. Its file appears whole or not at all.

    Args:
        output: The PNG file to write; None writes nothing.
        theme: The colours.
        size: Width and height [inches].
        layout: Matplotlib's layout engine; None for no automatic layout.

    Yields:
        The figure, which is closed at the end.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    colours: Any = {
        "figure.facecolor": theme.background,
        "axes.facecolor": theme.floor,
        "axes.edgecolor": theme.text,
        "axes.labelcolor": theme.text,
        "axes.titlecolor": theme.text,
        "text.color": theme.text,
        "xtick.color": theme.text,
        "ytick.color": theme.text,
        "font.size": 11,
    }
    with plt.rc_context(colours):
        figure = plt.figure(figsize=size, layout=layout, dpi=_DPI)
        try:
            yield figure
            if output is not None:
                with file_written_beside(output) as partial:
                    figure.savefig(partial, dpi=_DPI)
        finally:
            plt.close(figure)
