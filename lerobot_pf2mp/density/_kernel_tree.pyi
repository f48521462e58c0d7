# SPDX-License-Identifier: Apache-2.0
"""The C extension. All arrays are float32 and contiguous unless stated otherwise. It releases the GIL while it works.

A tree is what `KernelTree` holds: (leaves, boxes, centre, periods, exponent_per_square, exponent_range). `periods` is empty
if no dimension is an angle. A ValueError is raised if the sizes of the arrays do not fit.
"""

from numpy.typing import NDArray

type Tree = tuple[NDArray, NDArray, NDArray, NDArray, float, float]

LEAF_SIZE: int
INTERFACE: int

def order_points(points: NDArray, order: NDArray) -> None:
    """Fills `order` ``(N,)`` int64 so that each LEAF_SIZE successive points ``(N, D)`` are one leaf."""

def sum_kernels(tree: Tree, queries: NDArray, offsets: NDArray, log_sums: NDArray, n_threads: int) -> None:
    """Fills `offsets` ``(Q, D)`` to the local means and `log_sums` ``(Q,)`` of the kernels at queries ``(Q, D)``."""

def sum_other_kernels(
    tree: Tree,
    labels: NDArray,
    queries: NDArray,
    query_labels: NDArray,
    log_sums: NDArray,
    distances: NDArray,
    n_threads: int,
) -> None:
    """Fills `log_sums` ``(Q,)`` and `distances` ``(Q,)`` to the nearest anchor, both without some of the anchors.

    Left out are those whose label, one of int32 ``(L, LEAF_SIZE)``, differs by at most 1 from the query's, one of ``(Q,)``.
    """

def lead_to_targets(
    tree: Tree, targets: Tree, queries: NDArray, threshold: float, offsets: NDArray, n_threads: int
) -> None:
    """Fills `offsets` ``(Q, D)`` to the nearest target; zero where the log sum is above the threshold."""

def step_to_targets(
    tree: Tree,
    targets: Tree,
    queries: NDArray,
    threshold: float,
    share: float,
    max_distance: float,
    pull: tuple[float, float, float],
    steps: NDArray,
    n_threads: int,
) -> None:
    """Fills `steps` ``(Q, D)``, which cover a share of the offset to the local mean, times the weight of the pull.

    The pull is (log_normaliser, log_none, width). Its weight is (log_none - (log sum - log_normaliser)) / width within
    [0, 1].

    Where the log sum there is not above the threshold, they go on towards the nearest target, at most `max_distance`.
    """
