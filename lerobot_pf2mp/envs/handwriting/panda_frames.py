# SPDX-License-Identifier: Apache-2.0
"""Joint angles of two models of the Panda. They are the same arm, but two of its joints are at 0 in different postures.

The environments, their demonstrations and their checkpoints use the angles of gymnasium-robotics' model (`panda`). The
standard model, which a real Panda and most simulators have, counts the sixth joint from a quarter turn further back, and the
seventh from an eighth.
"""

from __future__ import annotations

import numpy as np

# Of the seven joints [rad] and the two fingers [m].
_OFFSETS = np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.pi / 2, np.pi / 4, 0.0, 0.0])


def to_standard(joints: np.ndarray) -> np.ndarray:
    """Positions ``(..., 9)`` of the standard Panda's joints for those of `panda` [rad; m]."""
    return joints + _OFFSETS


def from_standard(joints: np.ndarray) -> np.ndarray:
    """Positions ``(..., 9)`` of the joints of `panda` for those of the standard Panda [rad; m]."""
    return joints - _OFFSETS
