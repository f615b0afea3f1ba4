from __future__ import annotations

import heapq
import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator

from systems.messages import OccupancyGrid, Path
from systems.planners.astar import (
    AStarParameters,
    AStarPlanner,
    plan,
    pulled_straight,
)
from systems.planners.cost_map import CostMap, cost_map, driving_cost
from systems.planners.grid_search import shortest_way
from systems.planners.polyline import length_of
from tests.systems.planners.drawn import drawn, room

R = 0.15


def grid_of(cells: np.ndarray, resolution: float = 0.05) -> OccupancyGrid:
    return OccupancyGrid(stamp=0.0, frame_id="map", resolution=resolution, log_odds=cells)


def gaps(points: np.ndarray, grid: OccupancyGrid) -> float:
    """The least distance of a path from the squares of all occupied cells."""
    steps = np.concatenate(
        [a + np.linspace(0, 1, 200)[:, None] * (b - a) for a, b in pairwise(points)]
    )
    cells = np.argwhere(grid.log_odds > 0)[:, ::-1]
    middles = grid.origin + (cells + 0.5) * grid.resolution
    offset = np.abs(steps[:, None] - middles) - grid.resolution / 2
    return float(np.hypot(*np.maximum(offset, 0).transpose(2, 0, 1)).min())


# --- The search ---


def dijkstra(cost: np.ndarray, start: tuple[int, int]) -> np.ndarray:
    """The costs to all cells, written without any of the shortcuts."""
    best = np.full(cost.shape, math.inf)
    best[start] = 0.0
    queue = [(0.0, start)]
    while queue:
        so_far, (y, x) = heapq.heappop(queue)
        if so_far > best[y, x]:
            continue
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                v, u = y + dy, x + dx
                if not (0 <= v < cost.shape[0] and 0 <= u < cost.shape[1]):
                    continue
                if math.isinf(cost[v, u]) or math.isinf(cost[v, x]) or math.isinf(cost[y, u]):
                    continue
                total = so_far + math.hypot(dy, dx) * (cost[y, x] + cost[v, u]) / 2
                if total < best[v, u]:
                    best[v, u] = total
                    heapq.heappush(queue, (total, (v, u)))
    return best


def cost_of(way: list[tuple[int, int]], cost: np.ndarray) -> float:
    return sum(math.dist(a, b) * (cost[a] + cost[b]) / 2 for a, b in pairwise(way))


@pytest.mark.parametrize("seed", range(15))
def test_ways_are_as_short_as_dijkstras(seed: int) -> None:
    random = np.random.default_rng(seed)
    rows, columns = random.integers(8, 40, 2)
    cost = 1 + random.exponential(0.5, (rows, columns)) * random.integers(2)
    cost[random.random((rows, columns)) < random.uniform(0.1, 0.4)] = math.inf
    cells = np.argwhere(np.isfinite(cost))
    start = tuple(int(k) for k in cells[random.integers(len(cells))])
    best = dijkstra(cost, start)
    found = 0
    for goal in cells[random.integers(len(cells), size=10)]:
        goal = tuple(int(k) for k in goal)
        way = shortest_way(cost, start, goal)
        assert (way is None) == math.isinf(best[goal])
        if way is None:
            continue
        found += 1
        assert way[0] == start
        assert way[-1] == goal
        steps = np.abs(np.diff(way, axis=0)).max(axis=1) if len(way) > 1 else np.ones(0)
        assert (steps == 1).all()
        assert best[goal] * (1 - 1e-9) <= cost_of(way, cost) <= best[goal] * 1.001 + 1e-9
    assert found


def test_a_way_far_off_on_rough_ground_is_found_with_thousands_of_places_waiting() -> None:
    # So dear that the heuristic says little: nearly every cell is looked at first.
    cost = 1 + np.random.default_rng(0).exponential(30.0, (150, 150))
    way = shortest_way(cost, (75, 75), (2, 140))
    assert way is not None
    least = dijkstra(cost, (75, 75))[2, 140]
    assert least * (1 - 1e-9) <= cost_of(way, cost) <= least * 1.001


