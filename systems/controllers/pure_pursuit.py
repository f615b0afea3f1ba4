"""Tracking a route by steering at a point of it that lies ahead (pure pursuit)."""

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
from systems.planners.route import Route
from systems.validation import require, require_positive

Array = NDArray[np.float64]


@dataclass
class PurePursuitParameters(TrackingParameters):
    """How far ahead to look, beside leash and limits.

    Attributes:
        look_time: lookahead by speed, s.
        min_look: least lookahead, m.
        max_look: largest, m.
        k_x: speed by what the reference is ahead, 1/s (pure pursuit itself says nothing of it).
    """

    look_time: float = 0.5
    min_look: float = 0.15
    max_look: float = 0.8
    k_x: float = 2.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(look_time=self.look_time, min_look=self.min_look, k_x=self.k_x)
        require(
            self.min_look <= self.max_look < math.inf,
            "max_look",
            self.max_look,
            f"finite, at least min_look = {self.min_look:g} m",
        )


def lookahead(speed: float, parameters: PurePursuitParameters) -> float:
    """Returns how far ahead to look at a speed (m/s), m."""
    p = parameters
    return min(max(p.look_time * abs(speed), p.min_look), p.max_look)


def curvature_to(point: Array) -> float:
    """Returns the curvature (1/m) of the arc to a point (2,) [ahead, left] m, that starts ahead.

    2 y / (x^2 + y^2): Coulter's equation; 0 to the point where one stands.
    """
    x, y = point.tolist()
    squared = x * x + y * y
    return 2.0 * y / squared if squared > 0 else 0.0


def target(route: Route, place: float, distance: float) -> Array:
    """Returns the point (2,) of the route that lies ahead of a place by a way along it (m).

    Past the end of an open route it lies on the straight line that goes on from there.
    """
    run = float(route.run_at(place)) + distance
    pose = route.poses_at(float(route.time_at(run)))
    beyond = 0.0 if route.closed else max(run - route.length, 0.0)
    return np.array([pose[0] + beyond * math.cos(pose[2]), pose[1] + beyond * math.sin(pose[2])])


class PurePursuit(PathTracker):
    """Follows a route by the arc to a point ahead on it, farther ahead the faster it goes.

    .. pydrake_system::

        name: PurePursuit
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
        parameters: lookahead, leash and limits.
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

    Source: Coulter, "Implementation of the pure pursuit path tracking algorithm", CMU-RI-TR-92-01,
    1992. Its speed is the reference's, and more by what that is ahead.
    """

    def __init__(
        self,
        *,
        route: Route,
        parameters: PurePursuitParameters | None = None,
        rate: float = 20.0,
        laps: float = math.inf,
    ) -> None:
        self._parameters = parameters or PurePursuitParameters()
        super().__init__(route=route, parameters=self._parameters, rate=rate, laps=laps)

    def _track(self, pose: Array, progress: Progress, before: Array) -> Array:  # noqa: ARG002
        p = self._parameters
        ahead, _, turn = error_of(self._route.poses_at(progress.reference), pose).tolist()
        v_reference = float(self._route.speeds_at(progress.reference)[0])
        v = v_reference * math.cos(turn) + p.k_x * ahead
        goal = target(self._route, progress.place, lookahead(v_reference, p))
        point = error_of(np.array([goal[0], goal[1], 0.0]), pose)[:2]
        return np.array([v, v * curvature_to(point)])
