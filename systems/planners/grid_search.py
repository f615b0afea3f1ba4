"""The cheapest way on a grid: A*.

Hart, Nilsson, Raphael, "A formal basis for the heuristic determination of minimum cost paths", IEEE
Transactions on Systems Science and Cybernetics 4, 1968. Here on an 8-connected grid with the octile
distance as heuristic.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled, packed
from systems.planners.cost_map import STEPS, Cell

Array = NDArray[np.float64]

_DIAGONAL = math.sqrt(2.0)
# Breaks ties between equally long ways; the way found is longer than the best by no more than this.
_GREED = 1.001


def shortest_way(cost: Array, start: Cell, goal: Cell) -> list[Cell] | None:
    """Returns the cells of the cheapest way on an 8-connected grid, or None.

    A step costs its length in cells times the mean cost of its two cells. No step cuts a corner
    between two cells of which one cannot be entered. The way is at most 0.1 % costlier than the
    cheapest.

    Args:
        cost: (rows, columns) at least 1; inf where there is no way.
        start: (row, column).
        goal: (row, column).
    """
    if not (np.isfinite(cost[start]) and np.isfinite(cost[goal])):
        return None
    parent, spent = np.full(cost.shape, -1), np.full(cost.shape, math.inf)
    if not _search(packed(cost), *start, *goal, spent, parent):
        return None
    way = [goal]
    while way[-1] != start:
        row, column = divmod(int(parent[way[-1]]), cost.shape[1])
        way.append((row, column))
    return way[::-1]


@compiled("b1(f8[:,::1], i8, i8, i8, i8, f8[:,::1], i8[:,::1])")
def _search(
    cost: Array,
    start_row: int,
    start_column: int,
    goal_row: int,
    goal_column: int,
    spent: Array,
    parent: NDArray[np.int64],
) -> bool:
    """Writes from where each cell is reached, as an index; returns whether the goal is."""
    rows, columns = cost.shape
    closed = np.zeros((rows, columns), np.bool_)
    spent[start_row, start_column] = 0.0
    heap = np.empty((1024, 2))
    _push(heap, 0, 0.0, start_row * columns + start_column)
    waiting = 1
    while waiting:
        index = _pop(heap, waiting)
        waiting -= 1
        row, column = index // columns, index % columns
        if row == goal_row and column == goal_column:
            return True
        if closed[row, column]:
            continue
        closed[row, column] = True
        for k in range(8):
            dy, dx = STEPS[k]
            y, x = row + dy, column + dx
            inside = 0 <= y < rows and 0 <= x < columns
            if not inside or cost[y, x] == math.inf:
                continue
            if cost[y, column] == math.inf or cost[row, x] == math.inf:  # it would cut a corner
                continue
            step = _DIAGONAL if dy and dx else 1.0
            total = spent[row, column] + step * (cost[row, column] / 2 + cost[y, x] / 2)
            if total < spent[y, x]:
                spent[y, x] = total
                parent[y, x] = index
                far, near = abs(y - goal_row), abs(x - goal_column)
                far, near = max(far, near), min(far, near)
                to_go = (far + (_DIAGONAL - 1) * near) * _GREED
                if waiting == len(heap):
                    larger = np.empty((2 * waiting, 2))
                    for i in range(waiting):
                        larger[i, 0], larger[i, 1] = heap[i, 0], heap[i, 1]
                    heap = larger
                _push(heap, waiting, total + to_go, y * columns + x)
                waiting += 1
    return False


# A binary heap in the first rows of an array, [cost, cell] a row; of equal costs the least cell is
# the first. Python's own takes Numba ten seconds to compile.


@compiled()
def _is_before(heap: Array, i: int, cost: float, cell: float) -> bool:
    """Tells whether row i comes before (cost, cell)."""
    return heap[i, 0] < cost or (heap[i, 0] == cost and heap[i, 1] < cell)


@compiled()
def _copy(heap: Array, i: int, j: int) -> None:
    """Writes row i to row j."""
    heap[j, 0], heap[j, 1] = heap[i, 0], heap[i, 1]


@compiled()
def _push(heap: Array, n: int, cost: float, cell: float) -> None:
    """Adds to a heap of n rows, which has room for one more."""
    i = n
    while i > 0 and not _is_before(heap, (i - 1) // 2, cost, cell):
        _copy(heap, (i - 1) // 2, i)
        i = (i - 1) // 2
    heap[i, 0], heap[i, 1] = cost, cell


@compiled()
def _pop(heap: Array, n: int) -> int:
    """Takes the first cell from a heap of n rows."""
    first = int(heap[0, 1])
    cost, cell = heap[n - 1, 0], heap[n - 1, 1]
    i = 0
    while 2 * i + 1 < n - 1:
        child = 2 * i + 1
        if child + 1 < n - 1 and _is_before(heap, child + 1, heap[child, 0], heap[child, 1]):
            child += 1
        if not _is_before(heap, child, cost, cell):
            break
        _copy(heap, child, i)
        i = child
    heap[i, 0], heap[i, 1] = cost, cell
    return first
