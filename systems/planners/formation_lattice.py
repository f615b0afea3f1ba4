"""The lattice of equilateral triangles that a formation stands on, and what of it holds together.

A vertex is a pair of whole numbers (i, j), at the place origin + side (i a + j b) with unit vectors
a and b 60 degrees apart. Three beacons p, q, r at a triangle's corners carry a fourth robot to
p + q - r, the mirror image of r in the side p q. What can move like this hangs together by whole
sides: triangles that share a mere corner are a hinge, and robots in no triangle are strays.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from systems.validation import require, require_positive

Array = NDArray[np.float64]
Vertex = tuple[int, int]
Triangle = frozenset[Vertex]
Side = frozenset[Vertex]

_SIXTY = complex(0.5, math.sqrt(0.75))
_FIT_ROUNDS = 5


@dataclass(frozen=True)
class TriangleLattice:
    """Where the vertices are.

    Attributes:
        origin: [x, y] of vertex (0, 0) in W, m.
        heading: direction from (0, 0) to (1, 0), rad; (0, 1) is 60 degrees to its left.
        side: of the triangles, m.
    """

    origin: tuple[float, float]
    heading: float
    side: float

    def __post_init__(self) -> None:
        require_positive(side=self.side)

    def positions(self, vertices: ArrayLike) -> Array:
        """Returns the places (..., 2) m in W of vertices (..., 2), whole or in between."""
        v = np.asarray(vertices, float)
        turn = self.side * complex(math.cos(self.heading), math.sin(self.heading))
        z = complex(*self.origin) + turn * (v[..., 0] + v[..., 1] * _SIXTY)
        return np.stack([z.real, z.imag], axis=-1)

    def nearest(self, positions: ArrayLike) -> tuple[NDArray[np.int64], Array]:
        """Returns the vertices (n, 2) nearest to places (n, 2) m, and how far they are, (n,) m."""
        p = np.asarray(positions, float).reshape(-1, 2)
        turn = self.side * complex(math.cos(self.heading), math.sin(self.heading))
        z = (p[:, 0] + 1j * p[:, 1] - complex(*self.origin)) / turn
        j = z.imag / _SIXTY.imag
        low = np.floor(np.stack([z.real - 0.5 * j, j], axis=-1)).astype(np.int64)
        corners = low[:, None] + np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
        distances = np.linalg.norm(self.positions(corners) - p[:, None], axis=2)
        best = distances.argmin(axis=1)
        rows = np.arange(len(p))
        return corners[rows, best], distances[rows, best]


def fit_lattice(
    positions: ArrayLike, side: float, tolerance: float = 0.2
) -> tuple[TriangleLattice, list[Vertex]]:
    """Returns the lattice that robots stand on, by least squares, and the vertex of each.

    Args:
        positions: (n, 2) m in W, n >= 3. The first robot stands near vertex (0, 0).
        side: of the triangles, m.
        tolerance: how far a robot may stand from its vertex, in sides.

    Raises:
        ValueError: they do not stand at the vertices of triangles that share sides.
    """
    p = np.asarray(positions, float).reshape(-1, 2)
    require_positive(side=side)
    allowed = f"at least three robots at the vertices of triangles of {side:g} m that share sides"
    require(len(p) >= 3 and bool(np.isfinite(p).all()), "positions", p.tolist(), allowed)
    z = p[:, 0] + 1j * p[:, 1]
    apart = np.abs(z - z[0])
    apart[0] = np.inf
    nearest = int(np.argmin(np.abs(apart - side)))
    lattice = TriangleLattice((p[0, 0], p[0, 1]), float(np.angle(z[nearest] - z[0])), side)
    for _ in range(_FIT_ROUNDS):
        vertices, _ = lattice.nearest(p)
        w = vertices[:, 0] + vertices[:, 1] * _SIXTY
        turn = np.vdot(w - w.mean(), z - z.mean())  # Procrustes of the plane
        heading = float(np.angle(turn)) if abs(turn) > 0 else lattice.heading
        origin = z.mean() - side * np.exp(1j * heading) * w.mean()
        lattice = TriangleLattice((float(origin.real), float(origin.imag)), heading, side)
    found, distances = lattice.nearest(p)
    names = [(int(i), int(j)) for i, j in found]
    whole = body_of(names) if len(set(names)) == len(names) else frozenset()
    sound = bool(distances.max() <= tolerance * side) and len(whole) == len(names)
    require(sound, "positions", p.round(3).tolist(), allowed)
    return lattice, names


def strip(robots: int, side: float) -> Array:
    """Returns where robots stand in a straight strip of triangles along x, (n, 2) m.

    The first four with sides of 1.5 m are the start of [FORM]: (0.75, 0), (0, 1.30), (2.25, 0) and
    (1.5, 1.30) m; all others stand behind them, toward -x.

    Raises:
        ValueError: fewer than three robots.
    """
    require(robots >= 3, "robots", robots, "3 or greater")
    require_positive(side=side)
    place = np.arange(robots)
    along = np.where(place < 4, np.where(place ^ 1 < robots, place ^ 1, place), 3 - place)
    return side * np.stack([along / 2, _SIXTY.imag * (along % 2 == 0)], axis=-1)


def mirrored(r: Vertex, p: Vertex, q: Vertex) -> Vertex:
    """Returns the mirror image of r in the side p q of its triangle."""
    return p[0] + q[0] - r[0], p[1] + q[1] - r[1]


def triangles_of(vertices: Collection[Vertex]) -> list[Triangle]:
    """Returns the smallest triangles whose corners are all among the vertices, in their order."""
    there = set(vertices)
    return [
        frozenset({(i, j), other, (i, j + 1)})
        for i, j in sorted(there)
        for other in ((i + 1, j), (i - 1, j + 1))
        if other in there and (i, j + 1) in there
    ]


def sides_of(triangle: Triangle) -> Iterator[tuple[Vertex, Vertex, Vertex]]:
    """Yields p, q, r for each side p q of a triangle with the corner r opposite to it."""
    a, b, c = sorted(triangle)
    yield a, b, c
    yield b, c, a
    yield c, a, b


def bodies_of(vertices: Collection[Vertex]) -> list[frozenset[Vertex]]:
    """Returns the corners of each set of triangles that hang together by sides, largest first."""
    triangles = triangles_of(vertices)
    beside: dict[Side, list[int]] = {}
    for k, triangle in enumerate(triangles):
        for p, q, _ in sides_of(triangle):
            beside.setdefault(frozenset({p, q}), []).append(k)
    left, bodies = set(range(len(triangles))), []
    while left:
        reached = [left.pop()]
        for k in reached:
            for p, q, _ in sides_of(triangles[k]):
                more = left.intersection(beside[frozenset({p, q})])
                left -= more
                reached.extend(more)
        bodies.append(frozenset().union(*(triangles[k] for k in reached)))
    return sorted(bodies, key=lambda body: (-len(body), sorted(body)))


def body_of(vertices: Collection[Vertex]) -> frozenset[Vertex]:
    """Returns the largest of `bodies_of`; empty when there is no triangle."""
    bodies = bodies_of(vertices)
    return bodies[0] if bodies else frozenset()
