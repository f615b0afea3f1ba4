"""Recordings: written and read back, read by others, cut off, killed, on a full disk."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import zlib
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from mcap.data_stream import ReadDataStream
from mcap.reader import make_reader
from mcap.records import Chunk, Message, MessageIndex
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from pydrake.math import RigidTransform
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability
from ruamel.yaml import YAML

from systems.io import ros_motion, ros_vision
from systems.io.bag import BagReader, BagWriter
from systems.io.ros_motion import FrameTransform
from systems.messages import CameraImage, Detections

ROOT = Path(__file__).resolve().parents[3]
IMU = "sensor_msgs/msg/Imu"
TWIST = "geometry_msgs/msg/Twist"


def imu(k):
    sample = np.random.default_rng(k).normal(size=6)
    return ros_motion.imu_to_ros(sample, stamp=k / 100, frame_id="imu")


def write_run(folder, seconds=3.5, close=True):
    """A run as a robot records it; returns what was written and the writer."""
    writer = BagWriter(folder)
    written = []

    def write(topic, message, t, latched=False):
        writer.write(topic, message.__msgtype__, message, t, latched=latched)
        written.append((topic, round(t * 1e9) / 1e9, message))

    world = FrameTransform(0.0, "map", "odom", RigidTransform([1, 2, 3]))
    write("/tf_static", ros_motion.transforms_to_ros([world]), 0.0, latched=True)
    rng = np.random.default_rng(0)
    for k in range(round(seconds * 100)):
        t = k * 0.01  # as a simulator counts: 0.35000000000000003, ...
        write("/imu", imu(k), t)
        if k % 10 == 0:
            write("/cmd_vel", ros_motion.command_to_ros(rng.normal(size=2)), t)
        if k % 20 == 0:
            picture = rng.integers(0, 256, (12, 16), dtype=np.uint8)
            write("/image", ros_vision.image_to_ros(CameraImage(t, "front", picture)), t)
            found = Detections(
                stamp=t,
                family="tag36h11",
                ids=np.arange(3),
                corners=rng.normal(size=(3, 4, 2)),
                hamming=np.zeros(3, int),
                decision_margin=np.ones(3),
            )
            write("/tags", ros_vision.detections_to_ros(found), t)
    if close:
        writer.close()
    return written, writer


def plain(value):
    """A message as nested tuples that compare by value."""
    if hasattr(value, "__msgtype__"):
        fields = vars(value)
        return (value.__msgtype__, *((name, plain(fields[name])) for name in sorted(fields)))
    if isinstance(value, np.ndarray):
        return (value.dtype.str, value.tobytes())
    if isinstance(value, list | tuple):
        return tuple(plain(entry) for entry in value)
    return value


def assert_same(read, written):
    assert len(read) == len(written)
    for (topic, t, message), (topic_w, t_w, message_w) in zip(read, written, strict=True):
        assert (topic, t) == (topic_w, t_w)
        assert plain(message) == plain_float32(message_w)


def plain_float32(message):
    # The one field type that a message rounds.
    for entry in getattr(message, "detections", ()):
        entry.decision_margin = float(np.float32(entry.decision_margin))
    return plain(message)


def folder_bytes(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


# Written and read back


def test_what_was_written_is_read_back(tmp_path):
    written, _ = write_run(tmp_path / "bag")
    reader = BagReader(tmp_path / "bag")
    assert reader.topics() == {
        "/tf_static": "tf2_msgs/msg/TFMessage",
        "/imu": IMU,
        "/cmd_vel": TWIST,
        "/image": "sensor_msgs/msg/CompressedImage",
        "/tags": "apriltag_msgs/msg/AprilTagDetectionArray",
    }
    assert not reader.truncated
    assert reader.start == 0.0
    assert_same(list(reader.messages()), written)
    assert_same(list(reader.messages()), written)  # and again
    assert_same(list(BagReader(tmp_path / "bag" / "bag_0.mcap").messages()), written)
    some = [entry for entry in written if entry[0] in ("/tags", "/cmd_vel")]
    assert_same(list(reader.messages(["/tags", "/cmd_vel"])), some)


def test_the_log_time_is_the_float_of_the_nearest_nanosecond(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        writer.write("/imu", IMU, imu(0), 0.1 + 0.2)
    [(_, t, _)] = BagReader(tmp_path / "bag").messages()
    assert 0.1 + 0.2 != 0.3
    assert t == 0.3


def test_messages_come_in_log_time_order_whatever_the_order_of_writing(tmp_path):
    times = np.random.default_rng(1).permutation(np.arange(400) / 100).tolist()
    with BagWriter(tmp_path / "bag") as writer:
        for t in times:
            writer.write("/imu", IMU, imu(round(t * 100)), t)
    read = list(BagReader(tmp_path / "bag").messages())
    assert [t for _, t, _ in read] == sorted(times)
    assert all(m.header.stamp.nanosec == round(t % 1 * 1e9) for _, t, m in read)


def test_messages_of_one_time_stay_in_the_order_of_writing(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        for k in range(50):
            writer.write(f"/topic_{k % 7}", IMU, imu(k), k // 10)
    read = list(BagReader(tmp_path / "bag").messages())
    assert [plain(m) for _, _, m in read] == [plain(imu(k)) for k in range(50)]


# By others


def test_rosbags_reads_the_same_messages(tmp_path):
    written, _ = write_run(tmp_path / "bag")
    with AnyReader([tmp_path / "bag"]) as reader:
        read = [
            (connection.topic, t / 1e9, reader.deserialize(data, connection.msgtype))
            for connection, t, data in reader.messages()
        ]
        durability = {
            connection.topic: [qos.durability for qos in connection.ext.offered_qos_profiles]
            for connection in reader.connections
        }
        assert reader.message_count == len(written)
        assert (reader.start_time, reader.end_time) == (0, 3_490_000_001)
        assert reader.topics["/imu"].msgcount == 350
    assert_same(read, written)
    assert durability["/tf_static"] == [QosDurability.TRANSIENT_LOCAL]
    assert durability["/imu"] == []


def test_the_mcap_package_reads_the_same_messages(tmp_path):
    written, _ = write_run(tmp_path / "bag")
    path = tmp_path / "bag" / "bag_0.mcap"
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        by_index = [(c.topic, m.log_time, m.data) for _, c, m in reader.iter_messages()]
        statistics = reader.get_summary().statistics
    records = [(r.topic, r.log_time, r.data) for r in BagReader(path).records()]
    assert by_index == records
    assert statistics.message_count == len(written)
    assert statistics.chunk_count == 4
    with path.open("rb") as file:  # from start to end, without the index
        kinds = [type(r).__name__ for r in StreamReader(file, validate_crcs=True).records]
    assert kinds.count("Message") == len(written)
    assert kinds.count("Schema") == kinds.count("Channel") == 2 * 5  # in a chunk, in the summary
    assert kinds[-1] == "Footer"


def test_the_index_points_at_every_message(tmp_path):
    write_run(tmp_path / "bag")
    data = (tmp_path / "bag" / "bag_0.mcap").read_bytes()
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()

    def record_at(content, offset):
        """The record's body as a stream, and its length."""
        length = int.from_bytes(content[offset + 1 : offset + 9], "little")
        return ReadDataStream(BytesIO(content[offset + 9 : offset + 9 + length])), length

    found = 0
    for chunk_index in summary.chunk_indexes:
        chunk = Chunk.read(record_at(data, chunk_index.chunk_start_offset)[0])
        content = get_chunk_data_stream(chunk, validate_crc=True)[0].read(chunk.uncompressed_size)
        for channel, offset in chunk_index.message_index_offsets.items():
            index = MessageIndex.read(record_at(data, offset)[0])
            assert index.channel_id == channel
            for log_time, where in index.records:
                message = Message.read(*record_at(content, where))
                assert (message.channel_id, message.log_time) == (channel, log_time)
                found += 1
    assert found == summary.statistics.message_count


