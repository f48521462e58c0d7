# SPDX-License-Identifier: Apache-2.0
"""What a user sees before trusting a field: the numbers, the verdict and the page."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from forked_commands import run, run_well
from PIL import Image
from torch import Tensor
from untrained_policies import write_checkpoint

from lerobot_pf2mp.commands import cli
from lerobot_pf2mp.dataset_tools.writing.lerobot_writer import DatasetSpec, write_dataset
from lerobot_pf2mp.field_report.examination import Frames, make_field_report
from lerobot_pf2mp.field_report.of_dataset import _names_of
from lerobot_pf2mp.field_report.report import EpisodeSupport, FieldReport, OutlyingFrame
from lerobot_pf2mp.field_report.verdict import judge_demonstrations
from lerobot_pf2mp.figures.report_page import write_report
from lerobot_pf2mp.fit_field import examine_dataset
from lerobot_pf2mp.policies.guided.action_kind import ActionKind
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.policies.guided.field_settings import FieldSettings

N_EPISODES, LENGTH = 12, 40
EPISODES = torch.arange(N_EPISODES).repeat_interleave(LENGTH)


def strokes(n_episodes: int = N_EPISODES, noise: float = 0.02) -> Tensor:
    """Actions (N, 2) of episodes that go the same way, from left to right along a wave."""
    x = torch.linspace(-1, 1, LENGTH).repeat(n_episodes)
    points = torch.stack([x, 0.5 * torch.sin(3 * x)], dim=1)
    return points + noise * torch.randn(points.shape, generator=torch.Generator().manual_seed(1))


def sample_of(actions: Tensor, episodes: Tensor | None = EPISODES, **settings: Any) -> DemonstratedActions:
    chosen = FieldSettings(**settings)
    sample = DemonstratedActions(chosen)
    frames = torch.arange(len(actions))
    sample.observe(actions.unsqueeze(1), None, frames, episodes, settings=chosen)
    return sample


def report_on(actions: Tensor, episodes: Tensor | None = EPISODES, **settings: Any) -> FieldReport:
    return make_field_report(sample_of(actions, episodes, **settings), source="a test")


def support(share: float, episode: int = 0, n_actions: int = 50) -> EpisodeSupport:
    return EpisodeSupport(episode, n_actions, share, 0.5 - share)


def supports(*shares: float) -> list[EpisodeSupport]:
    return [support(share, episode) for episode, share in enumerate(shares)]


# The verdict.

ENOUGH, TOO_FEW = "The demonstrations are enough", "More demonstrations are needed"


@pytest.mark.parametrize(
    ("episodes", "reach", "is_enough", "sentence"),
    [
        (supports(0.0, 0.02, 0.01), 0.1, True, f"{ENOUGH}: 1 % of .* no demonstration is alone"),
        (supports(0.3), 0.1, None, "cannot be told from one episode"),
        ([], 0.1, None, "cannot be told from one episode"),
        ([EpisodeSupport(None, 50, 0.0, 1.0)], 0.1, None, "the field does not know the episodes"),
        (supports(0.0, 0.9, 0.0, 0.0), 0.1, False, "^Episode 1 of 4 is alone"),
        (supports(*[0.0] * 20, 0.9, 0.8, 0.7), 0.1, False, "^Episodes 20, 21 and 22 of 23 are alone"),
        (supports(*[0.0] * 20, *[0.9] * 8), 0.1, False, "^Episodes 20, 21, 22, 23, 24, 25 and 2 more of 28"),
        (supports(*[0.0] * 199, 0.9), 0.1, True, f"{ENOUGH}: .*, but episode 199 is alone"),
        (supports(0.9, 0.8, 0.0), 0.1, False, f"{TOO_FEW}: 56.7 % of a held-out demonstration's actions"),
        (supports(0.05, 0.03, 0.04), 0.1, False, f"{TOO_FEW}: 4 % of .* \\(mean of 3\\)"),
        (supports(0.0, 0.0, 0.0), 0.6, False, f"{TOO_FEW}: they are so far apart .* 60 % of their spread"),
    ],
)
def test_the_verdict_is_one_sentence_that_follows_the_rule(episodes, reach, is_enough, sentence):
    verdict = judge_demonstrations(episodes, 0.01, reach, spread=1.0)
    assert verdict[0] is is_enough
    assert re.search(sentence, verdict[1]), verdict[1]
    assert "\n" not in verdict[1]


def test_an_episode_of_a_few_actions_is_not_called_alone():
    few = [*supports(*[0.0] * 30), support(1.0, episode=30, n_actions=3)]
    assert "no demonstration is alone" in judge_demonstrations(few, 0.02, 0.1, 1.0)[1]


def test_demonstrations_that_go_the_same_way_are_enough():
    report = report_on(strokes())
    assert report.is_enough, report.verdict
    assert [episode.episode for episode in report.episodes] == list(range(N_EPISODES))


def test_an_episode_that_went_elsewhere_is_alone():
    actions = strokes()
    actions[EPISODES == 4] *= torch.tensor([1.0, -1.0])
    report = report_on(actions)
    assert not report.is_enough
    assert report.verdict.startswith("Episode 4 of 12 is alone")
    by_share = sorted(report.episodes, key=lambda episode: -episode.outside_share)
    assert by_share[0].episode == 4
    assert by_share[0].outside_share > 0.5 > by_share[1].outside_share
    assert by_share[0].smallest_support < 0
    assert report.outlying == ()  # a way of its own is no wrong value


def test_demonstrations_that_have_nothing_in_common_are_too_few():
    actions = torch.rand(4 * LENGTH, 3, generator=torch.Generator().manual_seed(0))
    places = torch.tensor([[-1.0, -1, -1], [1, 1, -1], [-1, 1, 1], [1, -1, 1]]).repeat_interleave(LENGTH, 0)
    report = report_on(places + 0.3 * actions, EPISODES[: 4 * LENGTH])
    assert not report.is_enough
    assert report.verdict.startswith(TOO_FEW)


@pytest.mark.parametrize("episodes", [None, torch.zeros(LENGTH, dtype=torch.int64)])
def test_one_recording_cannot_be_judged_by_others(episodes):
    report = report_on(strokes(1), episodes)
    assert report.is_enough is None
    assert [episode.episode for episode in report.episodes] == [None if episodes is None else 0]


# The numbers.


def test_each_episode_is_judged_by_density_and_threshold_of_the_others():
    actions = strokes(3, noise=0.05)
    report = report_on(actions, EPISODES[: 3 * LENGTH], threshold_quantile=0.1)
    h = report.bandwidth

    def log_density(queries: Tensor, anchors: Tensor) -> Tensor:
        exponents = -torch.cdist(queries.double(), anchors.double()).square() / (2 * h**2)
        return torch.logsumexp(exponents, dim=1) - np.log(len(anchors) * 2 * np.pi * h**2)

    parts = actions.split(LENGTH)
    held_out = [log_density(parts[i], torch.cat([parts[j] for j in range(3) if j != i])) for i in range(3)]
    for i, episode in enumerate(report.episodes):
        others = torch.cat([held_out[j] for j in range(3) if j != i])
        threshold = others.sort().values[int(0.1 * len(others)) - 1]
        assert episode.smallest_support == pytest.approx((held_out[i].min() - threshold).item(), abs=2e-3)
        assert episode.outside_share == pytest.approx((held_out[i] < threshold).double().mean().item())


def test_wrong_values_are_listed_the_farthest_first():
    actions = strokes()
    actions[100], actions[333] = torch.tensor([0.0, 30.0]), torch.tensor([50.0, 0.0])
    report = report_on(actions)
    assert [(frame.episode, frame.frame) for frame in report.outlying] == [(8, 333), (2, 100)]
    assert report.outlying[0].distance == pytest.approx(49, abs=0.5)
    assert report.outlying[0].bandwidths == pytest.approx(report.outlying[0].distance / report.bandwidth)
    assert report.n_anchors == len(actions) - 2
    assert [episode.n_actions for episode in report.episodes if episode.n_actions < LENGTH] == [39, 39]


def test_all_frames_are_looked_at_not_only_those_that_the_field_keeps():
    actions = strokes()
    actions[100] = torch.tensor([0.0, 30.0])
    sample = sample_of(actions, n_points=200)
    report = make_field_report(
        sample, source="a test", frames=Frames(actions, EPISODES, torch.arange(len(actions)))
    )
    assert (report.n_frames, len(report.episodes)) == (len(actions), N_EPISODES)
    assert 199 <= report.n_anchors <= 200
    assert [frame.frame for frame in report.outlying] == [100]
    assert sum(episode.n_actions for episode in report.episodes) == len(actions) - 1


def test_frames_of_episodes_that_the_sample_does_not_know_are_judged_too():
    actions = strokes()
    known = EPISODES < 9
    report = make_field_report(
        sample_of(actions[known], EPISODES[known]),
        source="a test",
        frames=Frames(actions, EPISODES, torch.arange(len(actions))),
    )
    assert len(report.episodes) == N_EPISODES
    assert max(episode.outside_share for episode in report.episodes) < 0.2


def test_dimensions_are_named_and_their_shares_add_up():
    noise = torch.randn(len(EPISODES), 1, generator=torch.Generator().manual_seed(2))
    wide = torch.cat([strokes(), 0.3 * noise, torch.zeros_like(noise), (noise > 0).float()], dim=1)
    sample = sample_of(wide, action_dims=(0, 2, 3, 4))
    names = ["x", "y", "height", "rest", "gripper"]
    dimensions = make_field_report(sample, source="a test", names=names).dimensions
    assert [(d.dim, d.name, d.kind) for d in dimensions] == [
        (0, "x", "continuous"),
        (2, "height", "continuous"),
        (3, "rest", "constant"),
        (4, "gripper", "two values"),
    ]
    assert sum(d.share for d in dimensions) == pytest.approx(1)
    assert dimensions[1].share > dimensions[0].share > dimensions[2].share == 0


def test_the_number_of_anchors_that_count_grows_with_the_bandwidth():
    low, median, high = report_on(strokes(), bandwidth=0.01).effective_anchors
    assert 1 <= low <= median <= high
    assert report_on(strokes(), bandwidth=0.2).effective_anchors[1] > 3 * median
    everything = report_on(strokes(), bandwidth=1e3).effective_anchors
    assert everything == pytest.approx([LENGTH * (N_EPISODES - 1)] * 3, rel=0.01)


def test_the_reach_is_where_a_lone_kernel_falls_to_the_threshold():
    report = report_on(strokes(), bandwidth=0.05, threshold_quantile=0.0)
    n_anchors, h = report.n_anchors, report.bandwidth
    lone = -(report.reach**2) / (2 * h**2) - np.log(n_anchors * 2 * np.pi * h**2)
    assert lone == pytest.approx(report.log_threshold) or report.reach == pytest.approx(h)


@pytest.mark.parametrize("n_points", [1, 2])
def test_a_field_of_hardly_any_actions_has_a_report(n_points):
    report = report_on(strokes(2)[:n_points], torch.arange(n_points))
    json.dumps(report.as_json(), allow_nan=False)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["x", "y"], ["x", "y"]),
        ({"motors": ["a", "b"]}, ["a", "b"]),
        ({"left": ["a"], "right": ["b"]}, ["a", "b"]),
        ({"y": 1, "x": 0}, ["x", "y"]),
        (None, None),
        ([], None),
    ],
)
def test_names_of_dimensions_are_read_in_every_form(names, expected):
    assert _names_of(names) == expected


# The page.


class _Page(HTMLParser):
    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.sources: list[str] = []
        self.text = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.sources += [str(value) for key, value in attrs if key in ("src", "srcset", "href", "action")]

    def handle_data(self, data: str) -> None:
        self.text += data


def write_page(report: FieldReport, folder: Path) -> _Page:
    write_report(report, folder)
    return _Page((folder / "report.html").read_text())


def test_the_page_holds_everything_and_needs_no_network(tmp_path):
    report = replace(report_on(strokes()), source="<b>$dataset$ & co</b>", action_kind=ActionKind(0.98, 0.1))
    page = write_page(report, tmp_path / "report")
    assert [source.partition(",")[0] for source in page.sources] == ["data:image/png;base64"] * 4
    assert not {"script", "link", "iframe", "b"} & set(page.tags)
    for text in (
        report.verdict,
        "<b>$dataset$ & co</b>",
        f"{report.bandwidth:.4g}",
        "0.98",
        "look like positions",
    ):
        assert text in page.text
    assert "prefers-color-scheme: dark" in (tmp_path / "report/report.html").read_text()
    assert sorted(path.name for path in (tmp_path / "report").iterdir()) == [
        *("dimensions_dark.png", "dimensions_light.png", "report.html", "report.json"),
        *("support_dark.png", "support_light.png"),
    ]


def test_the_json_holds_the_same_numbers(tmp_path):
    report = report_on(strokes())
    write_report(report, tmp_path / "report")
    numbers = json.loads((tmp_path / "report/report.json").read_text())
    assert numbers == json.loads(json.dumps(report.as_json()))
    assert numbers["bandwidth"] == report.bandwidth
    assert numbers["episodes"][3]["outside_share"] == report.episodes[3].outside_share


def test_numbers_that_are_not_finite_become_null():
    report = replace(report_on(strokes()), episodes=(EpisodeSupport(0, 3, 1.0, -float("inf")),))
    assert report.as_json()["episodes"][0]["smallest_support"] is None


def test_the_page_lists_the_farthest_outlying_frames(tmp_path):
    frames = tuple(OutlyingFrame(3, 100 + i, 2.0, 20.0) for i in range(25))
    text = write_page(replace(report_on(strokes()), outlying=frames), tmp_path / "report").text
    assert "119" in text
    assert "120" not in text.split("Outlying frames")[-1]
    assert "5 more are in report.json" in text


# The commands.

FEATURES: dict[str, dict[str, Any]] = {
    "observation.state": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
    "action": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("field_report") / "strokes"
    episodes = [{key: part.numpy() for key in FEATURES} for part in (10 + 3 * strokes()).split(LENGTH)]
    write_dataset(folder, DatasetSpec("local/strokes", 10, FEATURES, "Do it.", "A card."), episodes)
    return folder


def options_for(data: Path) -> list[str]:
    return ["--dataset.repo_id=local/strokes", f"--dataset.root={data}"]


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    """Runs pf2mp-fit-field in this process and returns the line with which it ends."""

    def refused(*arguments: str) -> str:
        monkeypatch.setattr("sys.argv", ["pf2mp-fit-field", *arguments])
        with pytest.raises(SystemExit, match="1"):
            cli.fit_field()
        return capsys.readouterr().err.strip().splitlines()[-1]

    return refused


def test_a_dataset_alone_has_a_report(data):
    report = examine_dataset(repo_id="local/strokes", root=data)
    expected = report_on(2 * (strokes() - strokes().amin(0)) / (strokes().amax(0) - strokes().amin(0)) - 1)
    assert report.bandwidth == pytest.approx(expected.bandwidth, rel=1e-3)
    assert report.is_enough
    assert (report.source, report.n_frames) == ("dataset local/strokes", len(EPISODES))
    assert [dimension.name for dimension in report.dimensions] == ["x", "y"]
    assert report.action_kind is not None
    assert report.action_kind.are_positions


def test_a_report_on_some_episodes_is_about_them_alone(data):
    report = examine_dataset(repo_id="local/strokes", root=data, episodes=[2, 7, 9])
    assert [episode.episode for episode in report.episodes] == [2, 7, 9]


def test_options_of_the_field_apply_to_a_dataset_alone(data):
    options = {"field_bandwidth": 0.3, "field_action_dims": (1,), "n_field_points": 50}
    report = examine_dataset(repo_id="local/strokes", root=data, options=options)
    assert (report.bandwidth, report.n_anchors) == (0.3, 50)
    assert [dimension.name for dimension in report.dimensions] == ["y"]


def test_the_policys_own_normalisation_counts_if_there_is_one(data, tmp_path):
    checkpoint = write_checkpoint(tmp_path / "pf2mp", "pf2mp")  # normalised to 1.5 around 0
    report = examine_dataset(repo_id="local/strokes", root=data, checkpoint=checkpoint)
    alone = examine_dataset(repo_id="local/strokes", root=data)
    assert report.spread == pytest.approx(alone.spread * 3 / 1.5, rel=0.2)


@pytest.mark.slow
def test_the_command_reports_on_a_dataset_without_a_policy(data, tmp_path):
    report = tmp_path / "report"
    said = run_well(
        "pf2mp-fit-field", *options_for(data), f"--report={report}", "--policy.n_field_points=100"
    )
    assert "The demonstrations are enough" in said
    assert f"Wrote {report}/report.html" in said
    assert json.loads((report / "report.json").read_text())["n_anchors"] == 100
    assert [path.name for path in tmp_path.iterdir()] == ["report"]


@pytest.mark.slow
def test_the_command_writes_checkpoint_and_report(data, tmp_path):
    checkpoint = write_checkpoint(tmp_path / "fmp", "fmp")
    said = run_well(
        *("pf2mp-fit-field", f"--policy.path={checkpoint}", *options_for(data)),
        *(f"--output_dir={tmp_path / 'new'}", f"--report={tmp_path / 'report'}"),
    )
    assert "Wrote a pf2mp checkpoint" in said
    assert (tmp_path / "new/model.safetensors").is_file()
    assert (tmp_path / "report/report.html").is_file()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fmp", "new", "report"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--report=r", "--output_dir=o"], "error: --policy.path must be given"),
        (
            ["--report=r", "--policy.guidance_scale=1"],
            "error: --policy.guidance_scale must come with --policy.path",
        ),
        (["--report=r", "--policy.revision=main"], "error: --policy.revision must come with --policy.path"),
        (
            ["--report=o/r", "--output_dir=o", "--policy.path=p"],
            "error: --report must lie beside --output_dir, got o/r and o",
        ),
        (["--report=o", "--output_dir=o", "--policy.path=p"], "error: --report must lie beside --output_dir"),
        (["--policy.path=p"], "error: --output_dir must be given"),
    ],
)
def test_options_that_do_not_fit_together_are_refused(
    arguments, message, data, refused, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert refused(*options_for(data), *arguments).startswith(message)
    assert list(tmp_path.iterdir()) == []


def test_a_report_needs_a_dataset(refused):
    assert refused("--report=r") == "error: --dataset.repo_id must be given"


def test_an_existing_report_is_kept_unless_overwritten(data, refused, tmp_path, monkeypatch):
    report, other = tmp_path / "report", tmp_path / "other"
    write_report(report_on(strokes()), report)
    before = (report / "report.json").read_bytes()
    assert "exists already: choose another --report" in refused(*options_for(data), f"--report={report}")
    assert (report / "report.json").read_bytes() == before
    other.mkdir()
    (other / "thesis.txt").write_text("mine")
    line = refused(*options_for(data), f"--report={other}", "--overwrite=true")
    assert "is no report, it holds no report.json" in line
    assert [path.name for path in other.iterdir()] == ["thesis.txt"]
    arguments = ["pf2mp-fit-field", *options_for(data), f"--report={report}", "--overwrite=true"]
    monkeypatch.setattr("sys.argv", arguments)
    cli.fit_field()
    assert (report / "report.json").read_bytes() != before


def test_a_report_that_cannot_be_made_leaves_nothing(refused, tmp_path):
    line = refused(
        *("--dataset.repo_id=local/none", f"--dataset.root={tmp_path / 'none'}"),
        f"--report={tmp_path / 'report'}",
    )
    assert line.startswith("error: the dataset local/none")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("background", ["light", "dark"])
def test_the_command_draws_the_support_of_a_checkpoint_without_an_environment(background, tmp_path):
    checkpoint = write_checkpoint(tmp_path / "dppf", "dppf")
    output = tmp_path / "support.png"
    run_well(
        *("pf2mp-plot", "--figure=support", f"--checkpoint={checkpoint}"),
        *(f"--output={output}", f"--background={background}"),
    )
    red, green, blue = Image.open(output).convert("RGB").getpixel((5, 5))
    assert (red + green + blue > 600) == (background == "light")


@pytest.mark.slow
def test_the_support_of_a_policy_without_a_field_is_refused(tmp_path):
    checkpoint = write_checkpoint(tmp_path / "fmp", "fmp")
    finished = run(
        *("pf2mp-plot", "--figure=support", f"--checkpoint={checkpoint}", f"--output={tmp_path / 'a.png'}")
    )
    assert finished.returncode == 1
    assert finished.stderr.strip().splitlines()[-1].startswith("error: ")
    assert not (tmp_path / "a.png").exists()
