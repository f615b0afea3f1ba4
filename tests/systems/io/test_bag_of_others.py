"""Recordings that others made: MCAP of every kind, SQLite, ROS 1, and real ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore

from systems.io.bag import BagReader
from systems.io.ros_messages import decoder
from systems.io.ros_motion import imu_from_ros, imu_to_ros, transforms_from_ros
from systems.io.ros_types import definition, time_from_ros, typestore
from systems.io.ros_vision import camera_from_ros, detections_from_ros, image_from_ros

IMU = "sensor_msgs/msg/Imu"
EPOCH = 1_700_000_000_000_000_000  # ns


def sample(k):
    return np.random.default_rng(k).normal(size=6)


def imu(k):
    return imu_to_ros(sample(k), stamp=k / 100, frame_id="imu")


def assert_imu(reader, count, topic="/imu"):
    read = list(reader.messages([topic]))
    assert len(read) == count
    for k, (name, t, message) in enumerate(read):
        assert name == topic
        assert t == (EPOCH + k * 10**7) / 10**9
        np.testing.assert_array_equal(imu_from_ros(message), sample(k))


def write_mcap(path, *, count=300, finish=True, encoding="cdr", **options):
    """By the mcap package, as other people's tools do."""
    ros1 = encoding == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC) if ros1 else typestore()
    name = "sensor_msgs/Imu" if ros1 else IMU
    text = store.generate_msgdef(IMU)[0] if ros1 else definition(IMU)
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=8000, **options)
        writer.start(profile="ros1" if ros1 else "ros2")
        schema = writer.register_schema(name, "ros1msg" if ros1 else "ros2msg", text.encode())
        channel = writer.register_channel("/imu", encoding, schema)
        json = writer.register_schema("note", "jsonschema", b"{}")
        note = writer.register_channel("/note", "json", json)
        for k in range(count):
            data = (
                store.serialize_ros1(ros1_imu(store, k), IMU)
                if ros1
                else store.serialize_cdr(imu(k), IMU)
            )
            t = EPOCH + k * 10**7
            writer.add_message(channel, t, bytes(data), t)
            writer.add_message(note, t, b"{}", t)
        if finish:
            writer.finish()


def ros1_imu(store, k):
    ours = imu(k)
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](ours.header.stamp.sec, ours.header.stamp.nanosec)
    header = types["std_msgs/msg/Header"](k, stamp, "imu")
    return types[IMU](
        header,
        ours.orientation,
        ours.orientation_covariance,
        ours.angular_velocity,
        ours.angular_velocity_covariance,
        ours.linear_acceleration,
        ours.linear_acceleration_covariance,
    )


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.NONE},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.ZSTD},
        {"use_chunking": False},
        {"index_types": IndexType.NONE},
        {"use_statistics": False},
        {"repeat_channels": False, "repeat_schemas": False, "use_statistics": False},
        {"enable_crcs": False},
        {"encoding": "ros1"},
    ],
    ids=str,
)
def test_mcap_of_every_kind_is_read_whole_and_cut(tmp_path, options):
    path = tmp_path / "theirs.mcap"
    write_mcap(path, **options)
    reader = BagReader(path)
    assert reader.topics() == {"/imu": IMU}  # JSON is not ROS
    assert not reader.truncated
    assert reader.start == EPOCH / 10**9
    assert_imu(reader, 300)
    data = path.read_bytes()
    for part in (0.3, 0.55, 0.8):
        path.write_bytes(data[: int(part * len(data))])
        reader = BagReader(path)
        count = len(list(reader.messages()))
        assert count > 0
        assert reader.truncated or count == 300  # cut behind the messages, in the index
        assert_imu(reader, count)


def test_mcap_that_was_never_finished_is_read(tmp_path):
    path = tmp_path / "theirs.mcap"
    write_mcap(path, finish=False)
    reader = BagReader(path)
    assert reader.truncated
    assert 250 < len(list(reader.messages())) <= 300
    assert_imu(reader, len(list(reader.messages())))


