# SPDX-License-Identifier: Apache-2.0
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lerobot_pf2mp.process.worker_pool import worker_pool

_offset = 0


def set_offset(offset: int) -> None:
    global _offset
    _offset = offset


def add(value: int) -> tuple[int, int]:
    return _offset + value, os.getpid()


def leave_a_mark(folder: str, number: int) -> None:
    time.sleep(0.2)
    (Path(folder) / str(number)).touch()


@pytest.mark.slow
def test_tasks_run_in_other_processes_after_the_initializer() -> None:
    with worker_pool(2, set_offset, (10,)) as pool:
        results = list(pool.map(add, range(4)))
    assert [result for result, _ in results] == [10, 11, 12, 13]
    assert os.getpid() not in {process for _, process in results}
    assert _offset == 0


@pytest.mark.slow
def test_what_has_not_begun_when_an_error_comes_is_dropped(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="enough"), worker_pool(1, set_offset, (0,)) as pool:
        for number in range(50):
            pool.submit(leave_a_mark, str(tmp_path), number)
        while not (tmp_path / "0").exists():
            time.sleep(0.05)
        raise RuntimeError("enough")
    assert 1 <= len(list(tmp_path.iterdir())) < 10


@pytest.mark.slow
def test_what_has_begun_is_dropped_too_when_an_interruption_comes(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), worker_pool(1, set_offset, (0,)) as pool:
        pool.submit(leave_a_mark, str(tmp_path), 0)
        pool.submit(time.sleep, 60)
        while not (tmp_path / "0").exists():
            time.sleep(0.05)
        began = time.monotonic()
        raise KeyboardInterrupt
    assert time.monotonic() - began < 30


@pytest.mark.slow
def test_an_interrupted_worker_says_nothing(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(
        """
import os, signal
from lerobot_pf2mp.process.worker_pool import worker_pool

def nothing(): pass
def interrupt_oneself(): os.kill(os.getpid(), signal.SIGINT)

if __name__ == "__main__":
    with worker_pool(1, nothing, ()) as pool:
        print(type(pool.submit(interrupt_oneself).exception()).__name__)
"""
    )
    command = [sys.executable, tmp_path / "program.py"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (result.stdout, result.stderr) == ("BrokenProcessPool\n", "")


@pytest.mark.slow
def test_a_worker_that_is_interrupted_while_it_imports_says_nothing(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(
        """
import os, signal, time
from pathlib import Path
from lerobot_pf2mp.process.worker_pool import worker_pool

def nothing(): pass

if __name__ == "__mp_main__":  # the import of a worker, before it begins
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.5)
    Path("imported").touch()
if __name__ == "__main__":
    with worker_pool(1, nothing, ()) as pool:
        print(type(pool.submit(nothing).exception()).__name__)
"""
    )
    command = [sys.executable, tmp_path / "program.py"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, cwd=tmp_path)
    assert (result.stdout, result.stderr) == ("BrokenProcessPool\n", "")
    assert (tmp_path / "imported").exists()


ORPHANS = """
import os, time
from lerobot_pf2mp.process.worker_pool import worker_pool

def work(number):
    print(os.getpid(), flush=True)
    time.sleep(600)

def prepare():
    pass

if __name__ == "__main__":
    with worker_pool(2, prepare, ()) as pool:
        list(pool.map(work, range(2)))
"""


@pytest.mark.slow
def test_workers_end_with_their_parent_however_it_ends(tmp_path: Path) -> None:
    script = tmp_path / "orphans.py"
    script.write_text(ORPHANS)
    process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    workers = [int(process.stdout.readline()) for _ in range(2)]
    process.kill()
    process.wait()
    deadline = time.monotonic() + 30
    while any(Path(f"/proc/{worker}").exists() for worker in workers):
        assert time.monotonic() < deadline, "a worker is still there"
        time.sleep(0.05)
