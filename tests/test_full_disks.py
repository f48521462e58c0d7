# SPDX-License-Identifier: Apache-2.0
"""Commands whose output finds no place: one line that says so, and nothing half-written stays."""

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_worker import CommandWorker
from forked_commands import BIN, run_well
from untrained_policies import write_checkpoint

COLLECT = ("--task=maze_umaze", "--n_episodes=1", "--n_steps=8")
OF_POLICY = ("--checkpoint=policy", "--env.type=pf2mp_maze", "--env.task=MazeUMaze-v0")
COMMANDS = {
    "collect": ("pf2mp-collect", "--task=maze_umaze", "--n_episodes=20", "--n_steps=40", "--root=disk/out"),
    "collect-video": (
        "pf2mp-collect", "--task=maze_umaze", "--n_episodes=2", "--n_steps=40", "--obs_type=pixels_agent_pos",
        "--root=disk/out",
    ),
    "fit-field": (
        "pf2mp-fit-field", "--policy.path=policy", "--dataset.repo_id=local/maze", "--dataset.root=maze",
        "--output_dir=disk/out",
    ),
    "train-expert": (
        "pf2mp-train-expert", "--task=fetch_reach", "--total_steps=64", "--output_dir=disk/out",
        "--options={n_steps: 64, batch_size: 32, n_epochs: 1}",
    ),
    "plot": ("pf2mp-plot", "--figure=density", *OF_POLICY, "--output=disk/out.png"),
    "plot-flow": ("pf2mp-plot", "--figure=flow", *OF_POLICY, "--n_episodes=1", "--output=disk/out.gif"),
    "plot-video": (
        "pf2mp-plot", "--figure=video", *OF_POLICY, "--env.episode_length=4", "--episodes=[0]", "--output=disk/out.mp4"
    ),
    "benchmark": (
        "pf2mp-benchmark", "--policies={a: policy}", "--env.type=pf2mp_maze", "--env.task=MazeUMaze-v0",
        "--env.episode_length=4", "--n_episodes=1", "--n_repeats=1", "--output_dir=disk/out",
    ),
}  # fmt: skip
# A benchmark goes on where it was interrupted: these are whole, or cut off after a line.
KEPT = {"benchmark": {"out", "run.json", "episodes.csv", "summary.csv"}}
UNSHARED = ("unshare", "--map-root-user", "--mount")
PAGE = 4096  # bytes


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a checkpoint, a dataset, and a place for the disk."""
    home = tmp_path_factory.mktemp("home")
    write_checkpoint(home / "policy", "pf2mp")
    run_well("pf2mp-collect", *COLLECT, "--root=maze", cwd=home)
    (home / "disk").mkdir()
    return home


def error_of(code: int, said: str) -> str:
    """The one line in which a command ends."""
    assert code == 1 and "Traceback" not in said.split("torchcodec")[-1], said
    (line,) = (line for line in said.splitlines() if line.startswith("error: "))
    return line


@pytest.mark.slow
@pytest.mark.parametrize(
    "command", [name for name in COMMANDS if name not in ("plot-flow", "plot-video", *KEPT)]
)
def test_a_file_that_may_not_grow_is_one_line_and_leaves_nothing(command: str, home: Path) -> None:
    """A true limit on the size of files: 4 KiB."""
    before = {path.name for path in home.iterdir()}
    name, *options = COMMANDS[command]
    limited = ["bash", "-c", 'ulimit -f 4; exec "$@"', "bash", str(BIN / name), *options]
    finished = subprocess.run(limited, cwd=home, capture_output=True, text=True, check=False, timeout=300)
    assert "File too large" in error_of(finished.returncode, finished.stderr)
    assert {path.name for path in home.iterdir()} == before
    assert not list((home / "disk").iterdir())


def can_mount() -> bool:
    probe = [*UNSHARED, "mount", "-t", "tmpfs", "-o", f"size={PAGE}", "tmpfs", "/mnt"]
    try:
        return subprocess.run(probe, capture_output=True, check=False).returncode == 0
    except OSError:
        return False


@pytest.fixture(scope="module")
def worker(home: Path) -> Iterator[CommandWorker]:
    """A process that can mount disks, which no other one sees."""
    if not can_mount():
        pytest.skip("this machine does not let a test mount a disk")
    with CommandWorker(cwd=home, prefix=UNSHARED) as worker:
        yield worker


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "n_free"),  # pages
    [*((command, n_free) for command in COMMANDS for n_free in (0, 3)), ("benchmark", 4)],
)
def test_a_full_disk_is_one_line_and_leaves_nothing_half_written(
    command: str, n_free: int, worker: CommandWorker, home: Path
) -> None:
    def sh(script: str) -> None:
        assert worker.run("sh", "-c", script)[0] == 0

    sh(
        f"mount -t tmpfs -o size={16 * PAGE} tmpfs disk && head -c {(16 - n_free) * PAGE} /dev/zero > disk/others"
    )
    try:
        assert "No space left on device" in error_of(*worker.run(*COMMANDS[command]))
        disk = Path(f"/proc/{worker.process.pid}/root{home / 'disk'}")
        left = {path.name for path in disk.rglob("*")}
        assert {"others"} <= left <= {"others"} | KEPT.get(command, set())

        sh("mount -o remount,size=64m disk")
        code, said = worker.run(*COMMANDS[command])
        assert code == 0, said
        assert not [path.name for path in disk.rglob("*") if path.name.startswith(".")]
    finally:
        sh("umount --lazy disk")  # a failed video encoder keeps its file open until the process ends
