# SPDX-License-Identifier: Apache-2.0
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib import image
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from PIL import Image
from result_rows import SUMMARY, UNGUIDED, cell
from torch import Tensor

from lerobot_pf2mp import figures
from lerobot_pf2mp.envs.box import Box
from lerobot_pf2mp.field_report.report import DimensionShare, EpisodeSupport, FieldReport
from lerobot_pf2mp.figures import THEMES, Path2D, PathPair, Scene
from lerobot_pf2mp.figures.space import faces
from lerobot_pf2mp.potential_field import PotentialField, fit
from lerobot_pf2mp.results.summary import Cell

SCALE, SHIFT = torch.tensor([2.0, 1.0]), torch.tensor([0.5, -0.5])  # of normalised actions to metres
MAZE_MAP = [[1, 1, 1, 1], [1, 0, 0, 1], [1, 1, 1, 1]]
CORNER = (5, 5)  # a pixel of the margin


def to_metres(actions: Tensor) -> Tensor:
    return actions * SCALE + SHIFT


def field_of(*anchors: tuple[float, ...], bandwidth: float = 0.1) -> PotentialField:
    return fit(torch.tensor(anchors), bandwidth=bandwidth)


def scene_of(*anchors: tuple[float, ...], maze_map: Any = None) -> Scene:
    return Scene(to_metres, field_of(*anchors), maze_map)


def path_of(*positions: tuple[float, ...], collides_at: tuple[int, ...] = ()) -> Path2D:
    steps = len(positions) - 1
    return Path2D(np.array(positions), np.isin(np.arange(steps), collides_at))


PAIR = PathPair(
    episode=7,
    unguided=path_of((0.0, 0.0), (0.5, 0.0), (0.5, 0.4), collides_at=(1,)),
    guided=path_of((0.0, 0.0), (0.5, 0.0), (0.5, 0.2)),
    goal=np.array([0.5, 0.3]),
)
PAIR_3D = PathPair(
    episode=1,
    unguided=path_of((0.0, 0.0, 0.0), (0.5, 0.0, 0.1), collides_at=(0,)),
    guided=path_of((0.0, 0.0, 0.0), (0.5, 0.0, 0.2)),
    goal=None,
)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Figure]]:
    """The figures that were written."""
    figures: list[Figure] = []
    savefig = Figure.savefig

    def recorded(self: Figure, *arguments: Any, **options: Any) -> None:
        figures.append(self)
        savefig(self, *arguments, **options)

    monkeypatch.setattr(Figure, "savefig", recorded)
    yield figures
    figures.clear()


def lines_of(axis: Any) -> dict[str, Any]:
    return {line.get_label(): line for line in axis.lines}


# Lambda


def lambda_cells(**common: Any) -> list[Cell]:
    return [
        cell({**UNGUIDED, "collisions": 20, "successes": 45, **common}),
        *(
            cell({"guidance_scale": scale, "collisions": count, "successes": 50 - count, **common})
            for scale, count in ((8.0, 2), (0.08, 5), (0.8, 1))  # not in order
        ),
        cell(
            {
                "guidance_integrator": "euler",
                "guidance_scale": 1e-4,
                "collisions": 30,
                "successes": 10,
                **common,
            }
        ),
    ]


def test_lambda_shows_every_integrator_and_the_unguided_level(tmp_path: Path, drawn: list[Figure]) -> None:
    figures.plot_lambda(tmp_path / "lambda.png", cells=lambda_cells())
    (figure,) = drawn
    collision, success = figure.axes
    assert (collision.get_ylabel(), success.get_ylabel()) == ("collision rate [%]", "success rate [%]")
    for axis in figure.axes:
        assert axis.get_xscale() == "log"
        assert axis.get_xlabel() == r"$\lambda$ (guidance_scale)"
    for axis, rates, level, euler in ((collision, [10, 2, 4], 40, 60), (success, [90, 98, 96], 90, 20)):
        lines = lines_of(axis)
        assert list(lines["pf2mp, proximal"].get_xdata()) == [0.08, 0.8, 8.0]
        assert lines["pf2mp, proximal"].get_ydata() == pytest.approx(rates)
        assert lines["pf2mp, euler"].get_ydata() == pytest.approx([euler])
        assert lines["fmp, no guidance"].get_ydata() == pytest.approx([level] * 2)
        assert lines["pf2mp, proximal"].get_color() != lines["pf2mp, euler"].get_color()
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        *("fmp, no guidance", "pf2mp, euler", "pf2mp, proximal")
    ]
    assert figure.get_suptitle().startswith(f"{SUMMARY.task}: 50 episodes for each point")


