# SPDX-License-Identifier: Apache-2.0
"""What importing the package registers, in which order ever, and what it does not import."""

import subprocess
import sys

import pytest

# What a program imports first, in the notation of `pkgutil.resolve_name`.
FIRST = (
    ("lerobot_pf2mp",),
    ("lerobot", "lerobot_pf2mp"),
    ("lerobot.policies", "gymnasium", "lerobot_pf2mp"),
    ("lerobot_policy_pf2mp",),
    ("lerobot_pf2mp:FMPConfig",),
    # Modules that register, as the first of all: the import of LeRobot in them must not meet them half imported.
    ("lerobot_pf2mp.envs.configs.collision_env",),
    ("lerobot_pf2mp.policies.fmp.fused_adamw",),
    ("lerobot_pf2mp.policies.fmp.modeling_fmp",),
    ("lerobot_pf2mp.policies.guided.potential_field_step",),
)
# Each case is a fork of a process that has imported what takes long, but none of the packages that register.
EACH_FIRST = f"""
import os, pkgutil, sys, traceback
import datasets, diffusers, torch

def check_registrations():
    from lerobot.configs import PreTrainedConfig
    from lerobot.envs.configs import EnvConfig
    from lerobot.optim import OptimizerConfig
    from lerobot.processor import ProcessorStepRegistry
    import gymnasium
    assert {{"fmp", "pf2mp", "dppf"}} <= set(PreTrainedConfig.get_known_choices())
    ours = {{"pf2mp_maze", "pf2mp_fetch", "pf2mp_handwriting", "pf2mp_metaworld", "pf2mp_so101"}}
    assert ours <= set(EnvConfig.get_known_choices())
    assert "fused_adamw" in OptimizerConfig.get_known_choices()
    assert "potential_field" in ProcessorStepRegistry.list()
    assert len([name for name in gymnasium.registry if name.startswith("lerobot_pf2mp/")]) == 12

assert not {{"lerobot", "lerobot_pf2mp", "gymnasium"}} & set(sys.modules)
for first in {FIRST!r}:
    pid = os.fork()
    if not pid:
        try:
            for name in first:
                pkgutil.resolve_name(name)
            check_registrations()
            os._exit(0)
        except BaseException:
            traceback.print_exc()
            sys.stderr.flush()
            os._exit(1)
    print(*first, os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
"""


def run(code: str, *options: str) -> str:
    """What a new process prints that runs this code, without the current folder in its path."""
    finished = subprocess.run(
        [sys.executable, "-P", *options, "-c", code], capture_output=True, text=True, timeout=120, check=False
    )
    assert finished.returncode == 0, finished.stderr
    return finished.stdout


@pytest.mark.slow
def test_everything_is_registered_whatever_is_imported_first() -> None:
    assert run(EACH_FIRST).splitlines() == [" ".join([*first, "0"]) for first in FIRST]


def test_the_maths_needs_torch_alone() -> None:
    code = """
import sys, torch
before = set(sys.modules)
from lerobot_pf2mp import flow_matching, guidance, potential_field
print(*sorted({name.partition(".")[0] for name in set(sys.modules) - before}))
"""
    # torch brings numpy; it has not imported all of it.
    assert set(run(code).split()) <= {"lerobot_pf2mp", "numpy"}


def test_importing_the_package_imports_neither_lerobot_nor_torch() -> None:
    code = """
import sys, lerobot_pf2mp
assert not {"lerobot", "torch", "gymnasium", "numpy"} & set(sys.modules)
assert {"load_policy", "PF2MPConfig"} <= set(dir(lerobot_pf2mp))
try:
    lerobot_pf2mp.load_polcy
except AttributeError as error:
    print(error)
"""
    assert run(code).strip() == "module 'lerobot_pf2mp' has no attribute 'load_polcy'"


