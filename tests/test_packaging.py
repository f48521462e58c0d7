# SPDX-License-Identifier: Apache-2.0
"""The distribution, as built, is found by LeRobot's plug-in discovery."""

import importlib
import importlib.util
import itertools
import re
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from pathlib import Path

import draccus
import pytest
import yaml
from lerobot.configs.train import TrainPipelineConfig
from lerobot.utils.import_utils import register_third_party_plugins
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from lerobot_pf2mp import DPPFConfig, PF2MPConfig, PF2MPFetchEnv, PF2MPHandwritingEnv, PF2MPMazeEnv
from lerobot_pf2mp.commands.benchmark import BenchmarkConfig, make_spec
from lerobot_pf2mp.envs.configs.metaworld import PF2MPMetaWorldEnv
from lerobot_pf2mp.envs.configs.so101 import PF2MPSO101Env

ROOT = Path(__file__).parents[1]

DISCOVER = """
import importlib.metadata, sys
from lerobot.utils.import_utils import register_third_party_plugins
register_third_party_plugins()
from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
import lerobot_pf2mp, gymnasium
assert "site-packages" in lerobot_pf2mp.__file__ and sys.argv[1] in lerobot_pf2mp.__file__, lerobot_pf2mp.__file__
for name in ("fmp", "pf2mp", "dppf"):
    assert get_policy_class(name).name == name
    config = PreTrainedConfig.get_choice_class(name)(device="cpu")
    make_pre_post_processors(config)
assert "pf2mp_maze" in EnvConfig.get_known_choices()
assert "lerobot_pf2mp/MazeLarge-v0" in gymnasium.registry
import lerobot_pf2mp.dataset_tools.maze.collect_maze
assert get_policy_class("guarded").name == "guarded"
print("discovered")
"""


HORIZONS = {
    "maze": 80,
    "fetch": 48,
    "handwriting": 64,
    "panda_symbol": 64,
    "metaworld": 112,
    "so101_small": 96,
    "so101_act": 48,
}
ENVS = {
    "maze": PF2MPMazeEnv,
    "fetch": PF2MPFetchEnv,
    "handwriting": PF2MPHandwritingEnv,
    "metaworld": PF2MPMetaWorldEnv,
    "so101": PF2MPSO101Env,
}


def test_distribution_name_is_one_that_lerobot_looks_for(monkeypatch: pytest.MonkeyPatch) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    looked_for: list[str] = []
    with monkeypatch.context() as patch:
        patch.setattr(importlib, "import_module", looked_for.append)
        register_third_party_plugins()
    assert project["name"] in looked_for


def test_constraints_hold_names_and_versions_only() -> None:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    assert [
        line for line in lines if not re.fullmatch(r"[a-z0-9]+([-._][a-z0-9]+)*==[0-9]+(\.[a-z0-9]+)*", line)
    ] == []
    names = [line.partition("==")[0] for line in lines]
    assert len(set(names)) == len(names)


def test_constraints_name_every_package_that_is_asked_for() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    requirements = [*project["dependencies"], *itertools.chain(*project["optional-dependencies"].values())]
    asked_for = {canonicalize_name(Requirement(text).name) for text in requirements}
    constrained = {line.partition("==")[0] for line in (ROOT / "constraints.txt").read_text().splitlines()}
    assert asked_for - constrained == {canonicalize_name(project["name"])}


def test_every_folder_of_code_is_packaged() -> None:
    tool = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    folders = {
        f"lerobot_pf2mp.{path.parent.relative_to(ROOT / top)}".replace("/", ".").removesuffix("..")
        if top == "lerobot_pf2mp"
        else ".".join(("lerobot_pf2mp", *path.parent.relative_to(ROOT).parts))
        for top in ("lerobot_pf2mp", "dataset_tools")
        for path in (ROOT / top).rglob("__init__.py")
    }
    moved = {"lerobot_pf2mp._info": "pf2mp_info"}
    assert {moved.get(folder, folder) for folder in folders} <= set(tool["packages"])


def skip_without_its_extra(env: dict) -> None:
    """Skips a test of a configuration for which something is not installed here."""
    if env.get("simulator") == "genesis" and importlib.util.find_spec("genesis") is None:
        pytest.skip("needs the extra genesis")
    if env.get("robot") == "unitree_z1":
        module = "lerobot_pf2mp.envs.handwriting.unitree_z1"
        pytest.importorskip(module, reason="needs the extra z1", exc_type=ImportError)


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted((ROOT / "eval_configs").rglob("*.yaml")), ids=lambda path: path.stem)
def test_configuration_files_are_valid(path: Path) -> None:
    content = yaml.safe_load(path.read_text())
    skip_without_its_extra(content.get("env", {}))
    assert f"--config_path={path.relative_to(ROOT)}" in path.read_text()  # the comment says how to use it
    if "metaworld" in path.stem and not path.stem.startswith("train_"):
        pytest.importorskip("metaworld", reason="needs the extra metaworld")
    if path.stem.startswith("train_"):
        config = draccus.parse(TrainPipelineConfig, path, args=[])
        (horizon,) = (steps for task, steps in HORIZONS.items() if task in path.stem)
        policy = config.policy
        assert (policy.chunk_size if policy.type == "act" else policy.horizon) == horizon
    elif "policies" in content:
        spec = make_spec(draccus.parse(BenchmarkConfig, path, args=[]))
        for changes in spec.variants.values():
            PF2MPConfig(device="cpu", **changes)
            DPPFConfig(device="cpu", **changes)
    else:
        (env,) = (env for task, env in ENVS.items() if task in path.stem)
        assert env(task=content["env"]["task"]).type == content["env"]["type"]
        overrides = {key: value for key, value in content["policy"].items() if key != "path"}
        (DPPFConfig if "dppf" in path.stem else PF2MPConfig)(device="cpu", **overrides)


@pytest.mark.slow
def test_a_fresh_interpreter_discovers_the_installed_wheel(tmp_path: Path) -> None:
    # By default the wheel is built from the source distribution, which is therefore tested too.
    subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(tmp_path), str(ROOT)],
        check=True,
        capture_output=True,
    )
    (wheel,) = tmp_path.glob("*.whl")
    fresh = tmp_path / "fresh"
    venv.create(fresh, with_pip=False)
    (site_packages,) = fresh.glob("lib/python*/site-packages")
    zipfile.ZipFile(wheel).extractall(site_packages)
    # The dependencies are this environment's; its own .pth files, and with them the editable install, are not followed.
    (site_packages / "dependencies.pth").write_text(sysconfig.get_paths()["purelib"])
    finished = subprocess.run(
        [str(fresh / "bin/python"), "-c", DISCOVER, str(fresh)],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=False,
    )
    assert finished.returncode == 0, finished.stderr
    assert "discovered" in finished.stdout
