# SPDX-License-Identifier: Apache-2.0
"""The files of a checkpoint's processors, looked at before LeRobot loads them.

LeRobot imports and calls whatever class a processor's JSON names: ``{"class": "subprocess.Popen", ...}`` runs a program. A
registered step has a name instead, and nothing is imported for it. So only registered steps, and classes that the user
trusts, may stand there.
"""

from __future__ import annotations

import json
import os
import typing
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

from huggingface_hub import hf_hub_download
from huggingface_hub.errors import EntryNotFoundError
from lerobot.processor import ProcessorStepRegistry

from lerobot_pf2mp.policies.option_kinds import is_of_kind

PREPROCESSOR, POSTPROCESSOR = "policy_preprocessor.json", "policy_postprocessor.json"

# Classes of steps, separated by commas, that may be loaded although they are not registered.
TRUST_VARIABLE = "PF2MP_TRUST"

# LeRobot's own steps that are not registered.
_LEROBOTS_OWN = (
    "lerobot.processor.pipeline.IdentityProcessorStep",
    "lerobot.policies.xvla.processor_xvla.LiberoProcessorStep",
)
_trusted: ContextVar[tuple[str, ...]] = ContextVar("trusted", default=())

_MIGRATION = "python -m lerobot.processor.migrate_policy_normalization --pretrained-path CHECKPOINT"


@contextmanager
def trusting(classes: Sequence[str]) -> Iterator[None]:
    """Lets steps of these classes be loaded, each by its full name, for example ``my_package.steps.MyStep``."""
    token = _trusted.set((*_trusted.get(), *classes))
    try:
        yield
    finally:
        _trusted.reset(token)


def check_processors(path: str | Path, revision: str | None = None, *, must_exist: bool = False) -> None:
    """Checks that loading a checkpoint's processors runs no foreign code and reads no file outside it.

    Args:
        path: A checkpoint's folder, or a repository on the Hub.
        revision: Branch, tag or commit on the Hub.
        must_exist: Whether it is an error if there are no processors.

    Raises:
        ValueError: If a step is neither registered nor trusted, its state lies outside the checkpoint, or its
            configuration is null where it must not be. It names the file and the class.
        FileNotFoundError: If there are no processors, and they must exist.
    """
    for name in (PREPROCESSOR, POSTPROCESSOR):
        file = _find(path, name, revision)
        if file is not None:
            _check_file(file, f"{path}/{name}")
        elif must_exist:
            raise FileNotFoundError(
                f"a checkpoint must hold its processors, got {path} without {name}. LeRobot's own checkpoints from before "
                f"they had them are migrated by: {_MIGRATION}"
            )


def _find(path: str | Path, name: str, revision: str | None) -> Path | None:
    """A file of a checkpoint; None if it does not exist."""
    if Path(path).is_dir():
        file = Path(path) / name
        return file if file.exists() else None
    if len(Path(path).parts) != 2:
        return None  # neither a folder nor the name of a repository
    try:
        return Path(hf_hub_download(str(path), name, revision=revision))
    except EntryNotFoundError:
        return None


def _check_file(file: Path, shown: str) -> None:
    try:
        pipeline = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{shown} must be JSON, got a file that is not: {error}") from error
    steps = pipeline.get("steps") if isinstance(pipeline, dict) else None
    if not isinstance(steps, list) or not all(isinstance(step, dict) for step in steps):
        raise ValueError(f"{shown} must hold a list of steps, got {_shortened(pipeline)}")
    trusted = {*_LEROBOTS_OWN, *_trusted.get(), *os.environ.get(TRUST_VARIABLE, "").split(",")}
    for step in steps:
        name, state_file, step_class = (step.get(key) for key in ("registry_name", "state_file", "class"))
        if not isinstance(name, str) and not (isinstance(step_class, str) and step_class in trusted):
            raise ValueError(
                f"every step of {shown} must be registered in LeRobot, by its registry_name, got the class "
                f"{step_class!r}: nothing of it was imported. If you trust it: --trust='[{step_class}]', or "
                f"the environment variable {TRUST_VARIABLE}"
            )
        is_plain = isinstance(state_file, str) and state_file == Path(state_file).name and state_file != ".."
        if "state_file" in step and not is_plain:
            raise ValueError(
                f"the state_file of every step in {shown} must be a file beside it, got {state_file!r} of {name!r}"
            )
        _check_values(name, step.get("config", {}), shown)


def _check_values(name: str | None, values: Any, shown: str) -> None:
    """Refuses null, or another value than a mapping, where a step's class needs one."""
    if not isinstance(values, dict):
        raise ValueError(
            f"the config of every step in {shown} must be a mapping, got {_shortened(values)} of {name!r}"
        )
    try:
        step_class = ProcessorStepRegistry.get(name)
        hints = typing.get_type_hints(step_class) if is_dataclass(step_class) else {}
    except (KeyError, NameError):  # LeRobot says which steps there are
        return
    for option, value in values.items():
        hint = hints.get(option, Any)
        is_optional = type(None) in typing.get_args(hint) or hint in (Any, type(None))
        is_mapping = typing.get_origin(hint) is dict
        if (value is None and not is_optional) or (is_mapping and not isinstance(value, dict)):
            raise ValueError(
                f"{option} of {name!r} in {shown} must be {'a mapping' if is_mapping else 'a value'}, got "
                f"{'null' if value is None else _shortened(value)}"
            )
        if not is_of_kind(value, hint):
            raise ValueError(f"{option} of {name!r} in {shown} must be {hint}, got {_shortened(value)}")


def _shortened(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
