"""Sparse optical flow to ROS messages, and back."""

from __future__ import annotations

import dataclasses
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from systems.io.bag import BagReader, BagWriter
from systems.io.playback import read_channel
from systems.io.ros_flow import matches_from_ros, matches_to_ros, serialised_matches
from systems.io.ros_messages import decoder, encoder
from systems.io.ros_types import typestore
from systems.messages import PointMatches, whole_nanoseconds

CLOUD = "sensor_msgs/msg/PointCloud2"


def some(n: int, k: int = 3, start: float = 0.0) -> PointMatches:
    draw = np.random.default_rng(k)
    now, before = (whole_nanoseconds(start + (k - i) / 60) for i in (0, 1))
    previous = draw.uniform(0, 640, (n, 2))
    current = previous + draw.normal(size=(n, 2))
    return PointMatches(now, before, "robot/camera", previous, current)


def over_the_wire(message: Any) -> Any:
    store = typestore()
    return store.deserialize_cdr(bytes(store.serialize_cdr(message, CLOUD)), CLOUD)


def assert_same(a: PointMatches, b: PointMatches) -> None:
    assert (a.stamp, a.previous_stamp, a.frame_id) == (b.stamp, b.previous_stamp, b.frame_id)
    for x, y in ((a.previous, b.previous), (a.current, b.current)):
        assert x.dtype == y.dtype == np.float64
        assert x.shape == y.shape
        assert x.tobytes() == y.tobytes()  # NaN and -0.0 too


@pytest.mark.parametrize("n", [0, 1, 500])
def test_matches_survive_bit_for_bit(n: int) -> None:
    matches = some(n)
    assert_same(matches_from_ros(over_the_wire(matches_to_ros(matches))), matches)


def test_times_since_1970_survive() -> None:
    matches = some(2, start=1_700_000_000.0)
    assert_same(matches_from_ros(over_the_wire(matches_to_ros(matches))), matches)


def test_rubbish_survives_as_it_is() -> None:
    current = np.array([[np.nan, -0.0], [np.inf, 1e300]])
    matches = PointMatches(1.0, 0.5, "c", np.zeros((2, 2)), current)
    assert_same(matches_from_ros(over_the_wire(matches_to_ros(matches))), matches)


def read_by_others(message: Any) -> dict[str, list[float]]:
    """As a stranger reads a cloud: point by point, field by field, with `struct`."""
    kinds = {6: "<I", 8: "<d"}
    return {
        field.name: [
            struct.unpack_from(
                kinds[field.datatype], message.data, k * message.point_step + field.offset
            )[0]
            for k in range(message.width)
        ]
        for field in message.fields
    }


def test_others_read_what_we_mean() -> None:
    matches = PointMatches(
        1.5, 1.25, "camera", np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([[5.0, 6.0], [7.0, 8.0]])
    )
    message = over_the_wire(matches_to_ros(matches))
    assert message.header.frame_id == "camera"
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1, 500_000_000)
    assert (message.height, message.width, message.is_dense) == (1, 2, True)
    assert len(message.data) == message.row_step == 2 * message.point_step
    assert read_by_others(message) == {
        "u": [5.0, 7.0],
        "v": [6.0, 8.0],
        "previous_u": [1.0, 3.0],
        "previous_v": [2.0, 4.0],
        "previous_age": [250_000_000] * 2,
    }


def test_no_matches_are_a_point_that_is_none() -> None:
    message = over_the_wire(matches_to_ros(some(0)))
    assert not message.is_dense  # as clouds say that some points are invalid
    assert np.isnan(read_by_others(message)["u"]).all()


def test_a_cloud_of_other_layout_is_read() -> None:
    # Big-endian, in rows with room at their ends, in single precision, with a field more; ROS 1.
    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types
    field = types["sensor_msgs/msg/PointField"]
    names = ("quality", "previous_age", "previous_v", "previous_u", "v", "u")
    point = struct.Struct(">fIffff")
    rows = [[(0.5, 10**8, 4, 3, 2, 1), (0.6, 10**8, 8, 7, 6, 5)], [(0.7, 10**8, 1, 2, 3, 4)] * 2]
    data = b"".join(b"".join(point.pack(*p) for p in row) + b"room" for row in rows)
    header = types["std_msgs/msg/Header"](1, types["builtin_interfaces/msg/Time"](2, 0), "eye")
    cloud = types[CLOUD](
        header, 2, 2,
        [field(name, 4 * k, 6 if k == 1 else 7, 1) for k, name in enumerate(names)],
        True, point.size, 2 * point.size + 4, np.frombuffer(data, np.uint8), True,
    )  # fmt: skip
    read = store.deserialize_ros1(bytes(store.serialize_ros1(cloud, CLOUD)), CLOUD)
    matches = matches_from_ros(read)
    assert (matches.stamp, matches.previous_stamp, matches.frame_id) == (2.0, 1.9, "eye")
    assert matches.current.tolist() == [[1, 2], [5, 6], [4, 3], [4, 3]]
    assert matches.previous.tolist() == [[3, 4], [7, 8], [2, 1], [2, 1]]


