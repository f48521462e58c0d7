# SPDX-License-Identifier: Apache-2.0
"""Every console script starts in a process of its own, as a user starts it; other tests run commands in forks."""

import subprocess
import tomllib
from pathlib import Path

import pytest
from forked_commands import BIN, SECONDS

PYPROJECT = Path(__file__).parents[1] / "pyproject.toml"
SCRIPTS = tomllib.loads(PYPROJECT.read_text(encoding="utf-8"))["project"]["scripts"]


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS)
def test_a_console_script_explains_itself_and_complains_about_nothing(script: str, tmp_path: Path) -> None:
    result = subprocess.run(
        [BIN / script, "--help"], cwd=tmp_path, capture_output=True, text=True, timeout=SECONDS, check=False
    )
    assert result.returncode == 0, result.stderr
    # LeRobot's own command says what this machine lacks to read videos.
    assert result.stderr == "" or script == "pf2mp-train"
    assert result.stdout.startswith(f"usage: {script} [")
    assert list(tmp_path.iterdir()) == []
