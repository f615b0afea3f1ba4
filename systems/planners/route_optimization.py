"""The fastest smooth route near a taught path: sequential convex programming over a spline.

The path is a cubic B-spline whose control points move along the normals of the taught path. In each
round the lap time and the limits are made linear or quadratic about the path so far, for control
points and squared speeds together; the quadratic program's answer is kept if the lap time that the
new path really allows, and what it really violates, have become less, else the next step is
shorter. (Squared speeds over the way are what makes the time convex: Verscheure, Demeulenaere,
Swevers, De Schutter, Diehl, "Time-optimal path tracking for robots: a convex optimization
approach", IEEE TAC 54, 2009.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.solvers import ClarabelSolver, MathematicalProgram

from systems.planners.path_spline import PathSpline, curvature, fit, third_differences
from systems.planners.route_limits import RouteLimits
from systems.planners.speed_profile import fastest, times
from systems.planners.taught_path import TaughtPath

Array = NDArray[np.float64]

_SPACING = 0.3  # m, of the control points
_STIFFNESS = 0.3  # of the fit to the taught path
_SMOOTHNESS = 3.0  # s/m^2, of the third differences beside the lap time
_GRID = 0.08  # m, of the places where limits are heeded
_PRICE = 20.0  # s per unit of violation
_ROUNDS = 60
_TRUST = (0.05, 1e-3)  # m, at first and at last
_GAIN = 1e-4  # s; rounds that win less are the last
_KEPT = 1e-3  # of limits, that may still be violated then


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What the path is to mind to its sides.

    Attributes:
        taught: the taught path.
        tags: (t, 2) positions, m.
        view: (n, 2) how far from each of the taught points the path may go to the right (negative)
            and to the left and have enough tags in view, m.
        view_price: what it costs to be a corridor's half width outside that at one place, s; all
            other limits are kept at any price.
    """

    taught: TaughtPath
    tags: Array
    view: Array
    view_price: float = 0.0


@dataclass(frozen=True, eq=False)
class Candidate:
    """A path and what it is worth.

    Attributes:
        spline: the path.
        squared: (k,) squared speeds at the places, m^2/s^2.
        time: of the lap, s.
        worth: time and smoothness together, s.
        violation: of all limits of the path at all places together, in parts of each.
    """

    spline: PathSpline
    squared: Array
    time: float
    worth: float
    violation: float

    @property
    def merit(self) -> float:
        """What is to become less."""
        return self.worth + _PRICE * self.violation


def optimize(around: Surroundings, limits: RouteLimits, spare: float = 0.02) -> Candidate:
    """Returns the fastest path, which violates limits if they cannot be kept together.

    Args:
        around: taught path, and what bounds the path to the sides.
        limits: of the route.
        spare: part of the limits of the path that is not used at the places that are looked at:
            between them a little more may happen.
    """
    taught = around.taught
    start = fit(taught.points, taught.closed, _SPACING, _STIFFNESS)
    pieces = start.pieces
    along = start.at(np.arange(-1.0, len(start.control) - 1.0), 1)
    normal = np.column_stack([-along[:, 1], along[:, 0]])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    count = max(round(taught.length / _GRID), 12)
    u: Array = pieces * np.arange(count, dtype=float) / (count - (not taught.closed))
    W = [start.weights(u, order) for order in range(3)]
    best = _weigh(start, u, around, limits, spare)
    trust = _TRUST[0]
    for _ in range(_ROUNDS):
        shift = _step(best, W, normal, around, limits, spare, trust)
        moved = None
        if shift is not None:
            spline = PathSpline(best.spline.control + shift[:, None] * normal, taught.closed)
            moved = _weigh(spline, u, around, limits, spare)
        if moved is not None and moved.merit < best.merit:
            won = best.merit - moved.merit
            best, trust = moved, min(1.5 * trust, _TRUST[0])
            if won < _GAIN and best.violation < _KEPT:
                break
        else:
            trust /= 3.0
            if trust < _TRUST[1]:
                break
    return best


