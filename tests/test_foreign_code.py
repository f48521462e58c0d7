# SPDX-License-Identifier: Apache-2.0
"""A checkpoint is data: loading one runs no foreign code, reads no file outside it, and is never silently unguarded."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from forked_commands import run
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.policies.factory import get_policy_class
from safetensors.torch import load_file, save_file
from untrained_policies import write_checkpoint

from lerobot_pf2mp import load_policy
from lerobot_pf2mp.errors import ConfigError
from lerobot_pf2mp.policies import processor_files
from lerobot_pf2mp.policies.processor_files import TRUST_VARIABLE

FILES = ("policy_preprocessor.json", "policy_postprocessor.json")
STEP = """
from pathlib import Path
from lerobot.processor import ProcessorStep

Path({marker!r}).touch()

class Step(ProcessorStep):
    def __call__(self, transition):
        return transition

    def transform_features(self, features):
        return features
"""


@pytest.fixture
def marker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that appears as soon as the module foreign_steps is imported."""
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules/foreign_steps.py").write_text(STEP.format(marker=str(tmp_path / "MARKER")))
    monkeypatch.syspath_prepend(tmp_path / "modules")
    monkeypatch.delitem(sys.modules, "foreign_steps", raising=False)
    return tmp_path / "MARKER"


def add_step(checkpoint: str, file: str, step: dict[str, Any]) -> None:
    path = Path(checkpoint) / file
    pipeline = json.loads(path.read_text())
    pipeline["steps"].insert(0, step)
    path.write_text(json.dumps(pipeline))


def change_step(checkpoint: str, name: str, change: Callable[[dict[str, Any]], object]) -> None:
    path = Path(checkpoint) / FILES[0]
    pipeline = json.loads(path.read_text())
    change(next(step for step in pipeline["steps"] if step["registry_name"] == name))
    path.write_text(json.dumps(pipeline))


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("kind", ["fmp", "pf2mp", "dppf", "act"])
def test_a_step_that_is_not_registered_is_named_and_not_imported(
    kind: str, file: str, marker: Path, tmp_path: Path
) -> None:
    checkpoint = write_checkpoint(tmp_path / "policy", kind)
    add_step(checkpoint, file, {"class": "foreign_steps.Step", "config": {}})
    with pytest.raises(
        ValueError, match=rf"{file} must be registered .*, got the class 'foreign_steps.Step'"
    ):
        load_policy(checkpoint)
    if kind != "act":  # LeRobot's own class
        with pytest.raises(ValueError, match="nothing of it was imported"):
            get_policy_class(kind).from_pretrained(checkpoint)
    assert not marker.exists() and "foreign_steps" not in sys.modules


@pytest.mark.parametrize(
    "step",
    [
        {"class": "subprocess.Popen", "config": {"args": ["touch", "MARKER"]}},
        {"class": "os.system", "config": {"command": "touch MARKER"}},
        {"class": "numpy.load", "config": {"file": "x.npy", "allow_pickle": True}},
        {"class": "lerobot.processor.NormalizerProcessorStep", "config": {}},
        {"class": ["foreign_steps.Step"], "config": {}},
        {"registry_name": None, "class": "foreign_steps.Step"},
        {"config": {}},
    ],
)
def test_no_other_class_is_called(
    step: dict[str, Any], marker: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint = write_checkpoint(tmp_path / "policy", "pf2mp")
    add_step(checkpoint, FILES[0], step)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="must be registered"):
        load_policy(checkpoint)
    assert not marker.exists()


