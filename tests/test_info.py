# SPDX-License-Identifier: Apache-2.0
"""The report of pf2mp-info, in this environment and in new ones in which something is wrong."""

import importlib.util
import json
import logging
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import time
import venv
from collections.abc import Callable
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.metadata import distribution, version
from pathlib import Path

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from pf2mp_info import probes
from pf2mp_info.checkpoint import checkpoint_lines
from pf2mp_info.trials import LINES
from pf2mp_info.versions import EXTRAS, ranges
from untrained_policies import write_checkpoint

from lerobot_pf2mp.density import kernel_tree

ROOT = Path(__file__).parents[1]
BIN = Path(sys.executable).parent
SECONDS = 400
PACKAGES = (
    "lerobot_policy_pf2mp",
    "lerobot",
    "torch",
    "mujoco",
    "gymnasium",
    "gymnasium-robotics",
    "numpy",
    "mink",
    "shapely",
    "minari",
    "accelerate",
)
ESSENTIAL = ("python", *PACKAGES, "discovery", "device", "simulation")
EXTRAS_OF_OURS = ("experts", "metaworld", "async (grpc)", "so101", "peft", "wandb")
OTHERS = ("lerobot-train", "extension", "rendering", "video", *EXTRAS_OF_OURS)
# Trials that do not answer in time are as good as none, where only the rest matters.
WITHOUT_TRIALS = "--time_limit=0.001"


def run(*command: str | Path, **changes: str) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "MUJOCO_GL")}
    return subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=SECONDS,
        check=False,
        cwd="/",
        env={**environment, **changes},
    )


def lines_of(result: subprocess.CompletedProcess[str]) -> dict[str, dict[str, str]]:
    """The lines of a report in JSON, by name; the code of the command fits them."""
    report = json.loads(result.stdout)
    assert sorted(report) == ["lines", "ok"]
    assert report["ok"] == all(line["status"] != "problem" for line in report["lines"])
    assert result.returncode == (0 if report["ok"] else 1)
    assert result.stderr == ""
    assert all(sorted(line) == ["name", "remedy", "status", "value"] for line in report["lines"])
    assert all(line["remedy"] for line in report["lines"] if line["status"] != "ok")
    lines = {line["name"]: line for line in report["lines"]}
    assert len(lines) == len(report["lines"])
    return lines


@pytest.fixture
def site_packages(tmp_path: Path) -> Path:
    """Of a new environment with this one's dependencies, and with this package where a wheel would put it."""
    venv.create(tmp_path / "env", with_pip=False)
    (folder,) = (tmp_path / "env").glob("lib/python*/site-packages")
    for entry in Path(sysconfig.get_paths()["purelib"]).iterdir():
        if "pf2mp" not in entry.name and entry.suffix != ".pth":
            (folder / entry.name).symlink_to(entry)
    for name in ("lerobot_pf2mp", "lerobot_policy_pf2mp", "pf2mp_info"):
        (folder / name).symlink_to(Path(importlib.util.find_spec(name).origin).parent)
    write_metadata(folder)
    # Another plug-in that talks and fails, which is not our concern.
    write_distribution(folder, "lerobot_policy_other", "1.0")
    (folder / "lerobot_policy_other.py").write_text("print('hello')\nimport no_such_module")
    return folder


def write_distribution(site_packages: Path, name: str, version: str, text: str | None = None) -> None:
    folder = site_packages / f"{name}-{version}.dist-info"
    folder.mkdir()
    text = text or f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
    (folder / "METADATA").write_text(text)


def write_metadata(site_packages: Path, *changes: tuple[str, str]) -> None:
    installed = distribution("lerobot_policy_pf2mp")
    text = installed.read_text("METADATA") or installed.read_text("PKG-INFO")  # the latter of a source tree
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    folder = site_packages / "lerobot_policy_pf2mp-0.1.0.dist-info"
    folder.mkdir(exist_ok=True)
    (folder / "METADATA").write_text(text)


def remove(site_packages: Path, *names: str) -> None:
    """Removes packages and what is known about them."""
    for entry in site_packages.iterdir():
        if entry.name.split("-")[0] in names and entry.is_symlink():
            entry.unlink()


def info(site_packages: Path, *options: str, **changes: str) -> subprocess.CompletedProcess[str]:
    python = site_packages.parents[2] / "bin" / "python"
    return run(python, "-c", "from pf2mp_info.command import main; main()", *options, **changes)