def test_known_lengths() -> None:
    cost = np.ones((20, 30))
    way = shortest_way(cost, (2, 3), (2, 23))
    assert cost_of(way or [], cost) == pytest.approx(20)
    way = shortest_way(cost, (2, 3), (12, 18))
    assert cost_of(way or [], cost) == pytest.approx(5 + 10 * math.sqrt(2))
    cost[:19, 15] = math.inf  # around the end of a wall, without cutting its corner
    way = shortest_way(cost, (19, 10), (19, 20))
    assert cost_of(way or [], cost) == pytest.approx(10)
    way = shortest_way(cost, (18, 14), (18, 16))
    assert cost_of(way or [], cost) == pytest.approx(4)
    assert shortest_way(cost, (5, 5), (5, 5)) == [(5, 5)]
    assert shortest_way(cost, (5, 15), (5, 5)) is None


def test_between_two_cells_that_touch_at_a_corner_there_is_no_way() -> None:
    cost = np.ones((9, 9))
    cost[np.arange(9), np.arange(9)] = math.inf
    assert shortest_way(cost, (0, 8), (8, 0)) is None


# --- The path ---


def costs_of(grid: OccupancyGrid, *points: Any, radius: float = R, **more: float) -> CostMap:
    return cost_map(grid, *(np.array(point) for point in points), radius=radius, **more)


@pytest.mark.parametrize("seed", range(20))
def test_paths_keep_the_radius_and_pulling_makes_them_cheaper(seed: int) -> None:
    random = np.random.default_rng(seed)
    cells = room(5.0)
    for row, column in random.integers(8, 80, (10, 2)):
        h, w = random.integers(1, 14, 2)
        cells[row : row + h, column : column + w] = 3.5
    grid = grid_of(cells)
    costs = costs_of(grid, soft_margin=0.2, soft_cost=3.0)
    free = np.argwhere(np.isfinite(costs.cost) & (costs.clearance < 9))
    a, b = (costs.middle(tuple(free[k])) for k in random.integers(len(free), size=2))
    found = plan(costs, a, b, 0.5)
    assert found is not None
    if not found.complete:
        assert shortest_way(costs.cost, costs.cell(a), costs.cell(b)) is None
        return
    np.testing.assert_array_equal(found.points[0], a)
    np.testing.assert_array_equal(found.points[-1], b)
    # The line of sight is sampled: it may cut a corner of a cell.
    assert gaps(found.points, grid) > R - 0.02
    way = shortest_way(costs.cost, costs.cell(a), costs.cell(b))
    whole = np.array([costs.middle(cell) for cell in way or []])
    assert driving_cost(costs, found.points) <= driving_cost(costs, whole) * 1.01
    assert len(found.points) <= len(whole)


def test_in_the_open_the_path_is_straight() -> None:
    costs = costs_of(grid_of(np.full((100, 100), -2.0, np.float32)))
    a, b = np.array([0.71, 0.33]), np.array([4.2, 2.9])
    found = plan(costs, a, b, 0.5)
    assert found is not None
    np.testing.assert_array_equal(found.points, [a, b])


def test_with_room_it_keeps_away_and_without_it_still_passes() -> None:
    cells = room(3.0)
    cells[:25, 30] = 3.5  # a wall up to y = 1.25 at x = 1.5
    grid = grid_of(cells)
    a, b = np.array([0.8, 0.6]), np.array([2.2, 0.6])
    near = plan(costs_of(grid), a, b, 0.5)
    far = plan(costs_of(grid, soft_margin=0.4, soft_cost=5.0), a, b, 0.5)
    assert near is not None
    assert far is not None
    assert R - 0.02 < gaps(near.points, grid) < R + 0.05
    assert gaps(far.points, grid) > R + 0.1


@pytest.mark.parametrize(("width", "passes"), [(0.6, True), (0.4, True), (0.25, False)])
def test_a_corridor_passes_if_it_is_wide_enough(width: float, passes: bool) -> None:
    n = round(width / 0.05)
    cells = np.full((40, 80), -2.0, np.float32)
    cells[:, [0, -1]] = cells[[0, -1]] = 3.5
    cells[:, 20:60] = 3.5
    cells[15 : 15 + n, 20:60] = -2.0
    costs = costs_of(grid_of(cells), soft_margin=0.2, soft_cost=3.0)
    found = plan(costs, np.array([0.5, 0.4]), np.array([3.5, 1.6]), 0.5)
    assert found is not None
    assert found.complete == passes
    middle = 0.75 + width / 2
    inside = found.points[(found.points[:, 0] > 1.0) & (found.points[:, 0] < 3.0)]
    assert (np.abs(inside[:, 1] - middle) < width / 2 - R + 0.026).all()


