# SPDX-License-Identifier: Apache-2.0
"""Probes: checks that try something out. Each runs in its own process, because it may crash.

Usage: python probes.py NAME. Writes the answer as JSON, {"error": REASON} if there is none.
"""

from __future__ import annotations

import importlib.util
import io
import json
import logging
import os
import re
import shutil
import sys
import warnings
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.metadata import distributions
from pathlib import Path
from types import ModuleType
from typing import Any

DISTRIBUTION = "lerobot_policy_pf2mp"
PACKAGE = "lerobot_pf2mp"
EXTENSION = "_kernel_tree"

_BALL = "<mujoco><worldbody><light pos='0 0 3'/><geom size='1'/></worldbody></mujoco>"
_SIMULATIONS = ("PointMaze_UMaze-v3", "FetchReach-v4")
_SIDE = 64  # side of the images [pixels]
_LONGEST = 300  # longest message of an error [characters]


def message_of(error: BaseException, longest: int = _LONGEST) -> str:
    """The type and message of an error, in one line of limited length."""
    words = " ".join([type(error).__name__ + ":" * bool(str(error)), *str(error).split()])
    return words if len(words) <= longest else words[: longest - 3] + "..."


def discovery() -> dict[str, Any]:
    """Our policies and environments that LeRobot's commands find, and the errors if they find none."""
    from lerobot.utils.import_utils import register_third_party_plugins

    reasons = []

    class Reasons(logging.Handler):
        """Keeps the errors of our import. LeRobot only logs them and continues without this package."""

        def emit(self, record: logging.LogRecord) -> None:
            """Called for each message."""
            if record.exc_info and record.exc_info[1] and record.args == (DISTRIBUTION,):
                reasons.append(message_of(record.exc_info[1]))

    logging.getLogger().addHandler(Reasons())
    register_third_party_plugins()

    from lerobot.configs import PreTrainedConfig
    from lerobot.envs.configs import EnvConfig

    return {
        "distributions": [name for name in map(_name_of, distributions()) if _is_ours(name)],
        "reasons": reasons,
        "policies": _ours(PreTrainedConfig.get_known_choices()),
        "environments": _ours(EnvConfig.get_known_choices()),
    }


def device() -> dict[str, Any]:
    """The devices on which torch computes."""
    import torch

    answer: dict[str, Any] = {"cores": _n_cores(), "gpus": [], "said": "", "mps": False}
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        has_gpu = torch.cuda.is_available()
    answer["said"] = " ".join(" ".join(str(warning.message).split()) for warning in said)
    if has_gpu:
        float(torch.ones(2, device="cuda").sum())
        for number in range(torch.cuda.device_count()):
            properties = torch.cuda.get_device_properties(number)
            answer["gpus"].append([properties.name, properties.total_memory])
    elif torch.backends.mps.is_available():
        float(torch.ones(2, device="mps").sum())
        answer["mps"] = True
    elif torch.version.cuda is None and shutil.which("nvidia-smi"):
        answer["said"] = f"torch {torch.__version__} is built without CUDA"
    return answer


def simulation() -> dict[str, Any]:
    """The errors, by name, of the simulations on which our environments are built; an empty text without an error."""
    import gymnasium
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    errors = {}
    for name in _SIMULATIONS:
        try:
            env = gymnasium.make(name)
            env.reset(seed=0)
            env.step(env.action_space.sample())
            env.close()
            errors[name] = ""
        except Exception as error:
            errors[name] = message_of(error)
    return {"errors": errors}


def rendering() -> dict[str, Any]:
    """The backend with which MuJoCo renders. An image is rendered for it as in our environments."""
    with _headless().rendering():
        import mujoco
        from gymnasium.envs.mujoco.mujoco_rendering import OffScreenViewer

        model = mujoco.MjModel.from_xml_string(_BALL)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        viewer = OffScreenViewer(model, data, _SIDE, _SIDE)
        image = viewer.render("rgb_array")
        if image.min() == image.max():
            raise RuntimeError("the image of a ball is empty")
    return {"backend": viewer.backend}


def video() -> dict[str, Any]:
    """The errors of the two video encoders that LeRobot uses: for evaluation videos, and for datasets with images."""
    import av
    import numpy as np

    answer: dict[str, Any] = {"av": av.__version__, "encoders": {}}
    for encoder in ("libx264", "libsvtav1"):
        try:
            with av.open(io.BytesIO(), "w", format="mp4") as file:
                stream: Any = file.add_stream(encoder, rate=10)
                stream.width, stream.height, stream.pix_fmt = _SIDE, _SIDE, "yuv420p"
                image = av.VideoFrame.from_ndarray(np.zeros((_SIDE, _SIDE, 3), np.uint8), format="rgb24")
                for packet in [*stream.encode(image), *stream.encode()]:
                    file.mux(packet)
            answer["encoders"][encoder] = ""
        except Exception as error:
            answer["encoders"][encoder] = message_of(error)
    return answer


def extension() -> dict[str, Any]:
    """Whether the C extension has been built, and from these sources. One that cannot be loaded is an error."""
    folder = _package_folder() / "density"
    files = [folder / f"{EXTENSION}{suffix}" for suffix in EXTENSION_SUFFIXES]
    built = [file for file in files if file.exists()]
    is_current = True
    for file in built[:1]:
        interface = getattr(_module_from(file, EXTENSION), "INTERFACE", None)
        is_current = interface == _needed_interface(folder) and not _is_newer(folder / f"{EXTENSION}.c", file)
    return {"is_built": bool(built), "is_current": is_current}


PROBES = {probe.__name__: probe for probe in (discovery, device, extension, simulation, rendering, video)}


def _ours(choices: dict[str, type]) -> list[str]:
    return sorted(name for name, choice in choices.items() if choice.__module__.split(".")[0] == PACKAGE)


def _name_of(distribution: Any) -> str:
    return distribution.metadata.get("Name") or ""


def _is_ours(name: str) -> bool:
    return re.sub(r"[-_.]+", "_", name).lower() == DISTRIBUTION


def _n_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _headless() -> ModuleType:
    """`lerobot_pf2mp.envs.headless`, without importing the rest of the package, which may fail."""
    return _module_from(_package_folder() / "envs" / "headless.py", "headless")


def _package_folder() -> Path:
    package = importlib.util.find_spec(PACKAGE)
    if package is None or not package.submodule_search_locations:
        raise ImportError(f"no module named {PACKAGE}")
    return Path(package.submodule_search_locations[0])


def _needed_interface(folder: Path) -> int | None:
    """The interface of the extension that the code calls. It is not imported, because torch may be what is broken."""
    found = re.search(
        r"^_INTERFACE = (\d+)$", (folder / "kernel_tree.py").read_text(encoding="utf-8"), re.MULTILINE
    )
    return int(found[1]) if found else None


def _is_newer(source: Path, built: Path) -> bool:
    """Whether the sources lie beside the extension, as in a checkout, and have changed since it was built."""
    return source.exists() and source.stat().st_mtime > built.stat().st_mtime


def _module_from(path: Path, name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _main(name: str) -> None:
    # Output of libraries must not get into the answer.
    with os.fdopen(os.dup(1), "w", encoding="utf-8") as output:
        os.dup2(2, 1)
        # Removes this folder, which is not in the path of LeRobot's commands.
        if not getattr(sys.flags, "safe_path", False):
            del sys.path[0]
        try:
            answer = PROBES[name]()
        except BaseException as error:
            answer = {"error": message_of(error)}
        json.dump(answer, output)


if __name__ == "__main__":
    _main(sys.argv[1])
