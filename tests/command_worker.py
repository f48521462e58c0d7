# SPDX-License-Identifier: Apache-2.0
"""Commands one after the other in one process, which has an environment or a file system of its own.

    with CommandWorker(env=...) as worker:
        code, said = worker.run("pf2mp-collect", "--task=maze_umaze")

Forks of the tests' fork server (`forked_commands`) have the libraries that it has imported, with its environment.
"""

import json
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Self

SECONDS = 300  # for a command, on a machine that is busy with other things

_LOOP = """
import json, subprocess, sys, time
from importlib.metadata import entry_points

sleep = time.sleep
time.sleep = lambda seconds: sleep(min(seconds, 0.02))  # between the attempts of clients
for line in sys.stdin:
    sys.argv = json.loads(line)
    code = 0
    try:
        scripts = entry_points(group="console_scripts", name=sys.argv[0])
        code = [script.load()() for script in scripts][0] if scripts else subprocess.call(sys.argv)
    except SystemExit as stop:
        code = stop.code
    print(f"\\n=== {code or 0}", flush=True)
"""


class CommandWorker:
    """A process that runs commands, those of this package without importing everything again.

    Args:
        env: Its environment; None for this one.
        cwd: The folder it runs in; None for this one.
        prefix: A program, with its arguments, that starts it, for example ``("unshare", "-rm")``.
    """

    def __init__(
        self, env: dict[str, str] | None = None, cwd: Path | None = None, prefix: tuple[str, ...] = ()
    ) -> None:
        self._said = tempfile.TemporaryFile("w+")  # noqa: SIM115, it is closed with the process
        self.process = subprocess.Popen(
            [*prefix, sys.executable, "-c", _LOOP],
            cwd=cwd,
            env=env,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._said,
            text=True,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.communicate()
        self._said.close()

    def run(self, *command: str) -> tuple[int, str]:
        """Runs a command; returns its exit code and what it wrote to the standard error stream.

        Raises:
            RuntimeError: If the process ends, or the command takes too long.
        """
        stdin, stdout = self.process.stdin, self.process.stdout
        assert stdin is not None and stdout is not None
        before = self._said.seek(0, 2)
        stdin.write(json.dumps(command) + "\n")
        stdin.flush()
        timer = threading.Timer(SECONDS, self.process.kill)
        timer.start()
        code = next((int(line[4:]) for line in stdout if line.startswith("=== ")), None)
        timer.cancel()
        self._said.seek(before)
        said = self._said.read()
        if code is None:
            raise RuntimeError(f"{command} ended its process, or took more than {SECONDS} s: {said}")
        return code, said