def discovery(site_packages: Path) -> dict[str, str]:
    """The line of the discovery alone."""
    code = "import json, pf2mp_info.trials as t; print(json.dumps(vars(t.trial_line('discovery', 300))))"
    return json.loads(run(site_packages.parents[2] / "bin" / "python", "-c", code).stdout)


@pytest.mark.slow
def test_here_everything_essential_is_well() -> None:
    lines = lines_of(run(BIN / "pf2mp-info", "--json=true"))
    assert sorted(lines) == sorted([*ESSENTIAL, *OTHERS])
    assert {name: lines[name]["status"] for name in ESSENTIAL} == dict.fromkeys(ESSENTIAL, "ok")
    assert lines["python"]["value"].startswith(".".join(map(str, sys.version_info[:3])))
    assert {name: lines[name]["value"] for name in PACKAGES} == {name: version(name) for name in PACKAGES}
    policies, environments = (
        [name for name, kind in choices.items() if kind.__module__.startswith("lerobot_pf2mp.")]
        for choices in (PreTrainedConfig.get_known_choices(), EnvConfig.get_known_choices())
    )
    assert lines["discovery"]["value"] == (
        f"policies {', '.join(sorted(policies))}; environments {', '.join(sorted(environments))}"
    )
    assert lines["simulation"]["value"] == "PointMaze_UMaze-v3, FetchReach-v4"
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else ""
    assert gpu in lines["device"]["value"]
    assert lines["experts"]["value"] == f"stable-baselines3 {version('stable-baselines3')}"
    assert lines["rendering"]["value"] in ("EGL", "OSMesa", "screen")
    assert lines["video"]["value"] == f"av {version('av')}: libx264, libsvtav1"


@pytest.mark.slow
def test_without_a_screen_glfw_does_not_render_which_is_said_and_is_not_essential() -> None:
    result = run(BIN / "pf2mp-info", MUJOCO_GL="glfw")
    assert result.returncode == 0, result.stdout
    *rows, verdict = result.stdout.splitlines()
    assert verdict == "No problem found."
    assert [row.split("  ")[0] for row in rows if "  ok" not in row and "  optional: " not in row] == []
    (rendering,) = (row for row in rows if row.startswith("rendering"))
    assert "no images of Fetch and handwriting" in rendering
    assert "optional: try without MUJOCO_GL: RuntimeError: rendering without a screen needs EGL" in rendering


@pytest.mark.slow
def test_a_mujoco_that_cannot_be_imported_is_a_problem() -> None:
    lines = lines_of(run(BIN / "pf2mp-info", "--json=true", MUJOCO_GL="glue"))
    assert {name for name, line in lines.items() if line["status"] == "problem"} == {"simulation"}
    assert lines["simulation"]["value"] == "no MuJoCo"
    reason = "try without MUJOCO_GL: RuntimeError: invalid value for environment variable MUJOCO_GL: glue"
    assert lines["simulation"]["remedy"] == reason
    assert lines["rendering"]["status"] == "optional"


def break_nothing(site_packages: Path) -> None:
    pass


def break_by_not_installing(site_packages: Path) -> None:
    (site_packages / "lerobot_policy_pf2mp-0.1.0.dist-info" / "METADATA").unlink()
    (site_packages / "lerobot_policy_pf2mp-0.1.0.dist-info").rmdir()


def break_by_hyphens(site_packages: Path) -> None:
    write_metadata(site_packages, ("Name: lerobot_policy_pf2mp", "Name: lerobot-policy-pf2mp"))


def break_by_a_missing_module(site_packages: Path) -> None:
    (site_packages / "lerobot_policy_pf2mp").unlink()


def replace_package(site_packages: Path, content: str) -> None:
    (site_packages / "lerobot_pf2mp").unlink()
    (site_packages / "lerobot_pf2mp").mkdir()
    (site_packages / "lerobot_pf2mp" / "__init__.py").write_text(content)


def break_by_an_import_error(site_packages: Path) -> None:
    replace_package(site_packages, "from lerobot.configs import NoSuchName")


