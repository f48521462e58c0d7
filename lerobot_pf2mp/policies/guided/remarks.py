# SPDX-License-Identifier: Apache-2.0
"""What a user should know about the actions to which a potential field was fitted, in one line each."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lerobot_pf2mp.potential_field import JudgedFit

# A remark names at most this many frames.
_N_NAMED = 6

# Normalised values beyond this show that the normalisation divided by almost nothing.
_LARGEST_VALUE = 1e3

# A dimension with fewer values than this is no continuous coordinate.
_FEW_VALUES = 10


def remarks_on_outlying(judged: JudgedFit, episodes: Tensor | None, frames: Tensor) -> str:
    """A line about the outlying points, or an empty string if there are none.

    Args:
        judged: The fit.
        episodes: ``(P,)`` episode numbers; None if they are unknown.
        frames: ``(P,)`` frame numbers.
    """
    outlying = judged.is_outlying.nonzero().flatten()
    if not len(outlying):
        return ""
    outlying = outlying[frames[outlying].argsort()]
    named = [
        f"frame {frames[i]}" + ("" if episodes is None else f" of episode {episodes[i]}")
        for i in outlying[:_N_NAMED].tolist()
    ]
    if len(outlying) > _N_NAMED:
        named.append(f"{len(outlying) - _N_NAMED} more")
    farthest = judged.distance[outlying].max().item() / judged.field.bandwidth
    return (
        f"{len(outlying)} of the {len(judged.is_outlying)} actions kept for the potential field are far from all others, by "
        f"up to {farthest:.3g} bandwidths, and left out of it: {', '.join(named)}."
    )


def remarks_on_dimensions(points: Tensor, bandwidth: float, dims: Sequence[int]) -> str:
    """A line about the dimensions that a density with one bandwidth cannot serve, or an empty string.

    The kernels are as wide in every dimension. A constant dimension carries no distance among the demonstrations, and an
    action that leaves the constant is far from all of them, as it should be; no remark is made.

    Args:
        points: ``(P, D)`` the field's points [normalised].
        bandwidth: h [normalised].
        dims: The D action dimensions they are.
    """
    found = []
    for dim, values in zip(dims, points.double().unbind(1), strict=True):
        low, high = (values.kthvalue(1 + round(q * (len(values) - 1))).values.item() for q in (0.05, 0.95))
        n_values = len(torch.unique(values))
        if values.abs().max() > _LARGEST_VALUE:
            found.append(
                f"dimension {dim} reaches {values.abs().max():.2g} in normalised units: the two numbers that "
                "normalise it almost coincide"
            )
        elif 1 < n_values < _FEW_VALUES and len(values) >= 10 * _FEW_VALUES:
            found.append(
                f"dimension {dim} takes {n_values} values only: a switch, or the rounding of a constant"
            )
        elif 0 < high - low < bandwidth:
            found.append(
                f"dimension {dim} varies by {high - low:.2g}, less than the bandwidth {bandwidth:.2g}: the field does not "
                "resolve it"
            )
    if not found:
        return ""
    return (
        f"The potential field has one bandwidth for all dimensions, but {'; '.join(found)}. Leave such dimensions out with "
        "field_action_dims if they have nothing to do with obstacles."
    )