def test_a_u_shaped_wall_is_left_backward() -> None:
    cells = room(5.0)
    cells[30:70, 70:73] = 3.5
    cells[30:33, 40:70] = cells[67:70, 40:70] = 3.5
    grid = grid_of(cells)
    a, b = np.array([3.0, 2.5]), np.array([4.4, 2.5])
    found = plan(costs_of(grid), a, b, 0.5)
    assert found is not None
    assert found.complete
    assert found.points[:, 0].min() < 2.0  # out at the open side
    assert gaps(found.points, grid) > R - 0.02
    assert length_of(found.points) > 4.5


def test_no_way_through_a_wall_leads_to_the_place_nearest_to_the_goal() -> None:
    cells = room(3.0)
    cells[:, 30] = 3.5
    grid = grid_of(cells)
    found = plan(costs_of(grid), np.array([0.5, 0.5]), np.array([2.5, 2.0]), 0.5)
    assert found is not None
    assert not found.complete
    assert found.points[-1] == pytest.approx([1.5 - R, 2.0], abs=0.08)


def test_unknown_ground_is_passable_but_dearer() -> None:
    # Straight on through what is unknown, or around on what is known.
    grid = drawn(*["............"] * 2, *["...??????..."] * 4, *["............"] * 2, repeat=5)
    a, b = np.array([0.3, 1.0]), np.array([2.7, 1.0])
    cheap = plan(costs_of(grid, unknown_cost=0.05), a, b, 0.5)
    dear = plan(costs_of(grid, unknown_cost=3.0), a, b, 0.5)
    assert cheap is not None
    assert dear is not None
    assert length_of(cheap.points) == pytest.approx(2.4, abs=0.01)
    assert length_of(dear.points) > 2.6


def test_a_start_and_a_goal_too_near_to_a_wall() -> None:
    grid = grid_of(room(3.0))
    start, goal = np.array([0.12, 1.5]), np.array([2.9, 0.7])
    found = plan(costs_of(grid), start, goal, 0.5)
    assert found is not None
    assert found.complete
    np.testing.assert_array_equal(found.points[0], start)
    assert found.points[1] == pytest.approx([0.22, 1.5], abs=0.08)
    assert found.points[-1] == pytest.approx([2.78, 0.7], abs=0.08)


def test_from_inside_what_is_occupied_there_is_no_path() -> None:
    cells = room(3.0)
    cells[20:40, 20:40] = 3.5
    costs = costs_of(grid_of(cells))
    assert plan(costs, np.array([1.5, 1.5]), np.array([0.5, 0.5]), 0.3) is None


def test_pulling_straight_keeps_what_it_may_not_shorten() -> None:
    corner = drawn(*["....."] * 3, *["##..."] * 3, repeat=4)
    costs = costs_of(corner, radius=0.05)
    way = shortest_way(
        costs.cost, costs.cell(np.array([0.1, 0.7])), costs.cell(np.array([0.6, 0.1]))
    )
    points = np.array([costs.middle(cell) for cell in way or []])
    pulled = pulled_straight(costs, points)
    assert 2 < len(pulled) < 8
    assert gaps(pulled, corner) > 0.02
    np.testing.assert_array_equal(pulled[[0, -1]], points[[0, -1]])


# --- The block ---