def break_by_a_crash(site_packages: Path) -> None:
    replace_package(site_packages, "import os\nos.abort()")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("break_it", "reason"),
    [
        (break_nothing, ""),
        (
            break_by_not_installing,
            "no distribution lerobot_policy_pf2mp in {env}: pip install . in its folder",
        ),
        (
            break_by_hyphens,
            "the distribution is called lerobot-policy-pf2mp, LeRobot looks for lerobot_policy_pf2mp, with underscores: ",
        ),
        (
            break_by_a_missing_module,
            "ModuleNotFoundError: No module named 'lerobot_policy_pf2mp': pip install --force-reinstall",
        ),
        (
            break_by_an_import_error,
            "ImportError: cannot import name 'NoSuchName' from 'lerobot.configs' (",
        ),
        (
            break_by_a_crash,
            "LeRobot's discovery does not run: ended with code -6, having said: Fatal Python error: Aborted",
        ),
    ],
    ids=["found", "not installed", "hyphens", "missing module", "import error", "crash"],
)
def test_if_lerobot_does_not_find_the_package_the_report_says_why(
    site_packages: Path, break_it: Callable[[Path], None], reason: str
) -> None:
    break_it(site_packages)
    line = discovery(site_packages)
    assert line["status"] == ("problem" if reason else "ok")
    assert line["remedy"].startswith(reason.format(env=site_packages.parents[2]))
    assert "no_such_module" not in line["remedy"]


@pytest.mark.slow
def test_without_lerobot_torch_and_draccus_the_report_is_complete_nevertheless(site_packages: Path) -> None:
    remove(site_packages, "lerobot", "torch", "draccus", "packaging", "av", "stable_baselines3")
    lines = lines_of(info(site_packages, "--json=true"))
    assert sorted(lines) == sorted([*ESSENTIAL, *OTHERS, "version ranges"])
    problems = {name: line["remedy"] for name, line in lines.items() if line["status"] == "problem"}
    assert problems == {
        "version ranges": "ModuleNotFoundError: No module named 'packaging'",
        "lerobot": 'pip install "lerobot"',
        "torch": 'pip install "torch"',
        "discovery": "LeRobot's discovery does not run: ModuleNotFoundError: No module named 'lerobot'",
        "device": "ModuleNotFoundError: No module named 'torch': install a torch that runs here "
        "(pytorch.org/get-started/locally)",
        "simulation": "ModuleNotFoundError: No module named 'packaging'",
    }
    assert lines["video"]["status"] == "optional"
    assert lines["video"]["remedy"].startswith("ModuleNotFoundError: No module named 'av': pip install ")
    assert lines["experts"] == {
        "name": "experts",
        "value": "no stable-baselines3",
        "status": "optional",
        "remedy": 'pip install "lerobot_policy_pf2mp[experts]"',
    }
    assert lines["numpy"]["status"] == "ok"


@pytest.mark.slow
def test_versions_outside_of_what_is_asked_for_are_problems(site_packages: Path) -> None:
    write_metadata(site_packages, ("Requires-Python: >=3.12", "Requires-Python: >=3.99"))
    lerobot = distribution("lerobot").read_text("METADATA").replace("Version: 0.6.1", "Version: 0.7.0")
    remove(site_packages, "mujoco", "lerobot", "accelerate", "numpy", "mink", "shapely", "stable_baselines3")
    write_distribution(site_packages, "lerobot", "0.7.0", lerobot)
    write_distribution(site_packages, "mujoco", "3.12.0")
    write_distribution(site_packages, "numpy", "2.3.0")
    write_distribution(site_packages, "accelerate", "1.13.9")
    write_distribution(site_packages, "shapely", "3.0.dev1")
    write_distribution(site_packages, "stable_baselines3", "3.0.0")
    lines = lines_of(info(site_packages, "--json=true", WITHOUT_TRIALS))
    found = {
        name: (line["value"], line["remedy"]) for name, line in lines.items() if line["status"] == "problem"
    }
    assert found.pop("python")[1] == "must be >=3.12,>=3.99: install into an environment of such a Python"
    assert found.pop("discovery")[1].endswith("no answer within 0.001 s (--time_limit)")
    assert found.pop("device")[1].startswith("no answer within 0.001 s (--time_limit)")
    assert found.pop("simulation") == ("no MuJoCo", "no answer within 0.001 s (--time_limit)")
    assert found == {
        "mujoco": ("3.12.0", 'pip install "mujoco<3.12,>=3.3"'),
        "lerobot": ("0.7.0", 'pip install "lerobot<0.7,>=0.6.1"'),
        "numpy": ("2.3.0", 'pip install "numpy<2.3.0,>=2.0.0"'),  # LeRobot asks for it
        # LeRobot asks for this with an extra of an extra.
        "accelerate": ("1.13.9", 'pip install "accelerate<2.0.0,>=1.14.0"'),
        "mink": ("not installed", 'pip install "mink>=1.1"'),
    }
    assert (lines["experts"]["value"], lines["experts"]["status"]) == ("stable-baselines3 3.0.0", "optional")


