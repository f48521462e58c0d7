# SPDX-License-Identifier: Apache-2.0
"""Runs many inputs in one forked process, and says of each how it ended."""

from __future__ import annotations

import contextlib
import json
import logging
import multiprocessing
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

SECONDS = 20.0  # an input that takes longer is a hang
BYTES = 4 * 10**9
MARKER = "FOREIGN_CODE_RAN"

# How an input can end; the first three are right.
VERDICTS = (
    "accepted",
    "refused",
    "usage",
    "traceback",
    "hang",
    "crash",
    "memory",
    "half-written",
    "foreign code",
)

# Makes an input in a folder and returns what to call with it.
Make = Callable[[random.Random, Path], Callable[[], object]]


@dataclass(frozen=True)
class Outcome:
    """How one input ended.

    Args:
        target: The name of the target.
        number: The number of the input.
        verdict: One of `VERDICTS`.
        said: The last line that was printed.
        seconds: How long it took.
    """

    target: str
    number: int
    verdict: str
    said: str
    seconds: float


class HangError(BaseException):
    """An input takes too long."""


def run_inputs(target: str, make: Make, n_inputs: int, seed: int, keep: Path) -> Iterator[Outcome]:
    """Runs the inputs of a target.

    Args:
        target: Its name.
        make: Makes an input.
        n_inputs: How many.
        seed: Seed of all inputs.
        keep: Folder for the inputs that end wrongly.
    """
    context = multiprocessing.get_context("fork")
    number = 0
    while number < n_inputs:
        receiver, sender = context.Pipe(duplex=False)
        process = context.Process(
            target=_work, args=(target, make, range(number, n_inputs), seed, keep, sender)
        )
        process.start()
        sender.close()
        while number < n_inputs:
            outcome = None
            if receiver.poll(3 * SECONDS):
                with contextlib.suppress(EOFError):
                    outcome = Outcome(**json.loads(receiver.recv()))
            if outcome is None:
                is_hanging = process.is_alive() and process.exitcode is None
                process.kill()
                process.join()
                verdict = "hang" if is_hanging else "crash"
                outcome = Outcome(target, number, verdict, f"exit code {process.exitcode}", 3 * SECONDS)
            yield outcome
            number += 1
            if outcome.verdict in ("hang", "crash"):
                break
        process.kill()
        process.join()


def _work(target: str, make: Make, numbers: range, seed: int, keep: Path, sender: Any) -> None:
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    resource.setrlimit(resource.RLIMIT_DATA, (used + BYTES, used + BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGALRM, _raise_hang)
    for number in numbers:
        with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
            outcome = _run_one(target, make, number, seed, Path(folder), keep)
        sender.send(json.dumps(asdict(outcome)))


def _raise_hang(*_: object) -> None:
    raise HangError


def _run_one(target: str, make: Make, number: int, seed: int, folder: Path, keep: Path) -> Outcome:
    here = folder / "a/b"  # ../x lies within the folder
    os.environ["HOME"] = str(folder)
    os.environ[MARKER] = str(folder / MARKER)
    for attempt in range(100):
        rng = random.Random(f"{seed}/{target}/{number}/{attempt}")
        shutil.rmtree(here, ignore_errors=True)
        here.mkdir(parents=True)
        os.chdir(here)
        try:
            call = make(rng, here)
            break
        except (TypeError, ValueError, OSError, KeyError, RuntimeError):
            continue  # a change that the file's own library refuses is no input
    else:
        raise AssertionError(f"{target} has no inputs")
    before = _hidden(folder)
    output = folder / "said"
    began = time.monotonic()
    verdict, said = _call(call, output)
    seconds = time.monotonic() - began
    left = _left_over(folder, before, verdict)
    if (folder / MARKER).exists() or "foreign_marker" in sys.modules:
        verdict = "foreign code"
    elif left:
        verdict, said = "half-written", f"{left} after: {said}"
    if verdict not in VERDICTS[:3]:
        with contextlib.suppress(OSError):
            shutil.copytree(folder, keep / f"{target}_{number}", dirs_exist_ok=True, symlinks=True)
    return Outcome(target, number, verdict, said[:300], round(seconds, 3))


def _left_over(folder: Path, before: set[Path], verdict: str) -> list[str]:
    """What should not be there: hidden files, and an output after an error. A benchmark goes on from its output."""
    left = [path.name for path in _hidden(folder) - before]
    output = folder / "a/b/out"
    if verdict != "accepted" and output.exists() and not (output / "run.json").exists():
        left.append("out")
    return left


def _hidden(folder: Path) -> set[Path]:
    return {path for path in folder.rglob(".*") if path.name not in (".cache", ".config", ".matplotlib")}


def _call(call: Callable[[], object], output: Path) -> tuple[str, str]:
    """How a call ends, and the last line that it prints."""
    kept = [os.dup(number) for number in (1, 2)]
    sys.stdout.flush(), sys.stderr.flush()
    with output.open("w") as file:
        for number in (1, 2):
            os.dup2(file.fileno(), number)
    logging.disable(logging.CRITICAL)
    code: Any = 0
    try:
        signal.setitimer(signal.ITIMER_REAL, SECONDS)
        call()
    except SystemExit as end:
        code = end.code
    except HangError:
        code = "hang"
    except MemoryError:
        code = "memory"
    except BaseException:
        traceback.print_exc()
        code = "traceback"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        sys.stdout.flush(), sys.stderr.flush()
        for number, saved in zip((1, 2), kept, strict=True):
            os.dup2(saved, number)
            os.close(saved)
    text = output.read_text(errors="replace")
    lines = [line for line in text.splitlines() if line.strip()] or [""]
    output.unlink()
    if code in ("hang", "memory"):
        return code, lines[-1]
    if code == "traceback" or "Traceback (most recent call last)" in text:
        at = [line.strip() for line in lines if line.strip().startswith("File ")][-1:]
        return "traceback", f"{lines[-1]} {at}" if code == "traceback" else f"{lines[-2]} {at}"
    if code in (0, None):
        return "accepted", lines[-1]
    if code == 2:
        return "usage", lines[-1]
    if "there is not enough memory" in lines[-1]:
        return "memory", lines[-1]
    return ("refused" if lines[-1].startswith("error: ") else "traceback"), lines[-1]
