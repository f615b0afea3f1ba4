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
    known = trail[np.isfinite(trail).all(axis=1)]
    if len(known) == 0:
        return np.full((len(times), 3), np.nan)
    t, x, y, theta = known.T
    if (np.abs(theta[1:] - theta[:-1]) > np.pi).any():
        theta = np.unwrap(theta)
    poses = np.empty((len(times), 3))
    for k, column in enumerate((x, y, theta)):
        poses[:, k] = np.interp(times, t, column)
    return poses


def ray_poses(scan: Scan, lidar_pose: Array, trail: Array) -> Array:
    """Returns where each ray of a scan began and where it went, in the trail's frame.

    Args:
        scan: n rays.
        lidar_pose: (3,) [x (m), y (m), yaw (rad)] of the lidar in the body.
        trail: of the body.

    Returns:
        (n, 3) [x (m), y (m), direction (rad)].
    """
    times = scan.stamp + scan.time_increment * np.arange(len(scan), dtype=float)
    rays = poses_at(trail, times)
    _carry(rays, packed(lidar_pose), packed(scan.angles))
    return rays


@compiled("void(f8[:,::1], f8[::1], f8[::1])")
def _carry(poses: Array, lidar_pose: Array, angles: Array) -> None:
    """Turns poses of the body (n, 3) into those of its lidar's rays."""
    for k in range(len(poses)):
        c, s = math.cos(poses[k, 2]), math.sin(poses[k, 2])
        poses[k, 0] += c * lidar_pose[0] - s * lidar_pose[1]
        poses[k, 1] += s * lidar_pose[0] + c * lidar_pose[1]
        poses[k, 2] += lidar_pose[2] + angles[k]
