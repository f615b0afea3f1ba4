"""Tracking a route by a Lyapunov function (Kanayama et al., 1990)."""

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
from systems.validation import require_positive

Array = NDArray[np.float64]


@dataclass
class KanayamaParameters(TrackingParameters):
    """Gains, beside leash and limits.

    At a speed v an offset dies out with natural frequency v sqrt(k_y) and damping
    k_theta / (2 sqrt(k_y)) along a straight line: critical for k_theta = 2 sqrt(k_y). The paper's
    gains are 10 /s, 64 /m^2 and 16 /m; the defaults are lower, for an estimate with noise.

    Attributes:
        k_x: speed by what the reference is ahead, 1/s.
        k_y: turning per metre driven by what it is to the left, 1/m^2.
        k_theta: turning per metre driven by its heading, 1/m.
    """

    k_x: float = 2.0
    k_y: float = 30.0
    k_theta: float = 11.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(k_x=self.k_x, k_y=self.k_y, k_theta=self.k_theta)


def track(error: Array, speeds: Array, parameters: KanayamaParameters) -> Array:
    """Returns the command [v (m/s), omega (rad/s)] of Kanayama's equation (8).

    v = v_r cos theta_e + k_x x_e, omega = omega_r + v_r (k_y y_e + k_theta sin theta_e).

    Args:
        error: (3,) [x_e (m), y_e (m), theta_e (rad)] of the reference as seen from the robot,
            equation (4).
        speeds: (2,) [v_r, omega_r] of the reference.
        parameters: gains.
    """
    p = parameters
    (x, y, theta), (v, omega) = error.tolist(), speeds.tolist()
    return np.array(
        [v * math.cos(theta) + p.k_x * x, omega + v * (p.k_y * y + p.k_theta * math.sin(theta))]
    )


class Kanayama(PathTracker):
    """Follows a route with Kanayama's law: globally stable for a reference that moves.

    .. pydrake_system::

        name: Kanayama
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
        parameters: gains, leash and limits.
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

    Source: Kanayama, Kimura, Miyazaki, Noguchi, "A stable tracking control method for an autonomous
    mobile robot", ICRA 1990.
    """

    def __init__(
        self,
        *,
        route: Route,
        parameters: KanayamaParameters | None = None,
        rate: float = 20.0,
        laps: float = math.inf,
    ) -> None:
        self._parameters = parameters or KanayamaParameters()
        super().__init__(route=route, parameters=self._parameters, rate=rate, laps=laps)

    def _track(self, pose: Array, progress: Progress, before: Array) -> Array:  # noqa: ARG002
        reference = self._route.poses_at(progress.reference)
        speeds = self._route.speeds_at(progress.reference)
        return track(error_of(reference, pose), speeds, self._parameters)
