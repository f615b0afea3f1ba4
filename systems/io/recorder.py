"""Records a diagram's ports into a rosbag2 folder."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem

from systems.io.bag import BagWriter
from systems.io.ros_messages import Encoder, encoder
from systems.io.ros_types import typestore
from systems.periods import period
from systems.validation import require, require_non_negative, require_positive

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Channel:
    """One port that is recorded.

    Attributes:
        port: name of the input port.
        topic: where it is published in the recording.
        encode: a message type, such as `sensor_msgs/msg/Imu`, for its usual conversion, or a
            function of the port's value and the time (s) that returns a ROS message, such as a
            `systems.io.stencils.Stencil`.
        model: what the port carries: a number n for a vector of n, else an example of the message
            (`Detections()`, `RigidTransform()`).
        rate: how often the port is looked at, Hz.
        only_new: record only what has another stamp than the last one recorded; for messages with
            a stamp.
        repeat: a vector that is the same as the last one recorded is recorded again only after
            this long, s; 0 records every look. Played back it is the same.

    Raises:
        ValueError: an attribute out of range, or a message type without a usual conversion.
    """

    port: str
    topic: str
    encode: str | Encoder
    model: Any
    rate: float
    only_new: bool = False
    repeat: float = 0.0

    def __post_init__(self) -> None:
        require(bool(self.port), "port", self.port, "a name")
        require(self.topic.startswith("/"), "topic", self.topic, "absolute, such as /imu/data")
        require_positive(rate=self.rate)
        if self.is_vector:
            require(self.model > 0, "model", self.model, "a vector of at least one element")
        if self.only_new:
            require(hasattr(self.model, "stamp"), "model", self.model, "a message with a stamp")
        require_non_negative(repeat=self.repeat)
        require(
            self.repeat == 0 or self.is_vector, "repeat", self.repeat, "0, of what is no vector"
        )
        if isinstance(self.encode, str):
            encoder(self.encode)

    @property
    def is_vector(self) -> bool:
        """Whether the port carries a vector."""
        return isinstance(self.model, int)


@dataclass(slots=True)
class _Tap:
    """A channel and what of it is in the file already: the file's state, not the diagram's.

    Attributes:
        port: where it is looked at.
        topic: see `Channel`.
        encode: makes its messages.
        is_vector: see `Channel`.
        only_new: see `Channel`.
        repeat: see `Channel`.
        stamp: of the last message, s.
        vector: the last one's bytes.
        since: when that was written, s.
    """

    port: InputPort
    topic: str
    encode: Encoder
    is_vector: bool
    only_new: bool
    repeat: float
    stamp: float = math.nan
    vector: bytes = b""
    since: float = -math.inf

    def is_due(self, value: Any, t: float) -> bool:
        """Whether a value is to be written at `t` (s); then it counts as written."""
        if self.is_vector and self.repeat == 0:
            return True
        if self.is_vector:
            now = value.tobytes()
            if now == self.vector and t < self.since + self.repeat - 1e-9:
                return False
            self.vector, self.since = now, t
            return True
        stamp = getattr(value, "stamp", t)
        if math.isnan(stamp) or (self.only_new and stamp == self.stamp):
            return False
        self.stamp = stamp
        return True


def _make_serialiser(channel: Channel, encode: Encoder) -> None:
    """Lets rosbags compile what a type needs now, not when its first message comes."""
    value = np.zeros(channel.model) if channel.is_vector else copy(channel.model)
    with suppress(Exception):  # what says nothing yet may have no message; nothing is written
        message = encode(value, 0.0)
        typestore().serialize_cdr(message, message.__msgtype__)


class Recorder(LeafSystem):
    """Writes what its ports carry into a recording, each at a rate of its own.

    .. pydrake_system::

        name: Recorder
        input_ports:
        - port of the first channel
        - ...
        - port of the last channel

    Args:
        channels: the ports, at least one.
        writer: the recording. Whoever makes it closes it, or calls `close`.
        static: topic to (message type, message), written once when the simulation is initialised,
            and kept for late subscribers: /tf_static, camera_info.

    Ports:
        {channel.port} (input, as channel.model says): what is recorded, with the time of the
            Context as log time. Messages that say nothing yet (a stamp of NaN) are left out.

    It looks in discrete updates, though it has no state, because it is to see what an estimator
    sees that updates at the same moment: messages that arrive then (Drake does unrestricted
    updates first), and of discrete states the values from before. A publish event would miss the
    former, and what is played back would come a step late. So a recording holds for each time what
    was in force then; `systems.io.playback` plays it so. A block that looks in unrestricted updates
    is the exception: played back, a message that arrives at the same moment reaches it a step
    earlier.

    The file is outside of the Context: a recorder has no influence on the simulation. What cannot
    be written, for want of space or because it does not fit its message, is counted in `lost`; the
    first of each kind is logged in one line, and the simulation goes on. That shows when the chunk
    ends, since only then what was looked at is written.

    Raises:
        ValueError: no channel, or two of one port.
    """

    def __init__(
        self,
        *,
        channels: Sequence[Channel],
        writer: BagWriter,
        static: Mapping[str, tuple[str, Any]] | None = None,
    ) -> None:
        super().__init__()
        require(len(channels) > 0, "channels", list(channels), "at least one")
        names = [channel.port for channel in channels]
        require(len(set(names)) == len(names), "channels", names, "of different port names")
        self._writer = writer
        self._static = dict(static or {})
        self._refused = 0
        # Made into ROS messages when a chunk begins, all at once: one after the other, between
        # what else a simulation does, takes twice as long.
        self._waiting: list[tuple[_Tap, Any, float]] = []
        self._chunk_end = -math.inf  # s
        self._warned: set[str] = set()
        groups: dict[float, list[_Tap]] = {}
        for channel in channels:
            port = (
                self.DeclareVectorInputPort(channel.port, channel.model)
                if channel.is_vector
                else self.DeclareAbstractInputPort(channel.port, AbstractValue.Make(channel.model))
            )
            encode = encoder(channel.encode) if isinstance(channel.encode, str) else channel.encode
            tap = _Tap(
                port=port,
                topic=channel.topic,
                encode=encode,
                is_vector=channel.is_vector,
                only_new=channel.only_new,
                repeat=channel.repeat,
            )
            groups.setdefault(channel.rate, []).append(tap)
            _make_serialiser(channel, encode)
        self.DeclareInitializationPublishEvent(self._record_static)
        for rate, group in groups.items():
            self.DeclarePeriodicDiscreteUpdateEvent(period(rate), 0.0, partial(self._record, group))

    @property
    def lost(self) -> int:
        """Messages that were to be recorded and are not in the file; final when it is closed."""
        return self._refused + self._writer.lost

    def close(self) -> None:
        """Writes what is outstanding and closes the recording; a full disk is logged."""
        self._write_waiting()
        try:
            self._writer.close()
        except OSError as error:
            self._warn("disk", f"end of the recording: {error}")

    def _record_static(self, context: Context) -> None:
        # Once, though a simulation may be initialised again.
        static, self._static = self._static, {}
        for topic, (msgtype, message) in static.items():
            self._write(topic, msgtype, message, context.get_time(), latched=True)

    def _record(
        self,
        group: list[_Tap],
        context: Context,
        discrete_state: DiscreteValues,  # noqa: ARG002 - Drake's signature; there is no state
    ) -> None:
        t = context.get_time()
        for tap in group:
            value = tap.port.Eval(context)
            if tap.is_due(value, t):
                # Of a pose Drake shows the one in its cache, which will change.
                kept = value.copy() if tap.is_vector else copy(value)
                self._waiting.append((tap, kept, t))
        if t >= self._chunk_end:
            self._chunk_end = self._writer.chunk_end(t)
            self._write_waiting()

    def _write_waiting(self) -> None:
        waiting, self._waiting = self._waiting, []
        for tap, value, t in waiting:
            try:
                message = tap.encode(value, t)
            except ValueError as error:
                self._refuse(tap.topic, error)
                continue
            self._write(tap.topic, message.__msgtype__, message, t)

    def _write(
        self, topic: str, msgtype: str, message: Any, t: float, latched: bool = False
    ) -> None:
        try:
            self._writer.write(topic, msgtype, message, t, latched=latched)
        except ValueError as error:
            self._refuse(topic, error)
        except OSError as error:
            self._warn("disk", f"recording at {t:.3f} s of the simulation: {error}; it goes on")

    def _refuse(self, topic: str, error: ValueError) -> None:
        self._refused += 1
        self._warn(topic, f"not recorded: {topic}: {error}")

    def _warn(self, kind: str, text: str) -> None:
        if kind not in self._warned:
            self._warned.add(kind)
            _log.warning(text)
