"""Smooth planar curves: uniform cubic B-splines, closed or open, whose curvature is continuous."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Of each of the four control points that count, by powers of the place in the piece, 1, w, w^2, w^3
# (de Boor, "A practical guide to splines", 2001, chapter IX, for equal knots).
_BASIS = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6.0


@dataclass(frozen=True, eq=False)
class PathSpline:
    """A curve of n pieces over the parameter u from 0 to n.

    Attributes:
        control: (m, 2) control points, m; as many as pieces if closed, else three more.
        closed: whether it ends where it begins.
    """

    control: Array
    closed: bool

    @property
    def pieces(self) -> int:
        """Number of pieces."""
        return len(self.control) - (0 if self.closed else 3)

    def weights(self, u: Array, order: int = 0) -> Array:
        """Returns how much each control point counts at parameters (k,): (k, m).

        Args:
            u: where; taken modulo the pieces if closed.
            order: of the derivative by u, 0 to 2.
        """
        n, m = self.pieces, len(self.control)
        u = np.mod(u, n) if self.closed else np.clip(u, 0.0, n)
        piece = np.minimum(u.astype(np.intp), n - 1)
        w = u - piece
        one, none = np.ones_like(w), np.zeros_like(w)
        powers = (
            [one, w, w * w, w**3],
            [none, one, 2 * w, 3 * w * w],
            [none, none, 2 * one, 6 * w],
        )[order]
        four = np.stack(powers, axis=1) @ _BASIS.T
        found = np.zeros((len(u), m))
        rows = np.arange(len(u))[:, None]
        np.add.at(found, (rows, (piece[:, None] + np.arange(4)) % m), four)
        return found

    def at(self, u: Array, order: int = 0) -> Array:
        """Returns the points at parameters (k,), or their derivatives by u: (k, 2)."""
        return self.weights(u, order) @ self.control

    def curvature(self, u: Array) -> Array:
        """Returns the curvature at parameters (k,), 1/m; positive to the left."""
        return curvature(self.at(u, 1), self.at(u, 2))

    def table(self, step: float) -> tuple[Array, Array]:
        """Returns parameters (k,) about a step (m) of the curve apart, and the way gone there."""
        fine = np.linspace(0, self.pieces, 32 * self.pieces + 1)
        speed = np.linalg.norm(self.at(fine, 1), axis=1)
        middle = np.linalg.norm(self.at((fine[1:] + fine[:-1]) / 2, 1), axis=1)
        du = fine[1] - fine[0]
        run = np.concatenate([[0.0], np.cumsum((speed[1:] + 4 * middle + speed[:-1]) * du / 6)])
        even = np.linspace(0, run[-1], max(round(run[-1] / step), 4) + 1)
        return np.interp(even, run, fine), even


def curvature(first: Array, second: Array) -> Array:
    """Returns the curvature (k,) of first and second derivatives (k, 2), 1/m."""
    cross = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return np.asarray(cross / np.maximum(np.linalg.norm(first, axis=1), 1e-9) ** 3)


def fit(points: Array, closed: bool, spacing: float, stiffness: float) -> PathSpline:
    """Returns the spline that passes near points at equal steps along a path.

    Args:
        points: (k, 2) m; of a closed path the first does not come again.
        closed: whether it is closed.
        spacing: about which control points are apart, m.
        stiffness: how much a third difference of the control points (m) counts, squared, beside the
            distance from a point (m), squared.
    """
    steps = np.diff(points, axis=0, append=points[:1]) if closed else np.diff(points, axis=0)
    length = float(np.hypot(*steps.T).sum())
    pieces = max(round(length / spacing), 6)
    spline = PathSpline(np.zeros((pieces + (0 if closed else 3), 2)), closed)
    u = pieces * np.arange(len(points)) / (len(points) if closed else len(points) - 1)
    W, D = spline.weights(u), third_differences(spline)
    control = np.linalg.solve(W.T @ W + stiffness * D.T @ D, W.T @ points)
    return PathSpline(np.asarray(control, np.float64), closed)


def third_differences(spline: PathSpline) -> Array:
    """Returns the matrix that takes control points to their third differences."""
    m = len(spline.control)
    if spline.closed:
        D = np.roll(np.eye(m), 1, axis=1) - np.eye(m)
        return np.asarray(D @ D @ D)
    return np.asarray(np.diff(np.eye(m), n=3, axis=0))