def test_lambda_shows_intervals(tmp_path: Path, drawn: list[Figure]) -> None:
    figures.plot_lambda(tmp_path / "lambda.png", cells=lambda_cells())
    bands = [band.get_datalim(drawn[0].axes[0].transData) for band in drawn[0].axes[0].collections]
    # Wilson's intervals of 1, 2 and 5 of 50: the lowest and the highest end.
    assert any(band.ymin == pytest.approx(0.354, abs=1e-3) and band.ymax == pytest.approx(21.36, abs=1e-2)
               for band in bands)  # fmt: skip


def test_policies_of_one_integrator_have_lines_of_their_own(tmp_path: Path, drawn: list[Figure]) -> None:
    others = [
        Cell(tuple(replace(row, policy="dppf" if row.guidance_scale else "dp") for row in one.repeats))
        for one in lambda_cells()
    ]
    figures.plot_lambda(tmp_path / "lambda.png", cells=[*lambda_cells(), *others])
    lines = lines_of(drawn[0].axes[0])
    names = ("pf2mp, proximal", "dppf, proximal", "fmp, no guidance", "dp, no guidance")
    styles = {(lines[name].get_color(), lines[name].get_linestyle()) for name in names}
    assert len(styles) == 4


@pytest.mark.parametrize(
    "cells", [lambda_cells()[:1], [*lambda_cells(), *lambda_cells(task="MazeMedium-v0")], []]
)
def test_lambda_needs_guided_results_of_one_task(tmp_path: Path, cells: list[Cell]) -> None:
    with pytest.raises(ValueError, match="results must be of one task and hold guided policies, got tasks"):
        figures.plot_lambda(tmp_path / "lambda.png", cells=cells)
    assert not list(tmp_path.iterdir())


# Fields


def test_density_is_drawn_where_the_demonstrations_are(tmp_path: Path, drawn: list[Figure]) -> None:
    scene = scene_of((0.0, 0.0), (0.0, 0.0), (0.5, 0.5))
    figures.plot_density(tmp_path / "density.png", scene=scene)
    axis, bar = drawn[0].axes
    (mesh,) = (child for child in axis.collections if child.get_array() is not None)
    shown = mesh.get_array()
    corners = mesh.get_coordinates()
    centres = (corners[:-1, :-1] + corners[1:, 1:]) / 2
    assert scene.field is not None
    expected = scene.field.log_density((torch.from_numpy(centres).float() - SHIFT) / SCALE).numpy()
    np.testing.assert_array_equal(shown.mask, expected < expected.max() - 12)
    assert 0 < shown.mask.sum() < shown.size
    np.testing.assert_allclose(shown.compressed(), expected[~shown.mask], atol=1e-2)
    peaks = np.argwhere(shown == shown.max())[0]
    np.testing.assert_allclose(centres[tuple(peaks)], SHIFT, atol=0.02)
    assert (axis.get_xlabel(), axis.get_ylabel(), bar.get_ylabel()) == (
        "x [m]",
        "y [m]",
        "log density [nats]",
    )
    assert axis.get_title() == "Density of 3 demonstrated actions, h = 0.1"


def test_arrows_point_to_the_demonstrations(tmp_path: Path, drawn: list[Figure]) -> None:
    figures.plot_arrows(tmp_path / "arrows.png", scene=scene_of((0.1, 0.2), (0.1, 0.2), maze_map=MAZE_MAP))
    (arrows,) = (child for child in drawn[0].axes[0].collections if isinstance(child, Quiver))
    # In normalised units they point at the anchor; a step of them scales by metres for each unit once more.
    offsets = (np.array([0.1, 0.2]) - (arrows.XY - SHIFT.numpy()) / SCALE.numpy()) * SCALE.numpy()
    directions = np.stack([arrows.U, arrows.V], axis=-1)
    assert len(directions) > 20
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1, rtol=1e-5)
    np.testing.assert_allclose(
        directions, offsets / np.linalg.norm(offsets, axis=-1, keepdims=True), atol=1e-3
    )