@pytest.mark.parametrize("way", ["argument", "variable"])
def test_a_trusted_step_is_loaded(
    way: str, marker: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint = write_checkpoint(tmp_path / "policy", "pf2mp")
    add_step(checkpoint, FILES[0], {"class": "foreign_steps.Step", "config": {}})
    trust = ["other.Step", "foreign_steps.Step"]
    if way == "variable":
        monkeypatch.setenv(TRUST_VARIABLE, ",".join(trust))
    _, preprocessor, _ = load_policy(checkpoint, trust=trust if way == "argument" else ())
    assert type(preprocessor.steps[0]).__name__ == "Step" and marker.exists()
    if way == "argument":  # for that call alone
        with pytest.raises(ValueError, match="must be registered"):
            load_policy(checkpoint)


def test_the_processors_of_the_main_branch_are_looked_at_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """LeRobot's commands take the processors from there, whatever the revision of the policy."""
    branches = {branch: write_checkpoint(tmp_path / branch, "pf2mp") for branch in ("main", "tested")}
    add_step(branches["main"], FILES[0], {"class": "subprocess.Popen", "config": {"args": ["true"]}})
    monkeypatch.setattr(
        processor_files,
        "hf_hub_download",
        lambda _, name, revision: f"{branches[revision or 'main']}/{name}",
    )
    with pytest.raises(ValueError, match="nothing of it was imported"):
        get_policy_class("pf2mp").from_pretrained("user/policy", revision="tested")


@pytest.mark.parametrize(
    "file", ["../outside.safetensors", "/etc/passwd", "sub/x.safetensors", "..", None, 3]
)
def test_no_state_outside_the_checkpoint_is_read(file: Any, tmp_path: Path) -> None:
    checkpoint = write_checkpoint(tmp_path / "policy", "pf2mp")
    save_file({"x": torch.zeros(1)}, tmp_path / "outside.safetensors")
    change_step(checkpoint, "normalizer_processor", lambda step: step.update(state_file=file))
    with pytest.raises(ValueError, match="state_file of every step .* must be a file beside it"):
        load_policy(checkpoint)


@pytest.mark.parametrize(
    ("name", "option", "value"),
    [
        ("rename_observations_processor", "rename_map", None),
        ("rename_observations_processor", "rename_map", []),
        ("normalizer_processor", "norm_map", None),
        ("normalizer_processor", "features", None),
        ("normalizer_processor", "features", "all"),
        ("normalizer_processor", "eps", "{a: b}"),
        ("device_processor", "device", 3),
    ],
)
def test_null_where_a_step_needs_a_value_is_named(name: str, option: str, value: Any, tmp_path: Path) -> None:
    checkpoint = write_checkpoint(tmp_path / "policy", "pf2mp")
    change_step(checkpoint, name, lambda step: step["config"].update({option: value}))
    with pytest.raises(ValueError, match=rf"{option} of '{name}' in .* must be .*, got "):
        load_policy(checkpoint)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "must be JSON"),
        ("[]", "must hold a list of steps"),
        ('{"steps": null}', "must hold a list of steps"),
        ('{"steps": [1]}', "must hold a list of steps"),
        ('{"steps": [{"registry_name": "to_batch_processor", "config": []}]}', "must be a mapping"),
        (100_000 * "[", "must be JSON"),
    ],
)
def test_a_file_that_describes_no_processor_is_named(content: str, said: str, tmp_path: Path) -> None:
    checkpoint = write_checkpoint(tmp_path / "policy", "pf2mp")
    (Path(checkpoint) / FILES[1]).write_text(content)
    with pytest.raises(ValueError, match=f"{FILES[1]} {said}|every step in .*{FILES[1]} {said}"):
        load_policy(checkpoint)


@pytest.mark.parametrize("file", FILES)
def test_a_checkpoint_without_processors_points_to_the_migration(file: str, tmp_path: Path) -> None:
    checkpoint = write_checkpoint(tmp_path / "policy", "fmp")
    (Path(checkpoint) / file).unlink()
    with pytest.raises(OSError, match=f"without {file}.*migrate_policy_normalization"):
        load_policy(checkpoint)


@pytest.fixture
def demonstrations(tmp_path: Path) -> Path:
    root = tmp_path / "data"
    finished = run("pf2mp-collect", "--task=maze_umaze", "--n_episodes=2", "--n_steps=12", f"--root={root}")
    assert finished.returncode == 0, finished.stderr
    return root


