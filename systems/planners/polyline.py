"""Paths as rows of points: how long they are, and what is left of them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled, packed

Array = NDArray[np.float64]


def length_of(points: Array) -> float:
    """Returns the length of a path (n, 2), m; 0 for one without a piece."""
    places = points.tolist()
    return float(sum(map(math.dist, places, places[1:])))


def rest_of(points: Array, position: Array) -> Array:
    """Returns the path from the place on it that is nearest to a position (2,): (m, 2) m.

    Args:
        points: (n, 2) m, at least one.
        position: m.
    """
    if len(points) == 1:
        return points
    rest = np.array(points)
    return rest[_cut(rest, packed(position)) :]


@compiled("i8(f8[:,::1], f8[::1])")
def _cut(points: Array, position: Array) -> int:
    """Moves the point before the nearest place to that place; returns which point that is."""
    nearest, least = 0, math.inf
    place_x, place_y = points[0, 0], points[0, 1]
    for k in range(len(points) - 1):
        dx, dy = points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1]
        squared = max(dx * dx + dy * dy, 1e-12)
        along = (position[0] - points[k, 0]) * dx + (position[1] - points[k, 1]) * dy
        share = min(max(along / squared, 0.0), 1.0)
        x, y = points[k, 0] + share * dx, points[k, 1] + share * dy
        distance = math.hypot(x - position[0], y - position[1])
        # Of equally near places the last: at a corner it is that of the piece that is to come.
        if distance <= least:
            nearest, least, place_x, place_y = k, distance, x, y
    points[nearest, 0], points[nearest, 1] = place_x, place_y
    return nearest


def points_along(points: Array, distances: Array) -> Array:
    """Returns the places at distances (k,) m along a path (n, 2): (k, 2) m; at most its end."""
    steps = np.diff(points, axis=0)
    run = np.concatenate([[0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))])
    columns = [np.interp(distances, run, points[:, axis]) for axis in (0, 1)]
    return np.stack(columns, axis=-1)
