# SPDX-License-Identifier: Apache-2.0
"""What the plug-in adds to how long LeRobot takes to start, and the maths to how long torch takes, in fresh processes.

``import lerobot`` alone imports next to nothing, not even torch. To register a policy its configuration must be imported,
and with it ``lerobot.policies``: torch, diffusers and all of LeRobot's own policies. That is the difference in the first
case; the second has them on both sides, as has every command of LeRobot that uses a policy. The maths needs neither.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from statistics import median

from harness import Row, ratio, time_in_turns

N_ROUNDS = 5
TARGET_SECONDS, TARGET_RATIO = 0.2, 1.05
MATHS_TARGET_SECONDS = 0.3
PLUGIN = "lerobot_policy_pf2mp"
MATHS = "from lerobot_pf2mp import flow_matching, guidance, potential_field"
POLICIES = "import lerobot.policies, lerobot.envs, lerobot.processor"

# LeRobot imports every installed distribution whose name begins with lerobot_policy_.
_HELP = f"""
import importlib.metadata, sys
found = importlib.metadata.distributions
importlib.metadata.distributions = lambda: (d for d in found() if d.metadata["Name"] not in {{hidden}})
from lerobot.scripts.lerobot_eval import main
sys.argv = ["lerobot-eval", "--help"]
try:
    main()
finally:
    assert ("{PLUGIN}" in sys.modules) != ("{PLUGIN}" in {{hidden}})
"""


def measure() -> Iterator[Row]:
    """The rows of this part."""
    imports = {
        "lerobot": "import lerobot",
        "lerobot and plug-in": "import lerobot, lerobot_pf2mp",
        "policies": POLICIES,
        "policies and plug-in": f"{POLICIES}, lerobot_pf2mp",
        "torch": "import torch",
        "torch and maths": f"import torch; {MATHS}",
    }
    times = _time(imports)
    for bare, case in (("lerobot", "import lerobot"), ("policies", POLICIES)):
        yield Row("startup", case, "takes", median(times[bare]), "s")
        added = [one - other for one, other in zip(times[f"{bare} and plug-in"], times[bare], strict=True)]
        yield Row("startup", case, "import lerobot_pf2mp adds", median(added), "s", target=TARGET_SECONDS)
    added = [one - other for one, other in zip(times["torch and maths"], times["torch"], strict=True)]
    yield Row("startup", "import torch", "takes", median(times["torch"]), "s")
    yield Row("startup", "import torch", "the maths adds", median(added), "s", target=MATHS_TARGET_SECONDS)
    hidden, shown = "without the plug-in", "with the plug-in"
    times = _time({hidden: _HELP.format(hidden=[PLUGIN]), shown: _HELP.format(hidden=[])})
    for name, seconds in times.items():
        yield Row("startup", "lerobot-eval --help", name, median(seconds), "s")
    value = ratio(times, shown, hidden)
    yield Row("startup", "lerobot-eval --help", f"{shown} / {hidden}", value, "x", target=TARGET_RATIO)


def _time(programs: dict[str, str]) -> dict[str, list[float]]:
    return time_in_turns({name: _runner(program) for name, program in programs.items()}, N_ROUNDS)


def _runner(program: str) -> Callable[[], object]:
    def run() -> object:
        finished = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, check=False
        )
        if finished.returncode:
            raise RuntimeError(f"a measured program failed:\n{program}\n{finished.stderr[-2000:]}")
        return finished

    return run
