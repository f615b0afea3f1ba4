"""What stands in a robot's way: walls, boxes and cylinders, upright on the ground."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Box, Cylinder, Shape
from pydrake.math import RigidTransform, RollPitchYaw

from plants.planar_shapes import PlanarShapes
from systems.markers.layout import Marker
from systems.validation import require, require_positive

Array = NDArray[np.float64]


def require_point(name: str, value: Any) -> None:
    """Raises `ValueError` for what is not [x, y] with finite numbers."""
    require(len(value) == 2 and bool(np.isfinite(value).all()), name, value, "[x, y] in metres")


class _UprightBox(ABC):
    """What a wall and a box have in common; they say `centre`, `heading` and `dimensions`."""

    @property
    @abstractmethod
    def centre(self) -> Array:
        """Returns the middle of the ground that it covers, (2,) m."""

    @property
    @abstractmethod
    def heading(self) -> float:
        """Returns the direction of its length, rad."""

    @property
    @abstractmethod
    def dimensions(self) -> list[float]:
        """Returns length, width and height, m."""

    def pose(self) -> RigidTransform:
        """Returns the pose of its shape: origin at its centre, x along its length."""
        return RigidTransform(
            RollPitchYaw(0.0, 0.0, self.heading), [*self.centre, self.dimensions[2] / 2]
        )

    def shape(self) -> Shape:
        """Returns its shape."""
        return Box(*self.dimensions)

    def footprint(self) -> PlanarShapes:
        """Returns the ground that it covers."""
        return PlanarShapes(
            centres=[self.centre], headings=[self.heading], sizes=[self.dimensions[:2]], radii=[0.0]
        )

    def distance(self, points: Array) -> Array:
        """Returns the distance of points (n, 3) from its surface, m; negative inside."""
        local = np.abs(self.pose().inverse().multiply(np.atleast_2d(points).T).T)
        outside = local - np.array(self.dimensions) / 2
        return np.asarray(
            np.linalg.norm(np.maximum(outside, 0), axis=1) + np.minimum(outside.max(axis=1), 0)
        )

    def gap(self, marker: Marker) -> float:
        """Returns how far a marker's square is from it, m; negative when they overlap.

        That is along the axis that parts them best: normals, and normals of pairs of edges.
        """
        X_BM = self.pose().inverse().multiply(marker.X_WM)
        normal, *edges = X_BM.rotation().matrix().T
        axes = np.vstack([np.eye(3), normal, *(np.cross(np.eye(3), edge) for edge in edges)])
        lengths = np.linalg.norm(axes, axis=1, keepdims=True)
        axes = (axes / np.maximum(lengths, 1e-9))[lengths[:, 0] > 1e-9]
        reach = np.abs(axes) @ np.array(self.dimensions) / 2
        reach += np.abs(axes @ np.transpose(edges)).sum(axis=1) * marker.size / 2
        return float((np.abs(axes @ X_BM.translation()) - reach).max())


@dataclass
class Wall(_UprightBox):
    """An upright wall on the ground.

    Attributes:
        start: [x, y] of one end of its centre line, m.
        end: [x, y] of the other end, m.
        thickness: m.
        height: m.
    """

    start: list[float]
    end: list[float]
    thickness: float = 0.05
    height: float = 0.6

    def __post_init__(self) -> None:
        require_point("start", self.start)
        require_point("end", self.end)
        require(self.start != self.end, "end", self.end, "another point than start")
        require_positive(thickness=self.thickness, height=self.height)

    @property
    def length(self) -> float:
        """Length of the centre line, m."""
        return float(np.hypot(*np.subtract(self.end, self.start)))

    @property
    def centre(self) -> Array:
        """The middle of the centre line, (2,) m."""
        return np.add(self.start, self.end) / 2

    @property
    def heading(self) -> float:
        """Direction from start to end, rad."""
        along = np.subtract(self.end, self.start)
        return float(np.arctan2(along[1], along[0]))

    @property
    def dimensions(self) -> list[float]:
        """Length, thickness and height, m."""
        return [self.length, self.thickness, self.height]


@dataclass
class BoxObstacle(_UprightBox):
    """A box that stands on the ground.

    Attributes:
        position: [x, y] of its centre, m.
        size: [length, width, height], m.
        heading_deg: direction of its length; 0 is along x, positive to the left.
    """

    position: list[float]
    size: list[float]
    heading_deg: float = 0.0

    def __post_init__(self) -> None:
        require_point("position", self.position)
        require(
            len(self.size) == 3 and all(math.isfinite(s) and s > 0 for s in self.size),
            "size",
            self.size,
            "[length, width, height], each greater than 0",
        )
        require(math.isfinite(self.heading_deg), "heading_deg", self.heading_deg, "finite")

    @property
    def centre(self) -> Array:
        """Its position, (2,) m."""
        return np.array(self.position)

    @property
    def heading(self) -> float:
        """Direction of its length, rad."""
        return math.radians(self.heading_deg)

    @property
    def dimensions(self) -> list[float]:
        """Length, width and height, m."""
        return self.size


@dataclass
class CylinderObstacle:
    """A cylinder that stands on the ground.

    Attributes:
        position: [x, y] of its axis, m.
        radius: m.
        height: m.
    """

    position: list[float]
    radius: float
    height: float = 0.6

    def __post_init__(self) -> None:
        require_point("position", self.position)
        require_positive(radius=self.radius, height=self.height)

    def pose(self) -> RigidTransform:
        """Returns the pose of its shape: origin at its centre."""
        return RigidTransform([*self.position, self.height / 2])

    def shape(self) -> Shape:
        """Returns its shape."""
        return Cylinder(self.radius, self.height)

    def footprint(self) -> PlanarShapes:
        """Returns the ground that it covers."""
        return PlanarShapes(
            centres=[self.position], headings=[0.0], sizes=[[0.0, 0.0]], radii=[self.radius]
        )

    def gap(self, marker: Marker) -> float:
        """Returns how far a marker's square is from it, m; negative when they overlap.

        That is in the horizontal plane, or up to a marker that is wholly above or below.
        """
        corners = marker.corners()
        heights = corners[:, 2]
        above = max(heights.min() - self.height, -heights.max())
        if above > 0:
            return float(above)
        beside = _cut(_cut(corners, 0.0, 1.0), self.height, -1.0)[:, :2] - self.position
        return _distance_of_origin(beside) - self.radius


def _cut(polygon: Array, level: float, sign: float) -> Array:
    """Returns what of a convex polygon (n, 3) has sign * (z - level) >= 0 (Sutherland, Hodgman)."""
    kept = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        over_a, over_b = sign * (a[2] - level), sign * (b[2] - level)
        if over_a >= 0:
            kept.append(a)
        if (over_a >= 0) != (over_b >= 0):
            kept.append(a + (b - a) * over_a / (over_a - over_b))
    return np.array(kept).reshape(-1, 3)


def _distance_of_origin(polygon: Array) -> float:
    """Returns the distance of the origin from a convex polygon (n, 2), however thin; 0 inside."""
    edges = np.roll(polygon, -1, axis=0) - polygon
    squares = np.maximum((edges * edges).sum(axis=1), 1e-18)
    part = np.clip(-(polygon * edges).sum(axis=1) / squares, 0, 1)
    nearest = np.linalg.norm(polygon + part[:, None] * edges, axis=1).min()
    side = edges[:, 1] * polygon[:, 0] - edges[:, 0] * polygon[:, 1]
    inside = bool((side > 0).all() or (side < 0).all())
    return 0.0 if inside else float(nearest)
