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

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

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
        self._halves = halves  # (n, 2) of length and width
        self._radii = radii
        length, width = halves.T
        corners = _CORNERS.real[:, None] * length + 1j * _CORNERS.imag[:, None] * width
        self._corners = corners * turns  # (4, n) about the centres

    def __len__(self) -> int:
        return len(self._centres)

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
        between = others._centres - self._centres[:, None]  # (n, m)
        # The corners of each shape, seen from the frame of the other's core, and the other way.
        corners = np.empty((2, 4, *between.shape), complex)
        corners[0] = (between + others._corners[:, None]) * self._turns.conj()[:, None]
        corners[1] = (self._corners[:, :, None] - between) * others._turns.conj()
        cores = np.empty((2, 1, *between.shape, 2))
        cores[0, 0] = self._halves[:, None]
        cores[1, 0] = others._halves
        xy = corners.view(float).reshape(*corners.shape, 2)
        # Far to one side or the other: corners are symmetric about their centre, which is not zero.
        beyond = np.maximum(xy.min(axis=1), -xy.max(axis=1)) - cores[:, 0]
        gap = beyond.max(axis=(0, 3))
        outside = np.maximum(np.abs(xy) - cores, 0)
        apart = np.sqrt((outside * outside).sum(axis=4).min(axis=(0, 1)))
        return np.where(gap > 0, apart, gap) - self._radii[:, None] - others._radii

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
