"""A robot that rolls over a sphere without slip: the kinematic twin of one on magnetic wheels."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.health import Counts
from systems.markers.pnp import rotation_from_vector
from systems.periods import period
from systems.shell.angles import nearest_rotation, rotation
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]


def body_rate(command: Array, radius: float) -> Array:
    """Returns the angular velocity (3,) of B in R, in B (rad/s), of [v, omega].

    Going forward over a sphere turns the body about its left axis, by the way over the radius.

    Args:
        command: (2,) speed over the surface (m/s), turning rate about the normal (rad/s).
        radius: of the sphere, m.
    """
    return np.array([0.0, command[0] / radius, command[1]])


class ShellRover(LeafSystem):
    """Follows drive commands over a sphere exactly, without mass.

    .. pydrake_system::

        name: ShellRover
        input_ports:
        - command
        output_ports:
        - pose
        - angular_velocity
        - health

    Args:
        radius: of the sphere, m.
        height: of base_link's origin over the sphere, m.
        initial_angles: [roll, pitch, yaw] at the start, rad.
        rate: of the steps, Hz; a command holds for a step.

    Ports:
        command (input, vector of 2): [v (m/s) over the surface, omega (rad/s) about the outward
            normal]. Not finite: it stands still.
        pose (output, RigidTransform): `X_RB` of base_link in the sphere's frame, at `rate`.
        angular_velocity (output, vector of 3): of base_link in the sphere's frame, along its own
            axes, rad/s, over the coming step.
        health (output, Health): commands that were not finite, by steps.

    Source: without slip `R_RB` obeys dR/dt = R [w]x with w = (0, v / radius, omega), whose solution
    over a step of constant command is R exp([w dt]x).

    Raises:
        ValueError: an argument out of range.
    """

    def __init__(
        self,
        *,
        radius: float,
        height: float = 0.0,
        initial_angles: tuple[float, float, float] = (0.0, 0.0, 0.0),
        rate: float = 300.0,
    ) -> None:
        super().__init__()
        require_positive(radius=radius, rate=rate)
        require_non_negative(height=height)
        require(
            len(initial_angles) == 3 and bool(np.isfinite(initial_angles).all()),
            "initial_angles",
            initial_angles,
            "three finite numbers [roll, pitch, yaw] (rad)",
        )
        self._radius = radius
        self._height = height
        self._dt = period(rate)
        self._command_input = self.DeclareVectorInputPort("command", 2)
        self._R = self.DeclareDiscreteState(rotation(np.array(initial_angles)).ravel())
        self.DeclarePeriodicDiscreteUpdateEvent(self._dt, 0.0, self._step)
        self._pose_output = self.DeclareAbstractOutputPort(
            "pose",
            lambda: AbstractValue.Make(RigidTransform()),
            self._calc_pose,
            {self.discrete_state_ticket(self._R)},
        )
        self._angular_velocity_output = self.DeclareVectorOutputPort(
            "angular_velocity",
            3,
            lambda context, output: output.SetFromVector(self._rate(context)[0]),
            {self._command_input.ticket()},
        )
        self._counts = Counts(self, "bad_command")

    def command_input_port(self) -> InputPort:
        """Returns the port of the drive command."""
        return self._command_input

    def pose_output_port(self) -> OutputPort:
        """Returns the port of the pose."""
        return self._pose_output

    def angular_velocity_output_port(self) -> OutputPort:
        """Returns the port of the angular velocity."""
        return self._angular_velocity_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    def _rotation(self, context: Context) -> Array:
        R: Array = context.get_discrete_state(self._R).get_value().reshape(3, 3)
        return R

    def _rate(self, context: Context) -> tuple[Array, bool]:
        """Returns the angular velocity, and whether the command was any."""
        command = self._command_input.Eval(context)
        sound = bool(np.isfinite(command).all())
        return body_rate(command if sound else np.zeros(2), self._radius), sound

    def _step(self, context: Context, discrete_state: DiscreteValues) -> None:
        rate, sound = self._rate(context)
        R = nearest_rotation(self._rotation(context) @ rotation_from_vector(rate * self._dt))
        discrete_state.set_value(self._R, R.ravel())
        self._counts.add(context, discrete_state, bad_command=not sound)

    def _calc_pose(self, context: Context, output: Any) -> None:
        R = self._rotation(context)
        position = (self._radius + self._height) * R[:, 2]
        output.set_value(RigidTransform(RotationMatrix(R), position))
