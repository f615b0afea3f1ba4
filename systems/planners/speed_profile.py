"""The fastest way to drive along a given path within limits of speed and acceleration."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from systems.planners.route_limits import RouteLimits

Array = NDArray[np.float64]


def speed_caps(curvature: Array, limits: RouteLimits) -> dict[str, Array]:
    """Returns by limit how fast each place may be passed (k,), m/s, whatever comes before or after.

    Args:
        curvature: (k,) 1/m.
        limits: of the robot.
    """
    bend = np.maximum(np.abs(curvature), 1e-9)
    return {
        "speed": np.full(len(bend), limits.max_speed),
        "lateral_acceleration": np.sqrt(limits.max_lateral_acceleration / bend),
        "turn_rate": limits.max_turn_rate / bend,
    }


def fastest(curvature: Array, steps: Array, limits: RouteLimits, closed: bool) -> Array:
    """Returns the squared speeds of the fastest drive: (k,) m^2/s^2.

    Between places the acceleration is constant. Under these limits the largest squared speed at
    every place is had at once, by one pass forward and one back (Bobrow, Dubowsky, Gibson,
    "Time-optimal control of robotic manipulators along specified paths", 1985).

    Args:
        curvature: (k,) at the places, 1/m.
        steps: way from each place to the next, m: (k,) if closed, else (k - 1,).
        limits: of the robot.
        closed: whether the last place leads to the first again, else it rests at both ends.
    """
    caps = np.min(list(speed_caps(curvature, limits).values()), axis=0) ** 2
    rise = 2 * limits.max_acceleration * steps
    if closed:  # from the slowest place, which no acceleration can slow any more
        first = int(np.argmin(caps))
        caps, rise = np.roll(caps, -first), np.roll(rise, -first)
        caps = np.append(caps, caps[0])
        return np.roll(_reachable(caps, rise)[:-1], first)
    caps = caps.copy()
    caps[[0, -1]] = 0.0
    return _reachable(caps, rise)


def _reachable(caps: Array, rise: Array) -> Array:
    b = caps.copy()
    for k in range(len(rise)):
        b[k + 1] = min(b[k + 1], b[k] + rise[k])
    for k in reversed(range(len(rise))):
        b[k] = min(b[k], b[k + 1] + rise[k])
    return b


def times(squared: Array, steps: Array, closed: bool) -> Array:
    """Returns when each place is reached, s, and at last the end of a closed path: from 0.

    Args:
        squared: (k,) squared speeds, m^2/s^2.
        steps: as for `fastest`.
        closed: as for `fastest`.
    """
    v = np.sqrt(np.append(squared, squared[0]) if closed else squared)
    return np.concatenate([[0.0], np.cumsum(2 * steps / np.maximum(v[1:] + v[:-1], 1e-9))])