class Rig:
    def __init__(self, hull: list[float] | None = None, **parameters: float) -> None:
        self.planner = AStarPlanner(hull=hull, parameters=AStarParameters(**parameters), rate=5.0)
        self.simulator = Simulator(self.planner)
        self.context = self.simulator.get_mutable_context()
        self.k = 0

    def look(self, pose: Any, goal: Any, grid: OccupancyGrid, looks: int = 1) -> np.ndarray:
        """The place to steer to after some looks of 0.2 s."""
        self.planner.pose_input_port().FixValue(self.context, [*pose, 0.0])
        self.planner.goal_input_port().FixValue(self.context, np.array(goal, float))
        self.planner.grid_input_port().FixValue(self.context, AbstractValue.Make(grid))
        self.k += looks
        self.simulator.AdvanceTo(0.2 * (self.k - 1) + 0.01)
        return self.planner.goal_output_port().Eval(self.context).copy()

    @property
    def path(self) -> Path:
        path: Path = self.planner.path_output_port().Eval(self.context)
        return path

    @property
    def reachable(self) -> float:
        return float(self.planner.reachable_output_port().Eval(self.context)[0])

    @property
    def counts(self) -> dict[str, int]:
        counts = self.planner.health_output_port().Eval(self.context).counts
        return {reason: number for reason, number in counts.items() if number}


def two_ways(upper: int = 20, lower: int = 20) -> OccupancyGrid:
    """A room with a wall across its middle that has a passage above and one below it."""
    cells = room(4.0)
    cells[lower : 80 - upper, 38:42] = 3.5
    return grid_of(cells)


@pytest.mark.parametrize("grid", [OccupancyGrid(), grid_of(np.zeros((40, 40), np.float32))])
def test_with_nothing_known_the_path_is_straight(grid: OccupancyGrid) -> None:
    rig = Rig()
    np.testing.assert_allclose(rig.look([1.0, 1.0], [1.0, 5.0], grid), [1.0, 1.6])
    np.testing.assert_allclose(rig.path.points, [[1.0, 1.0], [1.0, 5.0]])
    assert rig.path.stamp == 0.0
    assert rig.path.frame_id == "map"
    assert rig.reachable == 1.0
    assert rig.counts == {}


def test_near_its_end_the_goal_is_the_waypoint() -> None:
    rig = Rig()
    np.testing.assert_allclose(rig.look([1.0, 1.0], [1.3, 1.0], OccupancyGrid()), [1.3, 1.0])
    np.testing.assert_allclose(rig.look([1.3, 1.0], [1.3, 1.0], OccupancyGrid()), [1.3, 1.0])


def test_following_the_place_to_steer_to_leads_out_of_a_trap() -> None:
    cells = room(5.0)
    cells[30:70, 70:73] = 3.5
    cells[30:33, 40:70] = cells[67:70, 40:70] = 3.5
    grid = grid_of(cells)
    rig = Rig()
    position, goal = np.array([3.0, 2.4]), np.array([4.4, 2.5])
    way = [position]
    for _ in range(200):
        steer = rig.look(position, goal, grid)
        step = steer - position
        position = position + 0.06 * step / max(np.hypot(*step), 0.06)
        way.append(position)
        if np.hypot(*(goal - position)) < 0.05:
            break
    assert np.hypot(*(goal - position)) < 0.05
    assert gaps(np.array(way), grid) > R - 0.05
    assert rig.counts == {}


def test_the_path_is_kept_until_another_is_much_better() -> None:
    rig = Rig(improvement=0.1, replan_period=0.2)
    rig.look([1.0, 2.05], [3.0, 2.05], two_ways())
    first = rig.path
    above = first.points[:, 1].max() > 2.5
    assert above  # a little nearer
    rig.look([1.0, 1.95], [3.0, 2.05], two_ways(), looks=4)  # now the other one is
    assert rig.path is first
    rig.look([1.0, 1.2], [3.0, 1.9], two_ways())
    assert rig.path is not first  # another waypoint
    below = rig.path
    assert below.points[:, 1].min() < 1.0
    rig.look([1.0, 2.9], [3.0, 1.9], two_ways())  # far off it
    assert rig.path.points[:, 1].max() > 2.5


def test_a_path_that_becomes_blocked_is_replaced_at_once() -> None:
    rig = Rig(replan_period=1000.0)
    rig.look([1.0, 2.05], [3.0, 2.05], two_ways())
    first = rig.path
    assert first.points[:, 1].max() > 2.5
    rig.look([1.0, 2.05], [3.0, 2.05], two_ways(), looks=3)
    assert rig.path is first
    rig.look([1.0, 2.05], [3.0, 2.05], two_ways(upper=0))
    assert rig.path.points[:, 1].min() < 1.0
    assert rig.path.stamp == pytest.approx(0.8)
    # What is behind the robot does not matter any more.
    rig.look([2.4, 0.7], [3.0, 2.05], two_ways(upper=0))
    passed = rig.path
    rig.look([2.4, 0.7], [3.0, 2.05], two_ways(upper=0, lower=0), looks=3)
    assert rig.path is passed


