"""Plays a recording back into a diagram, in place of the blocks that were recorded.

A played port has at time t the last value whose log time is not after t. A recorder that looks at t
sees what an estimator sees that updates at t. So an estimator that updates when the recorder looked
(the same rate and offset) is given the same sequence again, bit for bit. Times are compared in
whole nanoseconds, which is what a recording keeps: 0.1 + 0.2 and 0.3 are the same time.
"""

from __future__ import annotations

import bisect
import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, LeafSystem, OutputPort

from systems.io.bag import BagReader
from systems.io.ros_messages import Decoder, decoder
from systems.io.ros_types import nanoseconds, seconds, time_from_ros
from systems.memo import Memo
from systems.messages import Health, Message
from systems.validation import require

Array = NDArray[np.float64]

# Decoded when they are looked at: a long recording of them does not fit into memory.
_PICTURES = ("sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image")


class Lazy:
    """A value that is made each time it is asked for.

    Args:
        make: makes it; raises ValueError when it cannot.
    """

    def __init__(self, make: Callable[[], Any]) -> None:
        self.make = make


class Entry(NamedTuple):
    """One value of a recording.

    Attributes:
        log_time: ns.
        stamp: time of measurement, s; NaN when the recorded one cannot be used.
        value: ours, or a `Lazy` one; None when it could not be decoded.
    """

    log_time: int
    stamp: float
    value: Any


def read_channel(
    reader: BagReader, topic: str, decode: Decoder | None = None, *, origin: float = 0.0
) -> list[Entry]:
    """Reads all of one topic.

    Pictures are kept as they were recorded (compressed) and decoded when they are played.

    Args:
        reader: the recording.
        topic: which.
        decode: makes our value of the ROS message; by default the usual one of its type.
        origin: time of the recording that is to be 0, s; `reader.start` for one that counts since
            1970. Log times and stamps are counted from it.

    Raises:
        ValueError: the recording has no such topic, or its type no usual conversion.
    """
    msgtype = reader.topics().get(topic, "")
    records = reader.records([topic])
    function = decode or decoder(msgtype)
    shift = nanoseconds(origin)

    def make(message: Any) -> Any:
        value = function(message)
        if shift and isinstance(value, Message):
            stamps = {
                name: _shifted(getattr(value, name), shift)
                for name in ("stamp", "previous_stamp")
                if hasattr(value, name)
            }
            return dataclasses.replace(value, **stamps)  # type: ignore[type-var]
        return value

    entries = []
    for record in records:
        stamp, value = math.nan, None
        try:
            message = record.message()
            stamp = _shifted(_stamp(message, record.log_time), shift)
            value = Lazy(partial(make, message)) if msgtype in _PICTURES else make(message)
        except ValueError:
            pass  # an entry without a value: whoever plays it counts it
        entries.append(Entry(record.log_time - shift, stamp, value))
    return entries


def _stamp(message: Any, log_time: int) -> float:
    if hasattr(message, "header"):
        return time_from_ros(message.header.stamp)
    return seconds(log_time)


def _shifted(stamp: float, shift: int) -> float:
    return seconds(nanoseconds(stamp) - shift) if math.isfinite(stamp) else stamp


class Track:
    """The sound entries of a channel, to be looked up by time.

    Args:
        entries: in log-time order.
        sound: whether a value is fit to be played; Lazy ones are not asked.

    Attributes:
        values: of the sound entries.
    """

    def __init__(self, entries: Sequence[Entry], sound: Callable[[Any], bool]) -> None:
        self.values: list[Any] = []
        self._times: list[int] = []
        self._dropped: dict[str, list[int]] = {
            "undecodable": [],
            "not_finite": [],
            "stamp_backwards": [],
        }
        stamp, log_time = -math.inf, -math.inf
        for entry in entries:
            if entry.value is None:
                self._dropped["undecodable"].append(entry.log_time)
            elif not math.isfinite(entry.stamp) or not (
                isinstance(entry.value, Lazy) or sound(entry.value)
            ):
                self._dropped["not_finite"].append(entry.log_time)
            elif entry.stamp < stamp or entry.log_time < log_time:
                self._dropped["stamp_backwards"].append(entry.log_time)
            else:
                self._times.append(entry.log_time)
                self.values.append(entry.value)
                stamp, log_time = entry.stamp, entry.log_time
        for times in self._dropped.values():
            times.sort()

    def index(self, t: float) -> int:
        """Returns which value is in force at `t` (s); -1 before the first."""
        return bisect.bisect_right(self._times, nanoseconds(t)) - 1

    def dropped(self, t: float) -> dict[str, int]:
        """Returns how many entries up to `t` (s) are left out, by reason."""
        time = nanoseconds(t)
        return {reason: bisect.bisect_right(times, time) for reason, times in self._dropped.items()}


