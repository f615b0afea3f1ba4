from __future__ import annotations

import math

import numpy as np
import pytest

from systems.avoiders.surroundings import (
    REMEMBERED,
    extend,
    in_frame,
    out_of_frame,
    step_between,
    surroundings,
)
from systems.messages import Scan
from systems.pose_trail import empty_trail
from tests.avoider_world import RAYS, TURN, World

NOTHING = np.full((REMEMBERED, 2), math.nan)
LIDAR = np.array([0.03, -0.02, 0.5])


def test_frames_are_each_other_inverse() -> None:
    pose = np.array([1.0, -2.0, 0.7])
    points = np.array([[0.3, 0.4], [-1.0, 2.0]])
    np.testing.assert_allclose(in_frame(pose, out_of_frame(pose, points)), points, atol=1e-12)
    # By hand: one metre before a robot that looks along y.
    np.testing.assert_allclose(
        out_of_frame(np.array([1.0, 2.0, math.pi / 2]), np.array([[1.0, 0.0]])), [[1.0, 3.0]]
    )


def test_a_step_is_what_the_estimate_says() -> None:
    step = step_between(
        np.array([1.0, 1.0, math.pi - 0.01]),
        np.array([0.98, 1.0, -math.pi + 0.02]),
        np.array([0.3, 0.0]),
        0.1,
    )
    np.testing.assert_allclose(step, [0.02 * math.cos(0.01), 0.02 * math.sin(0.01), 0.03])


@pytest.mark.parametrize(
    "pose", [[0.5, 0.0, 0.0], [0.02, 0.0, 1.0], [math.nan, 0.0, 0.0], [0.02, 0.0, math.nan]]
)
def test_a_step_is_what_the_command_says_when_the_estimate_jumps(pose: list[float]) -> None:
    step = step_between(np.zeros(3), np.array(pose), np.array([0.3, 0.6]), 0.1)
    # Along an arc of radius 0.5 m.
    expected = [0.5 * math.sin(0.06), 0.5 * (1 - math.cos(0.06)), 0.06]
    np.testing.assert_allclose(step, expected, atol=1e-9)


def driven(v: float, omega: float, duration: float, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """A trail along an arc, as an avoider makes it from exact estimates; and the last pose."""

    def pose(t: float) -> np.ndarray:
        return np.array(
            [v / omega * math.sin(omega * t), v / omega * (1 - math.cos(omega * t)), omega * t]
        )

    trail = empty_trail(duration=0.6, rate=rate)
    last = pose(0.0)
    for k in range(round(duration * rate) + 1):
        now = pose(k / rate)
        trail = extend(trail, k / rate, step_between(last, now, np.array([v, omega]), 1 / rate))
        last = now
    return trail, np.vectorize(pose, signature="()->(n)")


def test_points_of_a_turning_robot_are_where_the_obstacles_are() -> None:
    trail, pose = driven(0.3, 1.5, 1.0, 10.0)
    discs = [(1.0, 0.8, 0.1), (-0.5, 1.0, 0.05), (0.2, -0.9, 0.2)]
    world = World(discs=discs)
    began = 1.0 - 2 * TURN + 0.02  # nearly as old as a scan can become
    increment = TURN / RAYS
    body = pose(began + increment * np.arange(RAYS))
    lidar = np.array([[*out_of_frame(p, LIDAR[None, :2])[0], p[2] + LIDAR[2]] for p in body])
    scan = world.scan(lidar, began, increment)

    def misplaced(points: np.ndarray) -> float:
        on_map = out_of_frame(pose(1.0), points)
        gaps = [np.hypot(*(on_map - disc[:2]).T) - disc[2] for disc in discs]
        return float(np.abs(np.min(np.abs(gaps), axis=0)).max())

    points, _ = surroundings(scan, LIDAR, trail, NOTHING)
    assert len(points) > 20
    assert misplaced(points) < 0.005
    standing = trail.copy()
    standing[:, 1:] = standing[-1, 1:]
    assert misplaced(surroundings(scan, LIDAR, standing, NOTHING)[0]) > 0.2


def test_what_the_lidar_is_too_near_to_see_is_remembered_until_it_looks_past() -> None:
    lidar = np.zeros(3)
    trail = empty_trail(duration=0.6, rate=10.0)
    trail = extend(trail, 0.0, np.zeros(3))
    world = World(discs=[(0.25, 0.0, 0.02)])
    points, memory = surroundings(world.scan(np.zeros(3), 0.0), lidar, trail, NOTHING)
    assert np.hypot(*points.T).min() == pytest.approx(0.23)
    # 11 cm nearer it is within the least range: the rays that meet it fail.
    trail = extend(trail, 0.5, np.array([0.11, 0.0, 0.0]))
    near = world.scan(np.array([0.11, 0.0, 0.0]), 0.5)
    assert np.isnan(near.ranges).any()
    assert not np.isfinite(near.ranges).any()
    points, memory = surroundings(near, lidar, trail, memory)
    assert np.hypot(*points.T).min() == pytest.approx(0.12)
    points, memory = surroundings(near, lidar, trail, memory)  # once more, nothing is lost
    assert np.hypot(*points.T).min() == pytest.approx(0.12)
    # It has gone: the rays find nothing.
    points, memory = surroundings(World().scan(np.zeros(3), 0.5), lidar, trail, memory)
    assert len(points) == 0
    assert np.isnan(memory).all()


def test_a_scan_without_a_hit_has_no_points() -> None:
    trail = extend(empty_trail(duration=0.6, rate=10.0), 0.0, np.zeros(3))
    scan = Scan(stamp=0.0, range_max=12.0, ranges=np.full(RAYS, math.inf))
    points, memory = surroundings(scan, LIDAR, trail, NOTHING)
    assert points.shape == (0, 2)
    assert np.isnan(memory).all()
