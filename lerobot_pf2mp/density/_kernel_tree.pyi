# SPDX-License-Identifier: Apache-2.0
"""The C extension. All arrays are float32 and contiguous unless said otherwise; it holds no lock while it works.

A tree is what `KernelTree` holds: (leaves, boxes, centre, scale, reach). Sizes that do not fit raise a ValueError.
"""

from numpy.typing import NDArray

type Tree = tuple[NDArray, NDArray, NDArray, float, float]

LEAF_SIZE: int

def order_points(points: NDArray, order: NDArray) -> None:
    """Fills `order` ``(N,)`` int64 so that every LEAF_SIZE successive points ``(N, D)`` are a leaf's."""

def sum_kernels(tree: Tree, queries: NDArray, offsets: NDArray, log_sums: NDArray, n_threads: int) -> None:
    """Fills `offsets` ``(Q, D)`` to the local means and `log_sums` ``(Q,)`` of the kernels at queries ``(Q, D)``."""

def lead_to_targets(
    tree: Tree, targets: Tree, queries: NDArray, threshold: float, offsets: NDArray, n_threads: int
) -> None:
    """Fills `offsets` ``(Q, D)``: to the nearest target where the log sum is not above the threshold, elsewhere 0."""

def step_to_targets(
    tree: Tree,
    targets: Tree,
    queries: NDArray,
    threshold: float,
    share: float,
    reach: float,
    steps: NDArray,
    n_threads: int,
) -> None:
    """Fills `steps` ``(Q, D)``: a share of the way to the local mean, and from there at most `reach` to the nearest target.

    The second part is where the log sum there is not above the threshold.
    """
