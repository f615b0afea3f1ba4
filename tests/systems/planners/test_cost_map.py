from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from systems.messages import OccupancyGrid
from systems.planners.cost_map import (
    CostMap,
    cost_map,
    driving_cost,
    is_clear,
    line_cost,
    nearest_reachable,
    steering_point,
    way_out,
)
from tests.systems.planners.drawn import drawn, room


def test_clearance_and_cost_about_one_obstacle() -> None:
    cells = np.full((61, 61), -2.0, np.float32)
    cells[30, 30] = 3.5
    grid = OccupancyGrid(
        stamp=0.0, resolution=0.05, origin=np.array([-1.525, -1.525]), log_odds=cells
    )
    costs = cost_map(grid, radius=0.15, soft_margin=0.2, soft_cost=3.0, unknown_cost=0.5)
    for point in np.random.default_rng(0).uniform(-1.5, 1.5, (200, 2)):
        cell = costs.cell(point)
        gap = math.hypot(*costs.middle(cell)) - 0.025
        assert costs.clearance[cell] == pytest.approx(gap, abs=1e-6)
        if gap < 0.15 - 1e-6:
            assert math.isinf(costs.cost[cell])
        else:
            share = max(0.0, 1 - (gap - 0.15) / 0.2)
            assert costs.cost[cell] == pytest.approx(1 + 3 * share**2, abs=1e-4)
    # About the grid there is a rim of what is unknown.
    assert costs.at(np.array([[1.9, 0.0]]), costs.cost)[0] == 1.5
    assert math.isinf(costs.at(np.array([[3.9, 0.0]]), costs.cost)[0])


@pytest.mark.parametrize("point", [[9.0, 0.1], [-7.3, 4.0], [0.1, -12.0]])
def test_the_map_holds_the_points_and_keeps_the_grid_in_place(point: list[float]) -> None:
    grid = drawn("....", "..#.", "....", repeat=4)
    costs = cost_map(grid, np.array(point), radius=0.1, unknown_cost=1.0)
    assert costs.at(np.array([point]), costs.cost)[0] == 2.0
    assert costs.clearance[costs.cell(np.array([0.5, 0.3]))] <= 0
    assert costs.at(np.array([[0.1, 0.1]]), costs.cost)[0] == 1.0


@pytest.mark.parametrize("point", [[1e3, 0.0], [1e300, 0.0], [0.0, -40.0]])
def test_a_point_too_far_away_is_refused(point: list[float]) -> None:
    with pytest.raises(ValueError, match="longer than"):
        cost_map(drawn(".."), np.array(point), radius=0.1, max_side=30.0)


def test_an_empty_grid_is_unknown_all_over() -> None:
    costs = cost_map(OccupancyGrid(), np.array([1.0, 1.0]), radius=0.1, unknown_cost=0.5)
    assert (costs.cost == 1.5).all()


def flat(cells: list[str], radius: float = 0.02) -> CostMap:
    """A map of cells of 0.1 m without inflation, rim and all."""
    return cost_map(drawn(*cells, resolution=0.1), radius=radius)


def test_the_cost_of_a_line() -> None:
    costs = cost_map(drawn("....????", resolution=0.5), radius=0.1, unknown_cost=1.0)
    a, b = np.array([0.0, 0.25]), np.array([4.0, 0.25])
    assert line_cost(costs, a, b) == pytest.approx(2 * 1 + 2 * 2)
    assert driving_cost(costs, np.array([a, b, a])) == pytest.approx(12)
    assert math.isinf(line_cost(flat(["..#.."]), np.array([0.05, 0.05]), np.array([0.45, 0.05])))


def test_the_way_out_does_not_lead_through_a_wall() -> None:
    # Just before a thin wall; the free side is farther than what is behind the wall.
    grid = drawn(*["........#........"] * 12)
    costs = cost_map(grid, radius=0.15)
    start = costs.cell(np.array([0.375, 0.3]))
    assert math.isinf(costs.cost[start])
    way = way_out(costs, start, 0.5)
    assert way is not None
    assert costs.middle(way[-1])[0] < 0.375
    assert len(way) == 4
    assert all(costs.clearance[cell] > 0 for cell in way)
    assert way_out(costs, start, 0.1) is None


def test_where_it_fits_there_is_nothing_to_leave() -> None:
    costs = cost_map(drawn(*["........#........"] * 12), radius=0.15)
    cell = costs.cell(np.array([0.05, 0.3]))
    assert way_out(costs, cell, 0.5) == [cell]
    assert way_out(costs, (-1, 3), 0.5) is None


