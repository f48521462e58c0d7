# SPDX-License-Identifier: Apache-2.0
"""Commands that start at once: each runs in a fork of one process that has imported what they all import.

A command in a process of its own takes several seconds to import PyTorch and LeRobot. Here the standard library's fork
server imports them once, and a fork of it does what the command's script would do: it takes over the arguments, the
environment and the working folder, calls the entry point, and ends with its exit code. What a library reads from the
environment while it is imported, Hugging Face's offline switch and cache folder above all, is that of `conftest`; a
command that needs another value runs in a process of its own (`own_process`).

Example:
    finished = run("pf2mp-collect", "--task=maze_umaze", f"--root={folder}")
    assert finished.returncode == 0, finished.stderr
"""

import atexit
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import traceback
import types
from importlib.metadata import entry_points
from multiprocessing.forkserver import ensure_running
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

BIN = Path(sys.executable).parent
SECONDS = 600.0  # for a command, on a machine that is busy with other things

_ENVIRONMENT = dict(os.environ)  # as it is when this file is imported, before a test changes it
_IMPORTED_BEFORE = [
    "pytest",  # it is the main module, which a process of the standard library imports again
    "matplotlib.pyplot",
    "mujoco",
    "lerobot.scripts.lerobot_train",
    "lerobot.scripts.lerobot_eval",
    "lerobot.scripts.lerobot_rollout",
    "lerobot.scripts.lerobot_edit_dataset",
    "lerobot.async_inference.policy_server",
    "lerobot_pf2mp.commands.benchmark",
    "lerobot_pf2mp.commands.collect",
    "lerobot_pf2mp.commands.convert",
    "lerobot_pf2mp.commands.demo",
    "lerobot_pf2mp.commands.fit_field",
    "lerobot_pf2mp.commands.plot",
    "lerobot_pf2mp.commands.policy_server",
    "lerobot_pf2mp.commands.push",
    "lerobot_pf2mp.commands.train",
    "lerobot_pf2mp.commands.train_expert",
    "lerobot_pf2mp.training.train",
]
_forks = multiprocessing.get_context("forkserver")
_forks.set_forkserver_preload(_IMPORTED_BEFORE)


class ForkedCommand:
    """A command that runs; its methods are those of `subprocess.Popen`.

    Args:
        command: The name of a console script.
        arguments: Its arguments.
        cwd: The folder it runs in, by default this one.
        env: Its environment, by default this one.
        start_new_session: Whether it leads a process group of its own, so that `os.killpg` reaches it and its children.
    """

    def __init__(
        self,
        command: str,
        *arguments: str,
        cwd: Path | None = None,
        env: dict[str, str] | None = None,
        start_new_session: bool = False,
    ) -> None:
        self.args = [command, *arguments]
        self._said = tempfile.TemporaryDirectory()
        folder = Path(self._said.name)
        self._outputs = (folder / "stdout", folder / "stderr")
        for output in self._outputs:
            output.touch()
        self._process = _forks.Process(
            target=_be_the_command,
            args=(
                self.args,
                cwd or Path.cwd(),
                dict(os.environ) if env is None else env,
                start_new_session,
                self._outputs,
            ),
        )
        with mock.patch.dict(os.environ, _ENVIRONMENT, clear=True):
            ensure_running()
        self._process.start()

    @property
    def pid(self) -> int:
        """The number of its process."""
        assert self._process.pid is not None
        return self._process.pid

    @property
    def returncode(self) -> int | None:
        """Its exit code, minus the signal that ended it, or None as long as it runs."""
        return self._process.exitcode

    def poll(self) -> int | None:
        """Its exit code, or None as long as it runs."""
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Sends it a signal if it still runs."""
        if self.returncode is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        """Sends it SIGTERM."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Sends it SIGKILL."""
        self.send_signal(signal.SIGKILL)

    def wait(self, timeout: float | None = None) -> int:
        """Its exit code, once it has ended.

        Raises:
            subprocess.TimeoutExpired: If it still runs after `timeout` [s].
        """
        self._process.join(timeout)
        if self.returncode is None:
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0, *(self.read()))
        return self.returncode

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        """All that it wrote to its standard output and error, once it has ended."""
        self.wait(timeout)
        return self.read()

    def read(self) -> tuple[str, str]:
        """What it has written so far to its standard output and error."""
        stdout, stderr = (output.read_text(errors="replace") for output in self._outputs)
        return stdout, stderr


def run(
    command: str,
    *arguments: str,
    cwd: Path | None = None,
    env: dict[str, str] | None = None,
    timeout: float = SECONDS,
) -> subprocess.CompletedProcess[str]:
    """Runs a console script to its end, like `subprocess.run`.

    Args:
        command: Its name.
        arguments: Its arguments.
        cwd: The folder it runs in, by default this one.
        env: Its environment, by default this one.
        timeout: After how long it is killed [s].

    Raises:
        subprocess.TimeoutExpired: If it has been killed.
    """
    process = ForkedCommand(command, *arguments, cwd=cwd, env=env)
    try:
        stdout, stderr = process.communicate(timeout)
    finally:
        process.kill()
        returncode = process.wait()
    return subprocess.CompletedProcess(process.args, returncode, stdout, stderr)


def run_well(command: str, *arguments: str, **options: Any) -> str:
    """Runs a console script that must succeed; returns what it wrote to its standard output and error."""
    finished = run(command, *arguments, **options)
    assert finished.returncode == 0, finished.stdout[-2000:] + finished.stderr[-6000:]
    return finished.stdout + finished.stderr


def _be_the_command(
    arguments: list[str],
    cwd: Path,
    env: dict[str, str],
    start_new_session: bool,
    outputs: tuple[Path, Path],
) -> None:
    if start_new_session:
        os.setsid()
    # A shell that starts the tests in the background has told them, and so the fork server, to ignore it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for stream, output in zip((sys.stdout, sys.stderr), outputs, strict=True):
        stream.flush()
        with output.open("w") as file:
            os.dup2(file.fileno(), stream.fileno())
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(env)
    # For environments side by side, whose processes the command starts itself.
    multiprocessing.set_forkserver_preload(_IMPORTED_BEFORE)
    np.random.seed()  # all forks would draw the same numbers
    sys.argv = [str(BIN / arguments[0]), *arguments[1:]]
    # Not the main module of the tests, which the command's own processes would import.
    sys.modules["__main__"] = types.ModuleType("__main__")
    (script,) = entry_points(group="console_scripts", name=arguments[0])
    try:
        sys.exit(script.load()())
    except KeyboardInterrupt:
        traceback.print_exc()
        atexit._run_exitfuncs()
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGINT)
    except Exception:
        traceback.print_exc()
        sys.exit(1)
    finally:
        atexit._run_exitfuncs()
