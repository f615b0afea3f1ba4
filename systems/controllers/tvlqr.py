"""Tracking a route by a linear-quadratic regulator that varies along it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.controllers.path_tracking import (
    PathTracker,
    Progress,
    TrackingParameters,
    error_of,
)
from systems.controllers.unicycle import Unicycle, linearized
from systems.planners.route import Route
from systems.validation import require_positive

Array = NDArray[np.float64]

_MAX_LAPS = 50
_SETTLED = 1e-10  # of the cost, by which a lap may still change it


@dataclass
class TvlqrParameters(TrackingParameters):
    """How much errors and effort count, beside leash and limits.

    Each is what counts as much as the others: an error along the route of `along` costs as much as
    one across it of `across`, a heading off by `heading`, a speed other than the route's by `speed`
    or a turn rate other by `turn_rate`.

    Attributes:
        along: m.
        across: m.
        heading: rad.
        speed: m/s.
        turn_rate: rad/s.
    """

    along: float = 0.05
    across: float = 0.02
    heading: float = 0.15
    speed: float = 0.1
    turn_rate: float = 0.4

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(
            along=self.along,
            across=self.across,
            heading=self.heading,
            speed=self.speed,
            turn_rate=self.turn_rate,
        )

    def weights(self) -> tuple[Array, Array]:
        """Returns Q (3, 3) and R (2, 2) of the cost of one step."""
        Q = np.diag(np.array([self.along, self.across, self.heading]) ** -2.0)
        return Q, np.diag(np.array([self.speed, self.turn_rate]) ** -2.0)


@dataclass(frozen=True, eq=False)
class Schedule:
    """The regulator along a route, at n equal steps of time; of a closed route they repeat.

    The error e is the robot's pose as seen from the reference: ahead (m), left (m), turn (rad). The
    command is the reference's and d more: e' = A e + B d.

    Attributes:
        step: s.
        speeds: (n, 2) [v, omega] of the reference.
        A: (n, 3, 3).
        B: (n, 3, 2).
        K: (n, 2, 3): d = -K e.
        S: (n + 1, 3, 3): e' S e is the cost from there on.
        closed: whether it repeats.
    """

    step: float
    speeds: Array
    A: Array
    B: Array
    K: Array
    S: Array
    closed: bool

    def index(self, time: float) -> int:
        """Returns the number of the step at a time on the route (s)."""
        k = round(time / self.step)
        return k % len(self.K) if self.closed else min(max(k, 0), len(self.K) - 1)

    def following(self, k: int, count: int) -> NDArray[np.intp]:
        """Returns the numbers of the steps from k on; those after the end are the last."""
        ahead = k + np.arange(count)
        return ahead % len(self.K) if self.closed else np.minimum(ahead, len(self.K) - 1)


def error_model(speeds: Array, dt: float) -> tuple[Array, Array]:
    """Returns how an error behaves during one step along a reference.

    The unicycle is linearised in the reference's frame, at the heading of the middle of the step,
    and what comes out is told in the frame in which the reference ends.

    Args:
        speeds: (n, 2) [v, omega] of the reference, constant over each step.
        dt: the step, s.

    Returns:
        A: (n, 3, 3), B: (n, 3, 2).
    """
    turn = speeds[:, 1] * dt
    middle = np.column_stack([0 * turn, 0 * turn, turn / 2])
    A, B = linearized(Unicycle(), middle, speeds)
    # exp(A dt) and its integral: A is nilpotent, A^2 = 0.
    Phi = np.eye(3) + A * dt
    Gamma = (np.eye(3) * dt + A * dt**2 / 2) @ B
    into_next = np.zeros_like(A)
    c, s = np.cos(turn), np.sin(turn)
    into_next[:, 0, 0], into_next[:, 0, 1] = c, s
    into_next[:, 1, 0], into_next[:, 1, 1] = -s, c
    into_next[:, 2, 2] = 1.0
    return into_next @ Phi, into_next @ Gamma


def schedule(route: Route, rate: float, Q: Array, R: Array) -> Schedule:
    """Solves Riccati's difference equation backwards along a route.

    Along a closed one, lap after lap until it repeats.

    Args:
        route: the reference.
        rate: of the commands, Hz; the step becomes the next to 1 / rate that divides the route.
        Q: (3, 3) cost of an error in each step.
        R: (2, 2) cost of a command other than the reference's.
    """
    n = max(round(route.duration * rate), 1)
    dt = route.duration / n
    # The mean over each step; of turn rate and speed it leads where the route does.
    speeds = route.speeds_at(dt * (np.arange(n) + 0.5))
    A, B = error_model(speeds, dt)
    K, S = np.zeros((n, 2, 3)), np.zeros((n + 1, 3, 3))
    S[n] = Q
    for _ in range(_MAX_LAPS if route.closed else 1):
        for k in reversed(range(n)):
            SB = S[k + 1] @ B[k]
            K[k] = np.linalg.solve(R + B[k].T @ SB, SB.T @ A[k])
            M = Q + A[k].T @ S[k + 1] @ (A[k] - B[k] @ K[k])
            S[k] = (M + M.T) / 2
        if np.abs(S[0] - S[n]).max() <= _SETTLED * np.abs(S[0]).max():
            break
        if route.closed:
            S[n] = S[0]
    return Schedule(dt, speeds, A, B, K, S, route.closed)


class Tvlqr(PathTracker):
    """Follows a route with the linear-quadratic regulator of its own linearisation.

    .. pydrake_system::

        name: Tvlqr
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
        parameters: weights, leash and limits.
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

    Source: Anderson, Moore, "Optimal control: linear quadratic methods", 1990, section 2.4; for a
    closed route the periodic solution (Bittanti, Colaneri, De Nicolao, "The periodic Riccati
    equation", 1991).
    """

    def __init__(
        self,
        *,
        route: Route,
        parameters: TvlqrParameters | None = None,
        rate: float = 20.0,
        laps: float = math.inf,
    ) -> None:
        self._parameters = parameters or TvlqrParameters()
        super().__init__(route=route, parameters=self._parameters, rate=rate, laps=laps)
        self._schedule = schedule(route, rate, *self._parameters.weights())

    def _track(self, pose: Array, progress: Progress, before: Array) -> Array:  # noqa: ARG002
        error = error_of(pose, self._route.poses_at(progress.reference))
        K = self._schedule.K[self._schedule.index(progress.reference)]
        return self._route.speeds_at(progress.reference + self._dt / 2) - K @ error
