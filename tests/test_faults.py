# SPDX-License-Identifier: Apache-2.0
"""Small inputs that once ended in a traceback, a hang or a loss: each ends in one line, or does what was typed."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from forked_commands import run, run_well
from safetensors.torch import load_file, save_file
from untrained_policies import write_checkpoint

from lerobot_pf2mp import load_policy

COLLECT = ("--task=maze_umaze", "--n_episodes=1", "--n_steps=8")
BENCHMARK = (
    "--env.type=pf2mp_maze",
    "--env.task=MazeUMaze-v0",
    "--n_episodes=2",
    "--n_repeats=1",
    "--batch_size=2",
)


def refused(command: str, *options: str, cwd: Path) -> str:
    """The one line in which a command ends."""
    finished = run(command, *options, cwd=cwd, timeout=60)
    assert finished.returncode == 1, finished.stdout + finished.stderr
    # LeRobot logs a traceback of its own where a video decoder is missing.
    assert "Traceback" not in finished.stderr.split("torchcodec")[-1]
    before, error, line = finished.stderr.rstrip().rpartition("error: ")
    assert error and before[-1:] in ("\n", "") and "\n" not in line
    return line


def test_a_dataset_whose_name_has_a_comment_sign_deletes_no_other(tmp_path: Path) -> None:
    other = tmp_path / "maze"
    run_well("pf2mp-collect", *COLLECT, f"--root={other}", cwd=tmp_path)
    (other / "mine.txt").write_text("mine")
    run_well("pf2mp-collect", *COLLECT, f"--root={tmp_path / 'maze #2'}", "--overwrite=true", cwd=tmp_path)
    assert (other / "mine.txt").read_text() == "mine"
    assert (tmp_path / "maze #2/meta/info.json").is_file()


@pytest.mark.slow
def test_no_run_deletes_a_dataset_that_it_did_not_see(tmp_path: Path) -> None:
    """Of two runs with one output, the second ends with an error and the first one's data are there."""
    run_well("pf2mp-collect", *COLLECT, "--root=out", cwd=tmp_path)
    before = (tmp_path / "out/meta/info.json").read_bytes()
    assert "exists already" in refused("pf2mp-collect", *COLLECT, "--root=out", cwd=tmp_path)
    assert (tmp_path / "out/meta/info.json").read_bytes() == before


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--n_steps=1000000000",), "n_steps must be at most 100000, got 1e+09"),
        (("--obs_type=pixels_agent_pos", "--image_width=1000000000"), "image_width must be at most 8192"),
        (
            ("--obs_type=pixels_agent_pos", "--picture_width=1000000000000"),
            "image_width must be at most 8192",
        ),
        (("--task=fetch_reach", "--n_processes=1000000000"), "n_processes must be at most 256"),
        (("--action_noise=null",), "action_noise must be float, got null"),
        (("--letter_height=null", "--task=handwriting_pen"), "letter_height must be float, got null"),
        (("--maze_map=#####/#OOG#/#####",), "maze_map must be one of"),
        (("--task=!!python/object/apply:os.system ['id']",), "task must be one of"),
    ],
)
def test_collect(options: tuple[str, ...], said: str, tmp_path: Path) -> None:
    assert said in refused("pf2mp-collect", "--n_episodes=1", "--root=out", *options, cwd=tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "cannot be read|must be one that pf2mp-benchmark has written"),
        ("null", "must be one that pf2mp-benchmark has written"),
        ("[]", "must be one that pf2mp-benchmark has written"),
        ("{}", "must be one that pf2mp-benchmark has written"),
        ('{"episodes": {}, "variants": []}', "must be one that pf2mp-benchmark has written"),
    ],
)
def test_a_benchmark_that_goes_on_from_a_damaged_run(content: str, said: str, tmp_path: Path) -> None:
    policy = write_checkpoint(tmp_path / "policy", "fmp")
    (tmp_path / "out").mkdir()
    (tmp_path / "out/run.json").write_text(content)
    line = refused(
        "pf2mp-benchmark", f"--policies={{a: {policy}}}", "--output_dir=out", *BENCHMARK, cwd=tmp_path
    )
    assert said.split("|")[-1] in line
    assert (tmp_path / "out/run.json").read_text() == content


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--n_repeats=1000000000",), "n_repeats must be at most 10000"),
        (("--n_episodes=null",), "n_episodes must be int, got null"),
        (
            ("--env.episode_length=1000000000000000000000000000000",),
            "env.episode_length must be at most 1000000",
        ),
    ],
)
def test_benchmark(options: tuple[str, ...], said: str, tmp_path: Path) -> None:
    line = refused(
        "pf2mp-benchmark", "--policies={a: nowhere}", "--output_dir=out", *BENCHMARK, *options, cwd=tmp_path
    )
    assert said in line and not list(tmp_path.iterdir())