def test_the_metadata_follows_new_topics_at_once_and_messages_in_seconds(tmp_path, monkeypatch):
    clock = [100.0]
    monkeypatch.setattr("systems.io.bag.time.monotonic", lambda: clock[0])

    def said() -> dict[str, int]:
        text = (tmp_path / "bag" / "metadata.yaml").read_text()
        info = YAML(typ="safe").load(text)["rosbag2_bagfile_information"]
        topics = info["topics_with_message_count"]
        return {t["topic_metadata"]["name"]: t["message_count"] for t in topics}

    with BagWriter(tmp_path / "bag") as writer:

        def write(topic: str, t: float) -> None:
            message = ros_motion.imu_to_ros(np.zeros(6), stamp=t, frame_id="imu")
            writer.write(topic, IMU, message, t)

        for k in range(4):  # a chunk each
            write("/imu", float(k))
        assert said() == {"/imu": 0}  # since its first message: no chunk was at its end
        write("/other", 3.5)
        write("/imu", 4.0)
        assert said() == {"/imu": 4, "/other": 1}
        write("/imu", 5.0)
        assert said() == {"/imu": 4, "/other": 1}
        clock[0] += 1.0
        write("/imu", 6.0)
        assert said() == {"/imu": 6, "/other": 1}
    assert said() == {"/imu": 7, "/other": 1}


