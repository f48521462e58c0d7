# SPDX-License-Identifier: Apache-2.0
"""A network that goes away while a checkpoint or a dataset is published: one line, nothing half-published, and again."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from command_worker import CommandWorker
from hub_server import HubServer, Interruption
from untrained_policies import write_checkpoint

LARGE_FILE, COMMIT, TAG = "PUT /storage/", "/commit/main", "/tag/v3.0"
Run = Callable[..., tuple[int, str]]


@pytest.fixture(scope="module")
def hub() -> Iterator[HubServer]:
    with HubServer() as hub:
        hub.users["writes"] = "user"
        yield hub


@pytest.fixture(scope="module")
def run(hub: HubServer, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    """A function that runs a command and returns its exit code and what it wrote to the standard error stream."""
    home = tmp_path_factory.mktemp("home")
    with CommandWorker({**hub.environment(home, "writes"), "HF_HUB_DOWNLOAD_TIMEOUT": "1"}) as worker:
        yield worker.run


def push(folder: Path) -> list[str]:
    path = folder / "policy"
    if not path.exists():
        write_checkpoint(path, "pf2mp")
    return ["pf2mp-push", f"--path={path}", f"--repo_id=user/{folder.name}"]


def collect(folder: Path) -> list[str]:
    return [
        "pf2mp-collect",
        "--task=maze_umaze",
        "--n_episodes=2",
        "--n_steps=8",
        "--push_to_hub=true",
        f"--repo_id=user/{folder.name}",
        f"--root={folder / 'data'}",
        "--overwrite=true",
    ]


def contents(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "interruption", "n_commits"),
    [
        pytest.param(push, Interruption(LARGE_FILE), 1, id="checkpoint"),
        pytest.param(push, Interruption(LARGE_FILE, is_silent=True), 1, id="checkpoint-silence"),
        pytest.param(push, Interruption(COMMIT), 1, id="checkpoint-commit"),
        pytest.param(push, Interruption(COMMIT, n_bytes=None), 2, id="checkpoint-answer"),
        pytest.param(collect, Interruption(LARGE_FILE), 1, id="dataset"),
        pytest.param(collect, Interruption(COMMIT, is_silent=True), 1, id="dataset-silence"),
        pytest.param(collect, Interruption(TAG), 2, id="dataset-tag"),
    ],
)
def test_an_interrupted_upload_ends_in_one_line_and_succeeds_afterwards(
    command: Callable[[Path], list[str]],
    interruption: Interruption,
    n_commits: int,
    hub: HubServer,
    run: Run,
    tmp_path: Path,
) -> None:
    kind, told = (
        ("model", "") if command is push else ("dataset", f"the dataset was written to {tmp_path / 'data'}: ")
    )
    arguments = command(tmp_path)
    before = contents(tmp_path)
    hub.interruptions[:] = [interruption]
    hub.large_files.clear()  # what is there already is not uploaded again
    code, said = run(*arguments)
    assert code == 1 and "Traceback" not in said
    (line,) = (line for line in said.splitlines() if line.startswith("error: "))
    assert re.fullmatch(f"error: {told}user/{tmp_path.name} cannot be published: .+", line)
    # Nothing but the Hub's own commit, and perhaps one that is whole.
    repository = hub.repositories[kind, f"user/{tmp_path.name}"]
    commits = list(repository.commits.values())
    assert len(commits) == n_commits and set(commits[0]) == {".gitattributes"}
    assert not repository.tags
    after = contents(tmp_path)
    assert {name: after[name] for name in before} == before
    assert all(name.startswith("data/") for name in after.keys() - before.keys())

    hub.interruptions.clear()
    code, said = run(*arguments)
    assert code == 0, said
    assert len(repository.commits) == 2
    for name, content in contents(tmp_path / ("policy" if command is push else "data")).items():
        assert name == "README.md" or repository.files()[name] == content
    assert set(repository.tags) == (set() if command is push else {"v3.0"})


@pytest.mark.slow
def test_a_short_interruption_is_not_noticed(hub: HubServer, run: Run, tmp_path: Path) -> None:
    arguments = push(tmp_path)
    hub.interruptions[:] = [Interruption(LARGE_FILE, n_times=2)]
    hub.large_files.clear()
    code, said = run(*arguments)
    assert code == 0, said
    assert hub.interruptions[0].n_times == 0
    assert "model.safetensors" in hub.repositories["model", f"user/{tmp_path.name}"].files()
