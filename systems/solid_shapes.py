"""Convex solids and where a line enters them, shape by shape.

Every solid is convex, so a line runs inside it during one interval [enter, leave] of its length.
An affine map leaves the length along a line as it is and takes box, cylinder and ellipsoid (sphere)
to unit shapes: the cube, cut by a ball in none, two or three of its dimensions. So they are one
case, with the slabs of Kay and Kajiya ("Ray tracing complex scenes", SIGGRAPH 1986); a box is tried
without the ball. Hulls are cut face by face (Cyrus and Beck, "Generalized two- and
three-dimensional clipping", 1978).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    HalfSpace,
    Mesh,
    Shape,
    Sphere,
)

Array = NDArray[np.float64]
Interval = tuple[Array, Array]

# The functions that intersect; solids of a kind are intersected together.
BOX, ROUND_BOX, CAPSULE, HULL = range(4)
# Stands for a divisor of zero: the result is then so large that any other bound wins.
TINY = 1e-200
# In which dimensions a ball cuts the unit cube.
_CUBE, _TUBE, _FULL = np.array([[0.0, 0, 0], [1, 1, 0], [1, 1, 1]])[:, :, None]
# A hull thinner than this part of its radius is a flat decal, which has no inside.
_FLAT = 1e-5


def _clip(enter: Array, leave: Array) -> Array:
    """Returns where intervals begin; NaN for an empty one."""
    return np.where(enter <= leave, enter, np.nan)


def _slabs(o: Array, d: Array) -> Interval:
    """Returns where the lines `o + t d` run in the unit cube (|x| <= 1 in each dimension).

    A line along a slab is in it from -inf to inf, or enters at inf.
    """
    a, b = (-1 - o) / d, (1 - o) / d
    return np.minimum(a, b).max(axis=0), np.maximum(a, b).min(axis=0)


def _ball(o: Array, d: Array, part: Array) -> Interval:
    """Returns where the lines run in the unit ball, in those dimensions whose `part` is 1, not 0.

    NaN for a miss. The distance is taken at the closest point, which keeps its digits when the
    line starts far away.
    """
    d_part = part * d
    square = np.maximum((d_part * d).sum(axis=0), TINY)
    middle = (d_part * o).sum(axis=0) / -square
    closest = o + middle * d
    half = np.sqrt((1 - (part * closest * closest).sum(axis=0)) / square)
    return middle - half, middle + half


def enter_box(o: Array, d: Array) -> Array:
    """Returns where the lines `o + t d`, (3, n) each, enter the unit cube; NaN for a miss."""
    return _clip(*_slabs(o, d))


def enter_round_box(o: Array, d: Array, part: Array) -> Array:
    """Returns where the lines enter the unit cube cut by a ball; NaN for a miss."""
    near, far = _slabs(o, d)
    enter, leave = _ball(o, d, part)
    return _clip(np.maximum(enter, near), np.minimum(leave, far))


def enter_capsule(o: Array, d: Array, ratio: Array) -> Array:
    """Returns where the lines enter a capsule of unit radius; NaN for a miss.

    `ratio` is half the length of the straight part.
    """
    tube, _ = _ball(o, d, _TUBE)
    # What enters the endless tube beyond the straight part can only come in through that cap.
    height = o[2] + tube * d[2]
    from_cap = o.copy()
    from_cap[2] -= np.copysign(ratio, height)
    cap, _ = _ball(from_cap, d, _FULL)
    return np.where(np.abs(height) <= ratio, tube, cap)


def enter_hull(o: Array, d: Array, faces: Array, counts: NDArray[np.intp]) -> Array:
    """Returns where the lines enter a hull; NaN for a miss.

    Args:
        o: (3, n) m, from the hull's centre.
        d: (3, n).
        faces: (4, sum of counts) those of all hulls in one row: normal, distance from the centre.
        counts: (n,) how many belong to each line's hull.
    """
    line = np.repeat(np.arange(len(counts)), counts)
    height = faces[3] - np.einsum("in,in->n", faces[:3], o.take(line, axis=1))
    rise = np.einsum("in,in->n", faces[:3], d.take(line, axis=1))
    rise = np.where(np.abs(rise) < TINY, TINY, rise)
    t = height / rise
    starts = np.cumsum(counts) - counts
    enter = np.maximum.reduceat(np.where(rise < 0, t, -np.inf), starts)
    leave = np.minimum.reduceat(np.where(rise > 0, t, np.inf), starts)
    return _clip(enter, leave)


@dataclass(frozen=True)
class Solid:
    """What the intersection needs to know of one shape.

    Attributes:
        kind: which function intersects it.
        scale: (3,) half sizes, m; the map to the unit shape divides by them.
        radius: of the bounding sphere around `centre`, m.
        extent: (3,) half sizes of the box around `centre` that holds it, m.
        centre: (3,) m, in the shape's frame; also the origin of `faces`.
        part: (3, 1) of a round box, see `_ball`.
        ratio: of a capsule, see `enter_capsule`.
        faces: (f, 4) of a hull: outward unit normal and distance from the centre, m.
    """

    kind: int
    scale: Array
    radius: float
    extent: Array
    centre: Array = field(default_factory=lambda: np.zeros(3))
    part: Array = field(default_factory=lambda: _CUBE)
    ratio: float = 1.0
    faces: Array = field(default_factory=lambda: np.zeros((0, 4)))


def describe(shape: Shape) -> Solid | None:
    """Returns the solid of a shape; None for one without an inside.

    Raises:
        ValueError: a shape of another kind.
    """
    if isinstance(shape, Box):
        half = np.asarray(shape.size()) / 2
        return Solid(BOX, half, float(np.linalg.norm(half)), half)
    if isinstance(shape, Cylinder):
        radius, half_length = shape.radius(), shape.length() / 2
        half = np.array([radius, radius, half_length])
        return Solid(ROUND_BOX, half, float(np.hypot(radius, half_length)), half, part=_TUBE)
    if isinstance(shape, Ellipsoid):
        half = np.array([shape.a(), shape.b(), shape.c()])
        return Solid(ROUND_BOX, half, float(half.max()), half, part=_FULL)
    if isinstance(shape, Sphere):
        radius = shape.radius()
        half = np.full(3, radius)
        return Solid(ROUND_BOX, half, radius, half, part=_FULL) if radius > 0 else None
    if isinstance(shape, Capsule):
        radius, half_length = shape.radius(), shape.length() / 2
        extent = np.array([radius, radius, radius + half_length])
        scale = np.full(3, radius)
        return Solid(CAPSULE, scale, radius + half_length, extent, ratio=half_length / radius)
    if isinstance(shape, HalfSpace):
        faces = np.array([[0.0, 0.0, 1.0, 0.0]])
        return Solid(HULL, np.ones(3), np.inf, np.full(3, np.inf), faces=faces)
    if isinstance(shape, Convex | Mesh):
        return _describe_hull(shape)
    raise ValueError(
        f"shape is {shape!r}: must be Box, Sphere, Ellipsoid, Cylinder, Capsule, HalfSpace, "
        "Convex or Mesh"
    )


def _describe_hull(shape: Convex | Mesh) -> Solid | None:
    mesh = shape.GetConvexHull()
    vertices = np.array([mesh.vertex(i) for i in range(mesh.num_vertices())])
    normals = np.array([mesh.face_normal(i) for i in range(mesh.num_faces())])
    extent = np.ptp(vertices, axis=0) / 2
    centre = vertices.min(axis=0) + extent
    radius = float(np.linalg.norm(vertices - centre, axis=1).max())
    heights = (vertices - centre) @ normals.T
    if np.ptp(heights, axis=0).min() <= _FLAT * radius:
        return None
    faces = np.column_stack([normals, heights.max(axis=0)])
    return Solid(HULL, np.ones(3), radius, extent, centre, faces=faces)
