"""Equilateral triangles on the plane: the next vertex, the way to it, and errors from it.

Three robots stand as beacons on the vertices of a triangle, a fourth one stands mirrored outside
one of its edges (the entry) and drives through the triangle to where it is mirrored outside another
(the exit). By that the beacons are told apart, and are always listed in this order:

1. the one off the entry, straight ahead of the robot when it enters,
2. the pivot, on both edges,
3. the anchor, off the exit, straight behind the robot when it arrives.

Everything here works for triangles of either orientation: mirrored ones need no case of their own.

[FORM]: Kang, Kwon, Bae, Kim, "Monocular Vision-Based Swarm Robot Localization Using Equilateral
Triangular Formations".
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HEIGHT = math.sqrt(3) / 2  # of an equilateral triangle of side 1


def orientation(beacons: Array) -> Any:
    """Returns +1.0 for triangles listed counterclockwise, -1.0 for clockwise, 0.0 for a line.

    Args:
        beacons: (..., 3, 2) m.
    """
    a, b = beacons[..., 1, :] - beacons[..., 0, :], beacons[..., 2, :] - beacons[..., 0, :]
    return np.sign(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def next_vertex(beacons: Array) -> Array:
    """Returns the vertex (..., 2) that makes an equilateral triangle with beacons 1 and 2.

    Of the two it is the one beyond their edge, as seen from the anchor. Where the three stand
    exactly, it is the anchor mirrored at that edge.

    Args:
        beacons: (..., 3, 2) m; the third one only tells the side.
    """
    edge = beacons[..., 1, :] - beacons[..., 0, :]
    normal = np.stack([edge[..., 1], -edge[..., 0]], axis=-1)  # to the right of 1 -> 2
    outward = orientation(beacons)[..., None] * normal
    vertex: Array = beacons[..., :2, :].mean(axis=-2) + HEIGHT * outward
    return vertex


def gates(beacons: Array) -> Array:
    """Returns the middles (..., 2, 2) of entry and exit: the centre points of Algorithm II."""
    pivot = beacons[..., 1:2, :]
    middles: Array = (pivot + beacons[..., [2, 0], :]) / 2
    return middles


def arrival_heading(vertex: Array, anchor: Array) -> Any:
    """Returns the heading (rad) at the vertex with the anchor straight behind."""
    line = vertex - anchor
    return np.arctan2(line[..., 1], line[..., 0])


def components(error: Array, heading: Any) -> tuple[Any, Any]:
    """Splits a displacement into (longitudinal, lateral): along a heading and to its left.

    Args:
        error: (..., 2) m.
        heading: (...) rad; for errors of a vertex, `arrival_heading` there ([FORM] 4.2).
    """
    c, s = np.cos(heading), np.sin(heading)
    return c * error[..., 0] + s * error[..., 1], c * error[..., 1] - s * error[..., 0]


def side_ratios(triangle: Array, side: float) -> Array:
    """Returns the lengths (..., 3) of the sides 1-2, 2-3, 3-1, by the nominal one.

    Args:
        triangle: (..., 3, 2) m.
        side: nominal length, m.
    """
    lengths: Array = np.linalg.norm(np.roll(triangle, -1, axis=-2) - triangle, axis=-1)
    return lengths / side
