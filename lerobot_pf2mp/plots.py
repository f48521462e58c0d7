# SPDX-License-Identifier: Apache-2.0
"""Figures; the only user of matplotlib. What is drawn comes from `figures.py`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from lerobot_pf2mp.envs.box import Box
from lerobot_pf2mp.potential_field import PotentialField
from lerobot_pf2mp.results import NO_GUIDANCE, Cell
from lerobot_pf2mp.written_beside import file_written_beside

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

START = "#3b82d0"
GOAL = "#ff7f0e"
GUIDED = "#2e9e62"
EULER = "#d1495b"
COLLISION = "#d62020"
ANCHOR = "#d62728"

_DPI = 100
_WIDTH = 9.0  # [inches]; 900 pixels, the width of a README
# Nothing is drawn where the density is this far below its peak [nats]: there the field is all tail.
_DENSITY_RANGE = 12.0


@dataclass(frozen=True)
class Theme:
    """Colours that depend on the background.

    Args:
        background: Of the figure.
        text: Text, ticks and frames.
        grid: Grid lines.
        floor: Free space.
        wall: Obstacles.
        unguided: Paths and results without guidance.
        arrow: Arrows of the potential field.
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


@dataclass(frozen=True)
class Scene:
    """Where the actions of a policy live.

    Args:
        to_metres: Maps ``(..., D)`` normalised actions to positions [m], each axis linearly.
        field: The potential field [normalised]; None for a policy without one.
        maze_map: Rows of 0 (free) and 1 (wall), north first; None in an environment that is no maze.
        obstacles: Boxes that must not be touched [m].
    """

    to_metres: Callable[[Tensor], Tensor]
    field: PotentialField | None = None
    maze_map: list[list[int]] | None = None
    obstacles: Sequence[Box] = ()

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """What is drawn: left, right, bottom and top [m]."""
        if self.maze_map is not None:
            rows, columns = len(self.maze_map), len(self.maze_map[0])
            return -columns / 2, columns / 2, -rows / 2, rows / 2
        if self.field is None:
            raise ValueError("a scene must have a map or a field, got neither")
        anchors = self.to_metres(self.field.anchors).numpy()[:, :2]
        margin = 0.1 * np.ptp(anchors, axis=0)
        (left, bottom), (right, top) = anchors.min(axis=0) - margin, anchors.max(axis=0) + margin
        return float(left), float(right), float(bottom), float(top)


@dataclass(frozen=True)
class Path2D:
    """A way through a scene.

    Args:
        positions: ``(N + 1, D)`` positions [m]; D >= 2, of which three are drawn.
        collisions: ``(N,)`` true for the steps that collide.
    """

    positions: np.ndarray
    collisions: np.ndarray


@dataclass(frozen=True)
class PathPair:
    """The same episode, from the same noise, without and with guidance.

    Args:
        episode: Its number.
        unguided: The way without guidance.
        guided: The way with guidance.
        goal: ``(D,)`` the goal [m]; None if the environment has none.
        n_side_by_side: Episodes that ran side by side with it, on which their noise depends.
    """

    episode: int
    unguided: Path2D
    guided: Path2D
    goal: np.ndarray | None
    n_side_by_side: int = 1


