# SPDX-License-Identifier: Apache-2.0
"""Nothing is lost: of two runs with one output one ends, what appears meanwhile is kept, and what a kill left is found."""

import ctypes
import errno
import fcntl
import json
import logging
import multiprocessing
import os
import resource
import signal
import subprocess
import sys
import time
import types
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from lerobot_pf2mp.process import renaming
from lerobot_pf2mp.process.atomic_files import file_written_beside, written_beside
from lerobot_pf2mp.process.claims import claimed, workspace_of
from lerobot_pf2mp.process.interruption import (
    HungUp,
    Terminated,
    exit_code,
    sigterm_like_ctrl_c,
    uninterrupted,
)

BESIDE = {"kind": "dataset", "mark": "mark", "option": "--root"}


def everything_in(folder: Path) -> dict[str, str | None]:
    return {
        str(path.relative_to(folder)): path.read_text() if path.is_file() else None
        for path in folder.rglob("*")
    }


def write(
    folder: Path, text: str, overwrite: bool = False, between: Callable[[], object] = lambda: None
) -> None:
    with written_beside(folder, overwrite, **BESIDE) as new:
        new.mkdir()
        (new / "mark").write_text(text)
        between()


@pytest.fixture(params=["at once", "by renames"])
def _way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param == "by renames":
        monkeypatch.setattr(renaming, "_rename", lambda *_: False)


@pytest.mark.usefixtures("_way")
def test_a_folder_appears_whole_and_replaces_another_one(tmp_path: Path) -> None:
    write(tmp_path / "data", "first")
    with pytest.raises(FileExistsError, match="exists already: choose another --root, or pass --overwrite"):
        write(tmp_path / "data", "second")
    assert everything_in(tmp_path) == {"data": None, "data/mark": "first"}
    write(tmp_path / "data", "second", overwrite=True)
    assert everything_in(tmp_path) == {"data": None, "data/mark": "second"}


@pytest.mark.usefixtures("_way")
@pytest.mark.parametrize("appeared", ["folder", "empty folder", "file", "dataset", "link"])
def test_what_appears_at_the_target_meanwhile_is_kept(appeared: str, tmp_path: Path) -> None:
    target = tmp_path / "data"

    def appear() -> None:
        if appeared == "file":
            target.write_text("mine")
        elif appeared == "link":
            (tmp_path / "elsewhere").mkdir()
            target.symlink_to(tmp_path / "elsewhere")
        else:
            target.mkdir()
            if appeared != "empty folder":
                (target / ("mark" if appeared == "dataset" else "mine.txt")).write_text("mine")

    with pytest.raises(FileExistsError):
        write(target, "new", between=appear)
    before = everything_in(tmp_path)
    assert "new" not in before.values() and not [name for name in before if name.startswith(".")]
    assert target.exists() and (appeared not in ("folder", "file", "dataset") or "mine" in before.values())
    if appeared != "dataset":  # which may be overwritten, if one asks for it
        with pytest.raises(FileExistsError):
            write(target, "new", overwrite=True)
        assert everything_in(tmp_path) == before


def test_a_dataset_that_turns_into_something_else_meanwhile_is_kept(tmp_path: Path) -> None:
    write(tmp_path / "data", "first")
    with pytest.raises(FileExistsError, match="is no dataset"):
        write(
            tmp_path / "data",
            "new",
            overwrite=True,
            between=lambda: (tmp_path / "data/mark").rename(tmp_path / "data/x"),
        )
    assert everything_in(tmp_path) == {"data": None, "data/x": "first"}


def test_an_error_leaves_everything_as_it_was(tmp_path: Path) -> None:
    def fail() -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        write(tmp_path / "a/b/data", "new", between=fail)
    assert everything_in(tmp_path) == {}
    with (
        pytest.raises(OSError, match="No space left"),
        file_written_beside(tmp_path / "c/file.txt") as partial,
    ):
        partial.write_text("half")
        fail()
    assert everything_in(tmp_path) == {}


def hold(target: Path, is_held: "multiprocessing.synchronize.Event") -> None:
    with claimed(target):
        is_held.set()
        time.sleep(600)


