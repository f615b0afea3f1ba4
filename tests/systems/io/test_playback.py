"""Playing a recording back in place of what was recorded."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import VectorLogSink

from systems.io import playback
from systems.io.bag import BagReader, BagWriter
from systems.io.playback import Entry, Lazy, MessagePlayback, Track, VectorPlayback, read_channel
from systems.io.recorder import Channel, Recorder
from systems.io.ros_motion import estimate_to_ros, imu_to_ros
from systems.io.ros_types import header, message_class, nanoseconds, seconds
from systems.io.ros_vision import detections_from_ros, image_from_ros, image_to_ros
from systems.messages import CameraImage, Detections, PoseEstimate

IMU = "sensor_msgs/msg/Imu"
TAGS = "apriltag_msgs/msg/AprilTagDetectionArray"
IMAGE = "sensor_msgs/msg/CompressedImage"


def entries(*pairs):
    return [Entry(round(t * 1e9), t, value) for t, value in pairs]


def vector_at(system, t):
    context = system.CreateDefaultContext()
    context.SetTime(t)
    return system.value_output_port().Eval(context)


def health_at(system, t):
    context = system.CreateDefaultContext()
    context.SetTime(t)
    return dict(system.health_output_port().Eval(context).counts)


# Which value is in force


def test_the_last_value_not_after_now_is_sent():
    system = VectorPlayback(
        entries=entries((0.5, [1.0, 2.0]), (1.0, [3.0, 4.0])), size=2, nothing=[7.0, 8.0]
    )
    for t, expected in (
        (0.0, [7, 8]),
        (0.499999999, [7, 8]),
        (0.5, [1, 2]),
        (0.999999999, [1, 2]),
        (1.0, [3, 4]),
        (1e6, [3, 4]),
    ):
        assert vector_at(system, t).tolist() == expected


def test_times_are_compared_in_whole_nanoseconds():
    system = VectorPlayback(entries=entries((0.3, [1.0])), size=1)
    before = math.nextafter(0.3, 0.0)
    assert vector_at(system, before).tolist() == [1.0]
    assert vector_at(system, 0.1 + 0.2).tolist() == [1.0]
    assert vector_at(system, 0.3 - 1e-9).tolist() == [0.0]


def test_the_same_entry_is_the_same_object():
    first, second = PoseEstimate(stamp=0.1), PoseEstimate(stamp=0.2)
    system = MessagePlayback(entries=entries((0.1, first), (0.2, second)), nothing=PoseEstimate())
    context = system.CreateDefaultContext()
    for t, expected in ((0.15, first), (0.17, first), (0.2, second), (0.1, first)):
        context.SetTime(t)
        assert system.value_output_port().Eval(context) is expected


def test_a_lookup_agrees_with_a_search_through_the_list():
    rng = np.random.default_rng(0)
    times = np.sort(rng.integers(0, 10**9, 300))
    track = Track([Entry(int(t), seconds(int(t)), i) for i, t in enumerate(times)], lambda _: True)
    for t in [*rng.integers(0, 10**9, 300).tolist(), *times.tolist()]:
        assert track.index(seconds(t)) == max(
            (i for i, u in enumerate(times) if u <= t), default=-1
        )


# What is left out


def test_bad_entries_are_left_out_and_counted_when_their_time_comes():
    system = VectorPlayback(
        entries=[
            *entries((0.1, [1.0]), (0.2, [math.nan]), (0.3, [math.inf]), (0.4, [4.0])),
            Entry(500_000_000, 0.35, [5.0]),  # measured before the last one
            Entry(600_000_000, math.nan, [6.0]),
            Entry(700_000_000, 0.7, None),
            *entries((0.8, [8.0])),
        ],
        size=1,
    )
    values = [vector_at(system, t)[0] for t in np.arange(1, 9) / 10]
    assert values == [1, 1, 1, 4, 4, 4, 4, 8]
    nothing = {"undecodable": 0, "not_finite": 0, "stamp_backwards": 0}
    assert health_at(system, 0.15) == nothing
    assert health_at(system, 0.2) == {**nothing, "not_finite": 1}
    assert health_at(system, 0.55) == {**nothing, "not_finite": 2, "stamp_backwards": 1}
    assert health_at(system, 9.0) == {"undecodable": 1, "not_finite": 3, "stamp_backwards": 1}


def test_log_times_that_go_backwards_are_left_out():
    system = VectorPlayback(
        entries=[Entry(200, 1.0, [1.0]), Entry(100, 2.0, [2.0]), Entry(300, 3.0, [3.0])], size=1
    )
    assert vector_at(system, 1e-6).tolist() == [3.0]
    assert health_at(system, 1e-6)["stamp_backwards"] == 1


def test_messages_without_a_stamp_are_left_out():
    system = MessagePlayback(
        entries=[Entry(0, math.nan, PoseEstimate()), *entries((0.5, PoseEstimate(stamp=0.5)))],
        nothing=PoseEstimate(),
    )
    context = system.CreateDefaultContext()
    assert math.isnan(system.value_output_port().Eval(context).stamp)
    assert health_at(system, 0.0)["not_finite"] == 1


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"entries": entries((0.0, [1.0, 2.0])), "size": 3}, "shape of a value is"),
        ({"entries": [], "size": 0}, "size is 0"),
        ({"entries": [], "size": 2, "nothing": [1.0]}, "nothing is"),
    ],
)
def test_vectors_of_another_size_are_refused(arguments, text):
    with pytest.raises(ValueError, match=text):
        VectorPlayback(**arguments)


def test_messages_of_another_type_are_refused():
    with pytest.raises(ValueError, match="value is 'Detections': must be PoseEstimate"):
        MessagePlayback(entries=entries((0.0, Detections(stamp=0.0))), nothing=PoseEstimate())


# Pictures


def picture(k):
    data = np.random.default_rng(k).integers(0, 256, (12, 16), dtype=np.uint8)
    return CameraImage(stamp=k / 10, frame_id="front", data=data)


def write_pictures(folder, broken=()):
    with BagWriter(folder) as writer:
        for k in range(10):
            message = image_to_ros(picture(k))
            if k in broken:
                message.data = message.data[: len(message.data) // 4]
            writer.write("/image", IMAGE, message, k / 10)


def test_pictures_are_decoded_when_looked_at_and_once(tmp_path, monkeypatch):
    write_pictures(tmp_path / "bag")
    decoded = []

    def counting(message):
        decoded.append(message)
        return image_from_ros(message)

    monkeypatch.setitem(vars(playback), "decoder", lambda _: counting)
    channel = read_channel(BagReader(tmp_path / "bag"), "/image")
    system = MessagePlayback(entries=channel, nothing=CameraImage())
    assert not decoded
    context = system.CreateDefaultContext()
    seen = []
    for t in (0.3, 0.31, 0.35, 0.4, 0.45):
        context.SetTime(t)
        seen.append(system.value_output_port().Eval(context))
    assert len(decoded) == 2
    assert seen[0] is seen[1] is seen[2]
    assert seen[3] is seen[4]
    np.testing.assert_array_equal(seen[0].data, picture(3).data)
    np.testing.assert_array_equal(seen[3].data, picture(4).data)
    other = system.CreateDefaultContext()  # has a memory of its own
    other.SetTime(0.3)
    np.testing.assert_array_equal(system.value_output_port().Eval(other).data, picture(3).data)
    assert len(decoded) == 3


def test_pictures_that_cannot_be_decoded_are_left_out_and_counted(tmp_path):
    write_pictures(tmp_path / "bag", broken=(0, 4, 5))
    channel = read_channel(BagReader(tmp_path / "bag"), "/image")
    system = MessagePlayback(entries=channel, nothing=CameraImage())
    context = system.CreateDefaultContext()
    stamps, counts = [], []
    for k in range(8):
        context.SetTime(k / 10 + 0.01)
        stamps.append(system.value_output_port().Eval(context).stamp)
        counts.append(system.health_output_port().Eval(context).counts["undecodable"])
    np.testing.assert_array_equal(stamps, [math.nan, 0.1, 0.2, 0.3, 0.3, 0.3, 0.6, 0.7])
    assert counts == [1, 1, 1, 1, 2, 3, 3, 3]


# From the recording


def test_a_channel_is_read_with_its_times_and_stamps(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        for k in range(5):
            message = imu_to_ros(np.full(6, float(k)), stamp=k / 10, frame_id="imu")
            writer.write("/imu", IMU, message, k / 10 + 0.03)
    channel = read_channel(BagReader(tmp_path / "bag"), "/imu")
    assert [entry.log_time for entry in channel] == [30_000_000 + k * 10**8 for k in range(5)]
    assert [entry.stamp for entry in channel] == [k / 10 for k in range(5)]
    assert [entry.value.tolist() for entry in channel] == [[float(k)] * 6 for k in range(5)]
    magnitude = read_channel(
        BagReader(tmp_path / "bag"), "/imu", lambda m: [m.linear_acceleration.x]
    )
    assert [entry.value for entry in magnitude] == [[float(k)] for k in range(5)]


def test_a_recording_that_counts_since_1970_is_shifted(tmp_path):
    epoch = 1_700_000_000.0
    with BagWriter(tmp_path / "bag") as writer:
        for k in range(3):
            t = epoch + k * 0.25
            estimate = PoseEstimate(stamp=t, frame_id="map", covariance=np.eye(6))
            writer.write(
                "/pose",
                "geometry_msgs/msg/PoseWithCovarianceStamped",
                estimate_to_ros(estimate),
                t + 0.125,
            )
            image = CameraImage(stamp=t, data=np.zeros((2, 2), np.uint8))
            writer.write("/image", IMAGE, image_to_ros(image), t + 0.125)
    reader = BagReader(tmp_path / "bag")
    assert reader.start == epoch + 0.125
    for topic, nothing in (("/pose", PoseEstimate()), ("/image", CameraImage())):
        channel = read_channel(reader, topic, origin=epoch)
        assert [entry.log_time for entry in channel] == [125_000_000, 375_000_000, 625_000_000]
        assert [entry.stamp for entry in channel] == [0.0, 0.25, 0.5]
        system = MessagePlayback(entries=channel, nothing=nothing)
        context = system.CreateDefaultContext()
        context.SetTime(0.4)
        assert system.value_output_port().Eval(context).stamp == 0.25


def test_messages_that_cannot_be_decoded_are_entries_without_a_value(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        for k in range(3):
            estimate = PoseEstimate(stamp=float(k), covariance=np.eye(6))
            message = estimate_to_ros(estimate)
            message.pose.pose.orientation.w = 1.0 if k != 1 else 0.0
            writer.write("/pose", message.__msgtype__, message, float(k))
    channel = read_channel(BagReader(tmp_path / "bag"), "/pose")
    assert [entry.value is None for entry in channel] == [False, True, False]
    system = MessagePlayback(entries=channel, nothing=PoseEstimate())
    assert health_at(system, 5.0)["undecodable"] == 1


def test_a_type_without_a_usual_conversion_wants_one(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        text = message_class("std_msgs/msg/String")("hello")
        writer.write("/note", "std_msgs/msg/String", text, 0.0)
        range_ = message_class("sensor_msgs/msg/Range")(header(0.0, ""), 0, 0.1, 0.1, 1.0, 0.5)
        writer.write("/range", "sensor_msgs/msg/Range", range_, 0.0)
    reader = BagReader(tmp_path / "bag")
    with pytest.raises(ValueError, match="no conversion is known"):
        read_channel(reader, "/range")
    with pytest.raises(ValueError, match="did you mean '/note'"):
        read_channel(reader, "/notes")
    [entry] = read_channel(reader, "/range", lambda m: [m.range])
    assert entry.value == [0.5]


# Record and play


class Source(LeafSystem):
    """Random vectors and detections, new ones at `rate`, the detections held back for a while."""

    def __init__(self, rate, latency):
        super().__init__()
        self.sample = self.DeclareDiscreteState(6)
        self.DeclarePeriodicDiscreteUpdateEvent(1 / rate, 0.0, self.draw)
        self.detections = self.DeclareAbstractState(AbstractValue.Make(Detections()))
        self.DeclarePeriodicUnrestrictedUpdateEvent(1 / 15, latency, self.detect)
        self.DeclareStateOutputPort("sample", self.sample)
        self.DeclareStateOutputPort("detections", self.detections)
        self.latency = latency

    def draw(self, context, state):
        rng = np.random.default_rng(round(context.get_time() * 1e6))
        state.set_value(self.sample, rng.normal(size=6))

    def detect(self, context, state):
        t = context.get_time()
        rng = np.random.default_rng(round(t * 1e6))
        found = Detections(
            stamp=round((t - self.latency) * 1e9) / 1e9,
            frame_id="front",
            family="DICT_4X4_50",
            ids=rng.integers(0, 50, 3),
            corners=rng.uniform(0, 600, (3, 4, 2)),
            hamming=np.zeros(3, np.int64),
            decision_margin=rng.uniform(0, 100, 3).astype(np.float32).astype(float),
        )
        state.get_mutable_abstract_state(int(self.detections)).set_value(found)


class Consumer(LeafSystem):
    """Updates at `rate` on what its inputs say, as an estimator does, and remembers all of it."""

    def __init__(self, rate):
        super().__init__()
        self.sample = self.DeclareVectorInputPort("sample", 6)
        self.detections = self.DeclareAbstractInputPort(
            "detections", AbstractValue.Make(Detections())
        )
        self.state = self.DeclareDiscreteState(7)
        self.DeclarePeriodicDiscreteUpdateEvent(1 / rate, 0.0, self.update)
        self.DeclareStateOutputPort("state", self.state)
        self.log = []

    def update(self, context, state):
        sample = self.sample.Eval(context)
        found = self.detections.Eval(context)
        self.log.append(
            (
                context.get_time(),
                sample.tobytes(),
                found.stamp if len(found) else None,
                found.corners.tobytes(),
                found.decision_margin.tobytes(),
            )
        )
        old = context.get_discrete_state(self.state).get_value()
        state.set_value(self.state, 0.9 * old + [*sample, len(found) and found.corners.sum()])


@pytest.mark.parametrize("latency", [0.0, 0.04])
def test_a_played_recording_gives_the_same_bits_at_the_same_times(tmp_path, latency):
    """Estimators update at k 0.01 s as floats; the recording keeps whole nanoseconds."""
    duration = 3.0

    def wire(builder, consumer, sample, detections):
        builder.Connect(sample, consumer.GetInputPort("sample"))
        builder.Connect(detections, consumer.GetInputPort("detections"))
        sink = builder.AddSystem(VectorLogSink(7, 0.01))
        builder.Connect(consumer.get_output_port(), sink.get_input_port())
        return sink

    def run(builder, sink):
        simulator = Simulator(builder.Build())
        simulator.AdvanceTo(duration)
        return sink.FindLog(simulator.get_context()).data().tobytes()

    builder = DiagramBuilder()
    source = builder.AddSystem(Source(100.0, latency))
    consumer = builder.AddSystem(Consumer(100.0))
    sample, detections = source.GetOutputPort("sample"), source.GetOutputPort("detections")
    sink = wire(builder, consumer, sample, detections)
    recorder = builder.AddSystem(
        Recorder(
            channels=[
                Channel("sample", "/imu", IMU, 6, rate=100.0),
                Channel("detections", "/tags", TAGS, Detections(), rate=100.0, only_new=True),
            ],
            writer=BagWriter(tmp_path / "bag"),
        )
    )
    builder.Connect(sample, recorder.GetInputPort("sample"))
    builder.Connect(detections, recorder.GetInputPort("detections"))
    recorded = run(builder, sink)
    recorder.close()
    assert recorder.lost == 0

    reader = BagReader(tmp_path / "bag")
    builder = DiagramBuilder()
    played_sample = builder.AddSystem(VectorPlayback(entries=read_channel(reader, "/imu"), size=6))
    played_detections = builder.AddSystem(
        MessagePlayback(entries=read_channel(reader, "/tags"), nothing=Detections())
    )
    consumer_of_played = builder.AddSystem(Consumer(100.0))
    sink = wire(
        builder,
        consumer_of_played,
        played_sample.value_output_port(),
        played_detections.value_output_port(),
    )
    played = run(builder, sink)

    assert len(consumer.log) == 300
    assert len({entry[1] for entry in consumer.log}) == 300  # there was something to get wrong
    assert len({entry[2] for entry in consumer.log}) > 40
    assert consumer_of_played.log == consumer.log
    assert played == recorded


@pytest.mark.recording
def test_a_played_real_recording_follows_it(recordings: Path):
    reader = BagReader(recordings / "tagslam_aviary" / "tag_detections.bag")
    topic = "/apriltag_detector/tags"
    channel = read_channel(
        reader, topic, partial(detections_from_ros, family="tag36h11"), origin=reader.start
    )
    system = MessagePlayback(entries=channel, nothing=Detections())
    context = system.CreateDefaultContext()
    played, ages = [], []
    for record in reader.records([topic]):
        t = seconds(record.log_time - nanoseconds(reader.start))
        context.SetTime(t)
        played.append(system.value_output_port().Eval(context))
        ages.append(t - played[-1].stamp)
    assert len(played) == 681
    assert sum(len(found) for found in played) == 12_846
    assert 0 < min(ages) < max(ages) < 3.0  # measured before recorded


def test_a_lazy_value_is_no_value_of_another_type():
    system = MessagePlayback(
        entries=[Entry(0, 0.0, Lazy(lambda: picture(0)))], nothing=CameraImage()
    )
    assert system.value_output_port().Eval(system.CreateDefaultContext()).stamp == 0.0
