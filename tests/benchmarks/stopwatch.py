# SPDX-License-Identifier: Apache-2.0
"""Where the time of a running program goes."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any
from unittest.mock import patch


class Stopwatch:
    """Adds up the time spent in chosen functions, each without that of the others it calls.

    Attributes:
        seconds: The time of each name so far [s].
    """

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._inner: list[float] = []  # for each function that runs: time in other ones [s]

    def on(self, owner: Any, function: str, name: str) -> AbstractContextManager[Any]:
        """Times a module's function or a class's method, under a name, until the block is left."""
        return patch.object(owner, function, self._timed(getattr(owner, function), name))

    def _timed(self, function: Callable[..., Any], name: str) -> Callable[..., Any]:
        def timed(*args: Any, **kwargs: Any) -> Any:
            self._inner.append(0.0)
            began = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                took = time.perf_counter() - began
                self.seconds[name] += took - self._inner.pop()
                if self._inner:
                    self._inner[-1] += took

        return timed
