"""How long the collision monitor, the mapper and the planner take.

The peers are the same work by simpler means, timed in the same run: a search without a heuristic
for A*, and OpenCV's polygon filling for the free space of a scan (which knows no rays, so it is no
substitute: it cannot leave out those that failed).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from systems.controllers.braking import CollisionMonitorParameters
from systems.controllers.collision_monitor import safe_command
from systems.messages import OccupancyGrid, Scan
from systems.planners.astar import AStarParameters, plan
from systems.planners.cost_map import CostMap, cost_map
from systems.planners.grid_search import shortest_way
from systems.planners.occupancy import OccupancyParameters, cells_of, empty_grid, with_scan
from systems.planners.polyline import length_of
from systems.planners.sonar_grid import (
    Cones,
    SonarGridParameters,
    empty_sonar_grid,
    rectangles,
    with_cones,
)
from tests.benchmarks.table import Row, show

Array = NDArray[np.float64]


def rows() -> Iterator[Row]:
    """Yields the measurements."""
    yield from monitor_rows()
    yield mapper_row()
    yield sonar_row()
    yield from planner_rows()


def monitor_rows() -> Iterator[Row]:
    """One command looked at, with 360 points of a wall and of a room."""
    hull, p = np.array([0.11, 0.11, 0.093]), CollisionMonitorParameters()
    angles = np.radians(np.arange(360.0))
    for what, distance, scaled in (
        ("room of 2 m", 2.0, False),
        ("0.3 m before a wall", 0.3, True),
    ):
        walls = np.stack([np.full(4, distance) if not scaled else [0.3, 2.0, 2.0, 2.0],
                          np.radians([0.0, 90.0, 180.0, 270.0])])  # fmt: skip
        with np.errstate(divide="ignore"):
            to_walls = walls[0][:, None] / np.cos(angles - walls[1][:, None])
        ranges = np.where(to_walls > 0, to_walls, math.inf).min(axis=0)
        points = ranges[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        command = np.array([0.3, 0.2])
        look = lambda points=points, command=command: safe_command(  # noqa: E731
            command, command, command, points, hull, p
        )
        (best,) = _interleaved(look)
        factor = look()[1]
        yield Row(
            f"collision monitor, {what}: one look", f"{best * 1e3:.2f} ms, speed x {factor:.1f}"
        )


def mapper_row() -> Row:
    """One scan of 360 rays in a room of 5 m put into a grid of 120 x 120 cells."""
    angles = -math.pi + np.radians(np.arange(360.0))
    with np.errstate(divide="ignore"):
        ranges = np.minimum(2.5 / np.abs(np.cos(angles)), 2.5 / np.abs(np.sin(angles)))
    scan = Scan(stamp=0.0, range_min=0.15, range_max=12.0, ranges=ranges)
    rays = np.stack([np.zeros(360), np.zeros(360), angles], axis=-1)
    parameters = OccupancyParameters()
    grid = empty_grid(parameters)
    ends = ranges[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)

    def filled() -> None:
        free = np.zeros(grid.log_odds.shape, np.uint8)
        cv2.fillPoly(free, [cells_of(ends, grid)[:, ::-1].astype(np.int32)], 1)

    ours, theirs = _interleaved(lambda: with_scan(grid, scan, rays, parameters), filled)
    return Row("mapper: a scan of 360 rays, room of 5 m, 120 x 120 cells", f"{ours * 1e3:.2f} ms",
               peers=f"polygon filled by OpenCV: {theirs * 1e3:.2f} ms")  # fmt: skip


def sonar_row() -> Row:
    """One reading of a ring of 24 range finders, half of which hear something."""
    p = SonarGridParameters()
    directions = np.linspace(0, 2 * math.pi, 24, endpoint=False)
    echoes = np.where(np.arange(24) % 2 == 0, 1.8, math.nan)
    cones = Cones(
        faces=0.12 * np.stack([np.cos(directions), np.sin(directions)], axis=-1),
        directions=directions,
        half_angles=np.full(24, math.radians(7.5)),
        free=np.where(np.isnan(echoes), 2.6, 1.72),
        echoes=echoes,
    )
    known = empty_sonar_grid(p)
    (best,) = _interleaved(lambda: rectangles(with_cones(known, cones, 0.0, p), p.max_shapes))
    return Row("sonar grid: one reading of 24 range finders", f"{best * 1e3:.2f} ms")


def planner_rows() -> Iterator[Row]:
    """Plans on grids of 200 x 200 cells (10 m)."""
    for what, grid, start, goal, limit in (
        ("25 boxes", boxes(), [0.5, 0.5], [9.5, 9.4], 20.0),
        ("a U-shaped trap of 6 m", trap(), [5.0, 5.0], [9.0, 5.0], None),
    ):
        p, a, b = AStarParameters(), np.array(start), np.array(goal)

        def costs(
            grid: OccupancyGrid = grid, a: Array = a, b: Array = b, p: AStarParameters = p
        ) -> CostMap:
            return cost_map(
                grid, a, b, radius=p.radius, soft_margin=p.soft_margin, soft_cost=p.soft_cost,
                unknown_cost=p.unknown_cost, occupied_above=p.occupied_above,
            )  # fmt: skip

        on = costs()
        whole, search, without = _interleaved(
            lambda costs=costs, a=a, b=b, p=p: plan(costs(), a, b, p.escape),
            lambda on=on, a=a, b=b: shortest_way(on.cost, on.cell(a), on.cell(b)),
            lambda on=on, a=a: shortest_way(on.cost, on.cell(a), _hidden_goal(on)),
            repeats=15,
        )
        found = plan(on, a, b, p.escape)
        length = length_of(found.points) if found is not None else math.nan
        yield Row(
            f"planner, 200 x 200 cells, {what}: cost map, search and pulling straight",
            f"{whole * 1e3:.1f} ms (search {search * 1e3:.1f}), {length:.2f} m",
            "" if limit is None else f"<= {limit:g} ms",
            None if limit is None else bool(whole * 1e3 <= limit),
            f"search of all cells: {without * 1e3:.1f} ms",
        )


def boxes() -> OccupancyGrid:
    """A room with 25 boxes of 0.4 m at random."""
    random = np.random.default_rng(0)
    cells = _room()
    for row, column in random.integers(20, 180, (25, 2)):
        cells[row : row + 8, column : column + 8] = 3.5
    return OccupancyGrid(stamp=0.0, frame_id="map", log_odds=cells)


def trap() -> OccupancyGrid:
    """A room with a U of 6 m that is open to the left."""
    cells = _room()
    cells[40:160, 150:153] = 3.5
    cells[40:43, 50:150] = cells[157:160, 50:150] = 3.5
    return OccupancyGrid(stamp=0.0, frame_id="map", log_odds=cells)


def _room() -> NDArray[np.float32]:
    cells = np.full((200, 200), -2.0, np.float32)
    cells[[0, -1]] = cells[:, [0, -1]] = 3.5
    return cells


def _hidden_goal(costs: CostMap) -> tuple[int, int]:
    """Returns a cell outside the room, which cannot be reached: all that can be is looked at."""
    return costs.cell(np.array([-0.5, -0.5]))


def _interleaved(*functions: Callable[[], object], repeats: int = 60) -> list[float]:
    best = [math.inf] * len(functions)
    for _ in range(repeats):
        for k, function in enumerate(functions):
            started = time.perf_counter()
            function()
            best[k] = min(best[k], time.perf_counter() - started)
    return best


if __name__ == "__main__":
    show("Planner, mapper and collision monitor", rows())