def test_the_extras_that_are_recommended_ask_for_their_packages() -> None:
    wanted = ranges()
    assert [package for package, _, _ in EXTRAS.values() if not wanted.get(package)] == []


REBUILD = "pip install --force-reinstall --no-deps . in its folder"
BUILD = f"install a C compiler, then {REBUILD}"
NO_GPU = {"cores": 2, "gpus": [], "mps": False, "said": ""}
ENCODERS = {"libx264": "", "libsvtav1": "UnknownCodecError: libsvtav1"}


@pytest.mark.parametrize(
    ("trial", "answer", "line"),
    [
        ("device", NO_GPU, ("CPU, 2 cores", "ok", "")),
        ("device", {**NO_GPU, "mps": True}, ("MPS", "ok", "")),
        (
            "device",
            {**NO_GPU, "gpus": [["NVIDIA H200", 150 * 10**9], ["NVIDIA L4", 24 * 2**30]]},
            ("CUDA, NVIDIA H200 with 140 GiB, NVIDIA L4 with 24 GiB", "ok", ""),
        ),
        (
            "device",
            {**NO_GPU, "said": "The NVIDIA driver on your system is too old"},
            ("CPU, 2 cores", "optional", "the GPU is not used: The NVIDIA driver on your system is too old"),
        ),
        (
            "video",
            {"av": "15.1.0", "encoders": ENCODERS},
            (
                "av 15.1.0: libx264, no libsvtav1",
                "optional",
                "UnknownCodecError: libsvtav1: pip install --force-reinstall --no-deps av==15.1.0",
            ),
        ),
        (
            "simulation",
            {"errors": {"A": "", "B": "AssertionError"}},
            ("A, no B", "problem", "AssertionError"),
        ),
        ("rendering", {"backend": "osmesa"}, ("OSMesa", "ok", "")),
        ("extension", {"is_built": True, "is_current": True}, ("compiled", "ok", "")),
        (
            "extension",
            {"is_built": True, "is_current": False},
            ("compiled from older sources", "optional", REBUILD),
        ),
        (
            "extension",
            {"is_built": False, "is_current": True},
            ("not built", "optional", f"fields are slower on a CPU: {BUILD}"),
        ),
        (
            "extension",
            {"error": "ImportError: no"},
            ("cannot be loaded", "optional", f"ImportError: no: fields are slower on a CPU: {BUILD}"),
        ),
    ],
)
def test_what_answers_mean_that_this_machine_may_not_give(
    monkeypatch: pytest.MonkeyPatch, trial: str, answer: dict, line: tuple[str, str, str]
) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    made = LINES[trial](answer)
    assert (made.name, made.value, made.status, made.remedy) == (trial, *line)