def plot_maze_overview(output: Path, *, scene: Scene, pair: PathPair, background: str = "light") -> None:
    """Draws Figure 3 of the paper: maze, density map, potential field, and the same start and noise without and with it.

    Args:
        output: The PNG file to write.
        scene: A maze with a field.
        pair: An episode.
        background: One of `THEMES`.
    """
    theme = THEMES[background]
    field = _planar_field(scene)
    if scene.maze_map is None:
        raise ValueError("the overview needs a maze, got another environment")
    aspect = len(scene.maze_map) / len(scene.maze_map[0])
    # Three panels above, two below: at the width of a README five in a row would be too small to read.
    width = 12.0
    with _figure(output, theme, (width, width / 3 * 2 * aspect + 0.9)) as figure:
        grid = figure.add_gridspec(
            2, 6, hspace=0.17, wspace=0.12, left=0.01, right=0.99, top=0.94, bottom=0.02
        )
        axes = [
            figure.add_subplot(grid[row, column : column + 2]) for row, column in ((0, 0), (0, 2), (0, 4))
        ]
        axes += [figure.add_subplot(grid[1, column : column + 2]) for column in (1, 3)]
        for axis in axes:
            _draw_scene(axis, scene, theme)
        axes[0].set_title("(a) start and goal")
        _mark_ends(axes[0], pair.unguided.positions[0], pair.goal)
        axes[0].legend(
            loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=2, frameon=False, labelcolor=theme.text
        )
        axes[1].set_title(f"(b) density, {len(field.anchors)} demonstrated points")
        _draw_density(axes[1], scene)
        axes[2].set_title("(c) potential field")
        _draw_arrows(axes[2], scene, theme)
        for axis, path, colour, name in (
            (axes[3], pair.unguided, theme.unguided, "(d) FMP, no guidance"),
            (axes[4], pair.guided, GUIDED, "(e) PF2MP, same start and noise"),
        ):
            axis.set_title(f"{name}: {'collides' if path.collisions.any() else 'clear'}")
            _draw_path(axis, path, colour)
            _mark_ends(axis, path.positions[0], pair.goal)


def plot_density(output: Path, *, scene: Scene, background: str = "light") -> None:
    """Draws the log density of the demonstrated actions, and the anchors it is made of."""
    theme = THEMES[background]
    field = _planar_field(scene)
    with _figure(output, theme, _panel_size(scene, 0.75), layout="constrained") as figure:
        axis = figure.add_subplot()
        _draw_scene(axis, scene, theme, with_ticks=True)
        mesh = _draw_density(axis, scene)
        bar = figure.colorbar(mesh, ax=axis, fraction=0.04, pad=0.02)
        bar.set_label("log density [nats]")
        axis.set_title(f"Density of {len(field.anchors)} demonstrated actions, h = {field.bandwidth:.3g}")


def plot_arrows(output: Path, *, scene: Scene, background: str = "light") -> None:
    """Draws the direction of the potential's gradient, which points to where demonstrations went."""
    theme = THEMES[background]
    _planar_field(scene)
    with _figure(output, theme, _panel_size(scene, 0.75), layout="constrained") as figure:
        axis = figure.add_subplot()
        _draw_scene(axis, scene, theme, with_ticks=True)
        _draw_arrows(axis, scene, theme, per_metre=4)
        axis.set_title("Direction in which guidance moves an action")


