"""How full each direction around a robot is, and how far it gets in one: the geometry of VFH+.

[VFH+]: Ulrich and Borenstein, "VFH+: reliable obstacle avoidance for fast mobile robots", IEEE
International Conference on Robotics and Automation, 1998, pages 1572-1577.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from systems.angles import wrap
from systems.compiled import compiled, in_rows, packed

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@cache
def sector_middles(sectors: int) -> Array:
    """Returns the directions of the sectors in map, (sectors,) rad, read-only; the first is 0."""
    middles = np.asarray(wrap(np.arange(sectors) * (2 * math.pi / sectors)))
    middles.setflags(write=False)
    return middles


def primary_histogram(points: Array, radius: float, *, window: float, sectors: int) -> Array:
    """Returns how full each sector is: (sectors,), points weighted by their nearness.

    A point fills the sectors whose middle is within asin(radius / distance) of it, as in [VFH+], a
    quarter turn when it is nearer than the radius; and its own.

    Args:
        points: (k, 2) m about the robot's origin, with the axes of map.
        radius: by which they are widened, m.
        window: a point counts 1 - (distance / window)^2, m.
        sectors: how many the circle has.
    """
    density = np.empty(sectors)
    _primary_histogram(in_rows(points, 2), radius, window, density)
    return density


@compiled("void(f8[:,::1], f8, f8, f8[::1])")
def _primary_histogram(points: Array, radius: float, window: float, density: Array) -> None:
    n = len(density)
    width = 2 * math.pi / n
    # What a point fills may reach beyond the ends of the circle: it is laid out three times, and
    # folded.
    begin, end = np.zeros(3 * n), np.zeros(3 * n)
    for k in range(len(points)):
        x, y = points[k, 0], points[k, 1]
        distance = math.hypot(x, y)
        if not distance < window:
            continue
        weight = 1 - (distance / window) ** 2
        bearing = math.atan2(y, x)
        # 1e-9 for a point at the origin, which has no direction.
        half = math.asin(min(radius / max(distance, 1e-9), 1.0))
        own = math.floor(bearing / width + 0.5)
        begin[min(math.ceil((bearing - half) / width - 1e-9), own) + n] += weight
        end[max(math.floor((bearing + half) / width + 1e-9), own) + n + 1] += weight
    density[:] = 0.0
    filled = 0.0
    for k in range(3 * n):
        filled += begin[k] - end[k]
        density[k % n] += filled
    for k in range(n):
        density[k] = max(density[k], 0.0)


def binary_histogram(density: Array, blocked: Mask, low: float, high: float) -> Mask:
    """Returns which sectors are blocked: above `high`, or blocked before and not below `low`."""
    return (density > high) | (blocked & (density >= low))


def turning_limits(points: Array, radius: float, turning_radius: float) -> tuple[float, float]:
    """Returns how far to the right (<= 0) and to the left the robot can turn at speed, rad.

    A point within `radius` of the circle that the robot turns on blocks what lies beyond it on that
    side ([VFH+], masked polar histogram).

    Args:
        points: (k, 2) m, in the body's frame.
        radius: of the widened robot, m.
        turning_radius: m.
    """
    return _turning_limits(in_rows(points, 2), radius, turning_radius)


@compiled("UniTuple(f8, 2)(f8[:,::1], f8, f8)")
def _turning_limits(points: Array, radius: float, turning_radius: float) -> tuple[float, float]:
    right, left = -math.pi, math.pi
    reach = turning_radius + radius
    for k in range(len(points)):
        x, y = points[k, 0], points[k, 1]
        bearing = math.atan2(y, x)
        if bearing >= 0 and math.hypot(x, y - turning_radius) < reach:
            left = min(left, bearing)
        if bearing <= 0 and math.hypot(x, y + turning_radius) < reach:
            right = max(right, bearing)
    return right, left


def free_distance(points: Array, bearings: Array, radius: float) -> Array:
    """Returns how far a disc about the robot's origin gets in each direction, m.

    Args:
        points: (k, 2) m, in the frame of the bearings.
        bearings: (m,) rad.
        radius: of the disc, m. Of a point within it, only coming nearer counts.

    Returns:
        (m,) inf where nothing is in the way.
    """
    distances = np.empty(len(bearings))
    _free_distance(in_rows(points, 2), packed(bearings), radius, distances)
    return distances


@compiled("void(f8[:,::1], f8[::1], f8, f8[::1])")
def _free_distance(points: Array, bearings: Array, radius: float, distances: Array) -> None:
    for m in range(len(bearings)):
        c, s = math.cos(bearings[m]), math.sin(bearings[m])
        distances[m] = math.inf
        for k in range(len(points)):
            along = c * points[k, 0] + s * points[k, 1]
            aside = c * points[k, 1] - s * points[k, 0]
            if along > 0 and abs(aside) < radius:
                room = along - math.sqrt(radius * radius - aside * aside)
                distances[m] = min(distances[m], max(room, 0.0))