def test_the_metadata_says_what_ros_2_wants(tmp_path):
    written, _ = write_run(tmp_path / "bag")
    document = YAML(typ="safe").load((tmp_path / "bag" / "metadata.yaml").read_text())
    info = document["rosbag2_bagfile_information"]
    assert info["version"] == 5  # Humble's; later distributions read it
    assert info["storage_identifier"] == "mcap"
    assert info["relative_file_paths"] == ["bag_0.mcap"]
    assert info["message_count"] == len(written)
    assert info["duration"] == {"nanoseconds": 3_490_000_000}
    assert info["starting_time"] == {"nanoseconds_since_epoch": 0}
    assert (info["compression_format"], info["compression_mode"]) == ("", "")
    assert info["files"] == [
        {
            "path": "bag_0.mcap",
            "starting_time": info["starting_time"],
            "duration": info["duration"],
            "message_count": len(written),
        }
    ]
    topics = {t["topic_metadata"]["name"]: t for t in info["topics_with_message_count"]}
    assert topics["/imu"]["message_count"] == 350
    assert topics["/imu"]["topic_metadata"]["type"] == IMU
    assert topics["/imu"]["topic_metadata"]["serialization_format"] == "cdr"
    [latched] = YAML(typ="safe").load(
        topics["/tf_static"]["topic_metadata"]["offered_qos_profiles"]
    )
    assert (latched["durability"], latched["reliability"]) == (1, 1)  # rmw's numbers


def test_the_checksum_of_the_summary_is_right(tmp_path):
    write_run(tmp_path / "bag")
    data = (tmp_path / "bag" / "bag_0.mcap").read_bytes()
    # The footer's record: opcode, length, start of the summary, of its offsets, checksum; magic.
    footer = data[-37:]
    assert footer[0] == 2
    start = int.from_bytes(footer[9:17], "little")
    assert int.from_bytes(footer[25:29], "little") == zlib.crc32(data[start:-12])


def test_two_equal_runs_give_equal_bytes(tmp_path):
    write_run(tmp_path / "one" / "bag")
    write_run(tmp_path / "two" / "bag")
    assert folder_bytes(tmp_path / "one" / "bag") == folder_bytes(tmp_path / "two" / "bag")


# The process dies


def test_an_open_recording_is_whole_up_to_the_last_second_for_everyone(tmp_path):
    written, writer = write_run(tmp_path / "bag", close=False)
    on_disk = [entry for entry in written if entry[1] < 3.0]
    reader = BagReader(tmp_path / "bag")
    assert_same(list(reader.messages()), on_disk)
    assert reader.truncated
    with AnyReader([tmp_path / "bag"]) as others:
        assert sum(1 for _ in others.messages()) == len(on_disk)
    assert not list((tmp_path / "bag").glob("*.new"))
    writer.close()
    assert not BagReader(tmp_path / "bag").truncated


KILLED = """
    import sys, time
    from pathlib import Path
    import numpy as np
    from systems.io.bag import BagWriter
    from systems.io.ros_motion import imu_to_ros

    writer = BagWriter(Path(sys.argv[1]))
    k = 0
    while True:
        message = imu_to_ros(np.full(6, float(k)), stamp=k / 100, frame_id="imu")
        writer.write("/imu", "sensor_msgs/msg/Imu", message, k / 100)
        k += 1
        if k % 100 == 50:
            print(k, flush=True)
"""


@pytest.mark.parametrize("moment", [1, 7, 40])
def test_a_killed_process_leaves_all_but_the_last_second(tmp_path, moment):
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(KILLED), str(tmp_path / "bag")],
        stdout=subprocess.PIPE,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        text=True,
    )
    with process:
        for _ in range(moment):
            reached = int(process.stdout.readline())
        process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    expected = (reached - 50) // 100 * 100  # whole seconds before the last report
    try:
        reader = BagReader(tmp_path / "bag")
    except ValueError:
        assert expected == 0
        return
    read = list(reader.messages())
    assert len(read) >= expected
    assert len(read) % 100 == 0
    for k, (topic, t, message) in enumerate(read):
        assert (topic, t, message.linear_acceleration.z) == ("/imu", k / 100, float(k))