def test_without_a_definition_the_standard_one_is_taken(tmp_path):
    path = tmp_path / "theirs.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        for topic, name in (("/imu", IMU), ("/secret", "mine/msg/Secret")):
            channel = writer.register_channel(
                topic, "cdr", writer.register_schema(name, "ros2msg", b"")
            )
            data = bytes(typestore().serialize_cdr(imu(0), IMU))
            writer.add_message(channel, EPOCH, data, EPOCH)
        writer.finish()
    reader = BagReader(path)
    assert_imu(reader, 1)
    with pytest.raises(ValueError, match=r"/secret.*mine/msg/Secret is no standard message"):
        list(reader.messages(["/secret"]))


def test_a_folder_of_several_files_is_one_recording(tmp_path):
    for number in range(3):  # interleaved, so that order has to come from the times
        with (tmp_path / f"part_{number}.mcap").open("wb") as file:
            writer = Writer(file, chunk_size=3000)
            writer.start(profile="ros2")
            schema = writer.register_schema(IMU, "ros2msg", definition(IMU).encode())
            for _ in range(number):  # channel numbers differ between the files
                writer.register_channel("/unused", "cdr", schema)
            channel = writer.register_channel("/imu", "cdr", schema)
            for k in range(number, 300, 3):
                t = EPOCH + k * 10**7
                data = bytes(typestore().serialize_cdr(imu(k), IMU))
                writer.add_message(channel, t, data, t)
            writer.finish()
    reader = BagReader(tmp_path)
    assert_imu(reader, 300)
    last = tmp_path / "part_2.mcap"
    last.write_bytes(last.read_bytes()[: last.stat().st_size // 2])
    reader = BagReader(tmp_path)
    assert reader.truncated
    times = [t for _, t, _ in reader.messages()]
    assert 200 < len(times) < 300
    assert times == sorted(times)
    last.write_bytes(b"")  # as a recorder leaves it that died between two files
    reader = BagReader(tmp_path)
    assert reader.truncated
    assert len(list(reader.messages())) == 200


@pytest.mark.parametrize("plugin", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_what_rosbags_writes_is_read(tmp_path, plugin):
    folder = tmp_path / "theirs"
    with Rosbag2Writer(folder, version=8, storage_plugin=plugin) as writer:
        connection = writer.add_connection("/imu", IMU, typestore=typestore())
        for k in range(300):
            data = typestore().serialize_cdr(imu(k), IMU)
            writer.write(connection, EPOCH + k * 10**7, data)
    reader = BagReader(folder)
    assert reader.topics() == {"/imu": IMU}
    assert not reader.truncated
    assert_imu(reader, 300)
    (folder / "metadata.yaml").unlink()  # as a recorder leaves it that was killed
    assert_imu(BagReader(folder), 300)
    [file] = folder.iterdir()
    assert_imu(BagReader(file), 300)


def make_rosbag1(path, compression=None, order=range(300)):
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = Rosbag1Writer(path)
    writer.chunk_threshold = 20_000
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        connection = writer.add_connection("/imu", IMU, typestore=store)
        for k in order:
            data = store.serialize_ros1(ros1_imu(store, k), IMU)
            writer.write(connection, EPOCH + k * 10**7, data)


@pytest.mark.parametrize("compression", [None, *Rosbag1Writer.CompressionFormat])
def test_a_ros_1_bag_is_read_whole_and_cut(tmp_path, compression):
    path = tmp_path / "theirs.bag"
    make_rosbag1(path, compression)
    reader = BagReader(path)
    assert reader.topics() == {"/imu": IMU}
    assert not reader.truncated
    assert_imu(reader, 300)
    data = path.read_bytes()
    counts = []
    for part in (0.4, 0.6, 0.8, 0.99):
        path.write_bytes(data[: int(part * len(data))])
        reader = BagReader(path)
        assert reader.truncated
        counts.append(len(list(reader.messages())))
        assert_imu(reader, counts[-1])
    assert counts == sorted(counts)
    assert 0 < counts[0] < counts[2]


def test_messages_of_a_cut_ros_1_bag_come_in_log_time_order(tmp_path):
    path = tmp_path / "theirs.bag"
    make_rosbag1(path, order=[k ^ 1 for k in range(300)])  # 1, 0, 3, 2, ...
    data = path.read_bytes()
    for content in (data, data[:-1000]):
        path.write_bytes(content)
        assert_imu(BagReader(path), 300)
    assert BagReader(path).truncated


def test_a_ros_1_bag_cut_anywhere_never_raises_anything_else(tmp_path):
    make_rosbag1(tmp_path / "theirs.bag")
    data = (tmp_path / "theirs.bag").read_bytes()
    path = tmp_path / "cut.bag"
    for cut in np.random.default_rng(0).integers(0, len(data), 60).tolist():
        path.write_bytes(data[:cut])
        try:
            reader = BagReader(path)
        except ValueError as error:
            reason = str(error)
            assert str(path) in reason
            continue
        assert_imu(reader, len(list(reader.messages())))


# Real ones


@pytest.mark.recording
def test_tagslams_detections_are_read_by_the_definition_in_the_bag(recordings: Path):
    reader = BagReader(recordings / "tagslam_aviary" / "tag_detections.bag")
    topic = "/apriltag_detector/tags"
    assert reader.topics() == {topic: "apriltag_msgs/msg/ApriltagArrayStamped"}
    sightings, whole, ids, last = 0, 0, set(), 0.0
    for _, t, message in reader.messages():
        assert t >= last
        last = t
        detections = detections_from_ros(message, family="tag36h11")
        sightings += len(detections)
        whole += int((detections.hamming == 0).sum())
        ids.update(detections.ids.tolist())
        assert detections.frame_id == "pg_17041936"
        centres = detections.corners.mean(axis=1)
        assert ((centres > 0) & (centres < 2048)).all()
        # Clockwise in the picture, as the upright marker's corners are from the top-left one.
        x, y = detections.corners[..., 0], detections.corners[..., 1]
        area = (x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(axis=1) / 2
        assert (area > 100).all()
    # The second and third were counted before this code was written.
    assert (sightings, whole, len(ids)) == (12_846, 12_762, 96)


@pytest.mark.recording
def test_tagslams_trajectory_is_read(recordings: Path):
    reader = BagReader(recordings / "tagslam_aviary" / "reference.bag")
    odometry = {}
    for _, _, message in reader.messages(["/tagslam/odom/body_rig"]):
        odometry[time_from_ros(message.header.stamp)] = message
    estimate_from_ros = decoder("nav_msgs/msg/Odometry")
    compared = set()
    for _, _, message in reader.messages(["/tf"]):
        for entry in transforms_from_ros(message):
            if (entry.frame_id, entry.child_frame_id) == ("map", "rig"):
                # The same pose on two topics, in two messages.
                pose = estimate_from_ros(odometry[entry.stamp]).pose
                np.testing.assert_allclose(
                    entry.pose.GetAsMatrix4(), pose.GetAsMatrix4(), atol=1e-12
                )
                compared.add(entry.stamp)
    assert len(odometry) == 680
    assert compared == set(odometry)


@pytest.mark.recording
def test_a_real_camera_is_read(recordings: Path):
    reader = BagReader(recordings / "aruco_camera" / "aruco_images.bag")
    [(_, _, picture)] = reader.messages(["/raspicam_node/image/compressed"])
    image = image_from_ros(picture)
    assert image.data.shape == (960, 1280, 3)
    infos = list(reader.messages(["/raspicam_node/camera_info"]))
    assert len(infos) == 15
    camera = camera_from_ros(infos[0][2])
    assert (camera.width, camera.height) == (1280, 960)
    assert camera.K[0, 0] == pytest.approx(1014.3431)
    assert camera.distorted