def _steps(first: Array, du: float, closed: bool) -> Array:
    """Returns the way from each place to the next, m: (n,) if closed, else (n - 1,)."""
    speed = np.linalg.norm(first, axis=1)
    steps: Array = (speed + np.roll(speed, -1)) / 2 * du
    return steps if closed else steps[:-1]


def _weigh(
    spline: PathSpline, u: Array, around: Surroundings, limits: RouteLimits, spare: float
) -> Candidate:
    closed, du = spline.closed, float(u[1] - u[0])
    points, first = spline.at(u), spline.at(u, 1)
    kappa = curvature(first, spline.at(u, 2))
    steps = _steps(first, du, closed)
    squared = fastest(kappa, steps, limits, closed)
    time = float(times(squared, steps, closed)[-1])
    rough = third_differences(spline) @ spline.control
    place, direction, run = around.taught.nearest(points)
    offset = _offset(points, place, direction)
    excess = np.maximum(np.abs(kappa) / limits.max_curvature - (1 - spare), 0.0)
    excess += np.maximum(np.abs(offset) / limits.corridor - (1 - spare), 0.0)
    if len(around.tags) and limits.tag_distance > 0:
        distance = np.linalg.norm(points[:, None] - around.tags, axis=2).min(axis=1)
        excess += np.maximum(1 / (1 - spare) - distance / limits.tag_distance, 0.0)
    low, high = _view(around, run)
    unseen = np.maximum(np.maximum(offset - high, low - offset), 0.0) / limits.corridor
    worth = time + _SMOOTHNESS * float((rough * rough).sum())
    worth += around.view_price * float(unseen.sum())
    return Candidate(spline, squared, time, worth, float(excess.sum()))


def _offset(points: Array, place: Array, direction: Array) -> Array:
    off = points - place
    side = direction[:, 0] * off[:, 1] - direction[:, 1] * off[:, 0]
    return np.asarray(np.copysign(np.linalg.norm(off, axis=1), side))


def _view(around: Surroundings, run: Array) -> tuple[Array, Array]:
    """Returns the stretch with enough tags in view at ways along the taught path."""
    n = len(around.view)
    at = np.round(run / around.taught.length * (n if around.taught.closed else n - 1))
    found = around.view[at.astype(np.intp) % n]
    return found[:, 0], found[:, 1]