@pytest.fixture
def holder(tmp_path: Path) -> Iterator[multiprocessing.Process]:
    """Another process that has claimed tmp_path/data."""
    context = multiprocessing.get_context("fork")
    is_held = context.Event()
    process = context.Process(target=hold, args=(tmp_path / "data", is_held))
    process.start()
    assert is_held.wait(60)
    yield process
    process.kill()
    process.join()


def test_a_second_run_ends_before_it_begins(holder: multiprocessing.Process, tmp_path: Path) -> None:
    for overwrite in (False, True):
        with pytest.raises(FileExistsError, match=f"is being written by another process, {holder.pid}: wait"):
            write(tmp_path / "data", "second", overwrite)
    write(tmp_path / "data2", "another one")
    assert holder.is_alive()
    holder.kill()
    holder.join()
    write(tmp_path / "data", "third")
    assert everything_in(tmp_path) == {
        "data": None, "data/mark": "third", "data2": None, "data2/mark": "another one",
    }  # fmt: skip


def test_what_a_killed_run_left_is_named_and_removed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    target = tmp_path / "data"
    (workspace_of(target) / "new").mkdir(parents=True)
    (tmp_path / ".data.claim").write_text("{}")  # of a dead process
    (tmp_path / ".data.ab_12cd9.partial").mkdir()  # of a version before
    (tmp_path / ".partial.data").write_text("half")
    for other in (".data.b.partial", ".datax.partial", ".data.live0000.partial"):
        (tmp_path / other).mkdir()
    (tmp_path / ".data.live0000.claim").write_text("")
    with caplog.at_level(logging.WARNING):
        write(target, "new")
    assert sum("which an interrupted run left" in record.message for record in caplog.records) == 3
    left = {name for name in everything_in(tmp_path) if "/" not in name}
    assert left == {
        "data",
        ".data.b.partial",
        ".datax.partial",
        ".data.live0000.partial",
        ".data.live0000.claim",
    }


