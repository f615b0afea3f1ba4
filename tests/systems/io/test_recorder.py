"""Recording a diagram's ports."""

from __future__ import annotations

import logging
import math
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource

from systems.cameras import PinholeCamera
from systems.io.bag import BagReader, BagWriter
from systems.io.recorder import Channel, Recorder
from systems.io.ros_messages import encoder
from systems.io.ros_motion import FrameTransform, imu_from_ros, pose_from_ros, transforms_to_ros
from systems.io.ros_types import message_class, time_from_ros
from systems.io.ros_vision import camera_to_ros, detections_from_ros
from systems.messages import Detections

ROOT = Path(__file__).resolve().parents[3]
IMU = "sensor_msgs/msg/Imu"
TAGS = "apriltag_msgs/msg/AprilTagDetectionArray"
POSE = "geometry_msgs/msg/PoseStamped"


class Sensors(LeafSystem):
    """Counts: a vector at 100 Hz, detections at 10 Hz (NaN as stamp at first)."""

    def __init__(self):
        super().__init__()
        self.counter = self.DeclareDiscreteState(1)
        self.seen = self.DeclareDiscreteState(1)
        self.DeclarePeriodicDiscreteUpdateEvent(0.01, 0.0, self.count)
        self.DeclarePeriodicDiscreteUpdateEvent(0.1, 0.05, self.see)
        self.DeclareVectorOutputPort(
            "sample", 6, lambda c, o: o.SetFromVector(self.value(c) * np.arange(1.0, 7.0))
        )
        self.DeclareAbstractOutputPort(
            "detections", lambda: AbstractValue.Make(Detections()), self.calc_detections
        )

    def value(self, context):
        return context.get_discrete_state(self.counter)[0]

    def count(self, context, state):
        state.set_value(self.counter, [self.value(context) + 1])

    def see(self, context, state):
        state.set_value(self.seen, [context.get_discrete_state(self.seen)[0] + 1])

    def calc_detections(self, context, output):
        n = int(context.get_discrete_state(self.seen)[0])
        if n:
            stamp = round(0.05 + 0.1 * (n - 1), 9)
            output.set_value(
                Detections(
                    stamp=stamp,
                    family="tag36h11",
                    ids=np.array([n]),
                    corners=np.zeros((1, 4, 2)) + n + np.array([[0, 0], [1, 0], [1, 1], [0, 1]]),
                    hamming=np.array([0]),
                    decision_margin=np.array([1.0]),
                )
            )
        else:
            output.set_value(Detections())


def record(folder, channels, duration, static=None):
    """Records those channels of `Sensors`; returns the recorder, closed."""
    builder = DiagramBuilder()
    sensors = builder.AddSystem(Sensors())
    recorder = builder.AddSystem(
        Recorder(channels=channels, writer=BagWriter(folder), static=static)
    )
    for channel in channels:
        source = channel.port.split("_")[0]
        builder.Connect(sensors.GetOutputPort(source), recorder.GetInputPort(channel.port))
    simulator = Simulator(builder.Build())
    simulator.Initialize()
    simulator.Initialize()  # as it happens when a Context is changed before the start
    simulator.AdvanceTo(duration)
    recorder.close()
    return recorder


def test_each_port_is_recorded_at_its_rate(tmp_path):
    channels = [
        Channel("sample", "/imu", IMU, 6, rate=100.0),
        Channel("sample_slow", "/slow", IMU, 6, rate=10.0),
    ]
    recorder = record(tmp_path / "bag", channels, 1.0)
    reader = BagReader(tmp_path / "bag")
    fast = list(reader.messages(["/imu"]))
    slow = list(reader.messages(["/slow"]))
    assert [t for _, t, _ in fast] == [k / 100 for k in range(100)]
    assert [t for _, t, _ in slow] == [k / 10 for k in range(10)]
    # At t the value of before the update at t, as another block sees it.
    for k, (_, t, message) in enumerate(fast):
        np.testing.assert_array_equal(imu_from_ros(message), k * np.arange(1.0, 7.0))
        assert time_from_ros(message.header.stamp) == t
    assert recorder.lost == 0