COMMANDS = {
    "pf2mp-fit-field": "--policy.path={checkpoint} --dataset.repo_id=local/maze --dataset.root={data} --output_dir=out",
    "pf2mp-plot": "--figure=density --checkpoint={checkpoint} --env.type=pf2mp_maze --output=q.png",
    "pf2mp-benchmark": "--policies={{a: {checkpoint}}} --output_dir=out --n_episodes=1 --n_repeats=1",
    "pf2mp-push": "--path={checkpoint} --repo_id=you/policy",
    "pf2mp-train": "--policy.path={checkpoint} --policy.push_to_hub=false --dataset.repo_id=local/maze "
    "--dataset.root={data} --steps=1 --batch_size=2 --output_dir=out",
    "pf2mp-info": "--policy.path={checkpoint}",
    "lerobot-eval": "--policy.path={checkpoint} --env.type=pf2mp_maze --env.task=MazeUMaze-v0 --eval.n_episodes=1 "
    "--eval.batch_size=1 --output_dir=out",
    "lerobot-train": "--policy.path={checkpoint} --policy.push_to_hub=false --dataset.repo_id=local/maze "
    "--dataset.root={data} --steps=1 --batch_size=2 --num_workers=0 --output_dir=out",
}


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_refuses_foreign_steps(command: str, demonstrations: Path, tmp_path: Path) -> None:
    checkpoint = write_checkpoint(tmp_path / "policy", "pf2mp")
    add_step(checkpoint, FILES[0], {"class": "subprocess.Popen", "config": {"args": ["touch", "MARKER"]}})
    # Not by spaces: one value has them.
    options = COMMANDS[command].format(checkpoint=checkpoint, data=demonstrations).split(" --")
    finished = run(command, *[f"--{option.removeprefix('--')}" for option in options], cwd=tmp_path)
    assert finished.returncode != 0
    assert "got the class 'subprocess.Popen': nothing of it was imported" in finished.stdout + finished.stderr
    assert not (tmp_path / "MARKER").exists()
    if command.startswith("pf2mp") and command != "pf2mp-info":
        assert finished.stderr.splitlines()[-1].startswith("error: ") and "Traceback" not in finished.stderr


# Never silently unguarded.


@pytest.mark.parametrize(
    ("kind", "opened_as"),
    [("pf2mp", "fmp"), ("fmp", "pf2mp"), ("dppf", "diffusion"), ("diffusion", "dppf"), ("pf2mp", "dppf")],
)
def test_a_checkpoint_opened_as_another_type_names_the_right_one(
    kind: str, opened_as: str, tmp_path: Path
) -> None:
    checkpoint = write_checkpoint(tmp_path / "policy", kind)
    with pytest.raises(ConfigError, match=f"must be opened as a policy of type {kind}, got {opened_as}"):
        get_policy_class(opened_as).from_pretrained(checkpoint)


def test_lerobots_diffusion_policy_opens_its_own_checkpoints(tmp_path: Path) -> None:
    checkpoint = write_checkpoint(tmp_path / "policy", "diffusion")
    assert isinstance(DiffusionPolicy.from_pretrained(checkpoint), DiffusionPolicy)


@pytest.mark.parametrize("kind", ["fmp", "pf2mp", "dppf"])
def test_weights_that_lack_a_tensor_are_an_error(kind: str, tmp_path: Path) -> None:
    checkpoint = write_checkpoint(tmp_path / "policy", kind)
    weights = load_file(Path(checkpoint) / "model.safetensors")
    name = next(key for key in weights if "ema" not in key)
    del weights[name]
    save_file(weights, Path(checkpoint) / "model.safetensors")
    with pytest.raises(ValueError, match=f"must hold all weights of a {kind} policy .* got a file without"):
        load_policy(checkpoint)