class VectorPlayback(LeafSystem):
    """Plays recorded vectors: inertial samples, drive commands, planar poses.

    .. pydrake_system::

        name: VectorPlayback
        output_ports:
        - value
        - health

    Args:
        entries: of `read_channel`; their values vectors.
        size: of the vectors.
        nothing: what is sent before the first; zeros by default.

    Ports:
        value (output, vector of `size`): the last one whose log time is not after t.
        health (output, Health): entries left out up to t: `undecodable`, `not_finite` (an element
            or the stamp), `stamp_backwards` (stamp or log time before that of the last one played).

    Raises:
        ValueError: a value that is no vector of `size`, or `nothing` is not.
    """

    def __init__(
        self, *, entries: Sequence[Entry], size: int, nothing: ArrayLike | None = None
    ) -> None:
        super().__init__()
        require(size > 0, "size", size, "greater than 0")
        before = np.zeros(size) if nothing is None else np.asarray(nothing, float)
        require(before.shape == (size,), "nothing", before.tolist(), f"{size} numbers")
        for entry in entries:
            if entry.value is not None:
                shape = np.shape(entry.value)
                require(shape == (size,), "shape of a value", shape, f"({size},)")
        self._track = Track(entries, lambda value: bool(np.isfinite(value).all()))
        # The first row is what is sent before the first entry.
        self._values = np.array([before, *self._track.values], float)
        self._track.values.clear()
        self._value_output = self.DeclareVectorOutputPort(
            "value", BasicVector(size), self._calc_value, {self.time_ticket()}
        )
        self._health_output = self.DeclareAbstractOutputPort(
            "health",
            lambda: AbstractValue.Make(Health()),
            self._calc_health,
            {self.time_ticket()},
        )

    def value_output_port(self) -> OutputPort:
        """Returns the port of the vectors."""
        return self._value_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of what was left out."""
        return self._health_output

    def _calc_value(self, context: Any, output: Any) -> None:
        output.SetFromVector(self._values[self._track.index(context.get_time()) + 1])

    def _calc_health(self, context: Any, output: Any) -> None:
        output.set_value(Health(self._track.dropped(context.get_time())))


class MessagePlayback(LeafSystem):
    """Plays recorded messages: pictures, detections, estimates, poses.

    Pictures are decoded when they are looked at, and only the last one is kept, in the Context.

    .. pydrake_system::

        name: MessagePlayback
        output_ports:
        - value
        - health

    Args:
        entries: of `read_channel`; their values all of the type of `nothing`.
        nothing: what is sent before the first, and an example of the message.

    Ports:
        value (output, of the type of `nothing`): the last one whose log time is not after t; the
            same object for as long as it stands.
        health (output, Health): entries left out up to t: `undecodable` (of pictures: those that
            were looked at), `not_finite` (the stamp), `stamp_backwards` (stamp or log time before
            that of the last one played).

    Raises:
        ValueError: a value of another type than `nothing`.
    """

    def __init__(self, *, entries: Sequence[Entry], nothing: Any) -> None:
        super().__init__()
        for entry in entries:
            if entry.value is not None and not isinstance(entry.value, Lazy):
                kind, expected = type(entry.value), type(nothing)
                require(issubclass(kind, expected), "value", kind.__name__, expected.__name__)
        self._nothing = nothing
        self._track = Track(entries, lambda value: math.isfinite(getattr(value, "stamp", 0.0)))
        self._memory = Memo(self, "the last picture")
        self._value_output = self.DeclareAbstractOutputPort(
            "value",
            lambda: AbstractValue.Make(nothing),
            self._calc_value,
            {self.time_ticket()},
        )
        self._health_output = self.DeclareAbstractOutputPort(
            "health",
            lambda: AbstractValue.Make(Health()),
            self._calc_health,
            {self.time_ticket()},
        )

    def value_output_port(self) -> OutputPort:
        """Returns the port of the messages."""
        return self._value_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of what was left out."""
        return self._health_output

    def _value(self, context: Context) -> Any:
        memory: _Decoded = self._memory(context, _Decoded)
        index = self._track.index(context.get_time())
        while index >= 0 and index != memory.index:
            if index in memory.undecodable:
                index -= 1
                continue
            value = self._track.values[index]
            try:
                memory.value = value.make() if isinstance(value, Lazy) else value
                memory.index = index
            except ValueError:
                memory.undecodable.add(index)
        return memory.value if index >= 0 else self._nothing

    def _calc_value(self, context: Any, output: Any) -> None:
        output.set_value(self._value(context))

    def _calc_health(self, context: Any, output: Any) -> None:
        t = context.get_time()
        counts = self._track.dropped(t)
        self._value(context)  # so that the picture of this moment counts, whoever asks first
        undecodable = self._memory(context, _Decoded).undecodable
        counts["undecodable"] += sum(i <= self._track.index(t) for i in undecodable)
        output.set_value(Health(counts))


@dataclasses.dataclass
class _Decoded:
    """The value that was decoded last, and which ones cannot be."""

    index: int = -1
    value: Any = None
    undecodable: set[int] = dataclasses.field(default_factory=set)
