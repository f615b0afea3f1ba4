"""What it costs a robot to drive where: an occupancy grid, grown by the robot's radius.

Near obstacles a metre costs more, so that the cheapest way keeps its distance where there is room
and still passes where there is little.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from heapq import heappop, heappush

import cv2
import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled
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

    Attributes:
        resolution: side of a cell, m.
        origin: (2,) corner of cell (0, 0) with the least coordinates, m.
        cost: (rows along y, columns along x) cost of a metre, at least 1; inf where the robot would
            touch something.
        clearance: (rows, columns) from the middle of the cell to what is occupied, m; 0 or less in
            it.
    """

    resolution: float
    origin: Array
    cost: Array
    clearance: Array

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
    shape = np.array(grid.log_odds.shape)
    corners = np.array([(point - grid.origin) / resolution for point in points]).reshape(-1, 2)
    low = np.floor(np.vstack([corners, [0, 0]]).min(axis=0))[::-1]
    high = np.ceil(np.vstack([corners, shape[::-1]]).max(axis=0))[::-1]
    sides = high - low + 2 * _RIM / resolution
    if sides.max() * resolution > max_side or sides.prod() > _MOST_CELLS:
        raise ValueError(f"the map would be longer than {max_side} m")
    rim = math.ceil(_RIM / resolution)
    before, after = rim - low.astype(int), rim + high.astype(int) - shape
    log_odds = np.pad(grid.log_odds, np.stack([before, after], axis=-1))
    occupied = log_odds > occupied_above
    if occupied.any():
        distance = cv2.distanceTransform(
            (~occupied).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE
        )
        clearance = (distance - 0.5).astype(float) * resolution
    else:
        clearance = np.full(log_odds.shape, np.inf)
    cost = np.empty(log_odds.shape)
    _costs(log_odds, clearance, radius, max(soft_margin, 1e-9), soft_cost, unknown_cost, cost)
    return CostMap(resolution, grid.origin - before[::-1] * resolution, cost, clearance)


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
    length = float(np.hypot(*(b - a)))
    n = max(math.ceil(length / (0.5 * costs.resolution)), 1)
    points = a + ((np.arange(n) + 0.5) / n)[:, None] * (b - a)
    return length * float(costs.at(points, costs.cost).mean())


def is_clear(costs: CostMap, points: Array, position: Array, radius: float) -> bool:
    """Returns whether a path (n, 2) m comes nowhere too near to an obstacle.

    That is nearer than the radius, or, for a robot that is nearer already, than it is now.
    """
    here = float(costs.at(position[None], costs.clearance)[0])
    least = min(radius, here) - costs.resolution / 2
    n = max(math.ceil(length_of(points) / (costs.resolution / 2)), 1)
    along = points_along(points, np.linspace(0, length_of(points), n + 1))
    return bool((costs.at(along, costs.clearance) >= least).all())


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