def test_a_process_killed_while_it_writes_loses_that_chunk_only(tmp_path):
    """The next chunk is written over the old index: any part of it may have got to the disk."""
    path = tmp_path / "bag" / "bag_0.mcap"
    written, writer = write_run(tmp_path / "bag", seconds=2.5, close=False)
    before = path.read_bytes()
    writer.flush()
    after = path.read_bytes()
    writer.close()
    end = next(i for i, (a, b) in enumerate(zip(before, after, strict=False)) if a != b)
    first_two = [entry for entry in written if entry[1] < 2.0]
    torn = tmp_path / "torn.mcap"
    rng = np.random.default_rng(0)
    for reached in [end + 1, *rng.integers(end, len(after), 40).tolist()]:
        torn.write_bytes(after[:reached] + before[reached:])
        reader = BagReader(torn)
        read = list(reader.messages())
        assert len(read) in (len(first_two), len(written))
        assert_same(read, written[: len(read)])
        assert reader.truncated


# Cut off


def test_a_recording_cut_anywhere_gives_a_prefix_or_says_why_not(tmp_path):
    written, _ = write_run(tmp_path / "bag")
    data = (tmp_path / "bag" / "bag_0.mcap").read_bytes()
    path = tmp_path / "cut.mcap"
    cuts = np.random.default_rng(5).integers(0, len(data), 120).tolist()
    lengths = set()
    for cut in [*cuts, 0, 1, 8, len(data) - 1]:
        path.write_bytes(data[:cut])
        try:
            reader = BagReader(path)
        except ValueError as error:
            reason = str(error)
            assert str(path) in reason
            assert "\n" not in reason
            lengths.add(0)
            continue
        read = list(reader.messages())
        assert_same(read, written[: len(read)])
        assert reader.truncated or len(read) == len(written)
        lengths.add(len(read))
    assert len(lengths) == 5  # 0 to 4 chunks: all cases occurred


def test_a_damaged_chunk_is_left_out_and_said(tmp_path):
    written, _ = write_run(tmp_path / "bag")
    path = tmp_path / "bag" / "bag_0.mcap"
    with path.open("rb") as file:
        second = make_reader(file).get_summary().chunk_indexes[1]
    data = bytearray(path.read_bytes())
    data[second.chunk_start_offset + second.chunk_length // 2] ^= 0x40
    path.write_bytes(data)
    reader = BagReader(path)
    assert_same(list(reader.messages()), [e for e in written if not 1.0 <= e[1] < 2.0])
    assert reader.truncated


def test_random_damage_never_raises_anything_else(tmp_path):
    write_run(tmp_path / "bag")
    data = (tmp_path / "bag" / "bag_0.mcap").read_bytes()
    rng = np.random.default_rng(6)
    path = tmp_path / "damaged.mcap"
    for _ in range(150):
        damaged = bytearray(data)
        for place in rng.integers(0, len(data), rng.integers(1, 20)).tolist():
            damaged[place] = int(rng.integers(0, 256))
        path.write_bytes(damaged)
        try:
            for _ in BagReader(path).messages():
                pass
        except ValueError as error:
            reason = str(error)
            assert str(path) in reason


# Nothing to read


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("empty.mcap", b"", "empty file"),
        ("text.bag", b"hello, this is no recording\n", "not a recording"),
        ("noise.db3", bytes(range(256)) * 10, "not a recording"),
        ("magic.mcap", b"\x89MCAP0\r\n", "cut off before the first message"),
        ("zeros.mcap", b"\x89MCAP0\r\n" + bytes(1000), "cut off before the first message"),
        ("magic.bag", b"#ROSBAG V2.0\n", "cut off before the first message"),
        ("sqlite.db3", b"SQLite format 3\0" + bytes(100), "Cannot open database"),
    ],
)
def test_what_is_no_recording_says_so_in_one_line(tmp_path, name, content, reason):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ValueError, match=reason) as caught:
        BagReader(path)
    assert str(caught.value).startswith(f"recording {path}: ")
    assert "\n" not in str(caught.value)


