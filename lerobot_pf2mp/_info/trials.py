# SPDX-License-Identifier: Apache-2.0
"""Runs the probes and turns their answers into lines."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from . import probes
from .line import OPTIONAL, PROBLEM, Line
from .probes import DISTRIBUTION

POLICIES = {"dppf", "fmp", "guarded", "pf2mp"}

_BACKENDS = {"egl": "EGL", "osmesa": "OSMesa", "glfw": "screen"}


def answer_of(probe: str, seconds: float) -> dict[str, Any]:
    """Runs a probe in its own process and returns its answer; {"error": REASON} if it fails or takes longer."""
    try:
        finished = subprocess.run(
            [sys.executable, "-X", "faulthandler", probes.__file__, probe],
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            timeout=seconds,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return {"error": f"no answer within {seconds:g} s (--time_limit)"}
    try:
        return json.loads(finished.stdout)
    except ValueError:
        lines = [line for line in finished.stderr.splitlines() if line.strip()]
        said = [line for line in lines if line.startswith("Fatal Python error")] or lines[-1:] or ["nothing"]
        return {"error": f"ended with code {finished.returncode}, having said: {said[0]}"}


def discovery_line(answer: dict[str, Any]) -> Line:
    """Whether LeRobot's commands find this package; if not, the reason."""
    if "error" in answer:
        return _not_found(f"LeRobot's discovery does not run: {answer['error']}")
    policies, environments = answer["policies"], answer["environments"]
    if set(policies) >= POLICIES and environments:
        return Line("discovery", f"policies {', '.join(policies)}; environments {', '.join(environments)}")
    reinstall = "pip install --force-reinstall --no-deps . in its folder"
    if not answer["distributions"]:
        return _not_found(f"no distribution {DISTRIBUTION} in {sys.prefix}: pip install . in its folder")
    if DISTRIBUTION not in answer["distributions"]:
        names = ", ".join(answer["distributions"])
        return _not_found(
            f"the distribution is called {names}, LeRobot looks for {DISTRIBUTION}, with underscores: {reinstall}"
        )
    return _not_found(f"{'; '.join(answer['reasons']) or 'LeRobot gives no reason'}: {reinstall}")


def device_line(answer: dict[str, Any]) -> Line:
    """The device on which policies are trained and run."""
    if "error" in answer:
        remedy = "install a torch that runs here (pytorch.org/get-started/locally)"
        return Line("device", "torch does not compute", PROBLEM, f"{answer['error']}: {remedy}")
    if answer["gpus"]:
        gpus = ", ".join(f"{name} with {memory / 2**30:.0f} GiB" for name, memory in answer["gpus"])
        return Line("device", f"CUDA, {gpus}")
    if answer["mps"]:
        return Line("device", "MPS")
    value = f"CPU, {answer['cores']} cores"
    if answer["said"]:
        return Line("device", value, OPTIONAL, f"the GPU is not used: {answer['said']}")
    return Line("device", value)


def extension_line(answer: dict[str, Any]) -> Line:
    """Whether the C extension evaluates potential fields on a CPU."""
    rebuild = "pip install --force-reinstall --no-deps . in its folder"
    remedy = f"fields are slower on a CPU: install a C compiler, then {rebuild}"
    if "error" in answer:
        return Line("extension", "cannot be loaded", OPTIONAL, f"{answer['error']}: {remedy}")
    if not answer["is_built"]:
        return Line("extension", "not built", OPTIONAL, remedy)
    if not answer["is_current"]:
        return Line("extension", "compiled from older sources", OPTIONAL, rebuild)
    return Line("extension", "compiled")


def simulation_line(answer: dict[str, Any]) -> Line:
    """Whether MuJoCo and the environments of gymnasium-robotics run."""
    errors = {"MuJoCo": answer["error"]} if "error" in answer else answer["errors"]
    value = ", ".join(name if not error else f"no {name}" for name, error in errors.items())
    reasons = "; ".join(error for error in errors.values() if error)
    if reasons:
        return Line("simulation", value, PROBLEM, _without("MUJOCO_GL") + reasons)
    return Line("simulation", value)


def rendering_line(answer: dict[str, Any]) -> Line:
    """The backend that renders."""
    if "error" in answer:
        remedy = _without("MUJOCO_GL", "DISPLAY") + answer["error"]
        return Line("rendering", "no images of Fetch and handwriting", OPTIONAL, remedy)
    return Line("rendering", _BACKENDS.get(answer["backend"], answer["backend"]))


def video_line(answer: dict[str, Any]) -> Line:
    """Whether videos can be written."""
    if "error" in answer:
        return Line(
            "video", "does not work", OPTIONAL, f'{answer["error"]}: pip install "lerobot[evaluation]"'
        )
    value = f"av {answer['av']}: " + ", ".join(
        encoder if not reason else f"no {encoder}" for encoder, reason in answer["encoders"].items()
    )
    reasons = "; ".join(reason for reason in answer["encoders"].values() if reason)
    if reasons:
        remedy = f"{reasons}: pip install --force-reinstall --no-deps av=={answer['av']}"
        return Line("video", value, OPTIONAL, remedy)
    return Line("video", value)


LINES = {
    "discovery": discovery_line,
    "device": device_line,
    "extension": extension_line,
    "simulation": simulation_line,
    "rendering": rendering_line,
    "video": video_line,
}


def trial_line(probe: str, seconds: float) -> Line:
    """The line of one of `LINES`."""
    return LINES[probe](answer_of(probe, seconds))


def train_line() -> Line:
    """Whether the lerobot-train that a shell finds is the one of this environment."""
    name, folder = "lerobot-train", Path(sys.executable).parent
    remedy = f"activate this environment, or call {folder / name}"
    found = shutil.which(name)
    if found is None:
        return Line(name, "not in PATH", OPTIONAL, remedy)
    interpreter = _interpreter_of(Path(found))
    if interpreter and interpreter.parent.resolve() != folder.resolve():
        return Line(name, f"the one in PATH runs {interpreter}", OPTIONAL, remedy)
    return Line(name, "of this environment")


def _without(*variables: str) -> str:
    """The advice to try again without those of the variables that are set."""
    chosen = " and ".join(name for name in variables if os.environ.get(name))
    return f"try without {chosen}: " if chosen else ""


def _interpreter_of(script: Path) -> Path | None:
    """The Python interpreter in the first line of a script; None if there is none, as in a binary launcher."""
    with script.open("rb") as file:
        first = file.readline().decode("utf-8", "replace").strip()
    interpreter = Path(first[2:].strip())
    return interpreter if first.startswith("#!") and interpreter.name.startswith("python") else None


def _not_found(remedy: str) -> Line:
    return Line("discovery", "not found by LeRobot", PROBLEM, remedy)
