# SPDX-License-Identifier: Apache-2.0
"""Refuses LeRobot's relative actions (action minus state) together with a potential field, which needs positions."""

from __future__ import annotations

import gc
from collections.abc import Iterable
from typing import Any

from lerobot.processor import RelativeActionsProcessorStep


def refuse_relative_actions(steps: Iterable[Any]) -> None:
    """Checks that no step of a preprocessor makes actions relative to the state.

    Args:
        steps: The steps of a preprocessor with a potential field.

    Raises:
        ValueError: If one does.
    """
    if any(isinstance(step, RelativeActionsProcessorStep) and step.enabled for step in steps):
        raise ValueError(
            "a potential field needs actions that are absolute positions, got a preprocessor that makes them relative to "
            "the state (relative_actions_processor, enabled=true), which field_over=integrated does not add up either: "
            "train with use_relative_actions=false"
        )


def refuse_relative_actions_beside(step: Any) -> None:
    """`refuse_relative_actions` for the preprocessor that holds a step.

    LeRobot builds preprocessors from their files, and a step does not know the others. The garbage collector knows the
    lists that hold it.

    Args:
        step: A step of the preprocessor.
    """
    for holder in gc.get_referrers(step):
        if type(holder) in (list, tuple):
            refuse_relative_actions(holder)
