# SPDX-License-Identifier: Apache-2.0
"""Code shared by the commands: how they start and end, and the folders of the datasets that they write."""

from __future__ import annotations

import logging
import os
import sys
import traceback
from argparse import ArgumentError
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from draccus.utils import ParsingError
from safetensors import SafetensorError

from lerobot_pf2mp import __version__
from lerobot_pf2mp.commands.options import parse
from lerobot_pf2mp.process.interruption import exit_code, sigterm_like_ctrl_c

# Read by `processor_files`. Importing it would import LeRobot.
TRUST_VARIABLE = "PF2MP_TRUST"

# Earlier names of options. They still work.
_RENAMED = {"--picture_width": "--image_width"}

FAULT_OF_OURS = (
    "error: this is a fault of lerobot_policy_pf2mp, not of yours. Please report it where you got the package from, with "
    "the lines above, the command and its inputs, and the output of pf2mp-info"
)


def answer_version() -> None:
    """Prints the version and ends the process if the command line is ``--version``. Large imports come only later."""
    if sys.argv[1:] == ["--version"]:
        print(f"{Path(sys.argv[0]).name} {__version__}")
        sys.exit()


def run(config_class: type, main: Callable[[Any], None]) -> None:
    """Parses the command line and runs a command. Errors that users can cause print one line and exit with code 1."""
    answer_version()
    for number, argument in enumerate(sys.argv):
        name, equals, value = argument.partition("=")
        sys.argv[number] = f"{_RENAMED.get(name, name)}{equals}{value}"
    # LeRobot's lengthy warning about a video decoder that these commands do not use.
    logging.getLogger("lerobot.utils.import_utils").setLevel(logging.ERROR)
    try:
        with errors_in_one_line(), sigterm_like_ctrl_c():
            config: Any = parse(config_class)
            trust_steps(getattr(config, "trust", ()))
            main(config)
    except KeyboardInterrupt as interruption:
        print("interrupted: nothing half-written was left behind", file=sys.stderr)
        sys.exit(exit_code(interruption))


def trust_steps(classes: Sequence[str]) -> None:
    """Lets this process, and those that it starts, import these classes of processor steps (see `processor_files`)."""
    trusted = [*filter(None, classes), *filter(None, os.environ.get(TRUST_VARIABLE, "").split(","))]
    if trusted:
        os.environ[TRUST_VARIABLE] = ",".join(trusted)


@contextmanager
def errors_in_one_line() -> Iterator[None]:
    """Ends the process with code 1 after an error: one line if a user can cause it, a traceback if the fault is ours."""
    try:
        yield
    except MemoryError as error:
        print("error: there is not enough memory:", one_line(error) or "it is full", file=sys.stderr)
        sys.exit(1)
    except (
        ParsingError,
        ArgumentError,
        SafetensorError,  # also for a full disk
        ValueError,
        RuntimeError,
        OSError,
        ImportError,
    ) as error:
        print("error:", one_line(error), file=sys.stderr)
        sys.exit(1)
    except Exception:
        traceback.print_exc()
        print(FAULT_OF_OURS, file=sys.stderr)
        sys.exit(1)


def one_line(error: BaseException) -> str:
    """The message of an error in one line."""
    return " ".join(str(error).split())


def given[T](option: str, value: T | None) -> T:
    """The value of an option that must be given.

    Raises:
        ValueError: If it was not given.
    """
    if value is None:
        raise ValueError(f"{option} must be given")
    return value


def dataset_name_and_root(repo_id: str | None, root: Path | None, name: str) -> tuple[str, Path]:
    """The name and the folder of a dataset. By default these are local/NAME and LeRobot's folder for that name."""
    from lerobot.utils.constants import HF_LEROBOT_HOME

    repo_id = repo_id or f"local/{name}"
    return repo_id, (root or HF_LEROBOT_HOME / repo_id).expanduser()


class DatasetOptions(Protocol):
    """The options about the dataset that a command writes."""

    repo_id: str | None
    root: Path | None
    n_steps: int | None
    overwrite: bool


def write_and_report(
    options: DatasetOptions, name: str, n_steps: int, write: Callable[..., tuple[int, Counter[str]]]
) -> None:
    """Writes a dataset and prints how many episodes were written and how many were left out.

    Args:
        options: The command's options.
        name: Default of the dataset's name, which is then local/NAME in LeRobot's folder.
        n_steps: Default of the number of steps of an episode.
        write: Function of root, repo_id, n_steps and overwrite. It returns the number of written episodes, and the numbers
            of omitted ones by reason.
    """
    repo_id, root = dataset_name_and_root(options.repo_id, options.root, name)
    n_steps = n_steps if options.n_steps is None else options.n_steps
    n_episodes, dropped = write(root=root, repo_id=repo_id, n_steps=n_steps, overwrite=options.overwrite)
    left_out = ", ".join(f"{count} {reason}" for reason, count in dropped.items()) or "none"
    print(f"Wrote {n_episodes} episodes of {n_steps} steps to {root} (left out: {left_out}).")
