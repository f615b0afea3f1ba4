from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from systems.messages import Scan
from systems.scans import scan_fault, scan_points

ANGLES = np.radians(np.arange(-180.0, 180.0))


def turn_of_a_lidar(ranges: np.ndarray, turn: float = 0.1) -> Scan:
    n = len(ranges)
    return Scan(
        stamp=5.0,
        angle_min=-math.pi,
        angle_increment=2 * math.pi / n,
        time_increment=turn / n,
        range_min=0.15,
        range_max=12.0,
        ranges=np.asarray(ranges, float),
    )


def test_points_are_left_ahead_and_behind_where_they_should_be() -> None:
    ranges = np.full(360, math.inf)
    ranges[180], ranges[270], ranges[0] = 2.0, 1.0, 3.0  # ahead, left, behind
    found = scan_points(turn_of_a_lidar(ranges), np.array([0.1, 0.0, 0.0]))
    np.testing.assert_allclose(found, [[-2.9, 0], [2.1, 0], [0.1, 1.0]], atol=1e-12)
    # A lidar that is mounted turned by 90 degrees to the left.
    found = scan_points(turn_of_a_lidar(ranges), np.array([0.0, 0.0, math.pi / 2]))
    np.testing.assert_allclose(found, [[0, -3], [0, 2], [-1, 0]], atol=1e-12)


def test_only_hits_within_reach_are_points() -> None:
    ranges = np.full(360, 1.0)
    ranges[:5] = [math.inf, math.nan, 0.1, 12.5, -1.0]
    assert len(scan_points(turn_of_a_lidar(ranges), np.zeros(3))) == 355


@pytest.mark.parametrize("twist", [[0.3, 0.0], [0.0, 1.5], [0.3, -1.0], [-0.2, 0.7]])
@pytest.mark.parametrize("now", [None, 5.3])
def test_a_scan_made_on_the_move_is_straightened(twist: list[float], now: float | None) -> None:
    # Points that stand still, each seen from where the lidar was at its ray.
    random = np.random.default_rng(1)
    v, omega = twist
    mount = np.array([0.05, 0.02, 0.3])

    def body(t: float) -> np.ndarray:
        theta = omega * t
        if omega == 0:
            return np.array([v * t, 0.0, 0.0])
        return np.array([v / omega * math.sin(theta), v / omega * (1 - math.cos(theta)), theta])

    n = 360
    scan = turn_of_a_lidar(np.ones(n))
    places, ranges = np.zeros((n, 2)), random.uniform(0.5, 3.0, n)
    for i, (angle, distance) in enumerate(zip(scan.angles, ranges, strict=True)):
        x, y, theta = body(i * scan.time_increment)
        c, s = math.cos(theta), math.sin(theta)
        direction = angle + mount[2]
        px = mount[0] + distance * math.cos(direction)
        py = mount[1] + distance * math.sin(direction)
        places[i] = x + c * px - s * py, y + s * px + c * py
    found = scan_points(replace(scan, ranges=ranges), mount, twist=np.array(twist), now=now)
    x, y, theta = body((n - 1) * scan.time_increment if now is None else now - scan.stamp)
    c, s = math.cos(theta), math.sin(theta)
    offset = places - [x, y]
    expected = np.stack([c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0]])
    np.testing.assert_allclose(found, expected.T, atol=1e-12)


def test_what_is_unfit_for_driving_by() -> None:
    good = turn_of_a_lidar(np.ones(360))
    assert scan_fault(good, 5.1, max_age=0.3) is None
    assert scan_fault(Scan(), 5.1, max_age=0.3) == "no_scan"
    assert scan_fault(replace(good, ranges=np.zeros(0)), 5.1, max_age=0.3) == "no_scan"
    assert scan_fault(good, 5.31, max_age=0.3) == "stale_scan"
    assert scan_fault(good, 4.9, max_age=0.3) == "stale_scan"  # from the future
    assert scan_fault(replace(good, angle_min=math.nan), 5.1, max_age=0.3) == "garbled_scan"
    assert scan_fault(replace(good, angle_increment=0.0), 5.1, max_age=0.3) == "garbled_scan"
    assert scan_fault(replace(good, range_max=math.nan), 5.1, max_age=0.3) == "garbled_scan"
    negative, failed = np.ones(360), np.ones(360)
    negative[7] = -2.0
    failed[:181] = math.nan
    assert scan_fault(replace(good, ranges=negative), 5.1, max_age=0.3) == "garbled_scan"
    assert scan_fault(replace(good, ranges=failed), 5.1, max_age=0.3) == "garbled_scan"
    # Nothing in reach is not a failure: the room may be large.
    assert scan_fault(replace(good, ranges=np.full(360, math.inf)), 5.1, max_age=0.3) is None
