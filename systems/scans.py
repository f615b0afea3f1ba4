"""Using lidar scans: are they fit for use, and where are their points?"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled, packed
from systems.messages import Scan

Array = NDArray[np.float64]

# What can be wrong with a scan; every consumer counts by these words on its `health`.
SCAN_FAULTS = ("no_scan", "stale_scan", "garbled_scan")


def scan_fault(scan: Scan, now: float, max_age: float) -> str | None:
    """Returns what makes a scan unfit for driving by, one of `SCAN_FAULTS`, or None.

    A scan is garbled when its angles or times are no numbers, when it holds numbers that are no
    ranges (negative ones), or when more than half of its rays failed: a lidar whose window is
    covered must not look like free space.

    Args:
        scan: the scan.
        now: the time, s.
        max_age: how long after its first ray it may be used, s.
    """
    if math.isnan(scan.stamp) or len(scan) == 0:
        return "no_scan"
    numbers = (scan.angle_min, scan.angle_increment, scan.time_increment, scan.range_min)
    sound = (
        all(map(math.isfinite, numbers))
        and scan.angle_increment != 0
        and scan.range_max > scan.range_min  # not NaN either: no point would be left
        and _are_ranges(packed(scan.ranges))
    )
    if not sound:
        return "garbled_scan"
    return "stale_scan" if not 0 <= now - scan.stamp + 1e-6 <= max_age else None


@compiled("b1(f8[::1])")
def _are_ranges(ranges: Array) -> bool:
    """Tells whether none is negative, and at most half of them are NaN."""
    failed = 0
    for distance in ranges:
        if distance < 0:
            return False
        failed += math.isnan(distance)
    return 2 * failed <= len(ranges)


def hits(scan: Scan) -> NDArray[np.intp]:
    """Returns the indices of the rays that measured a distance within the scan's range."""
    hit = (scan.ranges >= scan.range_min) & (scan.ranges <= scan.range_max)
    return np.flatnonzero(hit & np.isfinite(scan.ranges))


def scan_points(
    scan: Scan,
    lidar_pose: Array,
    *,
    twist: Array | None = None,
    now: float | None = None,
) -> Array:
    """Returns where the scan's hits are, in the body's frame at one moment: (k, 2) m.

    Rays that hit nothing, that failed, or that report less than range_min or more than range_max
    are left out.

    Args:
        scan: the scan.
        lidar_pose: (3,) [x (m), y (m), yaw (rad)] of the lidar in the body.
        twist: (2,) [v (m/s), omega (rad/s)] of the body, taken as steady since the scan's first
            ray; moves each point to where it is seen from `now`. None leaves out the motion.
        now: the moment, s; None is that of the last ray.
    """
    index = hits(scan)
    ranges = scan.ranges[index]
    angles = scan.angle_min + scan.angle_increment * index + lidar_pose[2]
    points = np.stack([ranges * np.cos(angles), ranges * np.sin(angles)], axis=-1) + lidar_pose[:2]
    if twist is None:
        return points
    end = scan.stamp + scan.time_increment * (len(scan) - 1) if now is None else now
    # From the body's frame when the ray was measured to that at the end: the way back along an arc.
    dt = end - (scan.stamp + scan.time_increment * index)
    turn = twist[1] * dt
    half = turn / 2
    chord = twist[0] * dt * np.sinc(half / np.pi)
    x = points[:, 0] - chord * np.cos(half)
    y = points[:, 1] - chord * np.sin(half)
    c, s = np.cos(turn), np.sin(turn)
    return np.stack([c * x + s * y, c * y - s * x], axis=-1)