def plot_trajectories(
    output: Path, *, scene: Scene, pairs: Sequence[PathPair], background: str = "light"
) -> None:
    """Draws episodes without and with guidance, from the same start and the same noise.

    Args:
        output: The PNG file to write.
        scene: Where they took place.
        pairs: The episodes, one panel each; of positions with three coordinates all three are drawn.
        background: One of `THEMES`.
    """
    theme = THEMES[background]
    is_3d = pairs[0].unguided.positions.shape[1] >= 3
    columns = min(len(pairs), 3)
    rows = -(-len(pairs) // columns)
    left, right, bottom, top = (0.0, 1.0, 0.0, 1.0) if is_3d else scene.extent
    panel = _WIDTH / columns
    size = (_WIDTH, rows * (panel * (0.92 if is_3d else (top - bottom) / (right - left)) + 0.3) + 0.5)
    # Axes in space do not tell the constrained layout how far their labels reach.
    with _figure(output, theme, size, layout=None if is_3d else "constrained") as figure:
        axes = figure.subplots(rows, columns, squeeze=False, subplot_kw={"projection": "3d"} if is_3d else {})
        if is_3d:
            border = 0.55 / size[1]
            figure.subplots_adjust(0.0, border, 0.94, 1 - border, wspace=0.05, hspace=0.28)
        for axis in axes.flat[len(pairs) :]:
            axis.set_axis_off()
        for axis, pair in zip(axes.flat, pairs, strict=False):
            if is_3d:
                _draw_space(axis, scene, pair, theme)
            else:
                _draw_scene(axis, scene, theme)
            _draw_path(axis, pair.unguided, theme.unguided, label="without guidance")
            _draw_path(axis, pair.guided, GUIDED, label="with guidance")
            _mark_ends(axis, pair.unguided.positions[0], pair.goal)
            axis.set_title(f"episode {pair.episode}", fontsize=11)
        handles, labels = axes.flat[0].get_legend_handles_labels()
        cross = axes.flat[0].plot(
            [], [], linestyle="none", marker="x", color=COLLISION, markersize=8, markeredgewidth=2.2
        )
        figure.legend(
            [*handles, *cross],
            [*labels, "collision"],
            loc="lower center" if is_3d else "outside lower center",
            ncols=5,
            frameon=False,
            labelcolor=theme.text,
        )


def plot_lambda(output: Path, *, cells: Sequence[Cell], background: str = "light") -> None:
    """Draws collision and success rate against lambda, with 95 % Wilson intervals.

    Args:
        output: The PNG file to write.
        cells: Results of one task: guided policies at several lambda, and their unguided twins.
        background: One of `THEMES`.

    Raises:
        ValueError: If there is no guided result, or the results are of several tasks.
    """
    theme = THEMES[background]
    tasks = {cell.repeats[0].task for cell in cells}
    lines: dict[tuple[str, str], list[Cell]] = {}
    unguided: dict[str, Cell] = {}
    for cell in cells:
        row = cell.repeats[0]
        if row.guidance_integrator == NO_GUIDANCE:
            unguided[row.policy] = cell
        else:
            lines.setdefault((row.policy, row.guidance_integrator), []).append(cell)
    if not lines or len(tasks) > 1:
        raise ValueError(f"results must be of one task and hold guided policies, got tasks {sorted(tasks)}")
    with _figure(output, theme, (_WIDTH, 3.9), layout="constrained") as figure:
        axes = figure.subplots(1, 2)
        for axis, rate, title in (
            (axes[0], "collision", "collision rate [%]"),
            (axes[1], "success", "success rate [%]"),
        ):
            for number, (policy, cell) in enumerate(unguided.items()):
                _draw_level(axis, getattr(cell, rate), policy, theme.unguided, (":", "-.")[number % 2])
            for number, ((policy, integrator), line) in enumerate(sorted(lines.items())):
                colour = EULER if integrator == "euler" else GUIDED
                style = ("-", "--")[sorted({name for name, _ in lines}).index(policy) % 2]
                line = sorted(line, key=lambda cell: cell.repeats[0].guidance_scale)
                _draw_rates(axis, line, rate, f"{policy}, {integrator}", colour, style, "os^v"[number % 4])
            axis.set(xscale="log", xlabel=r"$\lambda$ (guidance_scale)", ylabel=title, ylim=(-2, 102))
            axis.grid(color=theme.grid, linewidth=0.6)
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside lower center", ncols=3, frameon=False, labelcolor=theme.text
        )
        (task,) = tasks
        first = cells[0]
        figure.suptitle(
            f"{task}: {first.n_episodes} episodes for each point, bands are 95 % intervals", fontsize=11
        )


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
    """Writes an animation of chunks moving from noise to paths, without and with guidance, over the field's arrows.

    Args:
        output: The GIF file to write.
        scene: Where the chunks live; its field is drawn.
        unguided: ``(N + 1, B, T, 2)`` chunks after each step [normalised], beginning with the noise.
        guided: ``(N + 1, B, T, 2)`` the same with guidance.
        starts: ``(B, 2)`` starts [m].
        goals: ``(B, 2)`` goals [m]; None if there are none.
        background: One of `THEMES`.
    """
    from matplotlib.animation import PillowWriter

    theme = THEMES[background]
    _planar_field(scene)
    left, right, bottom, top = scene.extent
    n_steps, n_chunks = len(unguided) - 1, unguided.shape[1]
    colours = [f"C{i}" for i in range(n_chunks)]
    with _figure(None, theme, (_WIDTH * 0.8, 0.4 * _WIDTH * (top - bottom) / (right - left) + 0.7)) as figure:
        grid = figure.add_gridspec(1, 2, left=0.01, right=0.99, top=0.88, bottom=0.02, wspace=0.03)
        panels = []
        for column, (chunks, name) in enumerate(((unguided, "without guidance"), (guided, "with guidance"))):
            axis = figure.add_subplot(grid[column])
            _draw_scene(axis, scene, theme)
            _draw_arrows(axis, scene, theme, alpha=0.35)
            for i in range(n_chunks):
                _mark_ends(axis, starts[i], None if goals is None else goals[i], size=9)
            dots = [
                axis.plot([], [], ".-", color=colour, markersize=5, markeredgewidth=0, zorder=5)[0]
                for colour in colours
            ]
            panels.append((axis, name, scene.to_metres(chunks).numpy(), dots))
        writer = PillowWriter(fps=15)
        n_between = max(1, round(30 / n_steps))
        times = [*np.linspace(0, n_steps, n_steps * n_between + 1), *[n_steps] * 15]
        times = [0.0] * 6 + times  # time to look at the noise and at the result
        with file_written_beside(output) as partial, writer.saving(figure, str(partial), dpi=80):
            for time in tqdm(times, desc="Flow", unit="frame"):
                for axis, name, steps, dots in panels:
                    step = min(int(time), n_steps - 1)
                    now = steps[step] + (time - step) * (steps[step + 1] - steps[step])
                    for dot, chunk in zip(dots, now, strict=True):
                        dot.set_data(chunk[:, 0], chunk[:, 1])
                        # Lines between actions that are still noise would hide everything.
                        dot.set_linewidth(1.5 * (time / n_steps) ** 6)
                    axis.set_title(f"{name}, t = {time / n_steps:.2f}", fontsize=11)
                writer.grab_frame()


