"""Reads ROS 1 bags that have no index, because the recorder died or the copy broke off.

`rosbags` wants the index at the file's end. Here the records are read one after the other from the
start, as far as they go. Format: https://wiki.ros.org/Bags/Format/2.0.
"""

from __future__ import annotations

import bz2
import struct
from collections.abc import Callable, Collection, Iterator
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame  # type: ignore[import-untyped]
from rosbags.typesys.msg import normalize_msgtype

from systems.io.record import Record
from systems.io.ros_types import deserialise

MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _CHUNK, _CONNECTION = b"\x02", b"\x05", b"\x07"
_DECOMPRESS: dict[bytes, Callable[[bytes], bytes]] = {
    b"none": bytes,
    b"bz2": bz2.decompress,
    b"lz4": lz4.frame.decompress,
}


class Rosbag1Scan:
    """The messages of a ROS 1 bag without index; they are held in memory.

    Args:
        path: the bag.

    Attributes:
        topics: topic to message type, in ROS 2's naming.
        truncated: always.

    Raises:
        ValueError: it is no ROS 1 bag.
        OSError: it cannot be read.
    """

    truncated = True

    def __init__(self, path: Path) -> None:
        self.topics: dict[str, str] = {}
        connections: dict[int, tuple[str, Callable[[bytes], Any]]] = {}
        self._records: list[Record] = []
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise ValueError("not a ROS 1 bag of version 2.0")
            try:
                for header, data in _records(file):
                    number = int.from_bytes(header.get(b"conn", b""), "little")
                    if header[b"op"] == _CONNECTION:
                        topic, msgtype, text = _connection(header, data)
                        self.topics.setdefault(topic, msgtype)
                        connections[number] = (
                            topic,
                            partial(
                                deserialise, msgtype=msgtype, text=text, encoding="msg", ros1=True
                            ),
                        )
                    elif header[b"op"] == _MESSAGE:
                        sec, nsec = struct.unpack("<II", header[b"time"])
                        topic, function = connections[number]
                        self._records.append(Record(topic, sec * 10**9 + nsec, data, function))
            except Exception:  # the first damaged record ends what can be read, however it fails
                pass
        self._records.sort(key=lambda record: record.log_time)

    def records(self, topics: Collection[str]) -> Iterator[Record]:
        """Yields the messages of these topics in log-time order."""
        return (record for record in self._records if record.topic in topics)


def _connection(header: dict[bytes, bytes], data: bytes) -> tuple[str, str, str]:
    """Returns topic, message type and definition of a connection record."""
    fields = _fields(data)
    return (
        header[b"topic"].decode(),
        normalize_msgtype(fields[b"type"].decode()),
        fields[b"message_definition"].decode(errors="replace"),
    )


def _records(file: BinaryIO) -> Iterator[tuple[dict[bytes, bytes], bytes]]:
    """Yields header and data of each record, those inside of chunks in the chunks' place."""
    while (head := _sized(file)) is not None:
        header = _fields(head)
        data = _sized(file)
        if data is None:
            return
        if header[b"op"] == _CHUNK:
            # A chunk that was still open has the size 0; its records follow at this level.
            yield from _records(BytesIO(_DECOMPRESS[header[b"compression"]](data)))
        else:
            yield header, data


def _sized(file: BinaryIO) -> bytes | None:
    """Reads a length and so many bytes; None when the file ends before."""
    length = file.read(4)
    if len(length) < 4:
        return None
    size = int.from_bytes(length, "little")
    data = file.read(size)
    return data if len(data) == size else None


def _fields(data: bytes) -> dict[bytes, bytes]:
    """Returns a header's fields."""
    fields = {}
    stream = BytesIO(data)
    while (field := _sized(stream)) is not None:
        name, _, value = field.partition(b"=")
        fields[name] = value
    return fields
