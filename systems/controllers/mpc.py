"""Tracking a route by model-predictive control: the regulator that knows its limits beforehand."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.solvers import ClarabelSolver, MathematicalProgram

from systems.controllers.path_tracking import PathTracker, Progress, error_of
from systems.controllers.tvlqr import Schedule, TvlqrParameters, schedule
from systems.planners.route import Route
from systems.validation import require

Array = NDArray[np.float64]

_ROUNDING = 1e-9


@dataclass
class MpcParameters(TvlqrParameters):
    """Weights and horizon, beside leash and limits.

    Attributes:
        horizon: how many commands ahead the limits are heeded.
    """

    horizon: int = 20

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            isinstance(self.horizon, int) and self.horizon >= 1,
            "horizon",
            self.horizon,
            "a whole number from 1 on",
        )


@dataclass(frozen=True, eq=False)
class Problem:
    """What is to be minimised: sum of e' Q e + d' R d over the horizon, and e' S e at its end.

    e_next = A e + B d, from the given error; the commands are those of the reference and d more.

    Attributes:
        error: (3,) now.
        A: (n, 3, 3).
        B: (n, 3, 2).
        Q: (3, 3).
        R: (2, 2).
        S: (3, 3).
        speeds: (n, 2) commands of the reference.
        before: (2,) the command that is followed now.
        low: (2,) least command.
        high: (2,) largest.
        change: (2,) by which one command may differ from the one before.
    """

    error: Array
    A: Array
    B: Array
    Q: Array
    R: Array
    S: Array
    speeds: Array
    before: Array
    low: Array
    high: Array
    change: Array

    def allows(self, commands: Array) -> bool:
        """Whether commands (n, 2) keep the limits."""
        steps = np.abs(np.diff(commands, axis=0, prepend=self.before[None]))
        return bool(
            (commands >= self.low - _ROUNDING).all()
            and (commands <= self.high + _ROUNDING).all()
            and (steps <= self.change + _ROUNDING).all()
        )


def unlimited(problem: Problem, K: Array) -> Array:
    """Returns the best commands (n, 2) where no limit binds: the regulator's own.

    Args:
        problem: whose S is the regulator's cost at the end of the horizon.
        K: (n, 2, 3) of the regulator.
    """
    e = problem.error
    commands = np.empty_like(problem.speeds)
    for k, gain in enumerate(K):
        d = -gain @ e
        commands[k] = problem.speeds[k] + d
        e = problem.A[k] @ e + problem.B[k] @ d
    return commands


def condensed(problem: Problem) -> tuple[Array, Array]:
    """Returns H (2n, 2n) and g (2n,): the cost is d' H d / 2 + g' d and what does not change."""
    n = len(problem.A)
    free, by_d = problem.error, np.zeros((3, 2 * n))
    H = 2 * np.kron(np.eye(n), problem.R)
    g = np.zeros(2 * n)
    for k in range(n):
        free, by_d = problem.A[k] @ free, problem.A[k] @ by_d
        by_d[:, 2 * k : 2 * k + 2] += problem.B[k]
        weight = problem.S if k == n - 1 else problem.Q
        H += 2 * by_d.T @ weight @ by_d
        g += 2 * by_d.T @ weight @ free
    return (H + H.T) / 2, g


def solve(problem: Problem) -> Array | None:
    """Returns the best commands (n, 2) within the limits; None if the solver finds none.

    A command that is outside the limits now is brought back as fast as its change allows.
    """
    n = len(problem.speeds)
    H, g = condensed(problem)
    reference = problem.speeds.ravel()
    reach = problem.change * (1 + np.arange(n)[:, None])
    low = np.minimum(problem.low, problem.before + reach).ravel() - reference
    high = np.maximum(problem.high, problem.before - reach).ravel() - reference
    D = np.eye(2 * n) - np.eye(2 * n, k=-2)
    middle = -D @ reference
    middle[:2] += problem.before
    change = np.tile(problem.change, n)
    program = MathematicalProgram()
    d = program.NewContinuousVariables(2 * n)
    program.AddQuadraticCost(H, g, d, is_convex=True)
    program.AddBoundingBoxConstraint(low, high, d)
    program.AddLinearConstraint(D, middle - change, middle + change, d)
    result = ClarabelSolver().Solve(program)
    if not result.is_success():
        return None
    return np.asarray(problem.speeds + result.GetSolution(d).reshape(n, 2))


class Mpc(PathTracker):
    """Follows a route with commands that are best within the limits over a horizon.

    .. pydrake_system::

        name: Mpc
        input_ports:
        - pose
        - covariance
        - sent
        output_ports:
        - command
        - state
        - health

    Args:
        route: what to follow.
        parameters: weights, horizon, leash and limits.
        rate: of the commands, Hz.
        laps: of a closed route, after which it stops.

    Ports:
        pose (input, vector of 3): [x (m), y (m), theta (rad)] of base_link in map, the estimate.
        covariance (input, vector of 9): (3, 3) of it, row by row; while it says that nothing is
            known, the command is 0.
        sent (input, vector of 2): [v, omega] as sent to the wheels; may be left unconnected, if
            they get what is commanded. One that is not finite counts as the last command.
        command (output, vector of 2): [v (m/s), omega (rad/s)], held between samples at `rate`;
            zeros while there is no estimate, while it is not finite, and after the end.
        state (output, TrackingState): reference, progress and status.
        health (output, Health): poses and sent commands that were not finite.

    The convex quadratic program over the time-varying linearisation of the route, with the limits
    of speed, turn rate and their changes, and the regulator's cost at the end of the horizon. While
    no limit binds its solution is the regulator's, which is tried first: it is known.

    Source: Rawlings, Mayne, Diehl, "Model predictive control", 2nd edition, 2017, section 1.3; the
    solver is Clarabel, which gives the same every time (OSQP's steps follow the clock).
    """

    def __init__(
        self,
        *,
        route: Route,
        parameters: MpcParameters | None = None,
        rate: float = 20.0,
        laps: float = math.inf,
    ) -> None:
        self._parameters = p = parameters or MpcParameters()
        super().__init__(route=route, parameters=p, rate=rate, laps=laps)
        self._weights = p.weights()
        self._schedule: Schedule = schedule(route, rate, *self._weights)

    def _track(self, pose: Array, progress: Progress, before: Array) -> Array:
        p, plan = self._parameters, self._schedule
        ahead = plan.following(plan.index(progress.reference), p.horizon)
        low, high = p.bounds()
        problem = Problem(
            error=error_of(pose, self._route.poses_at(progress.reference)),
            A=plan.A[ahead],
            B=plan.B[ahead],
            Q=self._weights[0],
            R=self._weights[1],
            S=plan.S[ahead[-1] + 1],
            speeds=plan.speeds[ahead],
            before=before,
            low=low,
            high=high,
            change=p.change(self._dt),
        )
        commands = unlimited(problem, plan.K[ahead])
        if problem.allows(commands):
            return commands[0]
        best = solve(problem)
        return commands[0] if best is None else best[0]
