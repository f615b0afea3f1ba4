"""What stands in a formation's way, as circles and convex polygons, and the room beside a path."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from systems.messages import Message

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Obstacles(Message):
    """Obstacles on the ground, known or sensed.

    Attributes:
        stamp: when this was known, s; NaN when nothing is known: then the ground counts as free.
        frame_id: the frame that they are in.
        circles: (n, 3) [x, y, radius], m.
        polygons: (m, k, 2) corners of convex polygons in order of either sense, m; one that has
            fewer than k corners repeats its last.
    """

    stamp: float = math.nan
    frame_id: str = ""
    circles: Array = field(default_factory=lambda: np.zeros((0, 3)))
    polygons: Array = field(default_factory=lambda: np.zeros((0, 4, 2)))

    def __len__(self) -> int:
        return len(self.circles) + len(self.polygons)

    @property
    def sound(self) -> bool:
        """Whether all its numbers are finite and no radius is negative."""
        finite = np.isfinite(self.circles).all() and np.isfinite(self.polygons).all()
        return bool(finite and (self.circles[:, 2] >= 0).all())

    def with_circles(self, circles: Iterable[Iterable[float]]) -> Obstacles:
        """Returns these and more circles [x, y, radius]."""
        more = np.array([list(circle) for circle in circles], float).reshape(-1, 3)
        return Obstacles(
            stamp=self.stamp,
            frame_id=self.frame_id,
            circles=np.concatenate([self.circles, more]),
            polygons=self.polygons,
        )


def clearance(obstacles: Obstacles, a: Array, b: Array) -> float:
    """Returns how far the straight line from a to b (2,) m is from all obstacles, m.

    At most 0 when it meets one; inf when there is none.
    """
    least = math.inf
    if len(obstacles.circles):
        gaps = _distances(obstacles.circles[:, :2], a, b) - obstacles.circles[:, 2]
        least = float(gaps.min())
    if len(obstacles.polygons):
        least = min(least, _polygon_clearance(obstacles.polygons, a, b))
    return least


def _polygon_clearance(polygons: Array, a: Array, b: Array) -> float:
    starts, ends = polygons, np.roll(polygons, -1, axis=1)
    side = _cross(ends - starts, a - starts)  # (m, k); no corner is beyond any side of its own
    if bool(((side >= 0).all(axis=1) | (side <= 0).all(axis=1)).any()):
        return 0.0
    side_b = _cross(ends - starts, b - starts)
    along = b - a
    crossed = (side * side_b < 0) & (_cross(along, starts - a) * _cross(along, ends - a) < 0)
    if bool(crossed.any()):
        return 0.0
    to_corners = _distances(starts.reshape(-1, 2), a, b).min()
    steps = ends - starts
    squares = np.maximum((steps * steps).sum(axis=2), 1e-18)
    to_ends = []
    for point in (a, b):
        share = np.clip(((point - starts) * steps).sum(axis=2) / squares, 0, 1)
        offsets = starts + share[..., None] * steps - point
        to_ends.append(np.sqrt((offsets * offsets).sum(axis=2)).min())
    return float(min(to_corners, *to_ends))


def _distances(points: Array, a: Array, b: Array) -> Array:
    """Returns the distances of points (n, 2) from the straight line from a to b, (n,) m."""
    along = b - a
    square = max(float(along @ along), 1e-18)
    share = np.clip((points - a) @ along / square, 0, 1)
    offsets = a + share[:, None] * along - points
    return np.asarray(np.sqrt((offsets * offsets).sum(axis=1)))


def _cross(u: Array, v: Array) -> Array:
    return np.asarray(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])