@pytest.mark.parametrize(
    ("scene", "found"),
    [
        (Scene(to_metres, None, MAZE_MAP), "got none"),
        (Scene(lambda actions: actions, field_of((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))), "got one over 3"),
    ],
)
def test_a_field_is_drawn_in_the_plane_only(tmp_path: Path, scene: Scene, found: str) -> None:
    for draw in (figures.plot_density, figures.plot_arrows):
        with pytest.raises(ValueError, match=f"needs a potential field over 2 action dimensions, {found}"):
            draw(tmp_path / "figure.png", scene=scene)
    assert not list(tmp_path.iterdir())


def test_the_extent_is_that_of_the_maze_or_else_of_the_demonstrations() -> None:
    anchors = (-1.0, -1.0), (1.0, 1.0)
    assert scene_of(*anchors, maze_map=MAZE_MAP).extent == (-2.0, 2.0, -1.5, 1.5)
    # x from -1.5 to 2.5 m, y from -1.5 to 0.5 m, and a tenth more on each side
    assert scene_of(*anchors).extent == pytest.approx((-1.9, 2.9, -1.7, 0.7))
    with pytest.raises(ValueError, match="a scene must have a map or a field, got neither"):
        _ = Scene(to_metres).extent


# Paths


def test_trajectories_show_both_trajectories_their_ends_and_collisions(
    tmp_path: Path, drawn: list[Figure]
) -> None:
    pairs = [replace(PAIR, episode=i) for i in range(4)]
    figures.plot_trajectories(
        tmp_path / "trajectories.png", scene=scene_of((0.0, 0.0), (1.0, 0.0), maze_map=MAZE_MAP), pairs=pairs
    )
    (figure,) = drawn
    assert [axis.get_title() for axis in figure.axes] == [*(f"episode {i}" for i in range(4)), "", ""]
    axis = figure.axes[1]
    lines = lines_of(axis)
    np.testing.assert_array_equal(lines["without guidance"].get_xydata(), PAIR.unguided.positions)
    np.testing.assert_array_equal(lines["with guidance"].get_xydata(), PAIR.guided.positions)
    np.testing.assert_array_equal(lines["start"].get_xydata(), [[0.0, 0.0]])
    np.testing.assert_array_equal(lines["goal"].get_xydata(), [[0.5, 0.3]])
    crosses = [line.get_xydata() for line in axis.lines if line.get_marker() == "x"]
    np.testing.assert_array_equal(np.concatenate(crosses), [[0.5, 0.4]])
    assert len(axis.patches) == 10  # the walls
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend == ["without guidance", "with guidance", "start", "goal", "collision"]


def test_trajectories_of_three_coordinates_are_drawn_in_space(tmp_path: Path, drawn: list[Figure]) -> None:
    figures.plot_trajectories(tmp_path / "trajectories.png", scene=Scene(to_metres), pairs=[PAIR_3D])
    (axis,) = drawn[0].axes
    assert (axis.get_xlabel(), axis.get_ylabel(), axis.get_zlabel()) == ("x [m]", "y [m]", "z [m]")
    drawn_way = np.stack(lines_of(axis)["with guidance"].get_data_3d(), axis=-1)
    np.testing.assert_array_equal(drawn_way, PAIR_3D.guided.positions)
    assert "goal" not in lines_of(axis)


def test_obstacles_are_drawn_in_space(tmp_path: Path, drawn: list[Figure]) -> None:
    wall = Box((0.25, 0.0, 0.1), (0.1, 0.4, 0.2))
    scene = Scene(to_metres, obstacles=[wall])
    figures.plot_trajectories(tmp_path / "trajectories.png", scene=scene, pairs=[PAIR_3D])
    (axis,) = drawn[0].axes
    (sides,) = (child for child in axis.collections if isinstance(child, Poly3DCollection))
    corners = np.unique(np.concatenate(faces(wall)), axis=0)
    expected = [[x, y, z] for x in (0.2, 0.3) for y in (-0.2, 0.2) for z in (0.0, 0.2)]
    np.testing.assert_allclose(corners, expected, atol=1e-12)
    for face in faces(wall):  # four corners of one side, in order: each differs from the next on one axis
        assert (np.abs(np.diff(face, axis=0, append=face[:1])) > 0).sum(axis=1).tolist() == [1, 1, 1, 1]
    assert sides.get_alpha() == 0.25
    # The axes show the wall and the trajectory in equal units.
    low, high = np.transpose([axis.get_xlim(), axis.get_ylim(), axis.get_zlim()])
    assert np.all(low <= wall.low)
    assert np.all(high >= wall.high)


