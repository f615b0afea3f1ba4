"""What stands around the robot now: the points of the last turn of its lidar, carried along.

A scan is up to two turns old when it is used (0.36 s for an RPLIDAR A1), and the robot turns by
half a radian in that time. So every ray is placed by where the robot was when it was measured, in a
frame that drifts but never jumps (`odom` of REP 105), made of the estimate's steps. And a lidar
sees nothing nearer than its least range: what went out of sight there is remembered.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from systems.angles import wrap
from systems.messages import Scan
from systems.pose_trail import ray_ends, ray_poses, remember

Array = NDArray[np.float64]

# The estimate has jumped, and not the robot moved, when it differs from the command by more than
# this. The slack allows for motors that lag behind the command or do better than it.
_SPEED_SLACK = 0.5  # m/s
_TURN_SLACK = 2.0  # rad/s
# Points this little beyond the lidar's least range are remembered, in case they come nearer.
_RIM = 0.1  # m
REMEMBERED = 48  # at most, one for each direction


def in_frame(pose: Array, points: Array) -> Array:
    """Returns points (k, 2) of the parent's frame in that of `pose` [x, y, theta]."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return (points - pose[:2]) @ np.array([[c, -s], [s, c]])


def out_of_frame(pose: Array, points: Array) -> Array:
    """Returns points (k, 2) of the frame `pose` [x, y, theta] in its parent's: the inverse."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return points @ np.array([[c, s], [-s, c]]) + pose[:2]


def step_between(last: Array, pose: Array, twist: Array, dt: float) -> Array:
    """Returns how the body moved in `dt` s, [x, y, theta] in its frame before.

    The estimate tells, unless it jumped or is not finite: then the command does.

    Args:
        last: (3,) estimate before.
        pose: (3,) estimate now.
        twist: (2,) [v (m/s), omega (rad/s)] as sent to the wheels.
        dt: s.
    """
    x, y, theta = last.tolist()
    c, s = math.cos(theta), math.sin(theta)
    dx, dy = float(pose[0]) - x, float(pose[1]) - y
    forward, aside = c * dx + s * dy, c * dy - s * dx
    turn = wrap(float(pose[2]) - theta)
    v, omega = float(twist[0]), float(twist[1])
    moved = (
        math.hypot(forward - v * dt, aside) <= _SPEED_SLACK * dt
        and abs(turn - omega * dt) <= _TURN_SLACK * dt
    )
    if not moved:
        half = omega * dt / 2
        chord = v * dt * (math.sin(half) / half if half else 1.0)
        forward, aside, turn = chord * math.cos(half), chord * math.sin(half), 2 * half
    return np.array((forward, aside, turn))


def extend(trail: Array, now: float, step: Array) -> Array:
    """Returns the trail (see `systems.pose_trail`) with the pose after one more step (3,)."""
    last = trail[-1].tolist()
    x, y, theta = last[1:] if all(map(math.isfinite, last)) else (0.0, 0.0, 0.0)
    c, s = math.cos(theta), math.sin(theta)
    forward, aside, turn = step.tolist()
    pose = (x + c * forward - s * aside, y + s * forward + c * aside, theta + turn)
    return remember(trail, now, np.array(pose))


def surroundings(
    scan: Scan, lidar_pose: Array, trail: Array, remembered: Array
) -> tuple[Array, Array]:
    """Returns the obstacles around the body now, and what to remember.

    Args:
        scan: one that is fit for use.
        lidar_pose: (3,) [x (m), y (m), yaw (rad)] of the lidar in the body.
        trail: of the body, in a frame that does not jump (see `extend`); its last row is now.
        remembered: (REMEMBERED, 2) points in the trail's frame, NaN where there is none.

    Returns:
        Points (k, 2) in the body's frame now, and the next `remembered`.
    """
    rays = ray_poses(scan, lidar_pose, trail)
    points = ray_ends(scan, rays)
    here = trail[-1, 1:]
    x, y = out_of_frame(here, lidar_pose[None, :2])[0]
    memory = points[np.hypot(points[:, 0] - x, points[:, 1] - y) <= scan.range_min + _RIM]
    if not np.isnan(remembered).all():
        kept = remembered[~np.isnan(remembered[:, 0])]
        kept = kept[_out_of_sight(scan, rays, kept)]
        memory = np.concatenate([kept, memory])
        points = np.concatenate([points, kept])
    return in_frame(here, points), _nearest_in_each_direction(memory, np.array((x, y)))


def _out_of_sight(scan: Scan, rays: Array, points: Array) -> NDArray[np.bool_]:
    """Tells which points may still be there, although the scan does not show them.

    They are near enough to be missed, and the ray that points at them best measured nothing.
    """
    dx, dy = points[:, :1] - rays[:, 0], points[:, 1:] - rays[:, 1]
    distances = np.hypot(dx, dy)
    aim = (dx * np.cos(rays[:, 2]) + dy * np.sin(rays[:, 2])) / distances
    ray = np.argmax(aim, axis=1)
    measured = scan.ranges[ray]
    nothing = np.isnan(measured) | (measured < scan.range_min)
    near = distances[np.arange(len(points)), ray] <= scan.range_min + _RIM
    hidden: NDArray[np.bool_] = nothing & near
    return hidden


def _nearest_in_each_direction(points: Array, centre: Array) -> Array:
    """Returns (REMEMBERED, 2): of each direction from `centre` the nearest point, NaN if none."""
    result = np.full((REMEMBERED, 2), math.nan)
    if len(points) == 0:
        return result
    offset = points - centre
    order = np.argsort(-np.hypot(offset[:, 0], offset[:, 1]))
    angle = np.arctan2(offset[order, 1], offset[order, 0]) / (2 * math.pi)
    result[np.floor(angle * REMEMBERED).astype(int) % REMEMBERED] = points[order]
    return result
