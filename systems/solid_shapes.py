"""Convex solids and where a line enters them, shape by shape.

Every solid is convex, so a line runs inside it during one interval [enter, leave] of its length.
An affine map leaves the length along a line as it is and takes box, cylinder and ellipsoid (sphere)
to unit shapes: the cube, cut by a ball in none, two or three of its dimensions. So they are one
case, with the slabs of Kay and Kajiya ("Ray tracing complex scenes", SIGGRAPH 1986). Hulls are cut
face by face (Cyrus and Beck, "Generalized two- and three-dimensional clipping", 1978).
"""

from __future__ import annotations

import math
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

from systems.compiled import compiled

Array = NDArray[np.float64]

# What intersects a solid.
ROUND_BOX, CAPSULE, HULL = range(3)
# Stands for a divisor of zero: the result is then so large that any other bound wins.
TINY = 1e-200
# In how many dimensions a ball cuts the unit cube.
_CUBE, _TUBE, _FULL = 0, 2, 3
# A hull thinner than this part of its radius is a flat decal, which has no inside.
_FLAT = 1e-5


@compiled()
def _ball(o: Array, d: Array, dimensions: int) -> tuple[float, float]:
    """Returns where the line `o + t d` runs in the unit ball of the first dimensions; or NaN.

    The distance is taken at the closest point, which keeps its digits when the line starts far
    away.
    """
    square, along, rest = 0.0, 0.0, 1.0
    for i in range(dimensions):
        square += d[i] * d[i]
        along += d[i] * o[i]
    square = max(square, TINY)
    middle = -along / square
    for i in range(dimensions):
        closest = o[i] + middle * d[i]
        rest -= closest * closest
    if rest < 0:
        return math.nan, math.nan
    half = math.sqrt(rest / square)
    return middle - half, middle + half


@compiled()
def enter_round_box(o: Array, d: Array, dimensions: int) -> float:
    """Returns where the line `o + t d` enters the unit cube (|x| <= 1); NaN for a miss.

    Args:
        o: (3,).
        d: (3,).
        dimensions: how many of the first ones a unit ball cuts the cube in; 0 leaves it whole.
    """
    enter, leave = -math.inf, math.inf
    for i in range(3):
        if d[i] == 0:
            if abs(o[i]) > 1:
                return math.nan
            continue
        a, b = (-1 - o[i]) / d[i], (1 - o[i]) / d[i]
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    if dimensions > 0:
        a, b = _ball(o, d, dimensions)
        if math.isnan(a):
            return math.nan
        enter, leave = max(enter, a), min(leave, b)
    return enter if enter <= leave else math.nan


@compiled()
def enter_capsule(o: Array, d: Array, ratio: float) -> float:
    """Returns where the line enters a capsule of unit radius; NaN for a miss.

    `ratio` is half the length of the straight part.
    """
    tube, _ = _ball(o, d, 2)
    height = o[2] + tube * d[2]
    if math.isnan(tube) or abs(height) <= ratio:
        return tube
    # What enters the endless tube beyond the straight part can only come in through that cap.
    from_cap = o.copy()
    from_cap[2] -= math.copysign(ratio, height)
    return _ball(from_cap, d, 3)[0]


@compiled()
def enter_hull(o: Array, d: Array, faces: Array) -> float:
    """Returns where the line enters a hull; NaN for a miss.

    Args:
        o: (3,) m, from the hull's centre.
        d: (3,).
        faces: (f, 4) outward normal, distance from the centre.
    """
    enter, leave = -math.inf, math.inf
    for k in range(len(faces)):
        nx, ny, nz = faces[k, 0], faces[k, 1], faces[k, 2]
        height = faces[k, 3] - (nx * o[0] + ny * o[1] + nz * o[2])
        rise = nx * d[0] + ny * d[1] + nz * d[2]
        if abs(rise) < TINY:
            rise = TINY
        if rise < 0:
            enter = max(enter, height / rise)
        else:
            leave = min(leave, height / rise)
    return enter if enter <= leave else math.nan


@dataclass(frozen=True)
class Solid:
    """What the intersection needs to know of one shape.

    Attributes:
        kind: which function intersects it.
        scale: (3,) half sizes, m; the map to the unit shape divides by them.
        radius: of the bounding sphere around `centre`, m.
        centre: (3,) m, in the shape's frame; also the origin of `faces`.
        dimensions: of a round box, see `enter_round_box`.
        ratio: of a capsule, see `enter_capsule`.
        faces: (f, 4) of a hull: outward unit normal and distance from the centre, m.
    """

    kind: int
    scale: Array
    radius: float
    centre: Array = field(default_factory=lambda: np.zeros(3))
    dimensions: int = _CUBE
    ratio: float = 1.0
    faces: Array = field(default_factory=lambda: np.zeros((0, 4)))


def describe(shape: Shape) -> Solid | None:
    """Returns the solid of a shape; None for one without an inside.

    Raises:
        ValueError: a shape of another kind.
    """
    if isinstance(shape, Box):
        half = np.asarray(shape.size()) / 2
        return Solid(ROUND_BOX, half, float(np.linalg.norm(half)))
    if isinstance(shape, Cylinder):
        radius, half_length = shape.radius(), shape.length() / 2
        half = np.array([radius, radius, half_length])
        return Solid(ROUND_BOX, half, float(np.hypot(radius, half_length)), dimensions=_TUBE)
    if isinstance(shape, Ellipsoid):
        half = np.array([shape.a(), shape.b(), shape.c()])
        return Solid(ROUND_BOX, half, float(half.max()), dimensions=_FULL)
    if isinstance(shape, Sphere):
        radius = shape.radius()
        half = np.full(3, radius)
        return Solid(ROUND_BOX, half, radius, dimensions=_FULL) if radius > 0 else None
    if isinstance(shape, Capsule):
        radius, half_length = shape.radius(), shape.length() / 2
        scale = np.full(3, radius)
        return Solid(CAPSULE, scale, radius + half_length, ratio=half_length / radius)
    if isinstance(shape, HalfSpace):
        faces = np.array([[0.0, 0.0, 1.0, 0.0]])
        return Solid(HULL, np.ones(3), np.inf, faces=faces)
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
    return Solid(HULL, np.ones(3), radius, centre, faces=faces)
