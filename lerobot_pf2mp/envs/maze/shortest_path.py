# SPDX-License-Identifier: Apache-2.0
"""Shortest paths through the free cells of a maze."""

from __future__ import annotations

from collections import deque
from collections.abc import Set

Cell = tuple[int, int]


def shortest_path(free: Set[Cell], start: Cell, goal: Cell) -> list[Cell]:
    """The cells from start to goal, by breadth-first search from the goal. So paths to one goal coincide after they meet.

    Args:
        free: The free cells, row and column, all connected.
        start: The first one.
        goal: The last one.
    """
    towards: dict[Cell, Cell] = {goal: goal}
    queue = deque([goal])
    while start not in towards:
        i, j = queue.popleft()
        for neighbour in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
            if neighbour in free and neighbour not in towards:
                towards[neighbour] = (i, j)
                queue.append(neighbour)
    path = [start]
    while path[-1] != goal:
        path.append(towards[path[-1]])
    return path
