from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from systems.messages import Scan
from systems.pose_trail import empty_trail, poses_at, ray_ends, ray_poses, remember


def test_a_trail_reaches_back_as_far_as_it_is_to() -> None:
    trail = empty_trail(duration=0.5, rate=10.0)
    for k in range(50):
        trail = remember(trail, k / 10, np.array([k, -k, 0.0]))
    assert trail[-1, 0] == 4.9
    assert trail[0, 0] <= 4.9 - 0.5
    np.testing.assert_allclose(poses_at(trail, np.array([4.41]))[0], [44.1, -44.1, 0.0])


def test_between_two_poses_it_is_interpolated_the_short_way_round() -> None:
    trail = remember(empty_trail(duration=1.0, rate=10.0), 1.0, np.array([0.0, 0.0, 3.1]))
    trail = remember(trail, 2.0, np.array([1.0, 2.0, -3.1]))
    found = poses_at(trail, np.array([0.0, 1.25, 1.5, 3.0]))
    np.testing.assert_allclose(found[:, :2], [[0, 0], [0.25, 0.5], [0.5, 1], [1, 2]])
    turn = 2 * math.pi - 6.2
    np.testing.assert_allclose(found[:, 2] - 3.1, [0, turn / 4, turn / 2, turn], atol=1e-12)


def test_an_empty_trail_knows_nothing() -> None:
    assert np.isnan(poses_at(empty_trail(duration=1.0, rate=10.0), np.zeros(2))).all()


def test_it_is_what_numpy_interpolates_over_several_turns_and_gaps() -> None:
    random = np.random.default_rng(4)
    times = np.cumsum(random.uniform(0.05, 0.2, 20))
    poses = np.cumsum(random.normal(0, 1.0, (20, 3)), axis=0)  # theta runs over several turns
    trail = np.column_stack([times, poses[:, :2], np.arctan2(np.sin(poses), np.cos(poses))[:, 2]])
    trail[[3, 11], [1, 3]] = np.nan
    known = np.isfinite(trail).all(axis=1)
    asked = random.uniform(times[0] - 0.3, times[-1] + 0.3, 200)  # in no order
    found = poses_at(trail, asked)
    unwrapped = np.unwrap(trail[known, 3])
    for k, column in enumerate((*trail[known, 1:3].T, unwrapped)):
        np.testing.assert_allclose(found[:, k], np.interp(asked, times[known], column), atol=1e-12)


def test_each_ray_starts_where_the_lidar_was() -> None:
    # Turning in place by a quarter in a second; the lidar sits 0.1 m ahead and looks to the left.
    trail = remember(empty_trail(duration=1.0, rate=10.0), 0.0, np.zeros(3))
    trail = remember(trail, 1.0, np.array([0.0, 0.0, math.pi / 2]))
    scan = Scan(
        stamp=0.0,
        angle_min=-0.2,
        angle_increment=0.1,
        time_increment=0.25,
        ranges=np.ones(5),
    )
    found = ray_poses(scan, np.array([0.1, 0.0, math.pi / 2]), trail)
    for i in range(5):
        theta = math.pi / 2 * i / 4
        expected = [0.1 * math.cos(theta), 0.1 * math.sin(theta)]
        assert found[i] == pytest.approx([*expected, theta + math.pi / 2 - 0.2 + 0.1 * i])


def test_a_ray_ends_where_it_hit_and_only_then() -> None:
    ranges = np.array([2.0, np.inf, np.nan, 0.1, 9.0, 0.5, 8.0])
    scan = Scan(stamp=0.0, range_min=0.15, range_max=8.0, ranges=ranges)
    rays = np.column_stack([np.ones(7), np.full(7, -1.0), np.radians([90, 0, 0, 0, 0, 180, 0])])
    expected = [[1.0, 1.0], [0.5, -1.0], [9.0, -1.0]]
    np.testing.assert_allclose(ray_ends(scan, rays), expected, atol=1e-12)
    endless = replace(scan, range_max=np.inf)
    assert len(ray_ends(endless, rays)) == 4  # not where there is nothing
