# SPDX-License-Identifier: Apache-2.0
"""Kinds and largest sizes of a policy's options. draccus lets null pass for a number, and code passes what it likes."""

from __future__ import annotations

import types
import typing
from collections.abc import Hashable, Iterator
from dataclasses import fields
from functools import cache
from numbers import Integral, Real
from typing import Any, Union, cast

# Beyond them a policy would only run out of memory or time.
LARGEST: dict[str, int] = {
    "diffusion_step_embed_dim": 65_536,
    "down_dims": 65_536,
    "field_action_dims": 100_000,
    "field_angle_dims": 100_000,
    "field_state_dims": 100_000,
    "horizon": 10_000,
    "kernel_size": 1001,
    "max_plans": 1000,
    "n_action_steps": 10_000,
    "n_field_points": 10_000_000,
    "n_groups": 65_536,
    "n_obs_steps": 1000,
    "num_inference_steps": 10_000,
    "num_train_timesteps": 100_000,
    "resize_shape": 10_000,
    "crop_shape": 10_000,
    "spatial_softmax_num_keypoints": 10_000,
}


def check_kinds_and_sizes(config: Any) -> None:
    """Checks that all numbers and switches of a configuration are what they must be, and not absurdly large.

    Args:
        config: A dataclass.

    Raises:
        ValueError: If one is null, of another kind, or above `LARGEST`. It names the option.
    """
    for name, kinds in _kinds_of(cast(Hashable, type(config))):
        value = getattr(config, name)
        if value is None:
            if type(None) not in kinds:
                raise ValueError(f"{name} must be {_described(kinds)}, got null")
            continue
        for item in value if isinstance(value, list | tuple) else (value,):
            if not any(_is_of(item, kind) for kind in kinds - {type(None)}):
                raise ValueError(f"{name} must be {_described(kinds)}, got {value!r}")
            if name in LARGEST and item > LARGEST[name]:
                raise ValueError(f"{name} must be at most {LARGEST[name]}, got {value}")


def is_of_kind(value: Any, hint: Any) -> bool:
    """Whether a value is of a type hint's kind, if that is a number, switch or text, or null; true for other hints."""
    kinds = set(_leaves(hint))
    if not kinds <= {int, float, bool, str, type(None)} or typing.get_origin(hint) in (tuple, list):
        return True
    return any(_is_of(value, kind) for kind in kinds)


@cache
def _kinds_of(config_class: Any) -> tuple[tuple[str, frozenset[type]], ...]:
    """The options that are numbers or switches, or tuples of them, with the kinds that they may have."""
    hints = typing.get_type_hints(config_class)
    found = []
    for field in fields(config_class):
        kinds = frozenset(_leaves(hints[field.name]))
        if kinds - {type(None)} and kinds <= {int, float, bool, type(None)}:
            found.append((field.name, kinds))
    return tuple(found)


def _leaves(hint: Any) -> Iterator[Any]:
    if typing.get_origin(hint) in (Union, types.UnionType, tuple, list):
        for part in typing.get_args(hint):
            if part is not Ellipsis:
                yield from _leaves(part)
    else:
        yield hint


def _is_of(value: Any, kind: type) -> bool:
    if isinstance(value, bool) or kind is bool:
        return isinstance(value, bool) and kind is bool
    return isinstance(value, Integral if kind is int else Real if kind is float else kind)


def _described(kinds: frozenset[type]) -> str:
    words = {int: "an integer", float: "a number", bool: "true or false", type(None): "null"}
    return " or ".join(words[kind] for kind in (int, float, bool, type(None)) if kind in kinds)
