from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from systems.controllers.path_tracking import TrackingState
from systems.messages import Scan
from systems.planners.route_clearance import ClearanceParameters, RouteClearance, free_distance
from tests.systems.controllers.tracking import circle, straight

P = ClearanceParameters(half_width=0.1, front=0.15, margin=0.05, look=1.5)


def points(*xy: tuple[float, float]) -> np.ndarray:
    return np.array(xy, float).reshape(-1, 2)


def test_it_measures_from_the_front_to_the_first_thing_on_the_way() -> None:
    found = free_distance(straight(), 0.5, points((2.0, 0.0), (1.4, 0.1)), P)
    assert found == pytest.approx(1.4 - 0.5 - 0.15, abs=0.04)


@pytest.mark.parametrize("point", [(1.4, 0.16), (1.4, -0.16), (0.2, 0.0), (2.3, 0.0)])
def test_what_stands_beside_behind_or_far_ahead_is_not_in_the_way(
    point: tuple[float, float],
) -> None:
    assert free_distance(straight(), 0.5, points(point), P) == math.inf


def test_no_points_leave_the_way_free() -> None:
    assert free_distance(straight(), 0.5, points(), P) == math.inf


def test_what_touches_the_front_leaves_nothing() -> None:
    assert free_distance(straight(), 0.5, points((0.64, 0.1)), P) == 0.0


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_it_looks_around_the_bend_and_across_the_end_of_a_lap(way: float) -> None:
    route = circle(1.0, way=way)
    a = 0.8  # rad into the next lap
    there = points((math.sin(a), way * (1 - math.cos(a))))
    assert free_distance(route, route.length - 0.3, there, P) == pytest.approx(0.95, abs=0.04)
    ahead = points((1.0, 0.0))  # straight ahead of the start, where the circle does not go
    assert free_distance(route, 0.0, ahead, P) == math.inf


def test_beyond_the_end_of_an_open_route_only_what_its_front_would_touch_counts() -> None:
    assert free_distance(straight(2.0), 1.5, points((2.1, 0.0)), P) == pytest.approx(0.45, abs=0.04)
    assert free_distance(straight(2.0), 1.5, points((2.3, 0.0)), P) == math.inf


def test_a_scan_that_cannot_be_used_leaves_the_way_unknown() -> None:
    block = RouteClearance(route=straight(), lidar_pose=[0.1, 0.0, math.pi], parameters=P)
    simulator = Simulator(block)
    context = simulator.get_mutable_context()
    c, s = math.cos(0.3), math.sin(0.3)
    block.pose_input_port().FixValue(context, [0.5, 0.0, 0.3])
    block.tracking_input_port().FixValue(context, TrackingState(run=0.5))
    block.scan_input_port().FixValue(context, Scan())
    simulator.AdvanceTo(0.01)
    port = block.free_distance_output_port()
    assert math.isnan(port.Eval(context)[0])
    # The lidar looks backwards: what is ahead on the route is at pi - 0.3 there.
    ranges = np.full(360, math.inf)
    target = np.array([1.5, 0.0]) - [0.5 + 0.1 * c, 0.1 * s]
    bearing = math.atan2(target[1], target[0]) - 0.3 - math.pi
    ranges[round(math.degrees(bearing + math.pi)) % 360] = float(np.hypot(*target))
    block.scan_input_port().FixValue(context, Scan(stamp=0.02, range_max=9.0, ranges=ranges))
    simulator.AdvanceTo(0.06)
    assert port.Eval(context)[0] == pytest.approx(0.85, abs=0.04)
    simulator.AdvanceTo(1.0)
    assert math.isnan(port.Eval(context)[0])
    counts = block.health_output_port().Eval(context).counts
    assert counts["no_scan"] == 1
    assert counts["stale_scan"] > 3


def test_arguments_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValueError, match="lidar_pose"):
        RouteClearance(route=straight(), lidar_pose=[0.0, math.nan, 0.0])
    with pytest.raises(ValueError, match="half_width"):
        ClearanceParameters(half_width=0.0)
