"""How good an estimate was: errors, consistency, path length, from logs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.angles import wrap

Array = NDArray[np.float64]

# Two-sided 95 % bounds of chi-square with 3 degrees of freedom.
NEES_BOUNDS = (0.2158, 9.3484)


@dataclass(frozen=True, eq=False)
class PoseLog:
    """Truth and estimate at common times.

    Attributes:
        t: (n,) s.
        truth: (n, 3) [x (m), y (m), theta (rad)]; None when nobody knows it.
        estimate: (n, 3).
        covariance: (n, 3, 3).
        known: (n,) whether there was an estimate yet.
    """

    t: Array
    truth: Array | None
    estimate: Array
    covariance: Array
    known: NDArray[np.bool_]

    def errors(self) -> Array:
        """Returns (m, 3) estimate minus truth while there was an estimate, heading wrapped."""
        assert self.truth is not None
        error = (self.estimate - self.truth)[self.known]
        error[:, 2] = wrap(error[:, 2])
        return error


def nees(errors: Array, covariance: Array) -> Array:
    """Returns (n,) normalised estimation error squared, e' P^-1 e, of errors (n, d).

    Infinite where a covariance (n, d, d) is singular: whoever claims to be certain.
    """
    regular = np.linalg.det(covariance) > 0
    values = np.full(len(errors), np.inf)
    e = errors[regular]
    values[regular] = np.einsum(
        "ni,ni->n", e, np.linalg.solve(covariance[regular], e[..., None])[..., 0]
    )
    return values


def path_length(positions: Array) -> float:
    """Returns the length of a path (n, 2), m."""
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


def pose_metrics(log: PoseLog) -> dict[str, float | None]:
    """Returns the metrics of a planar estimate; None where there is no truth or no estimate.

    `nees_mean` is per dimension (1 is right); `nees_in_bounds` is the part of the time inside the
    two-sided 95 % bounds.
    """
    names = ("position_rmse_m", "heading_rmse_deg", "nees_mean", "nees_in_bounds")
    if log.truth is None or not log.known.any():
        return dict.fromkeys(names)
    errors = log.errors()
    normalised = nees(errors, log.covariance[log.known])
    inside = (normalised >= NEES_BOUNDS[0]) & (normalised <= NEES_BOUNDS[1])
    values = (
        np.sqrt((errors[:, :2] ** 2).sum(axis=1).mean()),
        np.degrees(np.sqrt((errors[:, 2] ** 2).mean())),
        normalised.mean() / 3,
        inside.mean(),
    )
    return dict(zip(names, map(float, values), strict=True))