def test_a_path_without_a_recording_says_so(tmp_path):
    with pytest.raises(ValueError, match="No such file"):
        BagReader(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="no recording in this folder"):
        BagReader(tmp_path)
    BagWriter(tmp_path / "bag").close()
    with pytest.raises(ValueError, match="holds no message"):
        BagReader(tmp_path / "bag")


def test_an_unknown_topic_names_the_nearest(tmp_path):
    write_run(tmp_path / "bag")
    with pytest.raises(ValueError, match="did you mean '/image'"):
        BagReader(tmp_path / "bag").records(["/imge"])


# Refused when writing


def test_a_folder_that_holds_a_recording_is_not_overwritten(tmp_path):
    write_run(tmp_path / "bag")
    before = folder_bytes(tmp_path / "bag")
    with pytest.raises(ValueError, match=r"holds a recording already: bag_0\.mcap"):
        BagWriter(tmp_path / "bag")
    assert folder_bytes(tmp_path / "bag") == before


def test_a_folder_that_cannot_be_written_says_so_in_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "bag"):
        with pytest.raises(ValueError, match=f"recording folder {folder}: ") as caught:
            BagWriter(folder)
        assert "\n" not in str(caught.value)


def test_messages_that_do_not_fit_are_refused(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        writer.write("/imu", IMU, imu(0), 0.0)
        with pytest.raises(ValueError, match="type of /imu"):
            writer.write("/imu", TWIST, ros_motion.command_to_ros(np.zeros(2)), 0.0)
        with pytest.raises(ValueError, match="message type is 'sensor_msgs/msg/Imo'"):
            writer.write("/imo", "sensor_msgs/msg/Imo", imu(0), 0.0)
        with pytest.raises(ValueError, match="message on /imu is no"):
            writer.write("/imu", IMU, ros_motion.command_to_ros(np.zeros(2)), 0.0)
        for t in (-0.1, float("nan")):
            with pytest.raises(ValueError, match="time is"):
                writer.write("/imu", IMU, imu(0), t)
    with pytest.raises(ValueError, match="must be open"):
        writer.write("/imu", IMU, imu(0), 0.0)
    assert len(list(BagReader(tmp_path / "bag").messages())) == 1
    with pytest.raises(ValueError, match="chunk_seconds"):
        BagWriter(tmp_path / "other", chunk_seconds=0.0)


# A full disk

FULL = """
    import resource, sys
    from pathlib import Path
    import numpy as np
    from systems.io.bag import BagWriter
    from systems.io.ros_motion import imu_to_ros

    writer = BagWriter(Path(sys.argv[1]))
    noise = np.random.default_rng(0)
    failures = []
    for k in range(2000):
        if k == 950:  # room for a bit of the next chunk only
            size = writer.path.stat().st_size + 300
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
        if k == 1450:  # there is room again
            resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)
        message = imu_to_ros(noise.normal(size=6), stamp=k / 100, frame_id="imu")
        try:
            writer.write("/imu", "sensor_msgs/msg/Imu", message, k / 100)
        except OSError as error:
            failures.append(str(error))
            if k == int(sys.argv[2]):
                break
    else:
        writer.close()
    print(writer.lost)
    print("\\n".join(failures))
"""


def run_on_a_full_disk(folder, stop_at):
    result = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(FULL), str(folder), str(stop_at)],
        capture_output=True,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        text=True,
        check=True,
        timeout=60,
    )
    lost, *failures = result.stdout.splitlines()
    return int(lost), failures


def read_seconds(folder):
    return sorted({int(t) for _, t, _ in BagReader(folder).messages()})


def test_a_full_disk_costs_the_chunks_that_do_not_fit_only(tmp_path):
    lost, failures = run_on_a_full_disk(tmp_path / "bag", stop_at=-1)
    assert len(failures) == 5
    assert all("File too large" in line and "bag_0.mcap" in line for line in failures)
    assert lost == 500
    assert read_seconds(tmp_path / "bag") == [*range(9), *range(14, 20)]
    assert not BagReader(tmp_path / "bag").truncated
    with AnyReader([tmp_path / "bag"]) as others:
        assert sum(1 for _ in others.messages()) == 1500


def test_after_a_full_disk_what_was_written_before_is_whole(tmp_path):
    lost, failures = run_on_a_full_disk(tmp_path / "bag", stop_at=1100)
    assert (lost, len(failures)) == (200, 2)
    assert read_seconds(tmp_path / "bag") == [*range(9)]
    with AnyReader([tmp_path / "bag"]) as others:
        assert sum(1 for _ in others.messages()) == 900
