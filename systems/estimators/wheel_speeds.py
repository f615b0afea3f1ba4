"""How fast wheels turn, by encoders that count ticks."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.health import Counts
from systems.periods import period
from systems.validation import require, require_positive

Array = NDArray[np.float64]


class WheelSpeeds(LeafSystem):
    """Gives the mean speed of two wheels over a short time, from the counts of their encoders.

    .. pydrake_system::

        name: WheelSpeeds
        input_ports:
        - ticks
        output_ports:
        - wheel_speeds
        - health

    Args:
        ticks_per_turn: of a wheel.
        rate: how often the counts are read, Hz; the encoders'.
        window: over how long the speed is taken, s. A tick more or less is an error of
            2 pi / (ticks_per_turn window) rad/s, and the speed told is half a window old.
        max_speed: faster than this no wheel turns, rad/s: a counter that leaps has been reset.

    Ports:
        ticks (input, vector of 2): counts [right, left]. Not finite: dropped and counted, and the
            wheels are taken to go on as before.
        wheel_speeds (output, vector of 2): [right, left], rad/s, at `rate`; zeros before the
            second reading: until then the wheels stood.
        health (output, Health): `bad_ticks`, counts that were not finite; `leap`, counts that were
            too far from those before.

    Raises:
        ValueError: an argument out of range, or a window shorter than the time between readings.
    """

    def __init__(
        self,
        *,
        ticks_per_turn: float,
        rate: float = 50.0,
        window: float = 0.1,
        max_speed: float = 100.0,
    ) -> None:
        super().__init__()
        require_positive(ticks_per_turn=ticks_per_turn, rate=rate, max_speed=max_speed)
        length = round(window * rate)
        require(length >= 1, "window", window, f"at least {1 / rate:g} s, from reading to reading")
        self._angle = 2 * math.pi / ticks_per_turn
        self._dt = period(rate)
        self._most = max_speed / rate / self._angle  # ticks from reading to reading
        self._ticks_input = self.DeclareVectorInputPort("ticks", 2)
        # The readings of a window and one more, the latest last; NaN before the first.
        self._readings = self.DeclareDiscreteState(np.full(2 * (length + 1), math.nan))
        self._speeds = self.DeclareDiscreteState(2)
        self.DeclarePeriodicDiscreteUpdateEvent(self._dt, 0.0, self._read)
        self._speeds_output = self.DeclareStateOutputPort("wheel_speeds", self._speeds)
        self._counts = Counts(self, "bad_ticks", "leap")

    def ticks_input_port(self) -> InputPort:
        """Returns the port of the counts."""
        return self._ticks_input

    def wheel_speeds_output_port(self) -> OutputPort:
        """Returns the port of the speeds."""
        return self._speeds_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of what was dropped."""
        return self._counts.output_port

    def _read(self, context: Context, discrete_state: DiscreteValues) -> None:
        ticks = self._ticks_input.Eval(context)
        readings = context.get_discrete_state(self._readings).get_value().reshape(-1, 2)
        sound = bool(np.isfinite(ticks).all())
        if math.isnan(readings[0, 0]):
            if not sound:
                self._counts.add(context, discrete_state, bad_ticks=1)
                return
            readings = np.tile(ticks, (len(readings), 1))  # until then they stood
        step = (readings[-1] - readings[0]) / (len(readings) - 1)
        if not sound:
            self._counts.add(context, discrete_state, bad_ticks=1)
            ticks = readings[-1] + step  # as if it had gone on as before
        elif (np.abs(ticks - readings[-1]) > self._most).any():
            self._counts.add(context, discrete_state, leap=1)
            readings = readings + (ticks - readings[-1] - step)
        readings = np.vstack([readings[1:], ticks])
        speeds = self._angle * (readings[-1] - readings[0]) / ((len(readings) - 1) * self._dt)
        discrete_state.set_value(self._readings, readings.ravel())
        discrete_state.set_value(self._speeds, speeds)