@contextmanager
def _figure(
    output: Path | None, theme: Theme, size: tuple[float, float], layout: Any = None
) -> Iterator[Figure]:
    """A figure in the theme's colours, written to a file that appears whole or not at all."""
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


def _panel_size(scene: Scene, share: float) -> tuple[float, float]:
    left, right, bottom, top = scene.extent
    return share * _WIDTH, share * _WIDTH * 0.9 * (top - bottom) / (right - left) + 0.6


def _planar_field(scene: Scene) -> PotentialField:
    if scene.field is None or scene.field.dim != 2:
        found = "none" if scene.field is None else f"one over {scene.field.dim}"
        raise ValueError(f"this figure needs a potential field over 2 action dimensions, got {found}")
    return scene.field


def _draw_scene(axis: Axes, scene: Scene, theme: Theme, with_ticks: bool = False) -> None:
    from matplotlib.patches import Rectangle

    left, right, bottom, top = scene.extent
    for i, row in enumerate(scene.maze_map or []):
        for j, cell in enumerate(row):
            if cell:
                corner = (left + j, top - i - 1)
                axis.add_patch(
                    Rectangle(corner, 1, 1, facecolor=theme.wall, edgecolor=theme.wall, linewidth=0.4)
                )
    axis.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    if with_ticks:
        axis.set(xlabel="x [m]", ylabel="y [m]")
    else:
        axis.set(xticks=[], yticks=[])


def _draw_space(axis: Any, scene: Scene, pair: PathPair, theme: Theme) -> None:
    """Axes in space, equally scaled, and the obstacles."""
    from matplotlib.ticker import MaxNLocator
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    axis.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    axis.view_init(elev=22, azim=-35)
    corners = [pair.unguided.positions, pair.guided.positions]
    for box in scene.obstacles:
        corners += [box.low[None], box.high[None]]
        axis.add_collection3d(
            Poly3DCollection(_faces(box), facecolor=COLLISION, edgecolor=COLLISION, linewidth=0.8, alpha=0.25)
        )
    extent = np.ptp(np.concatenate([part[:, :3] for part in corners]), axis=0)
    axis.set_box_aspect(extent.clip(min=0.2 * extent.max()), zoom=0.88)
    for side in (axis.xaxis, axis.yaxis, axis.zaxis):
        side.set_pane_color(theme.floor)
        side._axinfo["grid"]["color"] = theme.grid
        side.set_major_locator(MaxNLocator(4))
    axis.tick_params(labelsize=8)


