# SPDX-License-Identifier: Apache-2.0
import json
import os
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foreign_recordings import FOREIGN_LAYOUT, demonstrations, line, write_d4rl, write_pointmaze
from forked_commands import SECONDS, ForkedCommand, run
from lerobot.datasets import LeRobotDataset
from result_rows import SUMMARY, UNGUIDED
from untrained_policies import write_checkpoint

from lerobot_pf2mp.commands import cli
from lerobot_pf2mp.results.rows import EpisodeRow, SummaryRow, read_rows, write_rows

MAZES = ("maze_umaze", "maze_medium", "maze_large")
COLLECT_SMALL = ("--task=maze_umaze", "--n_episodes=3", "--n_steps=5")


def everything_in(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def error_of(stderr: str) -> str:
    """The only line that starts with "error:", which must be the last."""
    lines = stderr.strip().splitlines()
    assert "Traceback" not in stderr
    assert [line for line in lines if line.startswith("error:")] == lines[-1:]
    return lines[-1]


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a command in this process and returns the line with which it ends."""

    def refused(command: Callable[[], None], *arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", [f"pf2mp-{command.__name__}", *arguments])
        capfd.readouterr()
        with pytest.raises(SystemExit, match="1") as exit_:
            command()
        assert exit_.value.code == 1
        captured = capfd.readouterr()
        assert "Wrote" not in captured.out
        return error_of(captured.err)

    return refused


# pf2mp-collect


@pytest.mark.slow
def test_collect_writes_a_dataset_that_lerobot_opens_and_does_not_replace_it_unasked(tmp_path: Path) -> None:
    root = tmp_path / "data" / "umaze"
    options = ("--task=maze_umaze", "--n_episodes=20", "--n_steps=80", "--seed=3", f"--root={root}")
    result = run("pf2mp-collect", *options)
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == f"Wrote 20 episodes of 80 steps to {root} (left out: none)."
    assert "Traceback" not in result.stderr
    dataset = LeRobotDataset("local/maze_umaze", root=root)
    assert (dataset.num_episodes, dataset.num_frames) == (20, 1600)
    assert dataset.features["action"]["shape"] == (2,)
    first = demonstrations("umaze", 1, seed=3)[0]
    np.testing.assert_allclose(dataset[0]["observation.state"], first.positions[0], rtol=1e-6)
    assert [path.name for path in (tmp_path / "data").iterdir()] == ["umaze"]

    before = (root / "meta/info.json").stat().st_mtime_ns
    again = run("pf2mp-collect", *options)
    assert again.returncode == 1
    assert (
        error_of(again.stderr)
        == f"error: {root} exists already: choose another --root, or pass --overwrite=true"
    )
    assert (root / "meta/info.json").stat().st_mtime_ns == before


@pytest.mark.slow
def test_unknown_options_end_with_the_usage_and_nothing_written(tmp_path: Path) -> None:
    result = run("pf2mp-collect", f"--root={tmp_path / 'd'}", "--n_episode=3", cwd=tmp_path)
    assert result.returncode == 2
    assert "usage: pf2mp-collect" in result.stderr
    assert "error: unrecognized arguments: --n_episode=3" in result.stderr
    assert "Traceback" not in result.stderr
    assert everything_in(tmp_path) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "facts"),
    [
        (
            "pf2mp-collect",
            [
                *MAZES,
                "by default local/TASK",
                "relative to the largest force (100 N)",
                "by default 80 for a maze, 48 for Fetch",
                "by default 4000 for a maze, 1000 for Fetch",
                "metaworld_pick_place_wall or so101_fence.",
                "x, y of the wall's centre [m]",
                "Width of these images, for a maze their longer side [pixels]",
            ],
        ),
        ("pf2mp-convert", [*MAZES, "by default local/TASK", "by default 80 for a maze, 48 for Fetch"]),
        (
            "pf2mp-plot",
            [
                "lambda, density, arrows, trajectories, overview, strokes, flow or video",
                "collision and success rate against lambda",
                "PNG, GIF for flow, MP4 for video",
                "light or dark",
                "(default: 100000)",
            ],
        ),
        (
            "pf2mp-fit-field",
            [
                "fmp becomes pf2mp, diffusion dppf, all others guarded",
                "[normalised action units], or likelihood, scott or silverman",
                "lambda, the strength of the guidance",
                "--policy.path",
                "--dataset.repo_id",
                "--output_dir",
            ],
        ),
    ],
)
def test_help_shows_examples_units_and_defaults(command: str, facts: list[str]) -> None:
    result = run(command, "--help")
    assert result.returncode == 0
    assert result.stderr == ""
    words = " ".join(result.stdout.split())
    assert f"Examples: {command} --" in words
    assert [fact for fact in facts if fact not in words] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "code", "metadata_begun"),
    [(signal.SIGINT, 130, False), (signal.SIGINT, 130, True), (signal.SIGTERM, 143, True)],
)
def test_ctrl_c_and_sigterm_in_the_middle_of_collecting_leave_nothing_behind(
    tmp_path: Path, number: signal.Signals, code: int, metadata_begun: bool
) -> None:
    process = ForkedCommand(
        "pf2mp-collect",
        "--n_episodes=4000",
        f"--root={tmp_path / 'd'}",
        env={**os.environ, "TMPDIR": str(tmp_path)},
    )
    try:
        end = time.monotonic() + SECONDS
        # Interrupt it as soon as the first frames are written, or after more than the 100 episodes that are buffered.
        under_way = (
            "new/meta/episodes/chunk-000/*.parquet" if metadata_begun else "new/data/chunk-000/*.parquet"
        )
        while not any(tmp_path.glob(f".d.partial/{under_way}")):
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < end
            time.sleep(0.01)
        time.sleep(0.1)
        process.send_signal(number)
        output, errors = process.communicate(timeout=SECONDS)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == code
    assert everything_in(tmp_path) == []
    assert output == ""
    assert "Traceback" not in errors
    assert errors.strip().splitlines()[-1] == "interrupted: nothing half-written was left behind"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ["--task=kitchen"],
            "error: task must be one of ['maze_umaze', 'maze_medium', 'maze_large', 'fetch_reach', 'fetch_push', "
            "'handwriting_joint', 'handwriting_pen', 'metaworld_reach_wall', 'metaworld_push_wall', "
            "'metaworld_pick_place_wall', 'so101_fence'], got",
        ),
        (["--n_episodes=0"], "error: n_episodes must be at least 1, got 0"),
        (["--n_episodes=-5"], "error: n_episodes must be at least 1, got -5"),
        (["--n_episodes=many"], "error: `n_episodes`: "),
        (["--n_steps=1"], "error: n_steps must be at least 2, got 1"),
        (["--action_noise=-0.5"], "error: action_noise must be finite and at least 0, got -0.5"),
        (["--action_noise=nan"], "error: action_noise must be finite and at least 0, got nan"),
        (["--maze_map=11111/10000/11111"], "error: maze_map must be closed"),
        (["--maze_map=11111/10101/11111"], "error: maze_map must be connected"),
        (
            ["--task=handwriting_pen", "--maze_map=111/101/111"],
            "error: --maze_map is for mazes only, got 111/101/111",
        ),
        (["--maze_map=nowhere"], "error: maze_map must be one of ['umaze', 'medium', 'large']"),
        (["--seed=-1"], "error: seed must be at least 0, got -1"),
        (["--overwrite=perhaps"], "error: `overwrite`: Couldn't parse 'perhaps' into a bool"),
    ],
)
def test_bad_values_for_collect_end_in_one_line_and_nothing_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Callable[..., str], options: list, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    line = refused(cli.collect, *COLLECT_SMALL, f"--root={tmp_path / 'd'}", *options)
    assert line.startswith(message)
    assert everything_in(tmp_path) == []


@pytest.mark.slow
def test_a_root_that_cannot_be_made_ends_in_one_line(tmp_path: Path, refused: Callable[..., str]) -> None:
    (tmp_path / "file").write_text("in the way")
    assert str(tmp_path / "file") in refused(cli.collect, *COLLECT_SMALL, f"--root={tmp_path / 'file' / 'd'}")
    assert everything_in(tmp_path) == ["file"]


@pytest.mark.slow
def test_overwrite_replaces_a_dataset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    for n_episodes in (3, 4):
        options = (f"--n_episodes={n_episodes}", "--overwrite=true", f"--root={tmp_path / 'd'}")
        monkeypatch.setattr(sys, "argv", ["pf2mp-collect", "--task=maze_umaze", "--n_steps=5", *options])
        cli.collect()
        assert f"Wrote {n_episodes} episodes of 5 steps" in capsys.readouterr().out
        info = json.loads((tmp_path / "d/meta/info.json").read_text())
        assert (info["total_episodes"], info["total_frames"]) == (n_episodes, 5 * n_episodes)
    assert [path.name for path in tmp_path.iterdir()] == ["d"]


@pytest.mark.slow
def test_a_root_below_the_home_folder_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # A shell does not expand the ~ of --root=~/d.
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["pf2mp-collect", *COLLECT_SMALL, "--root=~/d"])
    cli.collect()
    assert [path.name for path in tmp_path.iterdir()] == ["home"]
    assert (tmp_path / "home" / "d" / "meta" / "info.json").is_file()


# pf2mp-convert


@pytest.mark.slow
def test_convert_turns_a_d4rl_file_into_a_dataset_and_says_what_was_left_out(tmp_path: Path) -> None:
    trajectories = demonstrations("medium", 4)
    trajectories[2:2] = [line((-2.5, 2.5), (2.5, -2.5), 200), line((-2.5, 2.5), (-2.4, 2.5), 1)]
    path = write_d4rl(tmp_path / "maze2d.hdf5", trajectories, "medium", with_timeouts=True)
    root = tmp_path / "d"
    result = run(
        "pf2mp-convert",
        "--source.type=d4rl",
        f"--source.path={path}",
        "--task=maze_medium",
        "--n_steps=40",
        f"--root={root}",
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == (
        f"Wrote 4 episodes of 40 steps to {root} (left out: 1 in collision, 1 shorter than 2 steps)."
    )
    dataset = LeRobotDataset("local/maze_medium", root=root)
    assert (dataset.num_episodes, dataset.num_frames) == (4, 160)
    for number, index in enumerate((0, 1, 4, 5)):
        sample = dataset[40 * number]
        np.testing.assert_allclose(sample["observation.state"], trajectories[index].positions[0], atol=1e-5)
        np.testing.assert_allclose(
            sample["observation.environment_state"], trajectories[index].goal, atol=1e-5
        )
    assert "Converted from maze2d.hdf5 (d4rl)." in (root / "README.md").read_text()
    assert everything_in(tmp_path)[0] == "d"


@pytest.mark.slow
def test_convert_reads_minari_and_stops_at_the_number_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    expected = demonstrations("umaze", 5)
    folder = write_pointmaze(tmp_path / "in", monkeypatch, expected)
    monkeypatch.setattr(
        sys,
        "argv",
        [
            "pf2mp-convert",
            "--source.type=minari",
            f"--source.path={folder}",
            "--task=maze_umaze",
            "--n_episodes=3",
            "--n_steps=10",
            "--repo_id=me/minari",
            f"--root={tmp_path / 'd'}",
        ],
    )
    cli.convert()
    assert "Wrote 3 episodes of 10 steps" in capsys.readouterr().out
    dataset = LeRobotDataset("me/minari", root=tmp_path / "d")
    goals = [dataset[10 * number]["observation.environment_state"] for number in range(3)]
    np.testing.assert_allclose(goals, [trajectory.goal for trajectory in expected[:3]], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "error: --source.path must name the recording, got none"),
        (
            ["--source.path=no.hdf5"],
            "error: source.path must be an HDF5 file, got no.hdf5, which does not exist",
        ),
        (["--source.path=text.hdf5"], "error: text.hdf5 must be a whole HDF5 file"),
        (
            ["--source.path=gone", "--source.type=minari"],
            "error: source.path must be the folder of a Minari dataset",
        ),
        (["--source.path=.", "--source.type=minari"], "error: . must hold a Minari dataset"),
        (
            ["--source.path=good.hdf5", "--source.type=rlds"],
            "error: --source.type must be one of ['d4rl', 'minari', 'fetch', 'handwriting']",
        ),
        (["--source.path=good.hdf5", "--task=maze"], "error: task must be one of"),
        (["--source.path=good.hdf5", "--n_steps=0"], "error: n_steps must be at least 2, got 0"),
        (["--source.path=good.hdf5", "--n_episodes=0"], "error: n_episodes must be at least 1, got 0"),
        (["--source.path=good.hdf5", "--n_episodes=many"], "error: `n_episodes`"),
        (["--source.path=foreign.hdf5"], f"error: a D4RL maze2d file must hold {FOREIGN_LAYOUT}"),
    ],
)
def test_bad_values_for_convert_end_in_one_line_and_nothing_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Callable[..., str], options: list, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    trajectories = demonstrations("large", 2)
    write_d4rl(Path("good.hdf5"), trajectories, "large", with_timeouts=True)
    write_d4rl(Path("foreign.hdf5"), trajectories, "large", with_timeouts=True, infos__goal=None)
    Path("text.hdf5").write_text("404")
    before = everything_in(tmp_path)
    assert refused(cli.convert, f"--root={tmp_path / 'd'}", *options).startswith(message)
    assert everything_in(tmp_path) == before


# pf2mp-benchmark


BENCHMARK_SMALL = (
    "--env.type=pf2mp_maze",
    "--env.task=MazeUMaze-v0",
    "--env.episode_length=2",
    "--n_episodes=2",
    "--batch_size=1",
)


@pytest.mark.slow
def test_benchmark_compares_policies_and_prints_the_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed in (1, 2):
        write_checkpoint(tmp_path / f"policy_{seed}", "pf2mp", seed)
        write_checkpoint(tmp_path / f"act_{seed}", "act", seed)
    options = (
        f"--policies={{pf2mp: '{tmp_path}/policy_{{seed}}', act: '{tmp_path}/act_{{seed}}'}}",
        '--guidance=[none, "proximal:0.08,0.8"]',
        '--variants={"": {}, one step: {}}',
        "--seeds=[1, 2]",
        "--n_repeats=1",
        f"--output_dir={tmp_path / 'new' / 'benchmark'}",
    )
    monkeypatch.setattr(sys, "argv", ["pf2mp-benchmark", *BENCHMARK_SMALL, *options])
    cli.benchmark()
    output = capsys.readouterr().out
    table = (tmp_path / "new/benchmark/table.md").read_text()
    assert output.endswith(f"{table}\nWrote {tmp_path / 'new' / 'benchmark'}.\n")
    assert [tuple(row.split(" | ")[1:5]) for row in table.splitlines()[2:]] == [
        (policy, *guidance, variant)
        for rows in (
            [
                ("fmp", ("none", "")),
                ("pf2mp", ("proximal", "0.08")),
                ("pf2mp", ("proximal", "0.8")),
            ],
            [("act", ("none", ""))],
        )
        for variant in ("", "one step")
        for policy, guidance in rows
    ]
    rows = read_rows(tmp_path / "new/benchmark/episodes.csv", EpisodeRow)
    assert len(rows) == (3 + 1) * 2 * 2 * 2
    assert {row.checkpoint for row in rows if row.seed == 2} == {f"{tmp_path}/policy_2", f"{tmp_path}/act_2"}


@pytest.mark.slow
def test_help_of_benchmark_shows_examples_and_defaults(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["pf2mp-benchmark", "--help"])
    with pytest.raises(SystemExit, match="0"):
        cli.benchmark()
    words = " ".join(capsys.readouterr().out.split())
    for fact in (
        "Examples: pf2mp-benchmark --policies='{pf2mp: ",
        "none, or INTEGRATOR:LAMBDA,LAMBDA,... (default: ['none', 'proximal:0.8'])",
        "(default: 500)",
        "{seed} and {task} in the path of a checkpoint are replaced",
    ):
        assert fact in words


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--policies={}"], "error: policies must name at least one, got none"),
        (["--policies=pf2mp"], "error: `policies`"),
        (
            ["--policies={pf2mp: nowhere}"],
            "error: path must be a checkpoint's pretrained_model folder or a repository",
        ),
        (["--guidance=[off]"], "error: guidance must be none or INTEGRATOR:SCALE,SCALE,..."),
        (["--guidance=none"], "error: `guidance`"),
        (["--n_episodes=0"], "error: n_episodes must be at least 1, got 0"),
        (["--n_repeats=0"], "error: n_repeats must be at least 1, got 0"),
        (["--n_processes=0"], "error: n_processes must be at least 1, got 0"),
        (["--seeds=[]"], "error: seeds must name at least one, got none"),
        (["--seeds=[first]"], "error: `seeds"),
        (["--seeds=[0, 0]"], "error: seeds must differ from each other, got [0, 0]"),
        (["--seeds=[0, 1]"], "error: with several seeds the path of 'fmp' must hold {seed}"),
        (["--variants={fast: {steps: 1}}"], "error: the checkpoint "),
        (["--variants={strong: {guidance_scale: 8}}"], "error: guidance_scale must be given as guidance"),
        (["--env.task=MazeHuge-v0"], "error: task must be one of"),
    ],
)
def test_bad_values_for_benchmark_end_in_one_line_and_nothing_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Callable[..., str], options: list, message: str
) -> None:
    policy = write_checkpoint(tmp_path / "policy", "fmp")
    monkeypatch.chdir(tmp_path)
    before = everything_in(tmp_path)
    given = (*BENCHMARK_SMALL, f"--policies={{fmp: {policy}}}", "--output_dir=out", *options)
    assert refused(cli.benchmark, *given).startswith(message)
    assert everything_in(tmp_path) == before


# pf2mp-plot


@pytest.fixture
def results(tmp_path: Path) -> Path:
    rows = [replace(SUMMARY, **UNGUIDED), SUMMARY, replace(SUMMARY, guidance_scale=8.0)]
    write_rows(tmp_path / "results/summary.csv", rows, SummaryRow)
    return tmp_path / "results"


def run_plot(monkeypatch: pytest.MonkeyPatch, *options: str) -> None:
    monkeypatch.setattr(sys, "argv", ["pf2mp-plot", *options])
    cli.plot()


@pytest.mark.slow
def test_plot_draws_from_results(
    tmp_path: Path, results: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "new" / "lambda.png"
    run_plot(monkeypatch, "--figure=lambda", f"--results=[{results}]", f"--output={output}")
    assert capsys.readouterr().out.endswith(f"Wrote {output}.\n")
    assert output.read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
@pytest.mark.parametrize("figure", ["density", "arrows", "trajectories", "overview", "flow", "video"])
def test_plot_draws_from_a_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], figure: str
) -> None:
    policy = write_checkpoint(tmp_path / "policy", "pf2mp")
    ending, mark = {"flow": ("gif", b"GIF89a"), "video": ("mp4", b"ftyp")}.get(figure, ("png", b"\x89PNG"))
    output = tmp_path / f"{figure}.{ending}"
    run_plot(
        monkeypatch,
        f"--figure={figure}",
        f"--checkpoint={policy}",
        "--env.type=pf2mp_maze",
        "--env.task=MazeUMaze-v0",
        "--env.episode_length=2",
        "--n_episodes=1",
        "--episodes=[1]",
        "--options={guidance_scale: 0.4}",
        "--background=dark",
        f"--output={output}",
    )
    assert capsys.readouterr().out.endswith(f"Wrote {output}.\n")
    assert mark in output.read_bytes()[:12]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--figure=pie"], "error: --figure must be one of ('lambda', 'density', 'arrows', "),
        (["--background=blue"], "error: --background must be one of ('light', 'dark'), got 'blue'"),
        (["--n_episodes=0"], "error: --n_episodes must be at least 1 and --episodes at least 0, got 0 and []"),
        (["--episodes=[-1]"], "error: --n_episodes must be at least 1 and --episodes at least 0, got 6 and [-1]"),
        (["--episodes=first"], "error: `episodes`"),
        (["--output="], "error: --output must "),
        (["--output=figure.jpg"], "error: --output must end in .png for this figure, got figure.jpg"),
        (["--figure=flow"], "error: --output must end in .gif for this figure, got figure.png"),
        (["--figure=lambda"], "error: --results must name folders written by pf2mp-benchmark, got none"),
        (["--figure=lambda", "--results=[nowhere]"], "error: "),
        (["--figure=lambda", "--results=[results]", "--task=MazeHuge-v0"], "error: results must be of one task"),
        (["--checkpoint=nowhere"], "error: path must be a checkpoint's pretrained_model folder or a repository"),
        (["--checkpoint=fmp"], "error: the checkpoint must be of type pf2mp, dppf or guarded, got 'fmp'"),
        (["--options={guidance_scale: -1}"], "error: the checkpoint pf2mp cannot be loaded: guidance_scale must"),
        (["--options={scale: 1}"], "error: the checkpoint pf2mp cannot be loaded: a pf2mp policy's option must be"),
        (["--env.task=MazeHuge-v0"], "error: task must be one of"),
    ],
)  # fmt: skip
def test_bad_values_for_plot_end_in_one_line_and_nothing_written(
    tmp_path: Path,
    results: Path,
    monkeypatch: pytest.MonkeyPatch,
    refused: Callable[..., str],
    options: list[str],
    message: str,
) -> None:
    for kind in ("pf2mp", "fmp"):
        write_checkpoint(tmp_path / kind, kind)
    monkeypatch.chdir(tmp_path)
    before = everything_in(tmp_path)
    given = ("--figure=density", "--checkpoint=pf2mp", "--env.type=pf2mp_maze", "--output=figure.png")
    assert refused(cli.plot, *given, *options).startswith(message)
    assert everything_in(tmp_path) == before


# Fetch


@pytest.mark.slow
def test_collect_takes_demonstrations_in_fetch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "d"
    options = ("--task=fetch_reach", "--n_episodes=2", "--scene.wall_size=[0.2,0.04,0.1]", f"--root={root}")
    monkeypatch.setattr(sys, "argv", ["pf2mp-collect", *options])
    cli.collect()
    assert capsys.readouterr().out.startswith(f"Wrote 2 episodes of 48 steps to {root} (left out: ")
    dataset = LeRobotDataset("local/fetch_reach", root=root)
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (2, 96, 25)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--obs_type=pixels"], "error: obs_type must be one of ['state', 'pixels_agent_pos'], got 'pixels'"),
        (["--style=fast"], "error: style must be one of ['clear', 'hug'], got 'fast'"),
        (["--n_processes=0"], "error: n_processes must be at least 1, got 0"),
        (["--scene.wall_size=[0.3,0.04,0.9]"], "error: a wall must be at most 0.32 m high"),
        (["--scene.wall_position=[9,9]"], "error: a wall must stand on the table"),
        (["--scene.goal_range=[[1,2],[3,4]]"], "error: goal_range must be two corners of 3 coordinates"),
        (["--scene.wall_size=tall"], "error: `scene.wall_size`"),
        (
            ["--obs_type=pixels_agent_pos", "--image_width=3"],
            "error: render_size must be at least 32 pixels, got 3",
        ),
        (  # the earlier name of the option
            ["--obs_type=pixels_agent_pos", "--picture_width=4"],
            "error: render_size must be at least 32 pixels, got 4",
        ),
        (["--expert=nowhere"], "error: nowhere must be a folder written by pf2mp-train-expert"),
    ],
)
def test_bad_values_for_fetch_end_in_one_line_and_nothing_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Callable[..., str], options: list, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    given = ("--task=fetch_reach", "--n_episodes=1", "--root=d", *options)
    assert refused(cli.collect, *given).startswith(message)
    assert everything_in(tmp_path) == []