def test_a_message_is_recorded_once_and_not_before_there_is_one(tmp_path):
    channels = [
        Channel("detections", "/tags", TAGS, Detections(), rate=100.0, only_new=True),
        Channel("detections_again", "/again", TAGS, Detections(), rate=100.0),
    ]
    record(tmp_path / "bag", channels, 1.0)
    reader = BagReader(tmp_path / "bag")
    once = [(t, detections_from_ros(m)) for _, t, m in reader.messages(["/tags"])]
    again = [(t, detections_from_ros(m)) for _, t, m in reader.messages(["/again"])]
    assert [d.ids[0] for _, d in once] == list(range(1, 11))
    assert [d.stamp for _, d in once] == [round(0.05 + 0.1 * k, 9) for k in range(10)]
    # Measured at t, it is there for whoever looks next.
    assert [t for t, _ in once] == [round(0.06 + 0.1 * k, 9) for k in range(10)]
    assert len(again) == 94
    assert again[0][0] == 0.06


def test_poses_take_the_time_of_the_context(tmp_path):
    pose = RigidTransform(RollPitchYaw(0.1, 0.2, 0.3), [1.0, 2.0, 3.0])
    builder = DiagramBuilder()
    source = builder.AddSystem(ConstantValueSource(AbstractValue.Make(pose)))

    def to_tf(value, t):
        return transforms_to_ros([FrameTransform(t, "map", "base_link", value)])

    channels = [
        Channel("pose", "/truth", POSE, RigidTransform(), rate=4.0),
        Channel("frame", "/tf", to_tf, RigidTransform(), rate=4.0),
    ]
    recorder = builder.AddSystem(Recorder(channels=channels, writer=BagWriter(tmp_path / "bag")))
    for channel in channels:
        builder.Connect(source.get_output_port(), recorder.GetInputPort(channel.port))
    Simulator(builder.Build()).AdvanceTo(1.0)
    recorder.close()
    messages = list(BagReader(tmp_path / "bag").messages(["/truth"]))
    assert [time_from_ros(m.header.stamp) for _, _, m in messages] == [0, 0.25, 0.5, 0.75]
    np.testing.assert_allclose(
        pose_from_ros(messages[0][2]).GetAsMatrix4(), pose.GetAsMatrix4(), atol=1e-15
    )
    [first, *_] = BagReader(tmp_path / "bag").messages(["/tf"])
    assert first[2].transforms[0].child_frame_id == "base_link"


class Riser(LeafSystem):
    """Sends the pose of something that rises by 1 m/s."""

    def __init__(self):
        super().__init__()
        self.DeclareAbstractOutputPort(
            "pose",
            lambda: AbstractValue.Make(RigidTransform()),
            lambda c, o: o.set_value(RigidTransform([0.0, 0.0, c.get_time()])),
        )


def test_a_pose_is_recorded_as_it_was_though_it_moves_on(tmp_path):
    builder = DiagramBuilder()
    riser = builder.AddSystem(Riser())
    channel = Channel("pose", "/truth", POSE, RigidTransform(), rate=4.0)
    recorder = builder.AddSystem(Recorder(channels=[channel], writer=BagWriter(tmp_path / "bag")))
    builder.Connect(riser.get_output_port(), recorder.GetInputPort("pose"))
    Simulator(builder.Build()).AdvanceTo(1.5)
    recorder.close()
    heights = [(t, m.pose.position.z) for _, t, m in BagReader(tmp_path / "bag").messages()]
    assert heights == [(k / 4, k / 4) for k in range(6)]


def test_static_messages_come_first_and_once(tmp_path):
    camera = PinholeCamera.from_focal_length(64, 48, 50.0)
    static = {
        "/tf_static": (
            "tf2_msgs/msg/TFMessage",
            transforms_to_ros([FrameTransform(0.0, "base_link", "camera", RigidTransform())]),
        ),
        "/camera_info": (
            "sensor_msgs/msg/CameraInfo",
            camera_to_ros(camera, stamp=0.0, frame_id="camera"),
        ),
    }
    record(tmp_path / "bag", [Channel("sample", "/imu", IMU, 6, rate=10.0)], 2.5, static=static)
    read = [(topic, t) for topic, t, _ in BagReader(tmp_path / "bag").messages()]
    assert read[:2] == [("/tf_static", 0.0), ("/camera_info", 0.0)]
    assert sum(topic != "/imu" for topic, _ in read) == 2
    metadata = (tmp_path / "bag" / "metadata.yaml").read_text()
    assert metadata.count("durability: 1") == 2  # transient local


