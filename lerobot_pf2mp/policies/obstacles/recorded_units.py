# SPDX-License-Identifier: Apache-2.0
"""The units in which actions were recorded, in which obstacles are given, and normalised actions."""

from __future__ import annotations

import gc
from dataclasses import dataclass
from typing import Any

import torch
from lerobot.lerobot_types import TransitionKey
from lerobot.processor import NormalizerProcessorStep
from lerobot.utils.constants import ACTION
from torch import Tensor


@dataclass(frozen=True, eq=False)
class RecordedUnits:
    """Converts actions. All of LeRobot's normalisations are affine in each dimension: normalised = factor recorded + offset.

    Distances are not kept: a ball in recorded units is an ellipsoid in normalised ones. So all geometry of obstacles is done
    in recorded units.

    Args:
        factors: ``(A,)``.
        offsets: ``(A,)``.
    """

    factors: Tensor
    offsets: Tensor

    @classmethod
    def of(cls, normaliser: NormalizerProcessorStep) -> RecordedUnits:
        """Those of the normalising step of a preprocessor.

        Raises:
            ValueError: If it does not normalise actions, or not one to one.
        """
        feature = (normaliser.features or {}).get(ACTION)
        if feature is None:
            raise ValueError(
                "obstacles need the normalisation of actions, got a preprocessor that has none for them"
            )
        dim = feature.shape[0]
        transition: Any = {TransitionKey.ACTION: torch.stack([torch.zeros(dim), torch.ones(dim)])}
        zero, one = normaliser(transition)[TransitionKey.ACTION].double().cpu()
        factors = one - zero
        if not bool((factors.isfinite() & (factors != 0) & zero.isfinite()).all()):
            raise ValueError(
                f"obstacles need a normalisation of actions that is one to one, got the factors {factors.tolist()}"
            )
        return cls(factors.float(), zero.float())

    def on(self, dims: tuple[int, ...] | None, device: torch.device) -> RecordedUnits:
        """Those of some action dimensions, on a device; None for all."""
        chosen = slice(None) if dims is None else list(dims)
        return RecordedUnits(self.factors[chosen].to(device), self.offsets[chosen].to(device))

    def recorded(self, normalised: Tensor) -> Tensor:
        """Actions ``(..., A)`` in recorded units."""
        return (normalised - self.offsets) / self.factors

    def normalised(self, recorded: Tensor) -> Tensor:
        """Recorded actions ``(..., A)`` as normalised ones."""
        return recorded * self.factors + self.offsets


def units_beside(step: Any) -> RecordedUnits | None:
    """The `RecordedUnits` of the preprocessor that holds a step; None if it does not normalise actions one to one.

    LeRobot builds preprocessors from their files, and a step does not know the others. The garbage collector knows the
    lists that hold it.
    """
    for holder in gc.get_referrers(step):
        for other in holder if type(holder) in (list, tuple) else ():
            if isinstance(other, NormalizerProcessorStep):
                try:
                    return RecordedUnits.of(other)
                except ValueError:
                    return None
    return None
