# SPDX-License-Identifier: Apache-2.0
"""Options arrive as they were typed, and whatever is wrong with them is one line."""

from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from draccus.utils import ParsingError
from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig

from lerobot_pf2mp import PF2MPConfig, PF2MPMazeEnv
from lerobot_pf2mp.commands.options import parse, read_option

# A million values, by lists of ten times the list before.
ALIASES = "a: &a [1,1,1,1,1,1,1,1,1,1]\n" + "".join(
    f"{after}: &{after} [{','.join(10 * ['*' + before])}]\n" for before, after in pairwise("abcdef")
)


@dataclass
class Inner:
    root: Path | None = None
    size: tuple[float, float] | None = None
    offsets: list[float] = field(default_factory=list)


@dataclass
class Options:
    name: str = "maze"
    root: Path | None = None
    rule: float | str = "scott"
    results: list[Path] = field(default_factory=list)
    policies: dict[str, str] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    inner: Inner = field(default_factory=Inner)
    n_steps: int = 3
    seed: int = 0
    overwrite: bool = False


@dataclass
class OptionsWithChoices(Options):
    env: EnvConfig = field(default_factory=PF2MPMazeEnv)
    policy: PreTrainedConfig | None = None


@pytest.mark.parametrize(
    "typed",
    [
        "data/maze #2",
        "#####/#OOG#/#####",
        "2026-01-01",
        "~",
        "[data]",
        "{a: b}",
        "yes",
        "08",
        "1.10",
        "1e3",
        "!x",
        "include me",
        "include /etc/hostname",
        "a: b",
        "*a",
        "it's",
        '"quoted"',
        "None",
        " leading",
        "ünï 'c\\o\"de",
    ],
)
@pytest.mark.parametrize("option", ["name", "root", "inner.root"])
def test_texts_and_paths_arrive_as_they_were_typed(option: str, typed: str) -> None:
    found: Any = parse(Options, [f"--{option}={typed}"])
    for name in option.split("."):
        found = getattr(found, name)
    assert str(found) == str(type(found)(typed))
    assert isinstance(found, str if option == "name" else Path)
    for chosen in ("env.task", "policy.repo_id", "env.type"):
        assert read_option(OptionsWithChoices, chosen, typed) == typed


def test_null_is_nothing_only_where_nothing_is_allowed() -> None:
    assert parse(Options, ["--root=null"]).root is None
    assert parse(Options, ["--name=null"]).name == "null"


def test_other_values_are_yaml() -> None:
    args = ["--rule=0.5", "--results=[a, 2026-01-01, 08]", "--policies={a: 1.10, b: x/y}", "--overwrite=true"]
    found = parse(Options, [*args, "--inner.size=[1, 2.5]", "--options={n: 3, deep: {open: true}}"])
    assert found.rule == 0.5 and parse(Options, ["--rule=silverman"]).rule == "silverman"
    assert found.results == [Path("a"), Path("2026-01-01"), Path("08")]
    assert found.policies == {"a": "1.10", "b": "x/y"}
    assert found.overwrite is True and found.inner.size == (1.0, 2.5)
    assert found.options == {"n": 3, "deep": {"open": True}}
    assert parse(Options, ["--options={day: 2026-01-01}"]).options == {"day": "2026-01-01"}
    assert parse(Options, ["--options={n: null, deep: {open: null}}"]).options == {
        "n": None,
        "deep": {"open": None},
    }


def test_options_of_the_chosen_environment_and_policy_are_read() -> None:
    args = ["--policy.type=pf2mp", "--policy.guidance_integrator=euler", "--policy.n_action_steps=7"]
    found = parse(OptionsWithChoices, [*args, "--env.type=pf2mp_maze", "--env.task=MazeMedium-v0"])
    assert isinstance(found.policy, PF2MPConfig) and found.policy.guidance_integrator == "euler"
    assert found.policy.n_action_steps == 7 and found.env.task == "MazeMedium-v0"


