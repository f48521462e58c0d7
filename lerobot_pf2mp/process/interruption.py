# SPDX-License-Identifier: Apache-2.0
"""Handles Ctrl-C and SIGTERM, which `kill` and cluster schedulers send. Both end a command in the same way."""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

# The shell's exit codes.
INTERRUPTED = 130
TERMINATED = 143

_AT_ONCE = 1.0  # a second SIGTERM within this time is ignored [s]


class Terminated(KeyboardInterrupt):
    """Raised by SIGTERM. As a KeyboardInterrupt it runs the same clean-up as Ctrl-C."""


@contextmanager
def sigterm_like_ctrl_c() -> Iterator[None]:
    """Lets SIGTERM raise `Terminated` inside a `with` block, in the main thread of this process."""
    process, last = os.getpid(), -math.inf

    def terminate(*_: Any) -> None:
        nonlocal last
        # A process that a library has forked from this one ends as it would without this handler.
        if os.getpid() != process:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            os.kill(os.getpid(), signal.SIGTERM)
            return
        now = time.monotonic()
        # `timeout` signals the process and then its group. The second signal would interrupt the clean-up.
        if now - last > _AT_ONCE:
            last = now
            raise Terminated

    outer = signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, outer)


def exit_code(interruption: KeyboardInterrupt) -> int:
    """The exit code of a command after an interruption."""
    return TERMINATED if isinstance(interruption, Terminated) else INTERRUPTED
