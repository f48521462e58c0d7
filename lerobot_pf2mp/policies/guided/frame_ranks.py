# SPDX-License-Identifier: Apache-2.0
"""The order in which frames are kept: a one-to-one scrambling of their numbers, the finaliser of splitmix64.

Steele, Lea and Flood, Fast Splittable Pseudorandom Number Generators, 2014.
"""

from __future__ import annotations

from torch import Tensor

_GAMMA = -0x61C8864680B583EB
_FIRST, _SECOND = -0x40A7B892E31B1A47, -0x6B2FB644ECCEEE15
# Their inverses modulo 2^64.
_FIRST_INVERSE, _SECOND_INVERSE = -0x6921E4E8C0EE6F77, 0x319642B2D24D8EC3


def rank_of(frames: Tensor) -> Tensor:
    """The ranks of int64 frame numbers, of the same shape."""
    x = frames + _GAMMA
    x = (x ^ _shifted(x, 30)) * _FIRST
    x = (x ^ _shifted(x, 27)) * _SECOND
    return x ^ _shifted(x, 31)


def frame_of(ranks: Tensor) -> Tensor:
    """The frame numbers of ranks, of the same shape."""
    x = _unshifted(ranks, 31) * _SECOND_INVERSE
    x = _unshifted(x, 27) * _FIRST_INVERSE
    return _unshifted(x, 30) - _GAMMA


def _shifted(x: Tensor, n_bits: int) -> Tensor:
    """X >> n_bits as if x were unsigned."""
    return (x >> n_bits) & ((1 << (64 - n_bits)) - 1)


def _unshifted(x: Tensor, n_bits: int) -> Tensor:
    """The y with y ^ (y >> n_bits) = x."""
    y = x
    for _ in range(64 // n_bits):
        y = x ^ _shifted(y, n_bits)
    return y
