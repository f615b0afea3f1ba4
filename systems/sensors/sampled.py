"""What cameras and other slow sensors share: sampling at a rate, arrival after a latency."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, EventStatus, LeafSystem, OutputPort, State

from systems.messages import Message, whole_nanoseconds
from systems.noise import sample_index
from systems.validation import require_non_negative, require_positive

_SAME_TIME = 1e-9  # s; two sums of periods and latencies that mean one time differ by less


class SampledSensor(LeafSystem):
    """Base of sensors that measure a message at `rate` and deliver it `latency` later.

    A subclass declares its inputs, calls `_declare_sampling` and implements `_measure`. The
    delivered message and those under way are abstract state; before the first delivery the output
    is `nothing`.
    """

    def _declare_sampling(
        self, *, name: str, rate: float, latency: float, nothing: Message
    ) -> OutputPort:
        """Declares state, events and the output port.

        Args:
            name: name of the output port.
            rate: Hz.
            latency: time from measurement to arrival, s.
            nothing: what is sent before the first arrival.

        Returns:
            The output port. It changes only when a message arrives.

        Raises:
            ValueError: rate or latency out of range.
        """
        require_positive(rate=rate)
        require_non_negative(latency=latency)
        self.rate = rate
        self.latency = latency
        self._delivered = self.DeclareAbstractState(AbstractValue.Make(nothing))
        self._under_way = self.DeclareAbstractState(AbstractValue.Make(()))
        self.DeclarePeriodicUnrestrictedUpdateEvent(1.0 / rate, 0.0, self._take)
        self.DeclarePeriodicUnrestrictedUpdateEvent(1.0 / rate, latency, self._deliver)
        return self.DeclareAbstractOutputPort(
            name,
            lambda: AbstractValue.Make(nothing),
            lambda context, output: output.set_value(
                context.get_abstract_state(self._delivered).get_value()
            ),
            {self.abstract_state_ticket(self._delivered)},
        )

    @abstractmethod
    def _measure(self, context: Context, stamp: float, index: int) -> Message:
        """Measures.

        Args:
            context: the block's context at the time of measurement.
            stamp: that time, in whole nanoseconds, s.
            index: number of the sample, the key of its noise (see `systems.noise`).
        """

    def _take(self, context: Context, state: State) -> EventStatus:
        t = context.get_time()
        message = self._measure(context, whole_nanoseconds(t), sample_index(t, self.rate))
        slot = self._slot(state, self._under_way)
        slot.set_value((*slot.get_value(), (t + self.latency, message)))
        return EventStatus.Succeeded()

    def _deliver(self, context: Context, state: State) -> EventStatus:
        slot = self._slot(state, self._under_way)
        under_way = slot.get_value()
        # A simulation that starts late has deliveries before its first sample arrives.
        if not under_way or under_way[0][0] > context.get_time() + _SAME_TIME:
            return EventStatus.DidNothing()
        self._slot(state, self._delivered).set_value(under_way[0][1])
        slot.set_value(under_way[1:])
        return EventStatus.Succeeded()

    @staticmethod
    def _slot(state: State, index: Any) -> AbstractValue:
        return state.get_mutable_abstract_state(int(index))
