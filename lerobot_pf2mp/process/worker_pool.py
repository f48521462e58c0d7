# SPDX-License-Identifier: Apache-2.0
"""Processes that work side by side, stop without noise, and end with the process that started them."""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any


@contextmanager
def worker_pool(
    n_processes: int, initializer: Callable[..., None], arguments: tuple[Any, ...]
) -> Iterator[ProcessPoolExecutor]:
    """Fresh processes; what they have not begun when the block is left is dropped, and after an interruption all of it.

    Args:
        n_processes: How many.
        initializer: Called in each before its first task.
        arguments: Its arguments.
    """
    pool = ProcessPoolExecutor(
        n_processes,
        multiprocessing.get_context("spawn"),
        initializer=_start,
        initargs=(initializer, arguments),
    )
    try:
        with _sigint_blocked():
            pool.submit(_begin)  # the first task starts all processes
        yield pool
    except KeyboardInterrupt:
        # A terminal has interrupted them too, but `kill` reaches this process alone, and a task may take minutes.
        for process in list(pool._processes.values()):
            process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _sigint_blocked() -> Iterator[None]:
    """Blocks SIGINT here and in new processes. One that is interrupted while it imports would print a traceback."""
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


def _start(initializer: Callable[..., None], arguments: tuple[Any, ...]) -> None:
    # Ctrl-C in a terminal reaches every process; Python's own handler would print a traceback in each.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    threading.Thread(target=_end_with_parent, daemon=True).start()
    initializer(*arguments)


def _end_with_parent() -> None:
    """Ends this process as soon as the one that started it has ended, however it ended."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)


def _begin() -> None:
    """The task with which the processes start."""
