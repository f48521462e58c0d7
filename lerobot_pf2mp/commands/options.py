# SPDX-License-Identifier: Apache-2.0
"""Options of the commands, read as they were typed.

draccus reads every value as YAML: ``--root="data/maze #2"`` is data/maze for it, followed by a comment, ``~`` is nothing, a
date is a date, and ``!include`` reads another file. Here a value that is a text or a path is taken as it stands, others are
plain YAML without tags, and what draccus lets pass, such as null for a number, is an error.
"""

from __future__ import annotations

import json
import tomllib
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Union

import yaml
from draccus.argparsing import ArgumentParser
from draccus.parsers import decoding
from draccus.utils import CONFIG_ARG, DecodingError, ParsingError, deflatten, is_choice_type

from lerobot_pf2mp.commands.limits import LIMITS

# A configuration with more values than this is not looked at. Aliases of YAML can stand for any number of them.
_MOST_VALUES = 100_000
_LARGEST_FILE = 1_000_000  # bytes


class _PlainYaml(yaml.SafeLoader):
    """YAML's safe loader. Dates stay texts."""


_PlainYaml.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag != "tag:yaml.org,2002:timestamp"]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


def parse[T](config_class: type[T], args: Sequence[str] | None = None) -> T:
    """A command's options: those of its command line, then those of ``--config_path``, then the defaults.

    Args:
        config_class: The dataclass of the options.
        args: The command line; None for that of the process.

    Raises:
        ParsingError: If an option does not exist, cannot have its value, or the configuration file cannot be read.
        OSError: If the configuration file does not exist.
    """
    return _Parser(config_class, exit_on_error=True).parse_args(args)


class _Parser[T](ArgumentParser[T]):
    def _postprocessing(self, parsed_args: Any) -> T:
        texts = vars(parsed_args)
        path = texts.pop(CONFIG_ARG, None)
        in_file = {} if path is None else read_config_file(path, self.config_class)
        given = {name: read_option(self.config_class, name, text) for name, text in texts.items()}
        merged = _merged(in_file, deflatten(given, sep="."))
        try:
            config = decoding.decode(self.config_class, merged)
        except DecodingError as error:
            is_in_file = path is not None and not any(_is_below(name, error.key_path) for name in given)
            raise ParsingError(f"{f'{path}: ' if is_in_file else ''}{error}") from error
        _check([self.config_class], config, "")
        return config


def read_option(config_class: type, name: str, text: str) -> Any:
    """The value of an option on the command line.

    Args:
        config_class: The dataclass of the options.
        name: The option's name, for example ``dataset.root``.
        text: What was typed after the equals sign.
    """
    kinds = _kinds_at(config_class, name.split("."))
    if _is_text(kinds):
        return None if text == "null" and type(None) in kinds else text
    if text == "":
        return text  # an empty text is nothing for YAML
    try:
        return _as_typed(kinds, *_read_yaml(text))
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ParsingError(f"--{name} must be plain YAML, got {text!r}: {_in_one_line(error)}") from error


def quoted_texts(config_class: type, args: Sequence[str]) -> list[str]:
    """A command line for a command of LeRobot, which draccus reads, with texts and paths quoted where YAML needs it.

    Args:
        config_class: The dataclass of the command's options.
        args: What was typed.

    Raises:
        ParsingError: If the configuration file is no plain YAML.
        OSError: If it does not exist.
    """
    quoted = []
    for number, argument in enumerate(args):
        name, equals, text = argument.removeprefix("--").partition("=")
        if name == CONFIG_ARG:
            path = text if equals else "".join(args[number + 1 : number + 2])
            if Path(path).suffix or not _may_be_on_the_hub(path):
                read_config_file(path, config_class)
        # LeRobot itself reads these as they stand.
        is_raw = name.rpartition(".")[2] in (CONFIG_ARG, "type", "path", "discover_packages_path")
        if (
            argument.startswith("--")
            and equals
            and not is_raw
            and _is_text(_kinds_at(config_class, name.split(".")))
        ):
            argument = f"--{name}={text if text == 'null' else json.dumps(text, ensure_ascii=False)}"
        quoted.append(argument)
    return quoted


def _may_be_on_the_hub(path: str) -> bool:
    where = Path(path)
    return not where.exists() and not where.is_absolute() and len(where.parts) == 2


def read_config_file(path: str | Path, config_class: type) -> dict[str, Any]:
    """The options in a configuration file: YAML, or JSON or TOML by the file's ending.

    Args:
        path: The file.
        config_class: The dataclass of the options.

    Raises:
        ParsingError: If it is not readable, too large, or holds anything but options by name.
        OSError: If it does not exist.
    """
    path = Path(path).expanduser()
    try:
        if path.is_file() and path.stat().st_size > _LARGEST_FILE:
            raise ValueError(f"it must be smaller than 1 MB, got {path.stat().st_size} bytes")
        text = path.read_text(encoding="utf-8-sig")
        if path.suffix == ".json":
            typed = plain = json.loads(text)
        elif path.suffix == ".toml":
            typed = plain = tomllib.loads(text)
        else:
            typed, plain = _read_yaml(text)
    except OSError as error:
        raise OSError(f"the configuration {path} cannot be read: {error.strerror}") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ParsingError(f"the configuration {path} cannot be read: {_in_one_line(error)}") from error
    if not isinstance(typed, dict) or not all(isinstance(key, str) for key in typed):
        kind = {type(None): "nothing", list: "a list", dict: "other keys"}.get(type(typed), repr(typed))
        raise ParsingError(
            f"the configuration {path} must hold options by name, for example 'seed: 1', got {kind}"
        )
    return typing.cast(dict[str, Any], _as_typed([config_class], typed, plain))


