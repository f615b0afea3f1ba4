"""Reads rosbag2 folders of SQLite and ROS 1 bags through `rosbags`."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag2 import Reader as Rosbag2Reader

from systems.io.record import Record
from systems.io.ros_types import deserialise, first_line


class RosbagsSource:
    """The messages of recordings that `rosbags` reads.

    Args:
        paths: rosbag2 folders or SQLite files, or ROS 1 bags.
        ros1: which of the two.

    Attributes:
        topics: topic to message type, in ROS 2's naming.
        truncated: a part cannot be read.

    Raises:
        ValueError: none of them can be read.
    """

    def __init__(self, paths: list[Path], *, ros1: bool) -> None:
        self._ros1 = ros1
        self._open: Callable[[Path], Any] = Rosbag1Reader if ros1 else Rosbag2Reader
        self._paths: list[Path] = []
        self.topics: dict[str, str] = {}
        failure: Exception | None = None
        for path in paths:
            try:
                with self._open(path) as reader:
                    for connection in reader.connections:
                        self.topics.setdefault(connection.topic, connection.msgtype)
                self._paths.append(path)
            except Exception as error:  # a damaged file may trip the reader anywhere
                failure = error
        self.truncated = failure is not None
        if failure is not None and not self._paths:
            raise ValueError(first_line(failure))

    def records(self, topics: Collection[str]) -> Iterator[Record]:
        """Yields the messages of these topics in log-time order."""
        with ExitStack() as stack:
            readers = [stack.enter_context(self._open(path)) for path in self._paths]
            yield from heapq.merge(
                *(self._read(reader, topics) for reader in readers),
                key=lambda record: record.log_time,
            )

    def _read(self, reader: Any, topics: Collection[str]) -> Iterator[Record]:
        connections = [c for c in reader.connections if c.topic in topics]
        if not connections:  # which to rosbags means all of them
            return
        deserialisers = {c.id: self._deserialiser(c) for c in connections}
        messages = reader.messages(connections=connections)
        while True:
            try:
                connection, log_time, data = next(messages)
            except StopIteration:
                return
            except Exception:  # a damaged file may trip the reader anywhere
                self.truncated = True
                return
            yield Record(connection.topic, log_time, data, deserialisers[connection.id])

    def _deserialiser(self, connection: Any) -> Callable[[bytes], Any]:
        is_idl = connection.msgdef.format == MessageDefinitionFormat.IDL
        return partial(
            deserialise,
            msgtype=connection.msgtype,
            text=connection.msgdef.data,
            encoding="idl" if is_idl else "msg",
            ros1=self._ros1,
        )