def test_two_equal_runs_give_equal_bytes(tmp_path):
    channels = [
        Channel("sample", "/imu", IMU, 6, rate=100.0),
        Channel("detections", "/tags", TAGS, Detections(), rate=100.0, only_new=True),
    ]
    files = []
    for name in ("one", "two"):
        record(tmp_path / name / "bag", channels, 2.2)
        files.append({p.name: p.read_bytes() for p in (tmp_path / name / "bag").iterdir()})
    assert files[0] == files[1]
    assert set(files[0]) == {"bag_0.mcap", "metadata.yaml"}


def test_what_does_not_fit_its_message_is_counted_and_said_once(tmp_path, caplog):
    def refuse(value, t):
        if 0.25 < t < 0.55:
            raise ValueError("sample is too large: must be small")
        return encoder(IMU)(value, t)

    with caplog.at_level(logging.WARNING):
        recorder = record(tmp_path / "bag", [Channel("sample", "/imu", refuse, 6, rate=10.0)], 1.0)
    assert recorder.lost == 3
    assert len(list(BagReader(tmp_path / "bag").messages())) == 7
    [warning] = caplog.records
    assert warning.getMessage() == "not recorded: /imu: sample is too large: must be small"


FULL = """
    import logging, resource, sys
    from pathlib import Path
    import numpy as np
    from pydrake.systems.analysis import Simulator
    from pydrake.systems.framework import DiagramBuilder
    from pydrake.systems.primitives import ConstantVectorSource
    from systems.io.bag import BagWriter
    from systems.io.recorder import Channel, Recorder

    builder = DiagramBuilder()
    source = builder.AddSystem(ConstantVectorSource(np.arange(6.0)))
    writer = BagWriter(Path(sys.argv[1]))
    recorder = builder.AddSystem(Recorder(
        channels=[Channel("sample", "/imu", "sensor_msgs/msg/Imu", 6, rate=100.0)], writer=writer))
    builder.Connect(source.get_output_port(), recorder.GetInputPort("sample"))
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(3.5)
    size = writer.path.stat().st_size + 200
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    simulator.AdvanceTo(9.505)
    recorder.close()
    print(simulator.get_context().get_time(), recorder.lost)
"""


def test_a_full_disk_is_said_once_and_the_simulation_goes_on(tmp_path):
    result = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(FULL), str(tmp_path / "bag")],
        capture_output=True,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        text=True,
        timeout=60,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == ["9.505", "651"]  # 3.00 to 9.50 s
    [line] = result.stderr.splitlines()
    assert line.startswith("recording at 4.000 s of the simulation: [Errno 27] File too large")
    assert "bag_0.mcap" in line
    read = list(BagReader(tmp_path / "bag").messages())
    assert [t for _, t, _ in read] == [k / 100 for k in range(300)]


def test_recording_changes_nothing(tmp_path):
    def run(with_recorder):
        builder = DiagramBuilder()
        sensors = builder.AddSystem(Sensors())
        if with_recorder:
            recorder = builder.AddSystem(
                Recorder(
                    channels=[Channel("sample", "/imu", IMU, 6, rate=30.0)],
                    writer=BagWriter(tmp_path / "bag"),
                )
            )
            builder.Connect(sensors.GetOutputPort("sample"), recorder.GetInputPort("sample"))
        simulator = Simulator(builder.Build())
        simulator.AdvanceTo(1.0)
        if with_recorder:
            recorder.close()
            recorder.close()  # again: nothing happens
        context = simulator.get_context()
        return sensors.GetMyContextFromRoot(context).get_discrete_state(0).get_value()[0]

    assert run(True) == run(False)


