# SPDX-License-Identifier: Apache-2.0
"""Refuses arrays that claim to be much larger than what is stored of them, before memory or time is spent on them."""

from __future__ import annotations

from pathlib import Path

_HARMLESS = 2**26  # bytes that any array may have
# Recorded positions compress by a factor of 2 to 20. Columns of zeros compress better, but they are short.
_LARGEST_RATIO = 100


def check_size(name: str, shape: tuple[int, ...], n_bytes: int, n_stored: int, path: Path) -> None:
    """Checks that an array in a file can be recorded data.

    Args:
        name: Its name.
        shape: Its shape.
        n_bytes: Its size in memory [bytes].
        n_stored: What the file stores of it, compressed [bytes].
        path: The file, for the error message.

    Raises:
        ValueError: If it is larger than 64 MiB and than a hundred times what is stored.
    """
    if n_bytes > max(_HARMLESS, _LARGEST_RATIO * n_stored):
        raise ValueError(
            f"{name} must be stored in the file, got an array of shape {shape} and {n_bytes:.3g} bytes of which only "
            f"{n_stored} bytes are stored in {path}"
        )
