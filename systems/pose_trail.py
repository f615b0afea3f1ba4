"""A short trail of poses: where the robot was when each ray of a scan was measured."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled, packed
from systems.messages import Scan

Array = NDArray[np.float64]


def empty_trail(*, duration: float, rate: float) -> Array:
    """Returns a trail without a pose: (n, 4) rows [t (s), x (m), y (m), theta (rad)], all NaN.

    Args:
        duration: how far it is to reach back, s.
        rate: how often a pose is added, Hz.
    """
    return np.full((math.ceil(duration * rate) + 2, 4), np.nan)


def remember(trail: Array, t: float, pose: Array) -> Array:
    """Returns the trail with a pose (3,) added at its end and the oldest one dropped."""
    longer = np.empty_like(trail)
    longer[:-1] = trail[1:]
    longer[-1] = t, *pose
    return longer


def poses_at(trail: Array, times: Array) -> Array:
    """Returns the poses at times (n,) s: (n, 3), interpolated; theta is not wrapped.

    Before the oldest pose the robot is taken to have stood there; after the newest, to stand there
    still. NaN when the trail has no pose.
    """
    poses = np.empty((len(times), 3))
    _poses_at(packed(trail), packed(times), poses)
    return poses


@compiled("void(f8[:,::1], f8[::1], f8[:,::1])")
def _poses_at(trail: Array, times: Array, poses: Array) -> None:
    known = np.empty_like(trail)
    n = 0
    turns = 0.0  # what unwraps theta, rad
    for k in range(len(trail)):
        t, x, y, theta = trail[k, 0], trail[k, 1], trail[k, 2], trail[k, 3]
        if not (math.isfinite(t) and math.isfinite(x + y + theta)):
            continue
        if n:
            turn = theta + turns - known[n - 1, 3]
            if abs(turn) > math.pi:
                turns -= 2 * math.pi * math.floor(turn / (2 * math.pi) + 0.5)
        known[n, 0], known[n, 1], known[n, 2], known[n, 3] = t, x, y, theta + turns
        n += 1
    if n == 0:
        poses[:] = math.nan
        return
    j = 0  # of the pose before; the times mostly grow
    for k in range(len(times)):
        t = times[k]
        while j > 0 and t < known[j, 0]:
            j -= 1
        while j < n - 1 and t >= known[j + 1, 0]:
            j += 1
        standing = t < known[0, 0] or j == n - 1
        for i in range(3):
            poses[k, i] = known[j, i + 1]
            if not standing:
                slope = (known[j + 1, i + 1] - known[j, i + 1]) / (known[j + 1, 0] - known[j, 0])
                poses[k, i] += slope * (t - known[j, 0])


def ray_poses(scan: Scan, lidar_pose: Array, trail: Array) -> Array:
    """Returns where each ray of a scan began and where it went, in the trail's frame.

    Args:
        scan: n rays.
        lidar_pose: (3,) [x (m), y (m), yaw (rad)] of the lidar in the body.
        trail: of the body.

    Returns:
        (n, 3) [x (m), y (m), direction (rad)].
    """
    rays = np.empty((len(scan), 3))
    timing = np.array((scan.stamp, scan.time_increment, scan.angle_min, scan.angle_increment))
    _ray_poses(packed(trail), packed(lidar_pose), timing, rays)
    return rays


@compiled("void(f8[:,::1], f8[::1], f8[::1], f8[:,::1])")
def _ray_poses(trail: Array, lidar_pose: Array, timing: Array, rays: Array) -> None:
    times = np.empty(len(rays))
    for k in range(len(rays)):
        times[k] = timing[0] + timing[1] * k
    _poses_at(trail, times, rays)
    for k in range(len(rays)):
        c, s = math.cos(rays[k, 2]), math.sin(rays[k, 2])
        rays[k, 0] += c * lidar_pose[0] - s * lidar_pose[1]
        rays[k, 1] += s * lidar_pose[0] + c * lidar_pose[1]
        rays[k, 2] += lidar_pose[2] + (timing[2] + timing[3] * k)


def ray_ends(scan: Scan, rays: Array) -> Array:
    """Returns where the rays that hit something ended: (k, 2) m, in the frame of the rays.

    Args:
        scan: n rays; those that report less than range_min or more than range_max hit nothing.
        rays: (n, 3), see `ray_poses`.
    """
    ends = np.empty((len(scan), 2))
    limits = np.array((scan.range_min, scan.range_max))
    return ends[: _ray_ends(packed(scan.ranges), limits, packed(rays), ends)]


@compiled("i8(f8[::1], f8[::1], f8[:,::1], f8[:,::1])")
def _ray_ends(ranges: Array, limits: Array, rays: Array, ends: Array) -> int:
    n = 0
    for k in range(len(ranges)):
        if limits[0] <= ranges[k] <= limits[1] and ranges[k] < math.inf:
            ends[n, 0] = rays[k, 0] + ranges[k] * math.cos(rays[k, 2])
            ends[n, 1] = rays[k, 1] + ranges[k] * math.sin(rays[k, 2])
            n += 1
    return n
