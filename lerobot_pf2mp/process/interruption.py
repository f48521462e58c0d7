# SPDX-License-Identifier: Apache-2.0
"""Handles Ctrl-C, SIGTERM, which `kill` and cluster schedulers send, and SIGHUP, which a closed terminal sends.

All three end a command in the same way.
"""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

# The shell's exit codes.
INTERRUPTED = 130
TERMINATED = 143

_AT_ONCE = 1.0  # a second SIGTERM within this time is ignored [s]


HUNG_UP = 129


class Terminated(KeyboardInterrupt):
    """Raised by SIGTERM. As a KeyboardInterrupt it runs the same clean-up as Ctrl-C."""


class HungUp(Terminated):
    """Raised by SIGHUP."""


@contextmanager
def sigterm_like_ctrl_c() -> Iterator[None]:
    """Lets SIGTERM and SIGHUP raise `Terminated` inside a `with` block, in the main thread of this process.

    A SIGHUP that is ignored, as after ``nohup``, stays so.
    """
    process, last = os.getpid(), -math.inf

    def terminate(number: int, _: Any) -> None:
        nonlocal last
        # A process that a library has forked from this one ends as it would without this handler.
        if os.getpid() != process:
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
            return
        now = time.monotonic()
        # `timeout` signals the process and then its group. The second signal would interrupt the clean-up.
        if now - last > _AT_ONCE:
            last = now
            raise Terminated if number == signal.SIGTERM else HungUp

    outer = {
        number: signal.signal(number, terminate)
        for number in (signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM))
        if signal.getsignal(number) != signal.SIG_IGN
    }
    try:
        yield
    finally:
        for number, handler in outer.items():
            signal.signal(number, handler)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Puts off Ctrl-C, SIGTERM and SIGHUP until the end of a `with` block, for a clean-up that must not stop half-way."""
    if threading.current_thread() is not threading.main_thread():
        yield  # signals reach the main thread only
        return
    came: list[tuple[int, Any]] = []
    numbers = {signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)}
    outer = {number: signal.signal(number, lambda *args: came.append(args)) for number in numbers}
    try:
        yield
    finally:
        for number, handler in outer.items():
            signal.signal(number, handler)
        if came and callable(outer[signal.Signals(came[0][0])]) and not sys.exception():
            signal.raise_signal(came[0][0])


def exit_code(interruption: KeyboardInterrupt) -> int:
    """The exit code of a command after an interruption."""
    if isinstance(interruption, HungUp):
        return HUNG_UP
    return TERMINATED if isinstance(interruption, Terminated) else INTERRUPTED