def test_the_overview_says_which_trajectory_collides(tmp_path: Path, drawn: list[Figure]) -> None:
    scene = scene_of((0.0, 0.0), (0.2, 0.0), maze_map=MAZE_MAP)
    figures.plot_maze_overview(tmp_path / "overview.png", scene=scene, pair=PAIR)
    assert [axis.get_title() for axis in drawn[0].axes] == [
        "(a) start and goal",
        "(b) density, 2 demonstrated points",
        "(c) potential field",
        "(d) FMP, no guidance: collides",
        "(e) PF2MP, same start and noise: clear",
    ]
    with pytest.raises(ValueError, match="the overview needs a maze, got another environment"):
        figures.plot_maze_overview(tmp_path / "no.png", scene=scene_of((0.0, 0.0), (1.0, 1.0)), pair=PAIR)


# Files


@pytest.mark.slow
@pytest.mark.parametrize("background", list(THEMES))
def test_every_figure_has_the_colour_of_its_background(tmp_path: Path, background: str) -> None:
    scene = scene_of((0.0, 0.0), (0.3, 0.1), maze_map=MAZE_MAP)
    options: dict[str, Any] = {"scene": scene, "background": background}
    figures.plot_lambda(tmp_path / "lambda.png", cells=lambda_cells(), background=background)
    figures.plot_density(tmp_path / "density.png", **options)
    figures.plot_arrows(tmp_path / "arrows.png", **options)
    figures.plot_trajectories(tmp_path / "trajectories.png", pairs=[PAIR], **options)
    figures.plot_trajectories(tmp_path / "space.png", pairs=[PAIR_3D], **options)
    figures.plot_maze_overview(tmp_path / "overview.png", pair=PAIR, **options)
    paths = sorted(tmp_path.iterdir())
    assert len(paths) == 6
    for path in paths:
        picture = image.imread(path)
        assert 600 < picture.shape[1] <= 1200, path
        np.testing.assert_allclose(picture[CORNER][:3], to_rgb(THEMES[background].background), atol=0.01)


def test_a_figure_that_cannot_be_written_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write_half(self: Figure, path: Path, **options: Any) -> None:
        path.write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(Figure, "savefig", write_half)
    (tmp_path / "old.png").write_bytes(b"old")
    for name in ("new.png", "old.png"):
        with pytest.raises(KeyboardInterrupt):
            figures.plot_lambda(tmp_path / name, cells=lambda_cells())
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("old.png", b"old")]


