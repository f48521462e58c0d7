# SPDX-License-Identifier: Apache-2.0
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from lerobot.scripts import lerobot_train

from lerobot_pf2mp.commands import cli
from lerobot_pf2mp.process.interruption import (
    INTERRUPTED,
    TERMINATED,
    Terminated,
    exit_code,
    sigterm_like_ctrl_c,
)


@pytest.fixture
def outside() -> Iterator[list[int]]:
    """SIGTERMs that came outside of a block; without this, they would end the tests."""
    received: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, _: received.append(number))
    yield received
    signal.signal(signal.SIGTERM, before)


def terminate_oneself() -> None:
    os.kill(os.getpid(), signal.SIGTERM)


def test_sigterm_raises_in_the_block_and_only_there(outside: list[int]) -> None:
    with pytest.raises(Terminated), sigterm_like_ctrl_c():
        terminate_oneself()
    assert outside == []
    terminate_oneself()
    assert outside == [signal.SIGTERM]


def test_a_second_sigterm_at_once_does_not_interrupt_the_clean_up(outside: list[int]) -> None:
    cleaned_up = False
    with pytest.raises(Terminated), sigterm_like_ctrl_c():
        try:
            terminate_oneself()
        finally:
            terminate_oneself()
            cleaned_up = True
    assert cleaned_up
    assert outside == []


def test_a_later_sigterm_interrupts_the_clean_up(outside: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lerobot_pf2mp.process.interruption._AT_ONCE", 0.0)
    with sigterm_like_ctrl_c():
        for _ in range(2):
            with pytest.raises(Terminated):
                terminate_oneself()
    assert outside == []


def test_ctrl_c_and_sigterm_have_the_exit_codes_of_the_shell() -> None:
    assert exit_code(KeyboardInterrupt()) == INTERRUPTED == 128 + signal.SIGINT
    assert exit_code(Terminated()) == TERMINATED == 128 + signal.SIGTERM


def test_sigterm_ends_training_in_one_line(
    outside: list[int], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["pf2mp-train"])
    monkeypatch.setattr(lerobot_train, "make_train_eval_datasets", None)  # main replaces it
    monkeypatch.setattr(lerobot_train, "main", terminate_oneself)
    with pytest.raises(SystemExit) as exit_:
        cli.train()
    assert exit_.value.code == TERMINATED
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line == "interrupted: training continues from the last checkpoint with --resume=true"
    assert outside == []


@pytest.mark.slow
def test_a_forked_process_ends_by_sigterm_and_says_nothing(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(
        """
import multiprocessing, os, signal, time
from lerobot_pf2mp.process.interruption import sigterm_like_ctrl_c

if __name__ == "__main__":
    with sigterm_like_ctrl_c():
        process = multiprocessing.get_context("fork").Process(
            target=lambda: (os.kill(os.getpid(), signal.SIGTERM), time.sleep(60))
        )
        process.start()
        process.join()
        print(process.exitcode)
"""
    )
    command = [sys.executable, "-W", "ignore", tmp_path / "program.py"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (result.stdout, result.stderr) == (f"{-signal.SIGTERM}\n", "")