def test_out_of_reach_after_the_patience_and_in_reach_again() -> None:
    rig = Rig(patience=3.0, replan_period=0.2)
    closed, goal = two_ways(0, 0), [3.0, 2.0]
    rig.look([1.0, 2.0], goal, closed, looks=15)  # 2.8 s
    assert rig.reachable == 1.0
    assert rig.path.points[-1] == pytest.approx([1.9 - R, 2.0], abs=0.08)
    rig.look([1.0, 2.0], goal, closed, looks=1)
    assert rig.reachable == 0.0
    assert rig.counts == {"no_path": 16}
    rig.look([1.0, 2.0], [1.2, 2.0], closed)  # another waypoint
    assert rig.reachable == 1.0
    rig.look([1.0, 2.0], goal, closed, looks=20)
    assert rig.reachable == 0.0
    rig.look([1.0, 2.0], goal, two_ways())
    assert rig.reachable == 1.0
    assert rig.path.points[-1].tolist() == goal


@pytest.mark.parametrize(
    ("hull", "passes"), [(None, True), ([0.1, 0.1, 0.05], True), ([0.1, 0.35, 0.2], False)]
)
def test_a_hull_that_needs_more_room_than_the_radius_gets_it(
    hull: list[float] | None, passes: bool
) -> None:
    rig = Rig(hull=hull, patience=0.0)
    rig.look([1.0, 2.0], [3.0, 2.0], two_ways(upper=14, lower=14))  # 0.65 m
    assert rig.reachable == passes


@pytest.mark.parametrize("hull", [[0.1, 0.1], [0.1, 0.1, -0.1], [0.1, math.nan, 0.1]])
def test_a_hull_that_is_none_is_refused(hull: list[float]) -> None:
    with pytest.raises(ValueError, match="hull is"):
        AStarPlanner(hull=hull)


def test_inside_what_is_occupied_it_steers_to_the_waypoint() -> None:
    rig = Rig(patience=0.0, escape=0.3)
    cells = room(3.0)
    cells[20:40, 20:40] = 3.5
    steer = rig.look([1.5, 1.5], [0.5, 0.5], grid_of(cells))
    assert steer.tolist() == [0.5, 0.5]
    assert len(rig.path.points) == 0
    assert rig.reachable == 0.0


def test_bad_samples_are_dropped_and_counted() -> None:
    rig = Rig()
    grid, nan = two_ways(), math.nan
    steer = rig.look([1.0, 2.05], [3.0, 2.05], grid)
    path = rig.path
    bad = replace(grid, log_odds=np.full((80, 80), nan, np.float32))
    for pose, goal, bad_grid in (
        ([nan, 1.0], [3.0, 2.05], grid),
        ([1.0, 2.05], [nan, 2.05], grid),
        ([1.0, 2.05], [1e9, 2.05], grid),
        ([1.0, 2.05], [3.0, 2.05], replace(grid, resolution=0.0)),
        ([1.0, 2.05], [3.0, 2.05], bad),
    ):
        np.testing.assert_array_equal(rig.look(pose, goal, bad_grid), steer)
        assert rig.path is path
        assert rig.reachable == 1.0
    assert rig.counts == {"bad_pose": 1, "bad_goal": 2, "bad_grid": 2}
    rig.look([1.1, 2.05], [3.0, 2.05], grid)
    assert sum(rig.counts.values()) == 5


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("radius", 0.0),
        ("soft_margin", -0.1),
        ("soft_cost", math.nan),
        ("lookahead", 0.0),
        ("replan_period", -1.0),
        ("improvement", 1.0),
        ("patience", math.inf),
    ],
)
def test_parameters_out_of_range_are_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{field} is {value}: must be "):
        AStarParameters(**{field: value})
