# SPDX-License-Identifier: Apache-2.0
"""Which strokes of a drawing become demonstrations. Between two strokes the pen is lifted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lerobot_pf2mp.dataset_tools.handwriting.recorded_episode import LeftOutError

_ONE, _EACH = "one", "each"


@dataclass(frozen=True)
class StrokeChoice:
    """Which strokes of a drawing become demonstrations.

    Args:
        strokes: ``one``: the only stroke, and drawings of several are left out; ``each``: every stroke becomes a demonstration;
            or the number of a stroke, from 1.

    Raises:
        ValueError: If `strokes` is something else.
    """  # noqa: E501

    strokes: str = _ONE

    def __post_init__(self) -> None:
        if self.strokes not in (_ONE, _EACH) and not self._number:
            raise ValueError(f"strokes must be one, each or a number from 1 on, got {self.strokes!r}")

    def of(self, is_down: np.ndarray, is_new: np.ndarray, name: str) -> list[tuple[str, slice]]:
        """The chosen strokes of a drawing: their names and their samples.

        Args:
            is_down: ``(N,)`` whether the pen is down.
            is_new: ``(N,)`` whether the pen was lifted just before a sample.
            name: The drawing's name.

        Raises:
            LeftOutError: If the drawing has not the strokes that were chosen.
        """
        found = _strokes(is_down, is_new)
        if not found:
            raise LeftOutError(
                "with the pen off the table", f"the pen must be down in {name}, got it up in each row"
            )
        if self.strokes == _EACH:
            return [
                (f"stroke {number} of {name}" if len(found) > 1 else name, stroke)
                for number, stroke in enumerate(found, 1)
            ]
        if self._number > len(found):
            raise LeftOutError(
                f"with fewer than {self._number} strokes",
                f"a drawing must have {self._number} strokes, got {len(found)} in {name}",
            )
        if self._number:
            return [(f"stroke {self._number} of {name}", found[self._number - 1])]
        if len(found) > 1:
            raise LeftOutError(
                "with the pen lifted in between",
                f"a demonstration must be one stroke, got the pen lifted in row {found[0].stop} of {name} and put down "
                f"again ({len(found)} strokes: --source.strokes=each makes each a demonstration, a number takes that one)",
            )
        return [(name, found[0])]

    @property
    def _number(self) -> int:
        """The number of the stroke; 0 if none was chosen by its number."""
        return int(self.strokes) if self.strokes.isdecimal() and len(self.strokes) < 5 else 0


def _strokes(is_down: np.ndarray, is_new: np.ndarray) -> list[slice]:
    """The samples between which the pen stays down."""
    is_first = is_down & (is_new | ~np.append(False, is_down[:-1]))
    is_last = is_down & ~np.append(is_down[1:] & ~is_new[1:], False)
    return [slice(a, b + 1) for a, b in zip(np.flatnonzero(is_first), np.flatnonzero(is_last), strict=True)]
