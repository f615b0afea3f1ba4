"""A smooth closed curve through points: positions, headings and curvature by the way along it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.trajectories import PiecewisePolynomial

from systems.validation import require, require_positive

Array = NDArray[np.float64]


class ClosedCurve:
    """The periodic cubic spline through points in the plane, by arc length.

    Args:
        points: (n, 2) m, at least 3, in order; the last is joined to the first.
        step: between the places at which the curve is known, about, m.

    Attributes:
        length: m.
        s: (m,) the way from the first point to each place, m; the last place is one step before
            the first point.
        positions: (m, 2) m.
        headings: (m,) rad, in the direction of the points.
        curvatures: (m,) 1/m, positive to the left.

    Raises:
        ValueError: too few points, or two neighbours at one place.
    """

    def __init__(self, points: ArrayLike, *, step: float = 0.01) -> None:
        given = np.asarray(points, float)
        require(
            given.ndim == 2 and given.shape[1] == 2 and len(given) >= 3,
            "points",
            given.tolist(),
            "[x, y] three times or more",
        )
        require(bool(np.isfinite(given).all()), "points", given.tolist(), "finite")
        require_positive(step=step)
        closed = np.vstack([given, given[:1]])
        chords = np.hypot(*np.diff(closed, axis=0).T)
        require(
            bool((chords > 1e-6).all()), "points", given.tolist(), "no two neighbours at one place"
        )
        breaks = np.concatenate([[0.0], np.cumsum(chords)])
        spline = PiecewisePolynomial.CubicWithContinuousSecondDerivatives(breaks, closed.T, True)
        count = max(math.ceil(breaks[-1] / (step / 4)), 4 * len(given))
        u = np.linspace(0.0, breaks[-1], count + 1)
        fine = spline.vector_values(u)
        way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(fine)))])
        self.length = float(way[-1])
        self.s = np.linspace(0.0, self.length, max(round(self.length / step), 8), endpoint=False)
        places = np.interp(self.s, way, u)
        first = spline.derivative(1).vector_values(places)
        second = spline.derivative(2).vector_values(places)
        speed = np.hypot(*first)
        self.positions: Array = spline.vector_values(places).T.copy()
        self.headings: Array = np.arctan2(first[1], first[0])
        self.curvatures: Array = (first[0] * second[1] - first[1] * second[0]) / speed**3

    def at(self, s: ArrayLike) -> tuple[Array, Array]:
        """Returns positions (..., 2) m and headings (...) rad at ways s (m), which go round."""
        way = np.asarray(s, float) % self.length
        ring = np.append(self.s, self.length)
        closed = np.vstack([self.positions, self.positions[:1]])
        position = np.stack([np.interp(way, ring, closed[:, k]) for k in range(2)], axis=-1)
        turned = np.unwrap(np.append(self.headings, self.headings[0]))
        return position, np.interp(way, ring, turned)

    def curvature_at(self, s: ArrayLike) -> Array:
        """Returns the curvature at ways s (m), 1/m."""
        way = np.asarray(s, float) % self.length
        ring = np.append(self.s, self.length)
        curvature: Array = np.interp(way, ring, np.append(self.curvatures, self.curvatures[0]))
        return curvature

    def nearest(self, point: ArrayLike, around: float | None = None, within: float = 1.0) -> float:
        """Returns the way s (m) to the place of the curve that is nearest to a point.

        Args:
            point: (2,) m.
            around: look only near this way, m: for who follows a curve that comes near itself.
            within: how far before and after it, m.
        """
        away = np.hypot(*(self.positions - np.asarray(point, float)).T)
        if around is not None:
            apart = np.abs((self.s - around + self.length / 2) % self.length - self.length / 2)
            away = np.where(apart <= within, away, np.inf)
        return float(self.s[np.argmin(away)])

    def distances(self, points: ArrayLike) -> Array:
        """Returns (n,) distances of points (n, 2) from the curve, m."""
        gaps = np.asarray(points, float)[:, None] - self.positions
        nearest: Array = np.hypot(gaps[..., 0], gaps[..., 1]).min(axis=1)
        return nearest
