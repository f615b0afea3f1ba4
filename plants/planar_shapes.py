"""Distances between rectangles and discs in the plane: robots and obstacles seen from above.

All are one shape, the rounded rectangle: the points within `radius` of a core rectangle. A disc has
a core without extent, a wall's or a path's centre line one without width. The distance of two of
them is that of their cores, less both radii. Cores that are apart are nearest each other at a
corner of one of them; of cores that overlap, the depth is that along the normal of a side that
parts them with the shortest push (the separating axis theorem; Ericson, "Real-Time Collision
Detection", 2005, 4.4 and 5.2). Points of the plane are complex numbers here: a turn is a product.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from systems.compiled import compiled, packed

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Centres, turns, corners, halves and radii, for compiled code.
_Cores = tuple[ComplexArray, ComplexArray, ComplexArray, Array, Array]
_CORES = "Tuple((c16[::1], c16[::1], c16[:,::1], f8[:,::1], f8[::1]))"

_CORNERS = np.array([1 + 1j, -1 + 1j, -1 - 1j, 1 - 1j])


class PlanarShapes:
    """Rounded rectangles in the plane. Immutable.

    Args:
        centres: (n, 2) m.
        headings: (n,) direction of each rectangle's length, rad.
        sizes: (n, 2) length and width of each core, m; zeros for a disc.
        radii: (n,) by which each core is rounded, m.
    """

    def __init__(
        self, *, centres: ArrayLike, headings: ArrayLike, sizes: ArrayLike, radii: ArrayLike
    ) -> None:
        xy = np.asarray(centres, float).reshape(-1, 2)
        half = np.asarray(sizes, float).reshape(-1, 2) / 2
        self._set(
            xy[:, 0] + 1j * xy[:, 1],
            np.exp(1j * np.asarray(headings, float).reshape(-1)),
            half,
            np.asarray(radii, float).reshape(-1),
        )

    def _set(self, centres: ComplexArray, turns: ComplexArray, halves: Array, radii: Array) -> None:
        self._centres = centres
        self._turns = turns
        self._halves = packed(halves)  # (n, 2) of length and width
        self._radii = packed(radii)
        length, width = halves.T
        corners = _CORNERS.real[:, None] * length + 1j * _CORNERS.imag[:, None] * width
        self._corners = corners * turns  # (4, n) about the centres

    def __len__(self) -> int:
        return len(self._centres)

    @property
    def centres(self) -> Array:
        """Where they are, (n, 2) m."""
        return np.column_stack([self._centres.real, self._centres.imag])

    @property
    def radii(self) -> Array:
        """By which each core is rounded, (n,) m."""
        return self._radii

    def corners(self) -> Array:
        """Returns the corners of the cores, counterclockwise, (n, 4, 2) m."""
        corners = (self._centres + self._corners).T
        return np.stack([corners.real, corners.imag], axis=-1)

    @classmethod
    def joined(cls, parts: Iterable[PlanarShapes]) -> Self:
        """Returns all shapes of the parts in one."""
        parts = list(parts)
        names = ("_centres", "_turns", "_halves", "_radii")
        joined = cls(centres=[], headings=[], sizes=[], radii=[])
        if parts:
            joined._set(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))
        return joined

    def moved(self, pose: Sequence[float] | Array) -> Self:
        """Returns the shapes, given in a body's frame, in the world.

        Args:
            pose: [x (m), y (m), theta (rad)] of the body.
        """
        x, y, theta = (float(value) for value in pose)
        turn = complex(math.cos(theta), math.sin(theta))
        moved = type(self).__new__(type(self))
        moved.__dict__ |= self.__dict__
        moved._centres = self._centres * turn + complex(x, y)
        moved._turns = self._turns * turn
        moved._corners = self._corners * turn
        return moved

    def at(self, centres: Array) -> Self:
        """Returns the shapes with other centres, (n, 2) m."""
        moved = type(self).__new__(type(self))
        moved.__dict__ |= self.__dict__
        moved._centres = centres[:, 0] + 1j * centres[:, 1]
        return moved

    def distances(self, others: PlanarShapes) -> Array:
        """Returns the distance of each shape from each of the others, (n, m) m.

        It is negative where they overlap, by the length of the shortest push that parts them.
        """
        distances = np.empty((len(self), len(others)))
        _distances(self._cores, others._cores, distances)
        return distances

    def clearances(self, others: PlanarShapes, pose: Array) -> Array:
        """Returns how far the nearest of the shapes is from each of the others, (m,) m.

        As `moved(pose).distances(others).min(axis=0)`, but in one step.

        Args:
            others: m shapes, in the world.
            pose: (3,) [x (m), y (m), theta (rad)] of the body in whose frame the shapes are given.
        """
        clearances = np.empty(len(others))
        _clearances(packed(pose), self._cores, others._cores, clearances)
        return clearances

    @property
    def _cores(self) -> _Cores:
        return self._centres, self._turns, self._corners, self._halves, self._radii

    def distances_from(self, points: Array) -> Array:
        """Returns the distance of each shape from each of the points (m, 2), (n, m) m.

        It is negative inside.
        """
        between = points[:, 0] + 1j * points[:, 1] - self._centres[:, None]
        local = between * self._turns.conj()[:, None]
        x = np.abs(local.real) - self._halves[:, :1]
        y = np.abs(local.imag) - self._halves[:, 1:]
        outside = np.hypot(np.maximum(x, 0), np.maximum(y, 0))
        return np.asarray(outside + np.minimum(np.maximum(x, y), 0) - self._radii[:, None])


@compiled(f"void({_CORES}, {_CORES}, f8[:,::1])")
def _distances(cores: _Cores, others: _Cores, distances: Array) -> None:
    centres, turns, corners, halves, radii = cores
    other_centres, other_turns, other_corners, other_halves, other_radii = others
    for i in range(len(centres)):
        for j in range(len(other_centres)):
            between = other_centres[j] - centres[i]
            gap, apart = _core_gap(between, turns[i], halves[i], other_corners[:, j])
            gap_back, apart_back = _core_gap(
                -between, other_turns[j], other_halves[j], corners[:, i]
            )
            gap = max(gap, gap_back)
            if gap > 0:
                gap = min(apart, apart_back)
            distances[i, j] = gap - radii[i] - other_radii[j]


@compiled(f"void(f8[::1], {_CORES}, {_CORES}, f8[::1])")
def _clearances(pose: Array, cores: _Cores, others: _Cores, clearances: Array) -> None:
    centres, turns, corners, halves, radii = cores
    turn, shift = complex(math.cos(pose[2]), math.sin(pose[2])), complex(pose[0], pose[1])
    distances = np.empty((len(centres), len(clearances)))
    moved = (centres * turn + shift, turns * turn, corners * turn, halves, radii)
    _distances(moved, others, distances)
    for j in range(len(clearances)):
        clearances[j] = distances[:, j].min()


@compiled()
def _core_gap(
    between: complex, turn: complex, half: Array, corners: ComplexArray
) -> tuple[float, float]:
    """Looks at another core's corners from the frame of one.

    Returns:
        How far the other is beyond a side of the core, where it is farthest (negative when it is
        beyond none), and the least distance of its corners from the core, m.
    """
    low_x, high_x, low_y, high_y = math.inf, -math.inf, math.inf, -math.inf
    square = math.inf
    back = turn.conjugate()
    for k in range(4):
        corner = (between + corners[k]) * back
        x, y = corner.real, corner.imag
        low_x, high_x = min(low_x, x), max(high_x, x)
        low_y, high_y = min(low_y, y), max(high_y, y)
        dx, dy = max(abs(x) - half[0], 0.0), max(abs(y) - half[1], 0.0)
        square = min(square, dx * dx + dy * dy)
    beyond_x, beyond_y = max(low_x, -high_x) - half[0], max(low_y, -high_y) - half[1]
    return max(beyond_x, beyond_y), math.sqrt(square)