def test_results_with_giant_numbers(tmp_path: Path) -> None:
    lines = (Path(__file__).parents[1] / "results/maze_lambda/summary.csv").read_text().splitlines()
    cells = lines[1].split(",")
    cells[lines[0].split(",").index("n_episodes")] = str(10**30)
    (tmp_path / "results").mkdir()
    (tmp_path / "results/summary.csv").write_text(f"{lines[0]}\n{','.join(cells)}\n")
    line = refused("pf2mp-plot", "--figure=lambda", "--results=[results]", "--output=q.png", cwd=tmp_path)
    assert "numbers must have at most 15 digits, got 1000000000" in line


def change_config(name: str, value: object) -> Callable[[Path], None]:
    def change(checkpoint: Path) -> None:
        path = checkpoint / "config.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), name: value}))

    return change


def change_field(name: str, value: float) -> Callable[[Path], None]:
    def change(checkpoint: Path) -> None:
        (path,) = checkpoint.glob("*potential_field.safetensors")
        tensors = load_file(path)
        save_file({**tensors, name: torch.full_like(tensors[name], value)}, path)

    return change


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (change_config("num_inference_steps", 10**9), "num_inference_steps must be at most 10000"),
        (change_config("horizon", 8 * 10**30), "horizon must be at most 10000"),
        (change_config("horizon", -(10**30)), "horizon must be at least 1"),
        (change_config("horizon", None), "horizon must be an integer, got null"),
        (change_config("n_action_steps", 2.5), "`n_action_steps`: Couldn't parse '2.5' into an int"),
        (change_config("max_plans", None), "max_plans must be an integer, got null"),
        (change_config("field_action_dims", [None]), "field_action_dims must be an integer or null, got"),
        (change_config("field_bandwidth", 1e300), "field_bandwidth must lie between"),
        (change_config("field_bandwidth", 1e-300), "field_bandwidth must lie between"),
        (change_config("n_field_points", 10**18), "n_field_points must be at most"),
        (change_config("down_dims", [8, 10**9]), "down_dims must be at most"),
        (change_field("bandwidth", 1e300), "bandwidth in a potential field file must lie between"),
        (change_field("bandwidth", 1e-300), "bandwidth in a potential field file must lie between"),
        (
            change_field("log_threshold", float("inf")),
            "log_threshold in a potential field file must be finite",
        ),
        (change_field("points", 1e30), r"must hold finite points \(P, D\), below 1e[+]12"),
    ],
)
@pytest.mark.parametrize("kind", ["pf2mp", "dppf"])
def test_giant_and_missing_numbers_of_a_checkpoint(
    kind: str, change: Callable[[Path], None], said: str, tmp_path: Path
) -> None:
    checkpoint = Path(write_checkpoint(tmp_path / "policy", kind))
    change(checkpoint)
    with pytest.raises(ValueError, match=said):
        load_policy(checkpoint)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--output_dir=exists",), "Output directory exists already exists and resume is False"),
        (
            ("--dataset.episodes=[100000]",),
            "dataset.episodes must be numbers of episodes, from 0 to 0, got [100000]",
        ),
        (("--dataset.episodes=[0]", "--dataset.streaming=true"), "because LeRobot then reads all episodes"),
        (("--policy.horizon=800000000",), "horizon must be at most 10000"),
        (("--batch_size=0",), "batch_size should be a positive integer value"),
        (("--dataset.root=nowhere",), "the dataset local/maze cannot be loaded"),
        (("--config_path=empty.yaml",), "must hold options by name, for example 'seed: 1', got nothing"),
        (("--config_path=list.yaml",), "got a list"),
        (("--config_path=missing.yaml",), "the configuration missing.yaml cannot be read"),
    ],
)
def test_train(options: tuple[str, ...], said: str, tmp_path: Path) -> None:
    run_well("pf2mp-collect", *COLLECT, "--root=maze", cwd=tmp_path)
    (tmp_path / "exists").mkdir()
    (tmp_path / "empty.yaml").write_text("")
    (tmp_path / "list.yaml").write_text("- a\n")
    given = [
        "--policy.type=pf2mp",
        "--policy.push_to_hub=false",
        "--policy.device=cpu",
        "--dataset.repo_id=local/maze",
    ]
    given += ["--dataset.root=maze", "--steps=1", "--batch_size=2", "--num_workers=0", "--output_dir=out"]
    names = [option.partition("=")[0] for option in options]
    given = [option for option in given if option.partition("=")[0] not in names]
    assert said in refused("pf2mp-train", *given, *options, cwd=tmp_path)
    assert not (tmp_path / "out").exists()
