"""Recordings: writes rosbag2 folders (MCAP), reads those, rosbag2 of SQLite, and ROS 1 bags."""

from __future__ import annotations

import json
import os
import textwrap
import time
from collections.abc import Collection, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

from systems.io import mcap_writer, rosbag1_scan
from systems.io.mcap_reader import McapSource
from systems.io.mcap_writer import McapWriter
from systems.io.record import Record
from systems.io.ros_types import definition, first_line, nanoseconds, seconds, typestore
from systems.io.rosbag1_scan import Rosbag1Scan
from systems.io.rosbags_reader import RosbagsSource
from systems.io.stencils import SerialisedMessage
from systems.validation import nearest, require, require_positive

# Reliable, and kept for subscribers that come later, as tf2_ros offers /tf_static. The numbers are
# rmw's, as metadata of version 5 (Humble) has them: later distributions read that version too,
# Humble does not read theirs.
_LATCHED = """\
- history: 1
  depth: 1
  reliability: 1
  durability: 1
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: 1
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false"""
_METADATA_VERSION = 5
_METADATA_PERIOD = 1.0  # s


class BagWriter:
    """Writes a rosbag2 folder: `{folder name}_0.mcap` and `metadata.yaml`.

    Every second of log time ends a chunk, which goes to the operating system at once with the
    file's index. So a process that is killed leaves a whole recording up to the start of that
    second, for our reader and for others. `metadata.yaml` beside it is replaced, in one step, when
    a topic is new, and else at most once a second, of the clock on the wall: a simulation would do
    it forty times. The disk is not waited for (no fsync). The same messages give the same bytes.

    Args:
        folder: is made; must not hold a recording.
        chunk_seconds: log time in a chunk, s.

    Attributes:
        folder: as given.
        lost: messages that could not be written.

    Raises:
        ValueError: the folder holds a recording already or cannot be written; chunk_seconds out of
            range.
    """

    def __init__(self, folder: Path, *, chunk_seconds: float = 1.0) -> None:
        require_positive(chunk_seconds=chunk_seconds)
        self.folder = Path(folder)
        self.lost = 0
        self._chunk_length = nanoseconds(chunk_seconds)
        require(self._chunk_length > 0, "chunk_seconds", chunk_seconds, "1 ns or more")
        self._chunk: int | None = None  # which multiple of the length is being filled
        self._topics: dict[str, tuple[int, str, str]] = {}  # channel id, message type, QoS
        self._schemas: dict[str, int] = {}
        self._closed = False
        self._metadata = ""
        self._described = 0  # topics in `metadata.yaml`
        self._due = 0.0  # when that is written again, s
        self.path = self.folder / f"{self.folder.resolve().name}_0.mcap"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            held = sorted(p.name for p in self.folder.iterdir() if _is_recording(p))
            if held:
                raise ValueError(f"recording folder {folder} holds a recording already: {held[0]}")
            self._mcap = McapWriter(self.path, describe=self._describe)
        except OSError as error:
            raise ValueError(f"recording folder {folder}: {error.strerror}") from error
        try:
            self._write_metadata()
        except OSError as error:
            self._mcap.close()
            self.path.unlink()
            raise ValueError(f"recording folder {folder}: {error.strerror}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def write(
        self, topic: str, msgtype: str, message: Any, log_time: float, *, latched: bool = False
    ) -> None:
        """Writes a message.

        Args:
            topic: where it is published; a new one is added.
            msgtype: in ROS 2's naming, such as `geometry_msgs/msg/Twist`.
            message: of that type, made by `systems.io.ros_messages`, or serialised already.
            log_time: s, 0 or later.
            latched: for a new topic: late subscribers get its last message, as with /tf_static.

        Raises:
            ValueError: closed; log time out of range; the topic has another type; the message does
                not fit its type.
            OSError: the chunk before this message could not be written: its messages are lost,
                what was on disk stays readable. This message goes into the next chunk.
        """
        require(not self._closed, "recording", str(self.folder), "open")
        moment = nanoseconds(log_time)
        require(moment >= 0, "log_time", log_time, "0 or later")
        channel, known, _ = self._topics.get(topic) or self._add(topic, msgtype, latched)
        if msgtype != known:
            require(False, f"type of {topic}", msgtype, f"{known} as before")
        data = _serialised(topic, msgtype, message)
        failure: OSError | None = None
        if (chunk := moment // self._chunk_length) != self._chunk:
            self._chunk = chunk
            try:
                self.flush()
            except OSError as error:
                failure = error
        self._mcap.add_message(channel, moment, data)
        if failure is not None:
            raise failure

    def chunk_end(self, log_time: float) -> float:
        """Returns when (s) the chunk ends that a message of this time (s) goes into."""
        return seconds((nanoseconds(log_time) // self._chunk_length + 1) * self._chunk_length)

    def flush(self) -> None:
        """Ends the chunk and writes it.

        Raises:
            OSError: it could not be written; see `write`.
        """
        pending = self._mcap.pending
        try:
            self._mcap.end_chunk()
        except OSError as error:
            self.lost += pending
            raise OSError(error.errno, error.strerror, str(self.path)) from error
        described = len(self._topics)
        now = time.monotonic()
        if self._closed or described != self._described or now >= self._due:
            self._write_metadata()
            self._described, self._due = described, now + _METADATA_PERIOD

    def close(self) -> None:
        """Writes the last chunk and closes the file; again: does nothing.

        Raises:
            OSError: the chunk could not be written; the file is closed all the same.
        """
        if self._closed:
            return
        self._closed = True
        try:
            self.flush()
        finally:
            self._mcap.close()

    def _add(self, topic: str, msgtype: str, latched: bool) -> tuple[int, str, str]:
        if msgtype not in typestore().fielddefs:
            raise ValueError(
                f"message type is {msgtype!r}: unknown; {nearest(msgtype, typestore().fielddefs)}"
            )
        if msgtype not in self._schemas:
            self._schemas[msgtype] = self._mcap.add_schema(msgtype, definition(msgtype))
        qos = _LATCHED if latched else ""
        channel = self._mcap.add_channel(
            topic, self._schemas[msgtype], {"offered_qos_profiles": qos}
        )
        self._topics[topic] = (channel, msgtype, qos)
        return self._topics[topic]

    def _describe(self, mcap: McapWriter) -> dict[str, str]:
        """Makes the metadata of what is on disk, which is in the file as well as beside it."""
        start, end = mcap.times or (0, 0)
        count = sum(mcap.counts.values())
        span = [
            f"starting_time:\n  nanoseconds_since_epoch: {start}",
            f"duration:\n  nanoseconds: {end - start}",
            f"message_count: {count}",
        ]
        topics = [
            f"- topic_metadata:\n    name: {json.dumps(topic)}\n    type: {msgtype}\n"
            f"    serialization_format: cdr\n    offered_qos_profiles: {json.dumps(qos)}\n"
            f"  message_count: {mcap.counts[channel]}"
            for topic, (channel, msgtype, qos) in self._topics.items()
        ]
        name = json.dumps(self.path.name)
        file = textwrap.indent("\n".join([f"path: {name}", *span]), "  ")
        self._metadata = "\n".join(
            [
                f"version: {_METADATA_VERSION}",
                "storage_identifier: mcap",
                *span,
                "topics_with_message_count:" + ("" if topics else " []"),
                *topics,
                'compression_format: ""',
                'compression_mode: ""',
                f"relative_file_paths:\n- {name}",
                f"files:\n- {file.lstrip()}",
            ]
        )
        return {
            "serialized_metadata": self._metadata,
            # Ours: whether the recording was closed or its process died.
            "complete": "true" if self._closed else "false",
        }

    def _write_metadata(self) -> None:
        text = "rosbag2_bagfile_information:\n" + textwrap.indent(self._metadata, "  ") + "\n"
        path = self.folder / "metadata.yaml"
        fresh = path.with_suffix(".yaml.new")
        try:
            fresh.write_text(text)
            os.replace(fresh, path)
        except OSError:
            fresh.unlink(missing_ok=True)
            raise


class _Source(Protocol):
    topics: dict[str, str]
    truncated: bool

    def records(self, topics: Collection[str]) -> Iterator[Record]: ...


class BagReader:
    """Reads a recording, by others or by us, whole or cut off.

    Takes rosbag2 folders and single files of MCAP (compressed by zstd, lz4 or not at all) and of
    SQLite, and ROS 1 bags. What it is shows in the file, not in its name. An MCAP or ROS 1 file
    whose end is missing is read as far as it goes.

    Args:
        path: folder or file.

    Attributes:
        path: as given.
        start: log time of the first message, s.

    Raises:
        ValueError: there is nothing at the path, it is no recording, or no message in it can be
            found; one line that names the path and what is wrong.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        try:
            self._source = _open(self.path)
            first = next(self.records(), None)
        except OSError as error:
            raise ValueError(f"recording {path}: {error.strerror}") from error
        except ValueError as error:
            raise ValueError(f"recording {path}: {error}") from error
        if first is None:
            what = "cut off before the first message" if self.truncated else "holds no message"
            raise ValueError(f"recording {path}: {what}")
        self.start = seconds(first.log_time)

    @property
    def truncated(self) -> bool:
        """Whether something is missing: the end, or a damaged part met so far."""
        return self._source.truncated

    def topics(self) -> dict[str, str]:
        """Returns topic to message type, in ROS 2's naming."""
        return dict(self._source.topics)

    def records(self, topics: Collection[str] | None = None) -> Iterator[Record]:
        """Returns the messages in log-time order, not deserialised.

        Args:
            topics: only these; all when None.

        Raises:
            ValueError: the recording has no such topic.
        """
        known = self._source.topics
        for topic in topics or ():
            require(topic in known, "topic", topic, f"in the recording; {nearest(topic, known)}")
        return self._source.records(set(known if topics is None else topics))

    def messages(self, topics: Collection[str] | None = None) -> Iterator[tuple[str, float, Any]]:
        """Yields (topic, log time (s), message) in log-time order.

        A float keeps times since 1970 to a quarter of a microsecond; `records` has them exactly.

        Args:
            topics: only these; all when None.

        Raises:
            ValueError: the recording has no such topic, or a message does not fit its definition.
        """
        for record in self.records(topics):
            try:
                message = record.message()
            except ValueError as error:
                raise ValueError(f"recording {self.path}: {error}") from error
            yield record.topic, seconds(record.log_time), message


def _serialised(topic: str, msgtype: str, message: Any) -> bytes | memoryview:
    if isinstance(message, SerialisedMessage) and message.__msgtype__ == msgtype:
        return message.data
    try:
        return typestore().serialize_cdr(message, msgtype)
    except Exception as error:  # whatever a wrong field trips in the compiled serialiser
        raise ValueError(f"message on {topic} is no {msgtype}: {first_line(error)}") from error


def _is_recording(path: Path) -> bool:
    return path.name == "metadata.yaml" or path.suffix in (".mcap", ".db3", ".bag")


def _open(path: Path) -> _Source:
    if path.is_dir():
        mcap = sorted(path.glob("*.mcap"))
        if mcap:
            return McapSource(mcap)
        if (path / "metadata.yaml").exists():
            return RosbagsSource([path], ros1=False)
        sqlite = sorted(path.glob("*.db3"))
        if sqlite:
            return RosbagsSource(sqlite, ros1=False)
        raise ValueError("no recording in this folder")
    with path.open("rb") as file:
        head = file.read(16)
    if not head:
        raise ValueError("empty file")
    if head.startswith(mcap_writer.MAGIC):
        return McapSource([path])
    if head.startswith(rosbag1_scan.MAGIC):
        try:
            return RosbagsSource([path], ros1=True)
        except ValueError:
            return Rosbag1Scan(path)
    if head.startswith(b"SQLite format 3"):
        return RosbagsSource([path], ros1=False)
    raise ValueError("not a recording (MCAP, rosbag2 or ROS 1 bag)")
