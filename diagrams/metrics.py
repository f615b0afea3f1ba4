"""How good an estimate was: errors, consistency, path length, from logs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.angles import wrap

Array = NDArray[np.float64]

# Two-sided 95 % bounds of chi-square with 3 degrees of freedom.
NEES_BOUNDS = (0.2158, 9.3484)
JERK_STEP = 0.1  # s


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


def integrated_jerk(t: Array, positions: Array) -> float:
    """Returns the integral of the squared linear jerk over a motion, m^2/s^5.

    The third difference of positions that are `JERK_STEP` apart in time: slower changes than that
    are what a passenger feels, faster ones are the contact's and the servo's.

    Args:
        t: (n,) s, ascending.
        positions: (n, 2) m.
    """
    grid = np.arange(t[0], t[-1], JERK_STEP)
    path = np.stack([np.interp(grid, t, positions[:, k]) for k in range(2)], axis=1)
    jerk = np.diff(path, n=3, axis=0) / JERK_STEP**3
    return float((jerk**2).sum() * JERK_STEP)


def clearance_metrics(clearance: Array, contacts: Array) -> dict[str, float | int]:
    """Returns `contacts`, `min_clearance_m` and `mean_clearance_m`.

    Args:
        clearance: (n,) from the robot's hull to the nearest obstacle, m; inf where there is none.
        contacts: (n,) number of separate touches so far.
    """
    return {
        "contacts": int(contacts[-1]),
        "min_clearance_m": float(clearance.min()),
        "mean_clearance_m": float(clearance.mean()),
    }


def nis_mean(nis: Array) -> float | None:
    """Returns the mean normalised innovation squared per degree of freedom; 1 is right.

    Args:
        nis: (n, 2) logged output `nis` of an estimator: of the last update, and how many updates
            there were so far. None when there was none.
    """
    new = np.flatnonzero(np.diff(nis[:, 1], prepend=0.0) > 0)
    values = nis[new, 0]
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else None


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