def test_what_a_killed_run_was_about_to_replace_is_put_back(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    old = workspace_of(tmp_path / "data") / "old"
    old.mkdir(parents=True)
    (old / "mark").write_text("first")
    with caplog.at_level(logging.WARNING), pytest.raises(FileExistsError, match="exists already"):
        write(tmp_path / "data", "second")
    assert everything_in(tmp_path) == {"data": None, "data/mark": "first"}
    assert "Put " in caplog.text and "back, which an interrupted run was about to replace" in caplog.text


KILLED = """
import sys, time
from pathlib import Path
from lerobot_pf2mp.process.atomic_files import written_beside
with written_beside(Path(sys.argv[1]), True, kind="dataset", mark="mark", option="--root") as new:
    new.mkdir()
    (new / "mark").write_text("new")
    print("writing", flush=True)
    time.sleep(float(sys.argv[2]))
print("done", flush=True)
time.sleep(60)
"""


@pytest.mark.slow
def test_kills_at_any_moment_leave_the_old_or_the_new(tmp_path: Path) -> None:
    target = tmp_path / "data"
    write(target, "old")
    for number in range(12):
        process = subprocess.Popen(
            [sys.executable, "-c", KILLED, str(target), "0.002"], stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None and process.stdout.readline() == "writing\n"
        time.sleep(0.0005 * number)
        process.kill()
        process.wait()
        assert (target / "mark").read_text() in ("old", "new")
        write(target, "old", overwrite=True)
        assert everything_in(tmp_path) == {"data": None, "data/mark": "old"}


def test_a_full_disk_is_said_and_nothing_is_left(tmp_path: Path) -> None:
    """A true limit on the size of files, in a process of its own."""

    def fill() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
        try:
            with written_beside(tmp_path / "data", False, **BESIDE) as new:
                new.mkdir()
                (new / "mark").write_text(10_000 * "x")
        except OSError as error:
            os._exit(0 if error.errno == errno.EFBIG and not list(tmp_path.iterdir()) else 1)
        os._exit(2)

    process = multiprocessing.get_context("fork").Process(target=fill)
    process.start()
    process.join(60)
    assert process.exitcode == 0


@pytest.mark.usefixtures("_way")
def test_what_exists_is_not_renamed_over(tmp_path: Path) -> None:
    for name in ("old", "new"):
        (tmp_path / name).mkdir()
    with pytest.raises(FileExistsError):
        renaming.rename_to_new(tmp_path / "old", tmp_path / "new")
    assert everything_in(tmp_path) == {"old": None, "new": None}


@pytest.mark.usefixtures("_way")
def test_an_exchange_that_fails_leaves_the_old(tmp_path: Path) -> None:
    (tmp_path / "old").write_text("old")
    with pytest.raises(FileNotFoundError):
        renaming.exchange(tmp_path / "missing", tmp_path / "old", tmp_path / "spare")
    assert everything_in(tmp_path) == {"old": "old"}


@pytest.mark.parametrize("code", sorted(renaming._CANNOT))
def test_a_file_system_that_cannot_rename_so_gets_ordinary_renames(
    code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> int:
        ctypes.set_errno(code)
        return -1

    library = types.SimpleNamespace(renameat2=fail, renamex_np=fail)
    monkeypatch.setattr(renaming.ctypes, "CDLL", lambda *_, **__: library)
    write(tmp_path / "data", "first")
    write(tmp_path / "data", "second", overwrite=True)
    assert everything_in(tmp_path) == {"data": None, "data/mark": "second"}


def test_a_claim_whose_file_is_removed_meanwhile_is_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, flock = tmp_path / ".data.claim", fcntl.flock

    def lock_too_late(descriptor: int, operation: int) -> None:
        monkeypatch.setattr(fcntl, "flock", flock)
        file.unlink()  # by the one who held it
        flock(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", lock_too_late)
    with claimed(tmp_path / "data"):
        assert json.loads(file.read_text()) == {"process": os.getpid()}
        with (
            pytest.raises(FileExistsError, match="is being written by another process"),
            claimed(tmp_path / "data"),
        ):
            pass


def test_without_locks_nothing_is_cleared_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever left it may still be running."""

    def no_locks(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", no_locks)
    workspace_of(tmp_path / "data").mkdir()
    with claimed(tmp_path / "data"):
        assert workspace_of(tmp_path / "data").exists()


@pytest.mark.parametrize("mark", ["data.abcd_123", ".data.abcd_123.claim"])
def test_what_belongs_to_another_output_is_not_cleared_up(mark: str, tmp_path: Path) -> None:
    (tmp_path / mark).touch()
    left = tmp_path / ".data.abcd_123.partial"  # as versions before 0.2 named what they left of "data"
    left.mkdir()
    with claimed(tmp_path / "data"):
        assert left.exists()
    (tmp_path / mark).unlink()
    with claimed(tmp_path / "data"):
        assert not left.exists()


# Signals.


@pytest.mark.parametrize(
    ("number", "kind", "code"), [(signal.SIGTERM, Terminated, 143), (signal.SIGHUP, HungUp, 129)]
)
def test_a_signal_ends_a_block_like_ctrl_c(number: signal.Signals, kind: type, code: int) -> None:
    outside = signal.signal(number, signal.SIG_DFL)  # under nohup it is ignored
    try:
        with pytest.raises(kind) as raised, sigterm_like_ctrl_c():
            signal.raise_signal(number)
        assert exit_code(raised.value) == code
        assert signal.getsignal(number) is signal.SIG_DFL
    finally:
        signal.signal(number, outside)


def test_a_hang_up_that_is_ignored_stays_so() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with sigterm_like_ctrl_c():
            signal.raise_signal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_second_ctrl_c_does_not_interrupt_the_clean_up() -> None:
    steps = []
    with pytest.raises(KeyboardInterrupt, match="first"):
        try:
            raise KeyboardInterrupt("first")
        finally:
            with uninterrupted():
                signal.raise_signal(signal.SIGINT)
                steps.append("cleaned up")
            steps.append("went on")
    assert steps == ["cleaned up", "went on"]


def test_a_ctrl_c_during_the_last_steps_comes_after_them() -> None:
    steps = []
    before = signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # a shell may have told the tests to ignore it
    try:
        with pytest.raises(KeyboardInterrupt):
            with uninterrupted():
                signal.raise_signal(signal.SIGINT)
                steps.append("cleaned up")
            steps.append("went on")
    finally:
        signal.signal(signal.SIGINT, before)
    assert steps == ["cleaned up"]
