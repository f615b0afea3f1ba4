"""Wheel speeds to the 8-bit pulse widths that a microcontroller writes to its motor bridge."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context, InputPort, LeafSystem, OutputPort

Array = NDArray[np.float64]


def pulse_widths(duty: Array) -> Array:
    """Returns whole numbers from -255 to 255, the nearest to duty cycles from -1 to 1."""
    return np.rint(255.0 * np.minimum(np.maximum(duty, -1.0), 1.0))


class WheelPwm(LeafSystem):
    """Tells the bridge how wide its pulses are to be, by a model of the motors.

    .. pydrake_system::

        name: WheelPwm
        input_ports:
        - wheel_speeds
        output_ports:
        - pwm

    Args:
        to_duty: duty cycles (2,) from -1 to 1 of wheel speeds (2,) (rad/s): the model.

    Ports:
        wheel_speeds (input, vector of 2): [right, left] (rad/s).
        pwm (output, vector of 2): [right, left], whole numbers from -255 to 255.

    There is nothing to correct by: a robot without encoders knows no speed ([NAV] 2.2).
    """

    def __init__(self, *, to_duty: Callable[[Array], Array]) -> None:
        super().__init__()
        self._to_duty = to_duty
        self._speeds_input = self.DeclareVectorInputPort("wheel_speeds", 2)
        self._pwm_output = self.DeclareVectorOutputPort(
            "pwm", 2, self._calc_pwm, {self._speeds_input.ticket()}
        )

    def wheel_speeds_input_port(self) -> InputPort:
        """Returns the port of the wheel speeds."""
        return self._speeds_input

    def pwm_output_port(self) -> OutputPort:
        """Returns the port of the pulse widths."""
        return self._pwm_output

    def _calc_pwm(self, context: Context, output: Any) -> None:
        output.SetFromVector(pulse_widths(self._to_duty(self._speeds_input.Eval(context))))
