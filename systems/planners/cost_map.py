"""What it costs a robot to drive where: an occupancy grid, grown by the robot's radius.

Near obstacles a metre costs more, so that the cheapest way keeps its distance where there is room
and still passes where there is little.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from heapq import heappop, heappush

import cv2
import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled, packed
from systems.messages import OccupancyGrid
from systems.planners.polyline import length_of, points_along

Array = NDArray[np.float64]
Cell = tuple[int, int]

STEPS = ((0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, -1), (-1, 1))
_RIM = 1.0  # m
_MOST_CELLS = 4_000_000


@dataclass(frozen=True, eq=False)
class CostMap:
    """What it costs to drive where, made of an occupancy grid.

    Cost and clearance of all cells are worked out when they are first asked for: whether a path is
    still free can be told without.

    Attributes:
        resolution: side of a cell, m.
        origin: (2,) corner of cell (0, 0) with the least coordinates, m.
        log_odds: (rows along y, columns along x) float32; 0 is unknown.
        occupied_above: log-odds above which a cell is occupied.
        radius: of the circle that holds the robot, m.
        soft_margin: beyond the radius, a metre costs more up to this distance, m.
        soft_cost: how much more at the radius; falls with the square to 0 at soft_margin.
        unknown_cost: how much more where nothing has been seen.
    """

    resolution: float
    origin: Array
    log_odds: NDArray[np.float32]
    occupied_above: float
    radius: float
    soft_margin: float
    soft_cost: float
    unknown_cost: float

    @cached_property
    def clearance(self) -> Array:
        """From the middle of each cell to what is occupied, m; 0 or less in it."""
        occupied = self.log_odds > self.occupied_above
        if not occupied.any():
            return np.full(occupied.shape, np.inf)
        distance = cv2.distanceTransform(
            (~occupied).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE
        )
        return (distance - 0.5).astype(float) * self.resolution

    @cached_property
    def cost(self) -> Array:
        """Of a metre in each cell, at least 1; inf where the robot would touch something."""
        cost = np.empty(self.log_odds.shape)
        margin = max(self.soft_margin, 1e-9)
        _costs(
            self.log_odds, self.clearance, self.radius, margin, self.soft_cost, self.unknown_cost,
            cost,
        )  # fmt: skip
        return cost

    def cell(self, point: Array) -> Cell:
        """Returns the cell (row, column) of a point (2,) m; it may lie outside."""
        column, row = np.floor((point - self.origin) / self.resolution).astype(int)
        return int(row), int(column)

    def middle(self, cell: Cell) -> Array:
        """Returns the middle of a cell, (2,) m."""
        return self.origin + (np.array([cell[1], cell[0]]) + 0.5) * self.resolution

    def at(self, points: Array, values: Array) -> Array:
        """Returns the values (rows, columns) of the cells of points (n, 2) m; inf outside."""
        cells = np.floor((points - self.origin) / self.resolution).astype(np.intp)
        column, row = cells[:, 0], cells[:, 1]
        rows, columns = values.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        found = np.full(len(points), np.inf)
        found[inside] = values[row[inside], column[inside]]
        return found


def cost_map(
    grid: OccupancyGrid,
    *points: Array,
    radius: float,
    soft_margin: float = 0.0,
    soft_cost: float = 0.0,
    unknown_cost: float = 0.0,
    occupied_above: float = 0.5,
    max_side: float = 60.0,
) -> CostMap:
    """Returns what it costs to drive where, on the grid and around the points (2,) m.

    What lies outside the grid is unknown; there is always a rim of a metre about it, so that a way
    may lead around what fills it.

    Args:
        grid: what is known.
        points: to be on the map.
        radius: of the circle that holds the robot, m.
        soft_margin: beyond the radius, a metre costs more up to this distance, m.
        soft_cost: how much more at the radius; falls with the square to 0 at soft_margin.
        unknown_cost: how much more where nothing has been seen.
        occupied_above: log-odds above which a cell is occupied.
        max_side: longest side of the map, m.

    Raises:
        ValueError: the map would be larger than allowed.
    """
    resolution = grid.resolution
    rows, columns = grid.log_odds.shape
    x, y = grid.origin.tolist()
    across = [0.0, float(columns), *((float(point[0]) - x) / resolution for point in points)]
    along = [0.0, float(rows), *((float(point[1]) - y) / resolution for point in points)]
    sides = [-(-max(s) // 1) - min(s) // 1 + 2 * _RIM / resolution for s in (across, along)]
    fits = all(side * resolution <= max_side for side in sides)  # none is NaN either
    if not fits or sides[0] * sides[1] > _MOST_CELLS:
        raise ValueError(f"the map would be longer than {max_side} m")
    rim = math.ceil(_RIM / resolution)
    left, below = rim - math.floor(min(across)), rim - math.floor(min(along))
    shape = below + math.ceil(max(along)) + rim, left + math.ceil(max(across)) + rim
    log_odds = np.zeros(shape, np.float32)
    log_odds[below : below + rows, left : left + columns] = grid.log_odds
    return CostMap(
        resolution,
        np.array((x - left * resolution, y - below * resolution)),
        log_odds,
        occupied_above,
        radius,
        soft_margin,
        soft_cost,
        unknown_cost,
    )


@compiled("void(f4[:,::1], f8[:,::1], f8, f8, f8, f8, f8[:,::1])")
def _costs(
    log_odds: NDArray[np.float32],
    clearance: Array,
    radius: float,
    soft_margin: float,
    soft_cost: float,
    unknown_cost: float,
    cost: Array,
) -> None:
    rows, columns = cost.shape
    for row in range(rows):
        for column in range(columns):
            beyond = clearance[row, column] - radius
            if beyond < 0:
                cost[row, column] = math.inf
                continue
            share = max(1 - beyond / soft_margin, 0.0)
            unknown = unknown_cost if log_odds[row, column] == 0 else 0.0
            cost[row, column] = 1 + soft_cost * share * share + unknown


def way_out(costs: CostMap, cell: Cell, escape: float) -> list[Cell] | None:
    """Returns the shortest way from a cell to one where the robot fits: [cell] if it does there.

    It passes what is too near to an obstacle, but nothing occupied (except for its first cell), so
    it does not lead to the other side of a wall. None when there is none within `escape` (m).
    """
    rows, columns = costs.cost.shape
    if not (0 <= cell[0] < rows and 0 <= cell[1] < columns):
        return None
    most = escape / costs.resolution
    reached = {cell: 0.0}
    parent: dict[Cell, Cell] = {}
    heap = [(0.0, cell)]
    while heap:
        length, here = heappop(heap)
        if np.isfinite(costs.cost[here]):
            way = [here]
            while way[-1] != cell:
                way.append(parent[way[-1]])
            return way[::-1]
        for dy, dx in STEPS:
            there = here[0] + dy, here[1] + dx
            total = length + math.hypot(dy, dx)
            inside = 0 <= there[0] < rows and 0 <= there[1] < columns
            if not inside or total > most or total >= reached.get(there, math.inf):
                continue
            if costs.clearance[there] > 0:
                reached[there], parent[there] = total, here
                heappush(heap, (total, there))
    return None


def nearest_reachable(cost: Array, start: Cell, goal: Cell) -> Cell:
    """Returns the cell nearest to the goal that can be reached from start: the goal if it can.

    Args:
        cost: (rows, columns), inf where there is no way; finite at start.
        start: (row, column).
        goal: (row, column); may be outside.
    """
    _, labels = cv2.connectedComponents(np.isfinite(cost).astype(np.uint8), connectivity=4)
    rows, columns = cost.shape
    inside = 0 <= goal[0] < rows and 0 <= goal[1] < columns
    if inside and labels[goal] == labels[start]:
        return goal
    cells = np.argwhere(labels == labels[start])
    nearest = cells[np.argmin(((cells - goal) ** 2).sum(axis=1))]
    return int(nearest[0]), int(nearest[1])


def line_cost(costs: CostMap, a: Array, b: Array) -> float:
    """Returns what it costs to drive straight from a to b (2,) m; inf where it cannot be done."""
    return _line_cost(costs.cost, packed(costs.origin), costs.resolution, packed(a), packed(b))


@compiled("f8(f8[:,::1], f8[::1], f8, f8[::1], f8[::1])")
def _line_cost(cost: Array, origin: Array, resolution: float, a: Array, b: Array) -> float:
    rows, columns = cost.shape
    dx, dy = b[0] - a[0], b[1] - a[1]
    length = math.hypot(dx, dy)
    n = max(math.ceil(length / (0.5 * resolution)), 1)
    total = 0.0
    for k in range(n):
        share = (k + 0.5) / n
        column = math.floor((a[0] + share * dx - origin[0]) / resolution)
        row = math.floor((a[1] + share * dy - origin[1]) / resolution)
        if not (0 <= row < rows and 0 <= column < columns):
            return math.inf
        total += cost[row, column]
    return length * total / n


def is_clear(costs: CostMap, points: Array, position: Array, radius: float) -> bool:
    """Returns whether a path (n, 2) m comes nowhere too near to an obstacle.

    That is nearer than the radius, or, for a robot that is nearer already, than it is now.
    """
    frame = np.array((*costs.origin, costs.resolution, costs.occupied_above))
    return _is_clear(costs.log_odds, frame, packed(points), packed(position), radius)


@compiled("b1(f4[:,::1], f8[::1], f8[:,::1], f8[::1], f8)")
def _is_clear(
    log_odds: NDArray[np.float32], frame: Array, points: Array, position: Array, radius: float
) -> bool:
    resolution = frame[2]
    here = _clearance_at(log_odds, frame, position[0], position[1], radius)
    least = min(radius, here) - resolution / 2
    for k in range(max(len(points) - 1, 1)):
        after = min(k + 1, len(points) - 1)
        dx, dy = points[after, 0] - points[k, 0], points[after, 1] - points[k, 1]
        n = max(math.ceil(math.hypot(dx, dy) / (resolution / 2)), 1)
        for i in range(n + 1):
            x, y = points[k, 0] + i / n * dx, points[k, 1] + i / n * dy
            if not _clearance_at(log_odds, frame, x, y, radius) >= least:
                return False
    return True


@compiled()
def _clearance_at(
    log_odds: NDArray[np.float32], frame: Array, x: float, y: float, reach: float
) -> float:
    """Returns the clearance of a cell, m, as far as it is less than `reach`; else that or more."""
    resolution = frame[2]
    rows, columns = log_odds.shape
    column = math.floor((x - frame[0]) / resolution)
    row = math.floor((y - frame[1]) / resolution)
    if not (0 <= row < rows and 0 <= column < columns):
        return math.inf
    cells = math.ceil(reach / resolution + 0.5)
    nearest = math.inf
    for j in range(max(row - cells, 0), min(row + cells + 1, rows)):
        for i in range(max(column - cells, 0), min(column + cells + 1, columns)):
            if log_odds[j, i] > frame[3]:
                nearest = min(nearest, float((j - row) ** 2 + (i - column) ** 2))
    return (math.sqrt(nearest) - 0.5) * resolution


def steering_point(
    costs: CostMap, rest: Array, position: Array, *, radius: float, lookahead: float
) -> Array:
    """Returns the farthest place on a path to which a straight line from the robot is clear.

    Args:
        costs: what is where.
        rest: (n, 2) m, the path from the place nearest to the robot.
        position: (2,) of the robot, m.
        radius: see `is_clear`.
        lookahead: how far along the path at most, m.
    """
    distances = np.arange(lookahead, costs.resolution / 2, -costs.resolution)
    places = points_along(rest, np.minimum(distances, length_of(rest)))
    for place in places:
        if is_clear(costs, np.array([position, place]), position, radius):
            return np.array(place)
    return np.array(places[-1])


def driving_cost(costs: CostMap, points: Array) -> float:
    """Returns the cost of a path (n, 2) m, where it is too near to an obstacle that of a margin."""
    finite = costs.cost[np.isfinite(costs.cost)]
    dear = float(finite.max()) if len(finite) else 1.0
    n = max(math.ceil(length_of(points) / (costs.resolution / 2)), 1)
    along = points_along(points, (np.arange(n) + 0.5) / n * length_of(points))
    return length_of(points) * float(np.minimum(costs.at(along, costs.cost), dear).mean())
