"""What cameras and other slow sensors share: sampling at a rate, arrival after a latency."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Any

from pydrake.common.value import AbstractValue
from pydrake.systems.framework import (
    Context,
    EventStatus,
    InputPort,
    LeafSystem,
    OutputPort,
    State,
)

from systems.messages import Message, whole_nanoseconds
from systems.noise import sample_index
from systems.periods import period
from systems.validation import require, require_non_negative, require_positive

_ROUNDING = 1e-9  # s, by which the time at which somebody looks may be before that of an arrival


@dataclass(frozen=True, eq=False)
class _Samples(Message):
    """The last sample that has arrived and those under way: (time of arrival (s), message).

    A message itself, for Drake copies all abstract state at each change of any of it.
    """

    samples: tuple[tuple[float, Message], ...] = ()

    def arrived(self, t: float) -> int:
        """Returns how many have arrived at time t (s)."""
        count = 0
        for due, _ in self.samples:
            if due > t + _ROUNDING:
                break
            count += 1
        return count


class SampledSensor(LeafSystem):
    """Base of sensors that measure a message at `rate` and deliver it `latency` later.

    A subclass declares its inputs, calls `_declare_sampling` and implements `_measure`. The last
    message that has arrived and those under way are abstract state. Which has arrived is a matter
    of the time: an event of its own for that would be one more step of the simulation, and where
    it coincides with others Drake rounds its time, and leaves one in a thousand out. Before the
    first arrival the output is `nothing`.
    """

    def _declare_sampling(
        self,
        *,
        name: str,
        rate: float,
        latency: float,
        nothing: Message,
        clock_error: float = 0.0,
        switchable: bool = False,
    ) -> OutputPort:
        """Declares state, events and the output port, perhaps an input to switch it off.

        Args:
            name: name of the output port.
            rate: Hz.
            latency: time from measurement to arrival, s.
            nothing: what is sent before the first arrival.
            clock_error: by how much the stamps are late on the clock of all others, s: what is
                measured at t is said to be of t + clock_error. At most `latency`, as nothing may
                come from the future.
            switchable: whether it has an input `active` (vector of 1): while that is 0 nothing is
                measured; unconnected, it measures.

        Returns:
            The output port. It changes only when a message arrives, though for Drake it depends
            on the time, unless they arrive at once.

        Raises:
            ValueError: rate, latency or clock_error out of range.
        """
        require_positive(rate=rate)
        require_non_negative(latency=latency)
        sound = math.isfinite(clock_error) and clock_error <= latency
        require(sound, "clock_error", clock_error, f"at most the latency, {latency:g} s")
        self.rate = rate
        self.latency = latency
        self.clock_error = clock_error
        self._active_input = self.DeclareVectorInputPort("active", 1) if switchable else None
        self._nothing = nothing
        samples = self.DeclareAbstractState(AbstractValue.Make(_Samples()))
        self._samples = int(samples)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period(rate), 0.0, self._take)
        # What depends on the time is made anew for whoever asks at each step.
        told = {self.abstract_state_ticket(samples)} | ({self.time_ticket()} if latency else set())
        return self.DeclareAbstractOutputPort(
            name, lambda: AbstractValue.Make(nothing), self._calc_arrived, told
        )

    @abstractmethod
    def _measure(self, context: Context, stamp: float, index: int) -> Message:
        """Measures.

        Args:
            context: the block's context at the time of measurement.
            stamp: that time by the sensor's clock, in whole nanoseconds, s.
            index: number of the sample, the key of its noise (see `systems.noise`).
        """

    def _stamp(self, t: float) -> float:
        """Returns the time t (s) by the sensor's clock, in whole nanoseconds."""
        return whole_nanoseconds(t + self.clock_error)

    def active_input_port(self) -> InputPort:
        """Returns the port that switches it off and on, of one that is `switchable`."""
        assert self._active_input is not None
        return self._active_input

    def _is_off(self, context: Context) -> bool:
        port = self._active_input
        if port is None or not port.HasValue(context):
            return False
        return not port.Eval(context)[0] > 0

    def _take(self, context: Context, state: State) -> EventStatus:
        if self._is_off(context):
            return EventStatus.DidNothing()
        t = context.get_time()
        message = self._measure(context, self._stamp(t), sample_index(t, self.rate))
        slot: AbstractValue = state.get_mutable_abstract_state(self._samples)
        before: _Samples = slot.get_value()
        kept = before.samples[max(before.arrived(t) - 1, 0) :]
        slot.set_value(_Samples((*kept, (t + self.latency, message))))
        return EventStatus.Succeeded()

    def _calc_arrived(self, context: Context, output: Any) -> None:
        found: _Samples = context.get_abstract_state(self._samples).get_value()
        arrived = found.arrived(context.get_time())
        output.set_value(found.samples[arrived - 1][1] if arrived else self._nothing)
