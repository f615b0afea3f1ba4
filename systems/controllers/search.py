"""What to do while the robot does not know where it is: stand, then turn and look for markers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.health import Counts
from systems.periods import period
from systems.validation import require_non_negative, require_positive


@dataclass
class SearchParameters:
    """When the robot counts as lost and what it does then.

    Attributes:
        max_position_std: standard deviation of the position along its worst axis, m, beyond which
            the robot is lost.
        patience: time to stand still before turning, s.
        turn_rate: rate of the turn in place, rad/s.
    """

    max_position_std: float = 0.5
    patience: float = 0.5
    turn_rate: float = 0.6

    def __post_init__(self) -> None:
        require_positive(max_position_std=self.max_position_std, turn_rate=self.turn_rate)
        require_non_negative(patience=self.patience)


class SearchWhenLost(LeafSystem):
    """Passes the controller's command on while the estimate is good, else searches for markers.

    .. pydrake_system::

        name: SearchWhenLost
        input_ports:
        - command
        - covariance
        output_ports:
        - command
        - health

    Args:
        parameters: when the robot is lost and what it does then.
        rate: how often the estimate is looked at, Hz.

    Ports:
        command (input, vector of 2): [v (m/s), omega (rad/s)] of the controller.
        covariance (input, vector of 9): (3, 3) of the estimated [x, y, theta], row by row. One
            that is not finite counts as lost.
        command (output, vector of 2): the same command, or zeros, or [0, turn_rate].
        health (output, Health): samples at `rate` for which the robot was lost.
    """

    def __init__(self, *, parameters: SearchParameters | None = None, rate: float = 20.0) -> None:
        super().__init__()
        require_positive(rate=rate)
        self._parameters = parameters or SearchParameters()
        self._period = period(rate)
        self._command_input = self.DeclareVectorInputPort("command", 2)
        self._covariance_input = self.DeclareVectorInputPort("covariance", 9)
        self._duration = self.DeclareDiscreteState([self._period])  # of being lost, s
        self.DeclarePeriodicDiscreteUpdateEvent(self._period, 0.0, self._look)
        self._command_output = self.DeclareVectorOutputPort(
            "command",
            2,
            self._calc_command,
            {self._command_input.ticket(), self.discrete_state_ticket(self._duration)},
        )
        self._counts = Counts(self, "lost")

    def command_input_port(self) -> InputPort:
        """Returns the port of the controller's command."""
        return self._command_input

    def covariance_input_port(self) -> InputPort:
        """Returns the port of the estimate's covariance."""
        return self._covariance_input

    def command_output_port(self) -> OutputPort:
        """Returns the port of the command that is passed on."""
        return self._command_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    def _look(self, context: Context, discrete_state: DiscreteValues) -> None:
        xx, _, _, xy, yy = self._covariance_input.Eval(context)[:5].tolist()
        largest = (xx + yy) / 2 + math.hypot((xx - yy) / 2, xy)
        lost = not largest <= self._parameters.max_position_std**2
        duration = context.get_discrete_state(self._duration)[0]
        discrete_state.set_value(self._duration, [duration + self._period if lost else 0.0])
        self._counts.add(context, discrete_state, lost=lost)

    def _calc_command(self, context: Context, output: Any) -> None:
        duration = context.get_discrete_state(self._duration)[0]
        if duration == 0:
            output.SetFromVector(self._command_input.Eval(context))
        elif duration <= self._parameters.patience:
            output.SetFromVector([0.0, 0.0])
        else:
            output.SetFromVector([0.0, self._parameters.turn_rate])
