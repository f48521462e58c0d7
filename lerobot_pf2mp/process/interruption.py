# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C and SIGTERM, which `kill` and the schedulers of clusters send: both end a command in the same way."""

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

_AT_ONCE = 1.0  # [s]


class Terminated(KeyboardInterrupt):
    """SIGTERM has come; what cleans up after Ctrl-C cleans up after it too."""


@contextmanager
def sigterm_like_ctrl_c() -> Iterator[None]:
    """Within the block, in the main thread of this process, SIGTERM raises `Terminated`."""
    process, last = os.getpid(), -math.inf

    def terminate(*_: Any) -> None:
        nonlocal last
        # A process of a library's, forked from this one, ends as it would without us.
        if os.getpid() != process:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            os.kill(os.getpid(), signal.SIGTERM)
            return
        now = time.monotonic()
        # `timeout` signals the process and then its group; the second time would interrupt the clean-up.
        if now - last > _AT_ONCE:
            last = now
            raise Terminated

    outer = signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, outer)


def exit_code(interruption: KeyboardInterrupt) -> int:
    """With what code a command ends after an interruption."""
    return TERMINATED if isinstance(interruption, Terminated) else INTERRUPTED