@pytest.mark.slow
def test_the_flow_moves_from_noise_to_paths(tmp_path: Path) -> None:
    scene = scene_of((0.0, 0.0), (0.3, 0.1), maze_map=MAZE_MAP)
    noise, ends = torch.randn(1, 2, 5, 2), torch.zeros(1, 2, 5, 2)
    unguided = torch.cat([noise, noise / 2, ends])
    starts = np.zeros((2, 2))
    output = tmp_path / "new" / "flow.gif"
    figures.animate_flow(
        output, scene=scene, unguided=unguided, guided=unguided, starts=starts, goals=None, background="dark"
    )
    assert [path.name for path in output.parent.iterdir()] == ["flow.gif"]
    frames = []
    with Image.open(output) as animation:
        for number in range(animation.n_frames):
            animation.seek(number)
            frames.append(np.asarray(animation.convert("RGB"), dtype=float) / 255)
    np.testing.assert_allclose(frames[0][CORNER], to_rgb(THEMES["dark"].background), atol=0.05)
    assert len(frames) > 10
    # Both halves show the same chunks; the titles above them differ.
    height, width, _ = frames[0].shape
    halves = frames[-1][height // 4 :, : width // 2 - 10], frames[-1][height // 4 :, -(width // 2 - 10) :]
    assert np.abs(halves[0].mean() - halves[1].mean()) < 0.01
    assert np.abs(frames[0] - frames[-1]).max() > 0.2


# Support


def report_of(n_episodes: int, names: tuple[str, ...] = ("x", "y")) -> FieldReport:
    """A report in which the last episode is alone, and its worst action is far outside."""
    episodes = [EpisodeSupport(i, 40, 0.01 * (i % 3), 5.0 - i % 7) for i in range(n_episodes - 1)]
    episodes.append(EpisodeSupport(n_episodes - 1, 40, 0.8, -float("inf")))
    shares = [1 / len(names)] * len(names)
    kinds = ["constant", *["continuous"] * (len(names) - 1)]
    return FieldReport(
        source="a test",
        bandwidth=0.1,
        log_threshold=-3.0,
        threshold_quantile=0.01,
        reach=0.2,
        spread=0.5,
        n_frames=40 * n_episodes,
        n_anchors=100,
        effective_anchors=(1.0, 2.0, 3.0),
        episodes=tuple(episodes),
        outlying=(),
        dimensions=tuple(map(DimensionShare, range(len(names)), names, shares, kinds)),
        remark="",
        action_kind=None,
        is_enough=True,
        verdict="Enough.",
    )


@pytest.mark.parametrize("background", THEMES)
def test_a_few_episodes_get_a_bar_each_and_the_alone_one_another_colour(
    background: str, tmp_path: Path, drawn: list[Figure]
) -> None:
    report = report_of(5)
    figures.plot_support(tmp_path / "support.png", report=report, background=background)
    left, right = drawn[0].axes
    assert [bar.get_height() for bar in left.patches] == pytest.approx([0, 1, 2, 0, 80])
    assert [bar.get_height() for bar in right.patches] == [5, 4, 3, 2, -20]
    assert (left.get_ylabel(), left.get_xlabel()) == ("actions outside the safe set [%]", "episode")
    assert right.get_ylabel() == "smallest support [nats, cut at 20]"
    for axis in (left, right):
        assert [label.get_text() for label in axis.get_xticklabels()] == ["0", "1", "2", "3", "4"]
        colours = [bar.get_facecolor() for bar in axis.patches]
        assert colours[-1][:3] == to_rgb(figures.COLLISION)
        assert len(set(colours[:-1])) == 1
    assert image.imread(tmp_path / "support.png").shape[1] == 900


def test_thousands_of_episodes_are_drawn_as_a_curve_with_the_worst_first(
    tmp_path: Path, drawn: list[Figure]
) -> None:
    figures.plot_support(tmp_path / "support.png", report=report_of(4000))
    left, right = drawn[0].axes
    for axis, worst in ((left, 80), (right, -20)):
        assert not axis.patches
        curve, alone = axis.lines[:2]
        assert axis.get_xscale() == "log"
        assert len(curve.get_xdata()) == 4000
        assert (curve.get_xdata()[0], curve.get_ydata()[0]) == (1, worst)
        assert list(alone.get_xdata()) == [1]
    assert list(left.lines[0].get_ydata()) == sorted(left.lines[0].get_ydata(), reverse=True)
    assert list(right.lines[0].get_ydata()) == sorted(right.lines[0].get_ydata())


@pytest.mark.parametrize("n_episodes", [1, 12, 21, 40])
def test_the_numbers_of_episodes_do_not_overlap(n_episodes: int, tmp_path: Path, drawn: list[Figure]) -> None:
    figures.plot_support(tmp_path / "support.png", report=report_of(n_episodes))
    for axis in drawn[0].axes:
        boxes = [label.get_window_extent() for label in axis.get_xticklabels() if label.get_text()]
        assert all(left.x1 < right.x0 for left, right in pairwise(boxes))


def test_dimensions_are_drawn_with_their_names_and_shares(tmp_path: Path, drawn: list[Figure]) -> None:
    names = ("$x", "joint_with_quite_a_long_name.pos", "grip_per$", "y")
    figures.plot_dimensions(tmp_path / "dimensions.png", report=report_of(5, names))
    (axis,) = drawn[0].axes
    assert [label.get_text() for label in axis.get_yticklabels()] == list(names)
    assert [bar.get_width() for bar in axis.patches] == [25] * 4
    assert [text.get_text() for text in axis.texts] == ["25 % constant", *["25 %"] * 3]
    assert all(text.get_window_extent().x1 < axis.bbox.x1 for text in axis.texts)