@pytest.mark.skipif(not kernel_tree.is_available(), reason="the C extension could not be built")
@pytest.mark.parametrize("change", ["none", "another interface", "sources changed since", "no sources"])
def test_an_extension_of_other_sources_is_told(
    change: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(Path(kernel_tree.__file__).parent, tmp_path / "density")
    python, c = (tmp_path / "density" / name for name in ("kernel_tree.py", "_kernel_tree.c"))
    (built,) = (
        path for path in c.parent.glob("_kernel_tree.*") if path.name.endswith(tuple(EXTENSION_SUFFIXES))
    )
    age = 10 if change == "sources changed since" else -10  # [s]
    c.touch()  # a wheel has none
    os.utime(c, (time.time(), built.stat().st_mtime + age))
    if change == "another interface":
        python.write_text(python.read_text().replace("_INTERFACE = ", "_INTERFACE = 1"))
    if change == "no sources":
        c.unlink()
    monkeypatch.setattr(probes, "_package_folder", lambda: tmp_path)
    assert probes.extension() == {"is_built": True, "is_current": change in ("none", "no sources")}


@pytest.mark.slow
def test_unreadable_metadata_cost_one_line_each(site_packages: Path) -> None:
    remove(site_packages, "mink")
    write_distribution(site_packages, "mink", "newest")
    lines = lines_of(info(site_packages, "--json=true", WITHOUT_TRIALS))
    assert sorted(lines) == sorted([*ESSENTIAL, *OTHERS])
    assert (lines["mink"]["value"], lines["mink"]["status"]) == ("not known", "problem")
    assert lines["mujoco"] == {"name": "mujoco", "value": version("mujoco"), "status": "ok", "remedy": ""}

    write_metadata(site_packages, ("Requires-Dist: mink>=1.1", "Requires-Dist: mink of some age"))
    lines = lines_of(info(site_packages, "--json=true", WITHOUT_TRIALS))
    assert sorted(lines) == sorted([*ESSENTIAL, *OTHERS, "version ranges"])
    assert (lines["version ranges"]["value"], lines["version ranges"]["status"]) == ("not checked", "problem")
    assert lines["version ranges"]["remedy"].startswith("InvalidRequirement: ")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "value", "status"),
    [
        ("#!{env}/bin/python\n", "of this environment", "ok"),
        ("#!/elsewhere/bin/python3.12\n", "the one in PATH runs /elsewhere/bin/python3.12", "optional"),
        ("#!/usr/bin/env bash\n", "of this environment", "ok"),
        (None, "not in PATH", "optional"),
    ],
)
def test_a_lerobot_train_of_another_environment_is_noticed(
    tmp_path: Path, site_packages: Path, content: str | None, value: str, status: str
) -> None:
    env = site_packages.parents[2]
    (tmp_path / "path").mkdir()
    if content is not None:
        (tmp_path / "path" / "lerobot-train").write_text(content.format(env=env))
        (tmp_path / "path" / "lerobot-train").chmod(0o755)
    line = lines_of(info(site_packages, "--json=true", WITHOUT_TRIALS, PATH=str(tmp_path / "path")))[
        "lerobot-train"
    ]
    assert (line["value"], line["status"]) == (value, status)
    assert (f"{env}/bin/lerobot-train" in line["remedy"]) == (status == "optional")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--json=perhaps", "error: `json`: Couldn't parse 'perhaps' into a bool"),
        ("--time_limit=0", "error: time_limit must be finite and above 0 [s], got 0"),
        ("--time_limit=nan", "error: time_limit must be finite and above 0 [s], got nan"),
        ("--time_limit=inf", "error: time_limit must be finite and above 0 [s], got inf"),
    ],
)
def test_bad_values_end_in_one_line(option: str, message: str) -> None:
    result = run(BIN / "pf2mp-info", option)
    assert (result.returncode, result.stdout, result.stderr.strip()) == (1, "", message)


@pytest.mark.slow
def test_help_of_info_shows_examples_units_and_defaults() -> None:
    result = run(BIN / "pf2mp-info", "--help")
    assert (result.returncode, result.stderr) == (0, "")
    words = " ".join(result.stdout.split())
    for fact in (
        "Examples: pf2mp-info",
        "Largest duration of each trial [s]. (default: 120.0)",
        "for issue reports",
        "The exit code is 0",
    ):
        assert fact in words


def of_checkpoint(checkpoint: Path) -> dict[str, tuple[str, str]]:
    level = logging.root.manager.disable
    try:
        return {
            line.name: (line.value, line.status + line.remedy) for line in checkpoint_lines(str(checkpoint))
        }
    finally:
        logging.disable(level)


def test_of_a_checkpoint_the_report_says_how_its_plans_are_checked(tmp_path: Path) -> None:
    lines = of_checkpoint(Path(write_checkpoint(tmp_path, "pf2mp")))
    assert lines["policy"] == ("pf2mp, chunks of 4 actions", "ok")
    assert re.match(
        r"\d+ anchors of \d+ episodes in 2 dimensions, h = \S+, safe set: log density", lines["field"][0]
    )
    assert lines["guidance"][0] == "proximal, lambda = 0.8, unsupported, quantile 0.95"
    value, status = lines["plans"]
    assert re.match(
        r"log density on the way above \S+, calibrated on \d+ demonstrated plans; at most \S+ % false", value
    )
    assert status == "ok" and value.endswith("up to 8 drawn, on_unsupported=ignore")


def test_of_a_checkpoint_of_before_the_report_says_that_its_plans_are_not_checked() -> None:
    lines = of_checkpoint(Path(__file__).parent / "checkpoints/pf2mp")
    value, status = lines["plans"]
    assert value == "not checked" and status.startswith("optional") and "pf2mp-fit-field" in status


def test_a_checkpoint_that_cannot_be_loaded_is_a_problem_in_one_line(tmp_path: Path) -> None:
    ((value, status),) = of_checkpoint(tmp_path / "nothing").values()
    assert value == "cannot be loaded" and status.startswith("problem") and "\n" not in status