def test_a_recorder_without_connection_says_which_port(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        recorder = Recorder(channels=[Channel("sample", "/imu", IMU, 6, rate=10.0)], writer=writer)
        with pytest.raises(RuntimeError, match="sample"):
            Simulator(recorder).AdvanceTo(0.1)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"port": ""}, "port is ''"),
        ({"topic": "imu"}, "topic is 'imu'"),
        ({"rate": 0.0}, "rate is 0.0"),
        ({"rate": math.nan}, "rate is nan"),
        ({"model": 0}, "model is 0"),
        ({"only_new": True}, "a message with a stamp"),
        ({"encode": "sensor_msgs/msg/Imo"}, "did you mean 'sensor_msgs/msg/Imu'"),
    ],
)
def test_channels_that_cannot_be_are_refused(changes, text):
    good = {"port": "sample", "topic": "/imu", "encode": IMU, "model": 6, "rate": 10.0}
    with pytest.raises(ValueError, match=text):
        Channel(**{**good, **changes})


def test_a_recorder_needs_channels_of_different_names(tmp_path):
    channel = Channel("sample", "/imu", IMU, 6, rate=10.0)
    with BagWriter(tmp_path / "bag") as writer:
        for channels in ([], [channel, channel]):
            with pytest.raises(ValueError, match="channels is"):
                Recorder(channels=channels, writer=writer)


def test_a_vector_source_of_drake_is_recorded(tmp_path):
    builder = DiagramBuilder()
    source = builder.AddSystem(ConstantVectorSource([0.3, -0.2]))
    recorder = builder.AddSystem(
        Recorder(
            channels=[Channel("command", "/cmd_vel", "geometry_msgs/msg/Twist", 2, rate=10.0)],
            writer=BagWriter(tmp_path / "bag"),
        )
    )
    builder.Connect(source.get_output_port(), recorder.GetInputPort("command"))
    Simulator(builder.Build()).AdvanceTo(0.25)
    recorder.close()
    read = [(t, m.linear.x, m.angular.z) for _, t, m in BagReader(tmp_path / "bag").messages()]
    assert read == [(0.0, 0.3, -0.2), (0.1, 0.3, -0.2), (0.2, 0.3, -0.2)]


class Steps(LeafSystem):
    """A vector that changes at 1 s and at 2.5 s."""

    def __init__(self):
        super().__init__()
        self.DeclareVectorOutputPort("sample", 1, self.calc)

    def calc(self, context, output):
        t = context.get_time()
        output.SetFromVector([0.0 if t < 1 else 1.0 if t < 2.5 else 2.0])


def test_a_vector_that_stays_the_same_is_repeated_now_and_then(tmp_path):
    channel = Channel(
        port="sample",
        topic="/number",
        encode=lambda value, _: message_class("std_msgs/msg/Float64")(float(value[0])),
        model=1,
        rate=10.0,
        repeat=0.7,
    )
    builder = DiagramBuilder()
    steps = builder.AddSystem(Steps())
    recorder = builder.AddSystem(Recorder(channels=[channel], writer=BagWriter(tmp_path / "bag")))
    builder.Connect(steps.GetOutputPort("sample"), recorder.GetInputPort("sample"))
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(3.0)
    recorder.close()
    written = [(t, m.data) for _, t, m in BagReader(tmp_path / "bag").messages(["/number"])]
    times = [0.0, 0.7, 1.0, 1.7, 2.4, 2.5]
    np.testing.assert_allclose([t for t, _ in written], times, atol=1e-9)
    assert [value for _, value in written] == [0.0, 0.0, 1.0, 1.0, 1.0, 2.0]


def test_only_vectors_are_repeated():
    with pytest.raises(ValueError, match=r"repeat is 1\.0: must be 0, of what is no vector"):
        Channel(port="d", topic="/d", encode=TAGS, model=Detections(), rate=1.0, repeat=1.0)
    with pytest.raises(ValueError, match="repeat"):
        Channel(port="d", topic="/d", encode=TAGS, model=3, rate=1.0, repeat=-1.0)
