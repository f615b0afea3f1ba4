"""Least squares over the poses of a formation, and how old poses leave them without a trace lost.

What is known are the sightings among the robots as they stand, which stay what they are and are
linearised anew in every solution; and a quadratic cost, the prior, for the start and for all poses
that are no more. When a robot leaves, its sightings go into the prior and its pose is eliminated
(Schur complement): what it said of the others remains, as correlation among them.

A pose that is linearised once in the prior and again elsewhere in the sightings that remain would
seem to be known in directions in which nothing was measured, the heading of the whole above all. So
a robot whose sightings went into the prior keeps the derivatives of that moment until it moves
itself (first-estimate Jacobians: Huang, Mourikis, Roumeliotis, "Analysis and improvement of the
consistency of extended Kalman filter based SLAM", ICRA 2008).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from systems.estimators.formation_model import Layout, SightingModel, Sightings

Array = NDArray[np.float64]

_ITERATIONS = 12
_HALVINGS = 4
# m and rad; steps shrink by a factor of a thousand and more, so what is left is far below.
_CONVERGED = 1e-5


@dataclass(frozen=True, eq=False)
class Prior:
    """The cost d' A d / 2 - b' d, where d is the state less `origin`.

    Attributes:
        origin: (size,) what it is written about.
        A: (size, size) information.
        b: (size,).
        fixed: (robots,) whether a robot's derivatives are to be taken at `origin`.
    """

    origin: Array
    A: Array
    b: Array
    fixed: NDArray[np.bool_]

    def about(self, x: Array) -> Prior:
        """Returns the same cost, written about x wherever derivatives are not fixed."""
        point = linearisation_point(self, x)
        return replace(self, origin=point, b=self.b - self.A @ (point - self.origin))


@dataclass(frozen=True, eq=False)
class Solution:
    """The least of prior and sightings.

    Attributes:
        x: (size,) where it is.
        information: (size, size) there.
        cost: the sum of squares there, by variances; of the prior up to a constant.
        residuals: (n, 2) of the sightings, in standard deviations.
    """

    x: Array
    information: Array
    cost: float
    residuals: Array


def start(layout: Layout, x: Array, deviations: Array) -> Prior:
    """Returns the prior of independent numbers x (size,) with standard deviations (size,)."""
    fixed = np.zeros(layout.robots, bool)
    return Prior(x.copy(), np.diag(deviations**-2.0), np.zeros(layout.size), fixed)


def linearisation_point(prior: Prior, x: Array) -> Array:
    """Returns x (size,), with the poses whose derivatives are fixed where they were fixed."""
    point = x.copy()
    fixed = np.flatnonzero(np.repeat(prior.fixed, 3))
    point[fixed] = prior.origin[fixed]
    return point


def solve(layout: Layout, prior: Prior, sightings: Sightings, weights: Array, x: Array) -> Solution:
    """Finds the least by Gauss-Newton steps, halved while they lead uphill.

    Args:
        layout: of the state.
        prior: see there.
        sightings: n of them.
        weights: (n, 2) reciprocal variances; 0 leaves a number out.
        x: (size,) where to begin.
    """
    model, roots = SightingModel(layout, sightings), np.sqrt(weights)
    r, cost = _cost(prior, model, roots, x)
    for _ in range(_ITERATIONS):
        J = _scaled_jacobian(prior, model, roots, x)
        H = prior.A + J.T @ J
        gradient = prior.b - prior.A @ (x - prior.origin) + J.T @ r.ravel()
        step = np.linalg.solve(H, gradient)
        for _ in range(_HALVINGS):
            r_next, next_cost = _cost(prior, model, roots, x + step)
            if next_cost <= cost:
                break
            step /= 2
        x, r, cost = x + step, r_next, next_cost
        if np.abs(step).max() < _CONVERGED:
            break
    return Solution(x, H, cost, r)


def leave(
    layout: Layout,
    prior: Prior,
    sightings: Sightings,
    weights: Array,
    x: Array,
    robot: int,
    *,
    displacement: Array,
    deviations: Array,
) -> Prior:
    """Returns the prior after a robot has left the place that some sightings tell of.

    Args:
        layout: of the state.
        prior: before it left.
        sightings: all in which it saw or was seen, and no others.
        weights: (n, 2) reciprocal variances.
        x: (size,) the best estimate, about which they are linearised.
        robot: the one that leaves.
        displacement: (3,) where it went by its own account, in W: m, m, rad.
        deviations: (3,) standard deviations of that.
    """
    prior = prior.about(x)
    model, roots = SightingModel(layout, sightings), np.sqrt(weights)
    J = _scaled_jacobian(prior, model, roots, x)
    r = (model.residuals(x) * roots).ravel()
    A = prior.A + J.T @ J
    b = prior.b + J.T @ (r + J @ (x - prior.origin))

    own = slice(3 * robot, 3 * robot + 3)
    link = np.diag(deviations**-2.0)
    left, coupling, b_left = A[own, own] + link, A[own].copy(), b[own].copy()
    coupling[:, own] = -link  # to where it is now, which nothing else tells of
    A[own] = A[:, own] = 0.0
    A[own, own] = link
    b[own] = 0.0
    gain = np.linalg.solve(left, coupling).T
    A -= gain @ coupling
    b -= gain @ b_left

    origin, fixed = prior.origin.copy(), prior.fixed.copy()
    origin[own] += displacement
    fixed[sightings.observer] = fixed[sightings.target] = True
    fixed[robot] = False
    return Prior(origin, (A + A.T) / 2, b, fixed)


def _scaled_jacobian(prior: Prior, model: SightingModel, roots: Array, x: Array) -> Array:
    J = model.jacobian(linearisation_point(prior, x)) * roots[:, :, None]
    return J.reshape(2 * len(J), J.shape[2])


def _cost(prior: Prior, model: SightingModel, roots: Array, x: Array) -> tuple[Array, float]:
    """Returns the residuals in standard deviations, and twice the cost."""
    r = model.residuals(x) * roots
    d = x - prior.origin
    return r, float(d @ prior.A @ d - 2 * prior.b @ d + (r * r).sum())
