"""Waypoint following by distance and bearing ([NAV] section 4.3).

[NAV]: Hussein, Lazkani, Saad, Yehia, "Real-time robot navigation with QR-based localization and
lidar obstacle mapping".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.math import atan2, cos, sin, sqrt
from pydrake.math import max as drake_max
from pydrake.math import min as drake_min
from pydrake.systems.framework import BasicVector_, LeafSystem_
from pydrake.systems.scalar_conversion import TemplateSystem

from systems.validation import require_positive


@dataclass
class WaypointParameters:
    """Gains and limits of the waypoint controller.

    Attributes:
        k_p: speed by distance, 1/s.
        k_a: turning rate by bearing, 1/s.
        max_speed: m/s.
        max_turn_rate: rad/s.
        turn_in_place_beyond: no driving while the bearing exceeds this, rad; pi is the printed
            form, which drives at every bearing.
    """

    k_p: float = 0.8
    k_a: float = 2.0
    max_speed: float = 0.3
    max_turn_rate: float = 1.5
    turn_in_place_beyond: float = np.pi

    def __post_init__(self) -> None:
        require_positive(
            k_p=self.k_p,
            k_a=self.k_a,
            max_speed=self.max_speed,
            max_turn_rate=self.max_turn_rate,
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
        """Drives to a waypoint on the estimated pose.

        .. pydrake_system::

            name: WaypointController
            input_ports:
            - pose
            - goal
            output_ports:
            - command

        Args:
            parameters: gains and limits.

        Ports:
            pose (input, vector of 3): [x (m), y (m), theta (rad)] of base_link in map, the
                estimate.
            goal (input, vector of 2): [x, y] (m) in map.
            command (output, vector of 2): [v (m/s), omega (rad/s)], a function of pose and goal
                at every moment (whoever drives the wheels samples it); not finite when they are
                not.

        Source: [NAV] 4.3. Scalar types: float, AutoDiffXd, Expression.
        """

        def _construct(
            self, *, parameters: WaypointParameters | None = None, converter: Any = None
        ) -> None:
            super().__init__(converter=converter)
            self.parameters = parameters or WaypointParameters()
            self._pose_input = self.DeclareVectorInputPort("pose", BasicVector_[T](3))
            self._goal_input = self.DeclareVectorInputPort("goal", BasicVector_[T](2))
            self._command_output = self.DeclareVectorOutputPort(
                "command",
                BasicVector_[T](2),
                self._calc_command,
                {self._pose_input.ticket(), self._goal_input.ticket()},
            )

        def _construct_copy(self, other: Any, converter: Any = None) -> None:
            Impl._construct(self, parameters=other.parameters, converter=converter)

        def pose_input_port(self) -> Any:
            """Returns the port of the estimated pose."""
            return self._pose_input

        def goal_input_port(self) -> Any:
            """Returns the port of the waypoint."""
            return self._goal_input

        def command_output_port(self) -> Any:
            """Returns the port of the drive command."""
            return self._command_output

        def _calc_command(self, context: Any, output: Any) -> None:
            pose, goal = self._pose_input.Eval(context), self._goal_input.Eval(context)
            output.SetFromVector(np.array(drive_toward(pose, goal, self.parameters)))

    return Impl


WaypointController = WaypointController_[None]