def _faces(box: Box) -> list[np.ndarray]:
    """The six sides of a box, each as ``(4, 3)`` corners."""
    faces = []
    for axis in range(3):
        for end in (box.low, box.high):
            face = np.tile(end, (4, 1))
            for corner, (first, second) in enumerate(((0, 0), (0, 1), (1, 1), (1, 0))):
                other = [i for i in range(3) if i != axis]
                face[corner, other[0]] = (box.low, box.high)[first][other[0]]
                face[corner, other[1]] = (box.low, box.high)[second][other[1]]
            faces.append(face)
    return faces


def _mark_ends(axis: Axes, start: np.ndarray, goal: np.ndarray | None, size: float = 11) -> None:
    style: dict[str, Any] = {"linestyle": "none", "markersize": size, "markeredgecolor": "white", "zorder": 6}
    axis.plot(*_coordinates(start), marker="*", color=START, label="start", **style)
    if goal is not None:
        axis.plot(*_coordinates(goal), marker="X", color=GOAL, label="goal", **style)


def _draw_path(axis: Axes, path: Path2D, colour: str, label: str | None = None) -> None:
    axis.plot(
        *_coordinates(path.positions),
        color=colour,
        linewidth=2.2,
        solid_capstyle="round",
        zorder=4,
        label=label,
    )
    hits = path.positions[1:][path.collisions]
    style: dict[str, Any] = {"linestyle": "none", "marker": "x", "markersize": 8, "markeredgewidth": 2.2}
    axis.plot(*_coordinates(hits), color=COLLISION, zorder=7, **style)


def _coordinates(positions: np.ndarray) -> list[np.ndarray]:
    """At most three coordinates of ``(..., D)`` positions, as matplotlib wants them."""
    positions = np.atleast_2d(positions)
    return [positions[:, i] for i in range(min(3, positions.shape[1]))]


def _grid(scene: Scene, per_metre: float) -> tuple[np.ndarray, np.ndarray, Tensor, np.ndarray]:
    """A grid of positions over the scene: x and y [m], their normalised actions, and metres for one normalised unit."""
    left, right, bottom, top = scene.extent
    x = left + (np.arange(round((right - left) * per_metre)) + 0.5) / per_metre
    y = bottom + (np.arange(round((top - bottom) * per_metre)) + 0.5) / per_metre
    zero = scene.to_metres(torch.zeros(1, 2)).double().numpy()[0]
    scale = scene.to_metres(torch.ones(1, 2)).double().numpy()[0] - zero
    positions = np.stack(np.meshgrid(x, y), axis=-1)
    return x, y, torch.from_numpy((positions - zero) / scale).float(), scale


def _draw_density(axis: Axes, scene: Scene) -> Any:
    field = _planar_field(scene)
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


def _draw_arrows(
    axis: Axes, scene: Scene, theme: Theme, per_metre: float | None = None, alpha: float = 1.0
) -> None:
    field = _planar_field(scene)
    left, right, *_ = scene.extent
    per_metre = per_metre or 36 / (right - left)
    x, y, actions, scale = _grid(scene, per_metre)
    log_density = field.log_density(actions).numpy()
    # Phi is a gradient in normalised units; as a step it points in the direction of Phi times metres for each unit.
    steps = field.potential_gradient(actions).numpy() * scale
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


def _draw_level(axis: Axes, rate: Any, policy: str, colour: str, style: str) -> None:
    if rate is None:
        return
    axis.axhspan(*(100 * end for end in rate.interval), color=colour, alpha=0.25, linewidth=0)
    axis.axhline(
        100 * rate.value, color=colour, linestyle=style, linewidth=1.6, label=f"{policy}, no guidance"
    )


def _draw_rates(
    axis: Axes, line: list[Cell], rate: str, label: str, colour: str, style: str, marker: str
) -> None:
    scales = [cell.repeats[0].guidance_scale for cell in line]
    rates = [getattr(cell, rate) for cell in line]
    low, high = zip(*(rate.interval for rate in rates), strict=True)
    axis.fill_between(
        scales, 100 * np.array(low), 100 * np.array(high), color=colour, alpha=0.25, linewidth=0
    )
    axis.plot(
        scales,
        [100 * rate.value for rate in rates],
        color=colour,
        linestyle=style,
        marker=marker,
        markersize=4.5,
        label=label,
    )