def test_other_clouds_are_refused() -> None:
    message = matches_to_ros(some(3))
    lacking = dataclasses.replace(message, fields=message.fields[:-1])
    short = dataclasses.replace(message, data=message.data[:-1])
    empty = dataclasses.replace(message, width=0, row_step=0, data=message.data[:0])
    strange = dataclasses.replace(message.fields[-1], datatype=9)
    for cloud, said in (
        (dataclasses.replace(message, fields=[*message.fields[:-1], strange]), "datatype of 'prev"),
        (lacking, r"fields is \[.*\]: must be among others 'previous_age'"),
        (short, "data is '107 bytes': must be 1 rows of 3 points of 36 bytes"),
        (empty, "width is 0: must be 1 or more"),
    ):
        with pytest.raises(ValueError, match=said):
            matches_from_ros(cloud)


@pytest.mark.parametrize(
    ("stamps", "said"),
    [
        ((math.nan, 0.0), "time is nan"),
        ((0.0, math.nan), "time is nan"),
        ((1.0, 1.1), "previous_stamp is 1.1: must be up to 4.29 s before 1.0"),
        ((9.0, 1.0), "previous_stamp is 1.0: must be up to"),
    ],
)
def test_what_cannot_be_written_is_refused(stamps: tuple[float, float], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        matches_to_ros(PointMatches(*stamps))
    with pytest.raises(ValueError, match=said):
        serialised_matches(PointMatches(*stamps))


def record(path: Path, *, start: float = 0.0) -> list[PointMatches]:
    written = [some(n, k, start) for k, n in enumerate((0, 7, 300), start=1)]
    with BagWriter(path) as writer:
        for matches in written:
            message = encoder(CLOUD)(matches, 99.0)
            writer.write("/flow", CLOUD, message, matches.stamp)
    return written


def test_rosbags_reads_our_recording(tmp_path: Path) -> None:
    written = record(tmp_path / "bag")
    with AnyReader([tmp_path / "bag"]) as reader:
        (connection,) = reader.connections
        assert connection.msgtype == CLOUD
        read = [
            reader.deserialize(data, connection.msgtype)
            for _, _, data in reader.messages([connection])
        ]
    for matches, message in zip(written, read, strict=True):
        assert_same(matches_from_ros(message), matches)
    assert read_by_others(read[1])["u"] == written[1].current[:, 0].tolist()


@pytest.mark.parametrize("start", [0.0, 1_700_000_000.0])
def test_what_is_played_back_is_what_was_recorded(tmp_path: Path, start: float) -> None:
    written = record(tmp_path / "bag", start=start)
    entries = read_channel(BagReader(tmp_path / "bag"), "/flow", origin=start)
    for matches, entry in zip(written, entries, strict=True):
        played = entry.value
        # Both stamps count from the origin: what lies between two pictures does not change.
        assert played.stamp == whole_nanoseconds(matches.stamp - start)
        assert played.previous_stamp == whole_nanoseconds(matches.previous_stamp - start)
        assert played.current.tobytes() == matches.current.tobytes()
    assert decoder(CLOUD) is matches_from_ros


@pytest.mark.parametrize("n", [0, 1, 2, 7])
def test_the_bytes_are_those_of_rosbags(n: int) -> None:
    whole = some(n, start=1_700_000_000.0)
    torn = dataclasses.replace(whole, current=np.where(whole.current < 200, np.nan, whole.current))
    for length in range(9):  # of the frame's name: it moves all that follows
        for matches in (whole, torn):
            named = dataclasses.replace(matches, frame_id="ä" + "x" * length)
            written = serialised_matches(named)
            assert written.__msgtype__ == CLOUD
            assert written.data == bytes(typestore().serialize_cdr(matches_to_ros(named), CLOUD))