def _step(
    now: Candidate,
    W: list[Array],
    normal: Array,
    around: Surroundings,
    limits: RouteLimits,
    spare: float,
    trust: float,
) -> Array | None:
    """Returns by how much to move the control points along their normals, or None."""
    spline, closed = now.spline, now.spline.closed
    n, m = W[0].shape
    du = spline.pieces / (n if closed else n - 1)
    points, first, second = (w @ spline.control for w in W)
    by = [w[:, :, None] * normal for w in W]  # (n, m, 2) of each by the shifts
    speed = np.maximum(np.linalg.norm(first, axis=1), 1e-6)
    kappa = curvature(first, second)
    tangent = first / speed[:, None]
    speed_by = np.einsum("nmk,nk->nm", by[1], tangent)
    cross_by = (
        by[1][:, :, 0] * second[:, 1:] - by[1][:, :, 1] * second[:, :1]
        + first[:, :1] * by[2][:, :, 1] - first[:, 1:] * by[2][:, :, 0]
    )  # fmt: skip
    kappa_by = cross_by / speed[:, None] ** 3 - 3 * (kappa / speed)[:, None] * speed_by
    b = np.maximum(now.squared, 1e-4)
    root = np.sqrt(b)
    steps = _steps(first, du, closed)

    program = MathematicalProgram()
    x = program.NewContinuousVariables(m)
    d = program.NewContinuousVariables(n)  # of the squared speeds
    slack = program.NewContinuousVariables(3)
    program.AddBoundingBoxConstraint(-trust, trust, x)
    program.AddBoundingBoxConstraint(0.0, np.inf, slack)
    program.AddLinearCost(_PRICE * 10.0 * np.ones(3), slack)
    # Time: way by speed.
    way = speed * du
    program.AddLinearCost((du / root) @ speed_by, x)
    program.AddLinearCost(-way / (2 * b * root), d)
    program.AddQuadraticCost(np.diag(0.75 * way / (b * b * root)), np.zeros(n), d, is_convex=True)
    D = third_differences(spline)
    rough, stiff = D @ spline.control, (D[:, :, None] * normal).transpose(0, 2, 1).reshape(-1, m)
    H = 2 * _SMOOTHNESS * stiff.T @ stiff
    program.AddQuadraticCost(
        H + 1e-9 * np.eye(m), 2 * _SMOOTHNESS * stiff.T @ rough.ravel(), x, is_convex=True
    )
    # Speed, at rest at open ends; neither to fall nor to rise to more than twice.
    program.AddBoundingBoxConstraint(-0.5 * b, np.minimum(limits.max_speed**2 - b, b), d)
    a, w = limits.max_lateral_acceleration, limits.max_turn_rate
    program.AddLinearConstraint(
        np.hstack([b[:, None] * kappa_by, np.diag(kappa)]),
        np.minimum(-a - kappa * b, 0.0), np.maximum(a - kappa * b, 0.0), np.append(x, d),
    )  # fmt: skip
    program.AddLinearConstraint(
        np.hstack([root[:, None] * kappa_by, np.diag(kappa / (2 * root))]),
        np.minimum(-w - kappa * root, 0.0), np.maximum(w - kappa * root, 0.0), np.append(x, d),
    )  # fmt: skip
    rise = np.roll(np.eye(n), 1, axis=1) - np.eye(n)
    rise = rise if closed else rise[:-1]
    room = 2 * limits.max_acceleration * steps
    slope = rise @ b
    program.AddLinearConstraint(
        rise, np.minimum(-room - slope, 0.0), np.maximum(room - slope, 0.0), d
    )
    # Bend, with slack for a path that bends too much already.
    most = limits.max_curvature * (1 - spare)
    for sign in (1.0, -1.0):
        program.AddLinearConstraint(
            np.hstack([sign * kappa_by, -most * np.eye(1)[[0] * n]]),
            np.full(n, -np.inf), most - sign * kappa, np.append(x, slack[0]),
        )  # fmt: skip
    place, direction, run = around.taught.nearest(points)
    offset = _offset(points, place, direction)
    left = np.column_stack([-direction[:, 1], direction[:, 0]])
    offset_by = np.einsum("nmk,nk->nm", by[0], left)
    bound = limits.corridor * (1 - spare)
    for sign in (1.0, -1.0):
        program.AddLinearConstraint(
            np.hstack([sign * offset_by, -limits.corridor * np.ones((n, 1))]),
            np.full(n, -np.inf), bound - sign * offset, np.append(x, slack[1]),
        )  # fmt: skip
    if around.view_price > 0:
        low, high = _view(around, run)
        outside = program.NewContinuousVariables(n)  # in half widths
        program.AddBoundingBoxConstraint(0.0, np.inf, outside)
        program.AddLinearCost(around.view_price * np.ones(n), outside)
        for sign, edge in ((1.0, high), (-1.0, -low)):
            program.AddLinearConstraint(
                np.hstack([sign * offset_by, -limits.corridor * np.eye(n)]),
                np.full(n, -np.inf), edge - sign * offset, np.append(x, outside),
            )  # fmt: skip
    if len(around.tags) and limits.tag_distance > 0:
        least = limits.tag_distance / (1 - spare)
        off = points[:, None] - around.tags
        distance = np.linalg.norm(off, axis=2)
        k, tag = np.nonzero(distance < least + 3 * trust)
        if len(k):
            away = off[k, tag] / np.maximum(distance[k, tag], 1e-6)[:, None]
            nearer = -np.einsum("nmk,nk->nm", by[0][k], away)
            program.AddLinearConstraint(
                np.hstack([nearer, -limits.tag_distance * np.ones((len(k), 1))]),
                np.full(len(k), -np.inf), distance[k, tag] - least, np.append(x, slack[2]),
            )  # fmt: skip
    result = ClarabelSolver().Solve(program)
    return np.asarray(result.GetSolution(x)) if result.is_success() else None
