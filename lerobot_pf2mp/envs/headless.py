# SPDX-License-Identifier: Apache-2.0
"""Rendering with MuJoCo on machines without a screen."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from ctypes.util import find_library

_HOW_TO_INSTALL = (
    "rendering without a screen needs EGL or OSMesa: install libegl1 and libgl1-mesa-dri, or libosmesa6"
)


@contextmanager
def rendering() -> Iterator[None]:
    """Lets MuJoCo render inside a `with` block.

    Without a screen it renders with EGL, or else with OSMesa, unless MUJOCO_GL names a backend.

    Raises:
        RuntimeError: If rendering is not possible; the message says what to install.
    """
    has_screen = sys.platform != "linux" or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )
    if not has_screen and "MUJOCO_GL" not in os.environ:
        os.environ["MUJOCO_GL"] = _offscreen_backend()
    try:
        yield
    except Exception as error:
        chosen = os.environ.get("MUJOCO_GL", "unset")
        raise RuntimeError(
            f"{_HOW_TO_INSTALL}; got {type(error).__name__} with MUJOCO_GL {chosen}: {error}"
        ) from error


def _offscreen_backend() -> str:
    for library, backend in (("EGL", "egl"), ("OSMesa", "osmesa")):
        if find_library(library):
            return backend
    raise RuntimeError(f"{_HOW_TO_INSTALL}; got neither")
