"""The last block before the wheels: samples the drive command and keeps it within its limits."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.health import Counts
from systems.periods import period
from systems.validation import require, require_non_negative, require_positive


@dataclass
class WheelDriveParameters:
    """Limits of the drive.

    Attributes:
        rate: how often the command is taken, Hz.
        max_speed: m/s.
        max_turn_rate: rad/s.
        max_acceleration: m/s^2.
        max_turn_acceleration: rad/s^2.
        rest: until this time no command is taken, s: the robot stands while its gyro is calibrated.
    """

    rate: float = 50.0
    max_speed: float = 0.5
    max_turn_rate: float = 3.0
    max_acceleration: float = 1.0
    max_turn_acceleration: float = 10.0
    rest: float = 0.0

    def __post_init__(self) -> None:
        require_positive(**{name: v for name, v in vars(self).items() if name != "rest"})
        require_non_negative(rest=self.rest)


def _within(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)


class WheelDrive(LeafSystem):
    """Samples the command, limits speed and acceleration, and tells the wheels.

    .. pydrake_system::

        name: WheelDrive
        input_ports:
        - command
        output_ports:
        - sent
        - wheel_speeds
        - health

    Args:
        to_wheel_speeds: inverse kinematics, [v, omega] to [right, left] (rad/s).
        parameters: limits and rate.
        max_wheel_speed: the fastest that a wheel can turn, rad/s. A command that asks for more is
            scaled down, v and omega alike, so that the robot drives the same curve, slower.

    Ports:
        command (input, vector of 2): [v (m/s), omega (rad/s)]. A value that is not finite is
            dropped and counted, and the drive slows down to a stop.
        sent (output, vector of 2): the command after the limits, as the wheels get it and as the
            robot knows it, held between samples at `rate`.
        wheel_speeds (output, vector of 2): [right, left] (rad/s) of `sent`.
        health (output, Health): commands that were not finite.
    """

    def __init__(
        self,
        *,
        to_wheel_speeds: Callable[[list[float]], list[float]],
        parameters: WheelDriveParameters | None = None,
        max_wheel_speed: float = math.inf,
    ) -> None:
        super().__init__()
        require(max_wheel_speed > 0, "max_wheel_speed", max_wheel_speed, "greater than 0")
        p = parameters or WheelDriveParameters()
        self._rest = p.rest
        self._max_wheel_speed = max_wheel_speed
        self._limit = [p.max_speed, p.max_turn_rate]
        self._change = [p.max_acceleration / p.rate, p.max_turn_acceleration / p.rate]
        self._to_wheel_speeds = to_wheel_speeds
        self._command_input = self.DeclareVectorInputPort("command", 2)
        self._sent = self.DeclareDiscreteState(2)
        self.DeclarePeriodicDiscreteUpdateEvent(period(p.rate), 0.0, self._sample)
        self._sent_output = self.DeclareStateOutputPort("sent", self._sent)
        ticket = {self.discrete_state_ticket(self._sent)}
        self._wheel_speeds_output = self.DeclareVectorOutputPort(
            "wheel_speeds", 2, self._calc_wheel_speeds, ticket
        )
        self._counts = Counts(self, "bad_command")

    def command_input_port(self) -> InputPort:
        """Returns the port of the command."""
        return self._command_input

    def sent_output_port(self) -> OutputPort:
        """Returns the port of the command as sent."""
        return self._sent_output

    def wheel_speeds_output_port(self) -> OutputPort:
        """Returns the port of the wheel speeds."""
        return self._wheel_speeds_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    def _sample(self, context: Context, discrete_state: DiscreteValues) -> None:
        command: list[float] = self._command_input.Eval(context).tolist()
        if not all(map(math.isfinite, command)):
            self._counts.add(context, discrete_state, bad_command=1)
            command = [0.0, 0.0]
        if context.get_time() < self._rest:
            command = [0.0, 0.0]
        sent: list[float] = context.get_discrete_state(self._sent).get_value().tolist()
        if not (any(sent) or any(command)):
            return  # it stands: most robots of a formation do, most of the time
        (max_v, max_omega), (dv, domega) = self._limit, self._change
        v, omega = self._within_reach(_within(command[0], max_v), _within(command[1], max_omega))
        v = sent[0] + _within(v - sent[0], dv)
        omega = sent[1] + _within(omega - sent[1], domega)
        # Once more: on its way from one to the other it may leave what the wheels can do.
        discrete_state.set_value(self._sent, self._within_reach(v, omega))

    def _within_reach(self, v: float, omega: float) -> list[float]:
        if math.isinf(self._max_wheel_speed):
            return [v, omega]
        right, left = self._to_wheel_speeds([v, omega])
        fastest = max(abs(right), abs(left))
        factor = min(1.0, self._max_wheel_speed / max(fastest, 1e-9))
        return [v * factor, omega * factor]

    def _calc_wheel_speeds(self, context: Context, output: Any) -> None:
        sent = context.get_discrete_state(self._sent).get_value().tolist()
        output.SetFromVector(self._to_wheel_speeds(sent))
