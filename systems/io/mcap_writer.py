"""An MCAP file that is complete after every chunk.

The `mcap` package's writer adds the index and the end when it is closed; a process that dies before
leaves a file that most tools refuse. This one writes index and end after every chunk, and the next
chunk over them: chunk, index and end go out in one write, so at almost every moment the file on
disk is a whole one. The price is the index, about 0.2 kB a chunk, written anew each time.

Format: https://mcap.dev/spec. The bytes depend on what is written only.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

MAGIC = b"\x89MCAP0\r\n"
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_MESSAGE_HEADER = 22  # of these, the bytes that count into the record's length


def encode(record: McapRecord) -> bytes:
    """Returns a record's bytes."""
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


class McapWriter:
    """Writes one MCAP file, chunk by chunk.

    Args:
        path: of the new file.
        describe: called with this writer whenever the file's end is written; what it returns is in
            the file as the metadata record "rosbag2".

    Attributes:
        counts: messages of each channel that are on disk, by the channel's id.
        times: first and last log time that are on disk, ns; None when no message is.

    Raises:
        OSError: the file exists or cannot be written.
    """

    def __init__(self, path: Path, *, describe: Callable[[McapWriter], dict[str, str]]) -> None:
        self.counts: dict[int, int] = {}
        self.times: tuple[int, int] | None = None
        self._describe = describe
        self._schemas: list[bytes] = []  # encoded: they are written anew with every end
        self._channels: list[bytes] = []
        self._new: list[bytes] = []  # those that no chunk on disk holds yet
        self._chunk = bytearray()
        self._pending: dict[int, list[int]] = {}  # by channel: log time, offset, log time, ...
        self._index = bytearray()
        self._chunks = 0
        self._end = 0  # where the last chunk ends, and the next one goes
        self._tail = b""
        self._file = path.open("xb", buffering=0)
        head = MAGIC + encode(Header(profile="ros2", library="tagtrail"))
        try:
            self._write(head)
        except OSError:
            self._file.close()
            path.unlink()
            raise

    @property
    def pending(self) -> int:
        """Messages of the chunk that is not on disk yet."""
        return sum(len(entries) for entries in self._pending.values()) // 2

    def add_schema(self, name: str, text: str) -> int:
        """Adds a message definition (`ros2msg`) and returns its id."""
        number = len(self._schemas) + 1
        schema = Schema(id=number, data=text.encode(), encoding="ros2msg", name=name)
        self._schemas.append(encode(schema))
        self._new.append(self._schemas[-1])
        return number

    def add_channel(self, topic: str, schema: int, metadata: dict[str, str]) -> int:
        """Adds a topic and returns its id."""
        number = len(self._channels) + 1
        channel = Channel(
            id=number, topic=topic, message_encoding="cdr", metadata=metadata, schema_id=schema
        )
        self._channels.append(encode(channel))
        self._new.append(self._channels[-1])
        self.counts[number] = 0
        return number

    def add_message(self, channel: int, log_time: int, data: bytes | memoryview) -> None:
        """Adds a message to the chunk.

        Args:
            channel: its id.
            log_time: ns, 0 or later.
            data: CDR.
        """
        entries = self._pending.setdefault(channel, [])
        entries += (log_time, len(self._chunk))
        length = _MESSAGE_HEADER + len(data)
        self._chunk += _MESSAGE.pack(Opcode.MESSAGE, length, channel, 0, log_time, log_time)
        self._chunk += data

    def end_chunk(self) -> None:
        """Writes the chunk, if it holds a message, and the file's end after it.

        Raises:
            OSError: not all could be written. What was on disk before stays readable; the chunk's
                messages are gone.
        """
        before = (dict(self.counts), self.times, len(self._index), self._chunks)
        try:
            if self._pending:
                self._write(self._make_chunk())
                self._new.clear()
            else:
                self._write(b"")
        except OSError:
            self.counts, self.times, index_length, self._chunks = before
            del self._index[index_length:]
            raise
        finally:
            self._chunk.clear()
            self._pending.clear()

    def close(self) -> None:
        """Closes the file; a chunk that was not ended is gone."""
        self._file.close()

    def _make_chunk(self) -> bytes:
        """Returns the chunk and its message indexes, and adds it to the file's index."""
        definitions = b"".join(self._new)
        content = definitions + self._chunk
        times = [t for entries in self._pending.values() for t in entries[::2]]
        start, end = min(times), max(times)
        compressed = zstandard.compress(content, 1)
        records = bytearray(
            encode(
                Chunk(
                    compression="zstd",
                    data=compressed,
                    message_end_time=end,
                    message_start_time=start,
                    uncompressed_crc=zlib.crc32(content),
                    uncompressed_size=len(content),
                )
            )
        )
        length = len(records)
        offsets = {}
        for channel, entries in self._pending.items():
            offsets[channel] = self._end + len(records)
            entries[1::2] = [offset + len(definitions) for offset in entries[1::2]]
            size = 8 * len(entries)
            records += struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + size, channel, size)
            records += struct.pack(f"<{len(entries)}Q", *entries)
            self.counts[channel] += len(entries) // 2
        first, last = self.times or (start, end)
        self.times = (min(first, start), max(last, end))
        self._chunks += 1
        self._index += encode(
            ChunkIndex(
                chunk_length=length,
                chunk_start_offset=self._end,
                compression="zstd",
                compressed_size=len(compressed),
                message_end_time=end,
                message_index_length=len(records) - length,
                message_index_offsets=offsets,
                message_start_time=start,
                uncompressed_size=len(content),
            )
        )
        return bytes(records)

    def _make_tail(self, at: int) -> bytes:
        """Returns all that follows the last chunk, which ends at the offset `at`."""
        metadata = encode(Metadata(name="rosbag2", metadata=self._describe(self)))
        data_end = encode(DataEnd(data_section_crc=0))
        start, end = self.times or (0, 0)
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=self.counts,
            chunk_count=self._chunks,
            message_count=sum(self.counts.values()),
            message_end_time=end,
            message_start_time=start,
            metadata_count=1,
            schema_count=len(self._schemas),
        )
        groups = {
            Opcode.SCHEMA: b"".join(self._schemas),
            Opcode.CHANNEL: b"".join(self._channels),
            Opcode.STATISTICS: encode(statistics),
            Opcode.CHUNK_INDEX: bytes(self._index),
            Opcode.METADATA_INDEX: encode(
                MetadataIndex(offset=at, length=len(metadata), name="rosbag2")
            ),
        }
        summary_start = at + len(metadata) + len(data_end)
        summary, offsets = bytearray(), bytearray()
        for opcode, group in groups.items():
            if group:
                offsets += encode(SummaryOffset(opcode, summary_start + len(summary), len(group)))
                summary += group
        footer = Footer(
            summary_start=summary_start,
            summary_offset_start=summary_start + len(summary),
            summary_crc=0,
        )
        # The checksum covers the summary, and the footer up to the checksum.
        footer.summary_crc = zlib.crc32(encode(footer)[:-4], zlib.crc32(summary + offsets))
        return b"".join([metadata, data_end, summary, offsets, encode(footer), MAGIC])

    def _write(self, records: bytes) -> None:
        tail = self._make_tail(self._end + len(records))
        try:
            self._put(records + tail)
        except OSError:
            # The old tail's place is on the disk already: a full disk takes it back.
            self._put(self._tail)
            raise
        self._end += len(records)
        self._tail = tail

    def _put(self, data: bytes) -> None:
        self._file.seek(self._end)
        view = memoryview(data)
        while view:
            view = view[self._file.write(view) :]
        self._file.truncate()
