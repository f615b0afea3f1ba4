"""Waypoint following by distance and bearing ([NAV] section 4.3).

[NAV]: Hussein, Lazkani, Saad, Yehia, "Real-time robot navigation with QR-based localization and
lidar obstacle mapping".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pydrake.math import atan2, cos, sin, sqrt
from pydrake.math import max as drake_max
from pydrake.math import min as drake_min
from pydrake.systems.framework import BasicVector_, LeafSystem_
from pydrake.systems.scalar_conversion import TemplateSystem
from systems.validation import require, require_positive


@dataclass
class WaypointParameters:
    """Gains and limits of the waypoint controller.

    Attributes:
        k_p: speed by distance, 1/s.
        k_a: turning rate by bearing, 1/s.
        max_speed: m/s.
        max_turn_rate: rad/s.
        radius: a waypoint counts as reached inside this distance, m ([NAV]: 0.30).
        turn_in_place_beyond: no driving while the bearing exceeds this, rad; pi is the printed
            form, which drives at every bearing.
    """

    k_p: float = 0.8
    k_a: float = 2.0
    max_speed: float = 0.3
    max_turn_rate: float = 1.5
    radius: float = 0.30
    turn_in_place_beyond: float = np.pi

    def __post_init__(self) -> None:
        require_positive(
            k_p=self.k_p,
            k_a=self.k_a,
            max_speed=self.max_speed,
            max_turn_rate=self.max_turn_rate,
            radius=self.radius,
            turn_in_place_beyond=self.turn_in_place_beyond,
        )


def distance_and_bearing(pose: Any, goal: Any) -> tuple[Any, Any]:
    """Returns rho (m) and alpha (rad, wrapped) of `goal` [x, y] seen from `pose` [x, y, theta].

    [NAV] 4.3: rho = sqrt(dx^2 + dy^2), alpha = atan2(dy, dx) - theta. Floats, AutoDiffXd and
    Expression.
    """
    dx, dy = goal[0] - pose[0], goal[1] - pose[1]
    # The difference of angles, wrapped in one step and differentiable everywhere but at the goal.
    c, s = cos(pose[2]), sin(pose[2])
    return sqrt(dx * dx + dy * dy), atan2(c * dy - s * dx, c * dx + s * dy)


def drive_toward(pose: Any, goal: Any, parameters: WaypointParameters) -> list[Any]:
    """Returns the command [v (m/s), omega (rad/s)] that drives from `pose` to `goal`.

    [NAV] 4.3: v = k_p rho, omega = k_a alpha, each saturated.
    """
    rho, alpha = distance_and_bearing(pose, goal)
    v = drake_min(parameters.k_p * rho, parameters.max_speed)
    if parameters.turn_in_place_beyond < np.pi:  # a bearing beyond pi does not exist
        v = v * drake_max(0.0, 1.0 - abs(alpha) / parameters.turn_in_place_beyond)
    limit = parameters.max_turn_rate
    return [v, drake_max(-limit, drake_min(limit, parameters.k_a * alpha))]


@TemplateSystem.define("WaypointController_")
def WaypointController_(T: Any) -> Any:  # noqa: D103 - the class carries the documentation
    class Impl(LeafSystem_[T]):
        """Drives to one waypoint after the other on the estimated pose.

        .. pydrake_system::

            name: WaypointController
            input_ports:
            - pose
            output_ports:
            - command
            - waypoints_reached

        Args:
            waypoints: (n, 2) m, in map, in the order of the visit.
            parameters: gains and limits.
            rate: how often arrival is looked at, Hz.

        Ports:
            pose (input, vector of 3): [x (m), y (m), theta (rad)] of base_link in map, the
                estimate. A pose that is not finite commands standing still.
            command (output, vector of 2): [v (m/s), omega (rad/s)], a function of the pose at
                every moment (whoever drives the wheels samples it); zeros when all waypoints are
                reached.
            waypoints_reached (output, vector of 1): how many, updated at `rate`.

        Source: [NAV] 4.3. Scalar types: float, AutoDiffXd, Expression.

        Raises:
            ValueError: no waypoint, one that is not finite, or a parameter out of range.
        """

        def _construct(
            self,
            *,
            waypoints: NDArray[np.float64],
            parameters: WaypointParameters | None = None,
            rate: float = 20.0,
            converter: Any = None,
        ) -> None:
            super().__init__(converter=converter)
            waypoints = np.atleast_2d(np.asarray(waypoints, float))
            require(
                waypoints.shape[1] == 2 and len(waypoints) > 0 and bool(np.isfinite(waypoints).all()),
                "waypoints",
                waypoints.tolist(),
                "a list of at least one [x, y]",
            )
            require_positive(rate=rate)
            self.waypoints = waypoints
            self.parameters = parameters or WaypointParameters()
            self.rate = rate
            self._pose_input = self.DeclareVectorInputPort("pose", BasicVector_[T](3))
            self._reached = self.DeclareDiscreteState(1)
            self.DeclarePeriodicDiscreteUpdateEvent(1.0 / rate, 0.0, self._look_at_arrival)
            self._command_output = self.DeclareVectorOutputPort(
                "command",
                BasicVector_[T](2),
                self._calc_command,
                {self._pose_input.ticket(), self.discrete_state_ticket(self._reached)},
            )
            self._reached_output = self.DeclareVectorOutputPort(
                "waypoints_reached",
                BasicVector_[T](1),
                self._calc_reached,
                {self.discrete_state_ticket(self._reached)},
            )

        def _construct_copy(self, other: Any, converter: Any = None) -> None:
            Impl._construct(
                self,
                waypoints=other.waypoints,
                parameters=other.parameters,
                rate=other.rate,
                converter=converter,
            )

        def pose_input_port(self) -> Any:
            """Returns the port of the estimated pose."""
            return self._pose_input

        def command_output_port(self) -> Any:
            """Returns the port of the drive command."""
            return self._command_output

        def waypoints_reached_output_port(self) -> Any:
            """Returns the port of the number of waypoints reached."""
            return self._reached_output

        def _index(self, context: Any) -> int:
            value = context.get_discrete_state(self._reached)[0]
            return int(value if T is float else _extract(value))

        def _look_at_arrival(self, context: Any, discrete_state: Any) -> None:
            index = self._index(context)
            if index == len(self.waypoints):
                return
            pose = self._pose_input.Eval(context)
            rho, _ = distance_and_bearing(pose, self.waypoints[index])
            # Written so that NaN does not arrive.
            if (rho if T is float else _extract(rho)) < self.parameters.radius:
                discrete_state.set_value(self._reached, [T(index + 1)])

        def _calc_command(self, context: Any, output: Any) -> None:
            index = self._index(context)
            pose = self._pose_input.Eval(context)
            if index == len(self.waypoints) or (T is float and not np.isfinite(pose).all()):
                output.SetFromVector([T(0.0), T(0.0)])
                return
            output.SetFromVector(
                np.array(drive_toward(pose, self.waypoints[index], self.parameters))
            )

        def _calc_reached(self, context: Any, output: Any) -> None:
            output.SetFromVector(context.get_discrete_state(self._reached).get_value())

    def _extract(value: Any) -> float:
        return value.value() if hasattr(value, "value") else value.Evaluate()

    return Impl


WaypointController = WaypointController_[None]
