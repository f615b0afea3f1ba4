"""Paths as rows of points: how long they are, and what is left of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def length_of(points: Array) -> float:
    """Returns the length of a path (n, 2), m; 0 for one without a piece."""
    steps = np.diff(points, axis=0)
    return float(np.hypot(steps[:, 0], steps[:, 1]).sum()) if len(steps) else 0.0


def rest_of(points: Array, position: Array) -> Array:
    """Returns the path from the place on it that is nearest to a position (2,): (m, 2) m.

    Args:
        points: (n, 2) m, at least one.
        position: m.
    """
    if len(points) == 1:
        return points
    a, along = points[:-1], np.diff(points, axis=0)
    squared = np.maximum((along**2).sum(axis=1), 1e-12)
    share = np.clip(((position - a) * along).sum(axis=1) / squared, 0, 1)
    nearest = a + share[:, None] * along
    # Of equally near places the last: at a corner it is that of the piece that is to come.
    distance = np.hypot(*(nearest - position).T)
    k = len(distance) - 1 - int(np.argmin(distance[::-1]))
    return np.concatenate([nearest[k : k + 1], points[k + 1 :]])


def points_along(points: Array, distances: Array) -> Array:
    """Returns the places at distances (k,) m along a path (n, 2): (k, 2) m; at most its end."""
    steps = np.diff(points, axis=0)
    run = np.concatenate([[0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))])
    columns = [np.interp(distances, run, points[:, axis]) for axis in (0, 1)]
    return np.stack(columns, axis=-1)