def test_out_of_an_occupied_cell_one_may_get() -> None:
    costs = flat([".....", "..#..", "....."])
    cell = costs.cell(np.array([0.25, 0.15]))
    way = way_out(costs, cell, 0.5)
    assert way is not None
    assert len(way) == 2


def test_the_nearest_place_that_can_be_reached() -> None:
    cost = np.ones((5, 9))
    cost[:, 5] = np.inf
    assert nearest_reachable(cost, (2, 1), (2, 3)) == (2, 3)
    assert nearest_reachable(cost, (2, 1), (1, 7)) == (1, 4)
    assert nearest_reachable(cost, (2, 8), (1, -3)) == (1, 6)
    cost[2, 5] = 1.0
    assert nearest_reachable(cost, (2, 1), (1, 7)) == (1, 7)
    # Past a corner between two cells there is no way.
    cost = np.array([[1.0, np.inf], [np.inf, 1.0]])
    assert nearest_reachable(cost, (0, 0), (1, 1)) == (0, 0)


def box_room() -> CostMap:
    cells = room(3.0)
    cells[20:40, 28:32] = 3.5  # a wall from y = 1 to 2 at x = 1.4 to 1.6
    return cost_map(OccupancyGrid(stamp=0.0, resolution=0.05, log_odds=cells), radius=0.15)


def test_what_is_clear() -> None:
    costs = box_room()
    here = np.array([0.8, 1.5])
    assert is_clear(costs, np.array([here, [0.8, 2.5], [2.2, 2.5]]), here, 0.15)
    assert not is_clear(costs, np.array([here, [2.2, 1.5]]), here, 0.15)
    assert not is_clear(costs, np.array([here, [0.8, 2.06], [2.2, 2.06]]), here, 0.15)
    # From a place that is too near already it may go on, but not nearer.
    near = np.array([1.3, 1.5])
    assert is_clear(costs, np.array([near, [1.3, 2.0], [1.0, 2.0]]), near, 0.15)
    assert not is_clear(costs, np.array([near, [1.38, 1.5]]), near, 0.15)


@pytest.mark.parametrize("radius", [0.05, 0.15, 0.33])
def test_what_is_clear_is_so_on_the_map_of_clearances(radius: float) -> None:
    random = np.random.default_rng(1)
    cells = np.where(random.random((60, 60)) < 0.02, 3.5, -2.0).astype(np.float32)
    costs = cost_map(OccupancyGrid(stamp=0.0, resolution=0.05, log_odds=cells), radius=radius)
    verdicts = []
    for _ in range(300):
        points = random.uniform(-0.5, 3.5, 2) + np.cumsum(random.normal(0, 0.3, (3, 2)), axis=0)
        fine = np.concatenate([np.linspace(a, b, 2000) for a, b in pairwise(points)])
        here, least = (costs.at(p, costs.clearance).min() for p in (points[:1], fine))
        verdict = is_clear(costs, points, points[0], radius)
        # Looked at every half a cell: what it crosses by less it may miss.
        if least >= min(radius, here) - 0.025:
            assert verdict
        if least < min(radius, here) - 0.025 - 0.05:
            assert not verdict
        verdicts.append(verdict)
    assert 30 < sum(verdicts) < 270


def test_the_steering_point_is_as_far_along_as_can_be_seen() -> None:
    costs = box_room()
    path = np.array([[0.8, 1.5], [1.1, 2.3], [1.9, 2.3], [2.2, 1.5]])
    found = steering_point(costs, path, path[0], radius=0.15, lookahead=0.5)
    along = math.hypot(0.3, 0.8)
    np.testing.assert_allclose(found, path[0] + (path[1] - path[0]) * 0.5 / along)
    found = steering_point(costs, path, path[0], radius=0.15, lookahead=5.0)
    assert is_clear(costs, np.array([path[0], found]), path[0], 0.15)
    assert found[0] > 1.1  # past the first corner, which it may cut
    assert not is_clear(costs, np.array([path[0], path[2]]), path[0], 0.15)
    near_end = path[3] + [0.0, 0.1]
    rest = np.array([near_end, path[3]])
    np.testing.assert_allclose(
        steering_point(costs, rest, near_end, radius=0.15, lookahead=0.6), path[3]
    )
