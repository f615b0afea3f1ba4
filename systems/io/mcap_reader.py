"""Reads MCAP files, whole or cut off, one chunk at a time.

A whole file is read by its index. One whose end is missing, because the process that wrote it died
or the copy broke off, is scanned from the start as far as it goes. Chunks are found first and
loaded when their time comes, so a recording larger than memory can be read in log-time order.
"""

from __future__ import annotations

import heapq
import os
import struct
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk
from rosbags.typesys.msg import normalize_msgtype

from systems.io.mcap_writer import MAGIC
from systems.io.record import Record
from systems.io.ros_types import deserialise

_HEAD = struct.Struct("<BQ")  # opcode and length of a record
_KINDS: dict[int, Any] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
}
_SERIALISATIONS = ("cdr", "ros1")


@dataclass
class _Index:
    """Where the chunks of a file are and what is in them."""

    path: Path
    complete: bool = True
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[tuple[int, int]] = field(default_factory=list)  # first log time, offset

    def note(self, record: McapRecord) -> None:
        if isinstance(record, Schema):
            self.schemas[record.id] = record
        elif isinstance(record, Channel):
            self.channels[record.id] = record
        elif isinstance(record, Metadata) and record.metadata.get("complete") == "false":
            self.complete = False


class McapSource:
    """The messages of one or several MCAP files.

    Args:
        paths: the files.

    Attributes:
        topics: topic to message type, in ROS 2's naming.
        truncated: something is missing: a file's end was cut off, or a part is damaged.

    Raises:
        ValueError: none of them is an MCAP file.
        OSError: a file cannot be read.
    """

    def __init__(self, paths: list[Path]) -> None:
        found = [_read_index(path) or _scan(path) for path in paths]
        self._indexes = [index for index in found if index is not None]
        if not self._indexes:
            raise ValueError("not an MCAP file")
        self.truncated = not all(index is not None and index.complete for index in found)
        self.topics: dict[str, str] = {}
        for index in self._indexes:
            for channel in index.channels.values():
                if channel.message_encoding in _SERIALISATIONS:
                    self.topics.setdefault(channel.topic, _msgtype(index, channel))

    def records(self, topics: Collection[str]) -> Iterator[Record]:
        """Yields the messages of these topics in log-time order, equal times as in the file."""
        with ExitStack() as stack:
            files = [stack.enter_context(index.path.open("rb")) for index in self._indexes]
            selected = [_select(index, topics) for index in self._indexes]
            chunks = sorted(
                (start, number, offset)
                for number, index in enumerate(self._indexes)
                for start, offset in index.chunks
            )
            waiting: list[tuple[int, int, Record]] = []
            order = 0
            for start, number, offset in chunks:
                while waiting and waiting[0][0] < start:
                    yield heapq.heappop(waiting)[2]
                loaded = _load(files[number], offset)
                if loaded is None:
                    self.truncated = True
                    continue
                for message in loaded[1]:
                    if isinstance(message, Message) and message.channel_id in selected[number]:
                        topic, deserialise = selected[number][message.channel_id]
                        record = Record(topic, message.log_time, message.data, deserialise)
                        heapq.heappush(waiting, (message.log_time, order, record))
                        order += 1
            while waiting:
                yield heapq.heappop(waiting)[2]


def _msgtype(index: _Index, channel: Channel) -> str:
    schema = index.schemas.get(channel.schema_id)
    return normalize_msgtype(schema.name) if schema else ""


def _select(index: _Index, topics: Collection[str]) -> dict[int, tuple[str, Any]]:
    """Returns topic and deserialiser of each channel on these topics, by its id."""
    selected = {}
    for channel in index.channels.values():
        if channel.topic in topics and channel.message_encoding in _SERIALISATIONS:
            schema = index.schemas.get(channel.schema_id)
            selected[channel.id] = (
                channel.topic,
                partial(
                    deserialise,
                    msgtype=_msgtype(index, channel),
                    text=schema.data.decode(errors="replace") if schema else "",
                    encoding="idl" if schema and schema.encoding.endswith("idl") else "msg",
                    ros1=channel.message_encoding == "ros1",
                ),
            )
    return selected


def _read_index(path: Path) -> _Index | None:
    """Returns the index at the file's end; None when there is no sound one."""
    index = _Index(path)
    try:
        with path.open("rb") as file:
            reader = make_reader(file)
            summary = reader.get_summary()
            if summary is None or summary.statistics is None:
                return None
            if summary.statistics.message_count and not summary.chunk_indexes:
                return None  # messages that are in no chunk: only a scan finds them
            for record in (*summary.schemas.values(), *summary.channels.values()):
                index.note(record)
            for metadata in reader.iter_metadata():
                index.note(metadata)
            index.chunks = [
                (chunk.message_start_time, chunk.chunk_start_offset)
                for chunk in summary.chunk_indexes
            ]
    except Exception:  # an index that is not whole may trip its reader anywhere
        return None
    return index


def _scan(path: Path) -> _Index | None:
    """Returns the index of a file whose end is missing, as far as it goes; None: no MCAP file."""
    index = _Index(path)
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            return None
        offset = file.tell()
        while (loaded := _load(file, offset)) is not None:
            opcode, content = loaded
            if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                return index
            for record in content:
                index.note(record)
            times = [record.log_time for record in content if isinstance(record, Message)]
            if times:
                index.chunks.append((min(times), offset))
            offset = file.tell()
    index.complete = False
    return index


def _load(file: BinaryIO, offset: int) -> tuple[int, list[McapRecord]] | None:
    """Reads the record at `offset`, and leaves the file at the next one.

    Returns:
        Its opcode, and the records in it if it is a chunk, else itself; no records if it is of a
        kind that says nothing about messages. None: damaged or cut off.
    """
    file.seek(offset)
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    opcode, length = _HEAD.unpack(head)
    if opcode == 0 or length > os.fstat(file.fileno()).st_size - offset - _HEAD.size:
        return None
    stream = ReadDataStream(BytesIO(file.read(length)))
    try:
        if opcode == Opcode.CHUNK:
            return opcode, breakup_chunk(Chunk.read(stream), validate_crc=True)
        if opcode == Opcode.MESSAGE:
            return opcode, [Message.read(stream, length)]
        kind = _KINDS.get(opcode)
        return opcode, [kind.read(stream)] if kind else []
    except Exception:  # decompressing and parsing damaged bytes may fail in any way
        return None