@pytest.mark.slow
def test_a_package_that_is_registered_again_breaks_nothing() -> None:
    code = """
import importlib, sys, lerobot_pf2mp
importlib.reload(lerobot_pf2mp)
import lerobot, gymnasium
importlib.reload(lerobot_pf2mp)
from lerobot.configs import PreTrainedConfig
assert {"fmp", "pf2mp", "dppf"} <= set(PreTrainedConfig.get_known_choices())
assert "lerobot_pf2mp/MazeLarge-v0" in gymnasium.registry
assert not [finder for finder in sys.meta_path if type(finder).__module__.startswith("lerobot_pf2mp")]
print("done")
"""
    assert run(code, "-Werror::UserWarning:gymnasium").strip() == "done"


@pytest.mark.slow
def test_a_registration_that_fails_is_tried_again_and_never_silent() -> None:
    code = """
import sys, lerobot_pf2mp
from lerobot_pf2mp._autodiscover import registration
sys.modules["lerobot_pf2mp.policies.dppf.configuration_dppf"] = None  # importing it is an error
for attempt in range(2):
    try:
        import lerobot
    except ImportError as error:
        print(type(error).__name__)
del sys.modules["lerobot_pf2mp.policies.dppf.configuration_dppf"]
import lerobot
from lerobot.configs import PreTrainedConfig
assert {"fmp", "pf2mp", "dppf"} <= set(PreTrainedConfig.get_known_choices())
print("done")
"""
    assert run(code).split() == ["ModuleNotFoundError", "ModuleNotFoundError", "done"]


@pytest.mark.slow
def test_threads_that_use_different_names_first_wait_for_each_other() -> None:
    code = """
import lerobot_pf2mp
from concurrent.futures import ThreadPoolExecutor
with ThreadPoolExecutor(4) as pool:
    names = ["load_policy", "PF2MPConfig", "PF2MPMazeEnv", "PotentialFieldProcessorStep"]
    print(*[found.__name__ for found in pool.map(lambda name: getattr(lerobot_pf2mp, name), names)])
"""
    assert run(code).split() == ["load_policy", "PF2MPConfig", "PF2MPMazeEnv", "PotentialFieldProcessorStep"]


@pytest.mark.slow
def test_a_look_for_lerobot_leaves_it_as_it_is() -> None:
    code = """
import importlib.util, sys, lerobot_pf2mp
finders = list(sys.meta_path)
spec = importlib.util.find_spec("lerobot")
assert spec.origin.endswith("__init__.py") and "lerobot" not in sys.modules
assert sys.meta_path == finders
import lerobot
assert lerobot.__spec__.loader is lerobot.__loader__ and type(lerobot.__loader__).__name__ == "SourceFileLoader"
assert sys.meta_path != finders
print(lerobot.__version__)
"""
    assert run(code).startswith("0.6.")


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("pf2mp-info --version", "pf2mp-info 0."),
        ("pf2mp-train --version", "pf2mp-train 0."),
        ("pf2mp-collect --n_episode=3", "unrecognized arguments: --n_episode=3"),
        ("pf2mp-push", "error: --path must be given"),
        ("pf2mp-fit-field", "error: --policy.path must be given"),
        ("pf2mp-train-expert", "error: --output_dir must be given"),
        ("pf2mp-convert", "error: --source.path must name the recording, got none"),
        ("pf2mp-train --in_memory_limit_gb=much", "must be a number [GB], got 'much'"),
        ("pf2mp-collect --task=maze_largest", "task must be one of"),
    ],
)
def test_an_answer_that_needs_no_lerobot_does_not_wait_for_it(command: str, message: str) -> None:
    name, *arguments = command.split()
    code = f"""
import sys
from importlib.metadata import entry_points
sys.modules["lerobot"] = None  # importing it is an error
sys.modules["torch"] = None
sys.argv = ["{name}", *{arguments!r}]
(script,) = entry_points(group="console_scripts", name="{name}")
script.load()()
"""
    finished = subprocess.run(
        [sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    said = finished.stdout + finished.stderr
    assert message in said
    assert "Traceback" not in said
    assert finished.returncode == (
        0 if command.endswith("--version") else 2 if "unrecognized" in message else 1
    )