def _read_yaml(text: str) -> tuple[Any, Any]:
    """A YAML text with values of their own types, and with all of them as texts."""
    typed = yaml.load(text, _PlainYaml)
    _count_values(typed, [0])
    return typed, yaml.load(text, yaml.BaseLoader)


def _count_values(value: Any, so_far: list[int]) -> None:
    so_far[0] += 1
    if so_far[0] > _MOST_VALUES:
        raise ValueError(f"it must hold at most {_MOST_VALUES} values")
    for item in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _count_values(item, so_far)


def _as_typed(kinds: Sequence[Any], typed: Any, plain: Any) -> Any:
    """A value in which texts and paths are as they were written, not as YAML understands them."""
    if typed is None:
        return None
    if isinstance(typed, str) or (_is_text(kinds) and isinstance(plain, str)):
        return plain if isinstance(plain, str) else typed
    if isinstance(typed, dict):
        return {
            key: _as_typed(
                [kind for one in kinds for kind in _kinds_at(one, [str(key)])],
                value,
                plain.get(str(key), value) if isinstance(plain, dict) else value,
            )
            for key, value in typed.items()
        }
    if isinstance(typed, list):
        of_items = [item for kind in kinds for item in _item_kinds(kind)]
        texts = plain if isinstance(plain, list) and len(plain) == len(typed) else typed
        return [_as_typed(of_items, *pair) for pair in zip(typed, texts, strict=True)]
    return typed


def _kinds_at(kind: Any, names: Sequence[str]) -> list[Any]:
    """The types that a value below another one may have.

    There may be several, because the kind of an environment or policy is an option too.
    """
    members = _members(kind)
    if not names:
        return members
    found: list[Any] = []
    for member in members:
        if is_choice_type(member):
            if list(names) == ["type"]:
                found.append(str)
            for choice in member.get_known_choices().values():
                found += _field_kinds(choice, names)
        elif is_dataclass(member):
            found += _field_kinds(member, names)
        elif typing.get_origin(member) in (dict, Mapping):
            found += _kinds_at(typing.get_args(member)[1], names[1:])
    return found


def _field_kinds(owner: Any, names: Sequence[str]) -> list[Any]:
    if names[0] not in {field.name for field in fields(owner)}:
        return []
    try:
        hints = typing.get_type_hints(owner)
    except NameError:  # of an optional library that is not there
        return []
    return _kinds_at(hints[names[0]], names[1:])


def _members(kind: Any) -> list[Any]:
    is_union = typing.get_origin(kind) in (Union, types.UnionType)
    return [member for one in typing.get_args(kind) for member in _members(one)] if is_union else [kind]


def _item_kinds(kind: Any) -> list[Any]:
    if typing.get_origin(kind) not in (list, tuple):
        return []
    return [member for item in typing.get_args(kind) if item is not Ellipsis for member in _members(item)]


def _is_text(kinds: Sequence[Any]) -> bool:
    """Whether a value is a text or a path, whatever kind of environment or policy is chosen."""
    return bool({str, Path} & set(kinds)) and set(kinds) <= {str, Path, type(None)}


def _check(kinds: Sequence[Any], value: Any, name: str) -> None:
    """Refuses null where a value is needed, and numbers beyond all limits, anywhere in some options."""
    if value is None:
        if kinds and not {Any, type(None)} & set(kinds):
            wanted = " or ".join(dict.fromkeys(getattr(kind, "__name__", str(kind)) for kind in kinds))
            raise ParsingError(f"{name} must be {wanted}, got null")
        return
    limit = LIMITS.get(name.rpartition(".")[2].partition("[")[0])
    if limit is not None and isinstance(value, int | float) and value > limit:
        raise ParsingError(f"{name} must be at most {limit}, got {value:g}")
    for of_item, item, below in _parts(kinds, value):
        _check(of_item, item, f"{name}{below}" if name else below.removeprefix("."))


def _parts(kinds: Sequence[Any], value: Any) -> Iterator[tuple[list[Any], Any, str]]:
    """The values within a value, with their types and how their names go on."""
    if is_dataclass(value) and not isinstance(value, type):
        try:
            hints = typing.get_type_hints(type(value))
        except NameError:
            return
        for field in fields(value):
            yield _members(hints[field.name]), getattr(value, field.name), f".{field.name}"
    elif isinstance(value, list | tuple):
        of_items = [item for kind in kinds for item in _item_kinds(kind)]
        for number, item in enumerate(value):
            yield of_items, item, f"[{number}]"
    elif isinstance(value, dict):
        of_values = [
            member
            for kind in kinds
            if typing.get_origin(kind) in (dict, Mapping)
            for member in _members(typing.get_args(kind)[1])
        ]
        for key, item in value.items():
            yield of_values, item, f".{key}"


def _merged(below: dict[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Two nested dictionaries; where both have a value, that of `above`."""
    merged = dict(below)
    for key, value in above.items():
        is_nested = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = _merged(merged[key], value) if is_nested else value
    return merged


def _is_below(name: str, key_path: Sequence[str]) -> bool:
    """Whether an option is the one of an error, or one of its parts, or it is part of it."""
    names = name.split(".")
    n = min(len(names), len(key_path))
    return bool(n) and list(key_path[:n]) == names[:n]


def _in_one_line(error: BaseException) -> str:
    if isinstance(error, yaml.MarkedYAMLError) and error.problem and error.problem_mark:
        return f"line {error.problem_mark.line + 1}: {error.problem}"
    return " ".join(str(error).split()) or type(error).__name__
