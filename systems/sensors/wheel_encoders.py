"""Encoders on the wheels: counts of their angles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.periods import period
from systems.validation import require_positive

Array = NDArray[np.float64]


@dataclass
class WheelEncoderParameters:
    """Resolution of the encoders.

    Attributes:
        ticks_per_turn: of the wheel. The default is the slotted disc of 20 slots that comes with
            hobby robots, read by two light barriers (quadrature): four edges to a slot.
    """

    ticks_per_turn: float = 80.0

    def __post_init__(self) -> None:
        require_positive(ticks_per_turn=self.ticks_per_turn)


def ticks(angles: ArrayLike, ticks_per_turn: float) -> Array:
    """Returns the counts at wheel angles (rad): whole, falling when a wheel turns backward."""
    result: Array = np.floor(np.asarray(angles, float) * (ticks_per_turn / (2 * np.pi)))
    return result


class WheelEncoders(LeafSystem):
    """Counts ticks of the wheels, from where they stood at angle 0.

    .. pydrake_system::

        name: WheelEncoders
        input_ports:
        - wheel_angles
        output_ports:
        - ticks

    Args:
        parameters: resolution.
        rate: how often the counters are read, Hz.

    Ports:
        wheel_angles (input, vector of 2): [right, left] (rad), not wrapped.
        ticks (output, vector of 2): [right, left], whole numbers, held between readings; zeros
            before the first.

    Raises:
        ValueError: the rate is out of range.
    """

    def __init__(
        self, *, parameters: WheelEncoderParameters | None = None, rate: float = 50.0
    ) -> None:
        super().__init__()
        require_positive(rate=rate)
        self._ticks_per_turn = (parameters or WheelEncoderParameters()).ticks_per_turn
        self._angles_input = self.DeclareVectorInputPort("wheel_angles", 2)
        self._ticks = self.DeclareDiscreteState(2)
        self.DeclarePeriodicDiscreteUpdateEvent(period(rate), 0.0, self._read)
        self._ticks_output = self.DeclareStateOutputPort("ticks", self._ticks)

    def wheel_angles_input_port(self) -> InputPort:
        """Returns the port of the wheels' angles."""
        return self._angles_input

    def ticks_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._ticks_output

    def _read(self, context: Context, discrete_state: DiscreteValues) -> None:
        angles = self._angles_input.Eval(context)
        discrete_state.set_value(self._ticks, ticks(angles, self._ticks_per_turn))