def test_texts_in_a_file_arrive_as_they_were_written(tmp_path: Path) -> None:
    file = tmp_path / "options.yaml"
    file.write_text(
        "name: 1.10\nroot: 2026-01-01\nresults: [08, yes]\npolicies: {a: 1e3}\ninner: {root: ~}\nn_steps: 5\n"
        "seed: 4\n"
    )
    found = parse(Options, [f"--config_path={file}", "--seed=9"])
    assert (found.name, found.root, found.policies) == ("1.10", Path("2026-01-01"), {"a": "1e3"})
    assert found.results == [Path("08"), Path("yes")]
    assert found.inner.root is None and found.n_steps == 5
    assert found.seed == 9  # the command line comes first


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("options.json", '{"n_steps": 5}'),
        ("options.toml", "n_steps = 5"),
        ("bom.yaml", "\ufeffn_steps: 5"),
        ("bom.json", '\ufeff{"n_steps": 5}'),
        ("bom.toml", "\ufeffn_steps = 5"),
    ],
)
def test_files_of_other_kinds_are_read(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    assert parse(Options, [f"--config_path={tmp_path / name}"]).n_steps == 5


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "must hold options by name, for example 'seed: 1', got nothing"),
        ("- a\n", "got a list"),
        ("hello", "got 'hello'"),
        ("1: 2", "got other keys"),
        ("a: !include /etc/hostname", "line 1: could not determine a constructor for the tag '!include'"),
        (
            "seed: 1\nname: !!python/object/apply:os.system ['id']",
            "line 2: could not determine a constructor",
        ),
        ("seed: [1", "line 1: "),
        ("nothing: 1", "The fields `nothing` are not valid for"),
        ("inner: {nothing: 1}", "`inner`: The fields `nothing` are not valid for"),
        ("seed: null", "seed must be int, got null"),
        ("inner: {size: [1, null]}", r"inner.size\[1\] must be float, got null"),
        ("seed: " + 100_000 * "[", "cannot be read"),
        ("name: " + 1_000_000 * "x", "must be smaller than 1 MB, got 1000006 bytes"),
        (ALIASES, "at most 100000 values"),
        ("\x00", "cannot be read"),
    ],
)
def test_a_file_that_is_no_configuration_is_named(text: str, said: str, tmp_path: Path) -> None:
    file = tmp_path / "options.yaml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ParsingError, match=said) as raised:
        parse(Options, [f"--config_path={file}"])
    assert "got null" in said or str(file) in str(raised.value)


def test_an_error_of_the_command_line_does_not_name_the_file(tmp_path: Path) -> None:
    file = tmp_path / "options.yaml"
    file.write_text("seed: 1")
    with pytest.raises(ParsingError, match="`seed`: Couldn't parse 'x' into an int") as raised:
        parse(Options, [f"--config_path={file}", "--seed=x"])
    assert str(file) not in str(raised.value)


def test_a_file_that_does_not_exist_or_is_no_file_is_named(tmp_path: Path) -> None:
    for path in (tmp_path / "missing.yaml", tmp_path):
        with pytest.raises(OSError, match=f"the configuration {path} cannot be read: "):
            parse(Options, [f"--config_path={path}"])


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("--seed=null", "seed must be int, got null"),
        ("--seed=!x", "--seed must be plain YAML, got '!x': line 1"),
        ("--options=!!python/object/apply:os.system ['id']", "--options must be plain YAML"),
        ("--seed=[", "--seed must be plain YAML, got '\\['"),
        ("--inner.offsets=[null, 0]", r"inner.offsets\[0\] must be float, got null"),
        ("--policies={a:b/c}", "policies.a:b/c must be str, got null"),
        ("--n_steps=1000000000", "n_steps must be at most 100000, got 1e[+]09"),
        ("--n_steps=1e9", "`n_steps`: Couldn't parse '1e9' into an int"),
    ],
)
def test_a_bad_value_is_one_clear_error(option: str, said: str) -> None:
    with pytest.raises(ParsingError, match=said):
        parse(Options, [option])
