"""Messages written by filling in an example's fields: the bytes that rosbags would write."""

from __future__ import annotations

import math

import numpy as np
import pytest

from systems.io import ros_motion
from systems.io.bag import BagReader, BagWriter
from systems.io.ros_types import message_class, typestore
from systems.io.ros_wheels import wheel_angles_to_ros
from systems.io.stencils import SerialisedMessage, Stencil


def imu(sample, t, frame_id="imu"):
    return ros_motion.imu_to_ros(
        sample, stamp=t, frame_id=frame_id, gyro_variance=3e-7, accel_variance=0.25
    )


def frames(values, t):
    return ros_motion.planar_transforms_to_ros(
        values.reshape(-1, 3), stamp=t, frame_id="map", child_frame_ids=["a", "robot/base_link"]
    )


def estimate(values, t):
    return ros_motion.planar_estimate_to_ros(values[:3], values[3:].reshape(3, 3), stamp=t)


# Name to (size of the value, message of value and time, fields of the value).
MESSAGES = {
    "imu": (6, imu, None),
    "imu of another frame": (6, lambda v, t: imu(v, t, "a/b/c"), None),
    "imu without a frame": (6, lambda v, t: imu(v, t, ""), None),
    "twist": (2, lambda v, _: ros_motion.command_to_ros(v), None),
    "stamped twist": (2, lambda v, t: ros_motion.stamped_command_to_ros(v, stamp=t), None),
    "number": (1, lambda v, _: message_class("std_msgs/msg/Float64")(float(v[0])), None),
    "wheels": (2, lambda v, t: wheel_angles_to_ros(v, stamp=t, frame_id="wheels"), None),
    "pose": (
        3,
        lambda v, t: ros_motion.planar_pose_to_ros(v, stamp=t, frame_id="map"),
        ros_motion.planar_fields,
    ),
    "estimate": (12, estimate, lambda v: [*ros_motion.planar_fields(v[:3]), *v[3:]]),
    "frames": (
        6,
        frames,
        lambda v: [*ros_motion.planar_fields(v[:3]), *ros_motion.planar_fields(v[3:])],
    ),
}


def stencil_of(name):
    size, make, numbers = MESSAGES[name]
    unknown = np.full(size, np.nan)
    return Stencil(lambda t: make(unknown, t), *([] if numbers is None else [numbers]))


@pytest.mark.parametrize("name", MESSAGES)
def test_the_bytes_are_those_of_rosbags(name):
    size, make, _ = MESSAGES[name]
    stencil = stencil_of(name)
    rng = np.random.default_rng(0)
    stamps = [0.0, 0.1 + 0.2, 1527206460.123456, -0.25, 2.0**31 - 1, *rng.uniform(0, 1e4, 200)]
    for stamp in stamps:
        value = rng.normal(size=size) * 10.0 ** rng.integers(-300, 300, size)
        message = make(value, stamp)
        expected = typestore().serialize_cdr(message, message.__msgtype__)
        written = stencil(value, stamp)
        assert written == SerialisedMessage(message.__msgtype__, bytes(expected))


@pytest.mark.parametrize("special", [math.nan, math.inf, -math.inf, -0.0, 5e-324])
def test_a_field_may_be_filled_with_any_number(special):
    value = np.array([special, 2.0])
    message = ros_motion.command_to_ros(value)
    expected = typestore().serialize_cdr(message, message.__msgtype__)
    assert stencil_of("twist")(value, 0.0).data == bytes(expected)


def test_a_message_keeps_nothing_of_the_one_before():
    stencil = stencil_of("estimate")
    rng = np.random.default_rng(1)
    first, second = rng.normal(size=(2, 12))
    written = stencil(first, 1.5)
    stencil(second, 700.25)
    assert written == stencil(first, 1.5)


def test_more_or_fewer_numbers_than_fields_are_refused():
    for numbers in (np.zeros(5), np.zeros(7), np.zeros(1)):
        with pytest.raises(ValueError, match=r"numbers of sensor_msgs/msg/Imu .* 6 as the fields"):
            stencil_of("imu")(numbers, 0.0)


@pytest.mark.parametrize("stamp", [math.nan, math.inf, 2.0**31, -(2.0**31) - 1])
def test_a_stamp_that_ros_cannot_keep_is_refused(stamp):
    with pytest.raises(ValueError, match="time is"):
        stencil_of("imu")(np.zeros(6), stamp)


def test_both_kinds_of_messages_make_the_same_recording(tmp_path):
    stencil = stencil_of("imu")
    samples = np.random.default_rng(2).normal(size=(150, 6))
    for name, encode in (("objects", imu), ("bytes", stencil)):
        with BagWriter(tmp_path / name / "bag") as writer:
            for k, sample in enumerate(samples):
                message = encode(sample, k / 100)
                writer.write("/imu", message.__msgtype__, message, k / 100)
    files = [(tmp_path / name / "bag" / "bag_0.mcap").read_bytes() for name in ("objects", "bytes")]
    assert files[0] == files[1]
    read = [message for _, _, message in BagReader(tmp_path / "bytes" / "bag").messages()]
    np.testing.assert_array_equal([ros_motion.imu_from_ros(m) for m in read], samples)


def test_a_serialised_message_of_another_type_is_refused(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        twist = stencil_of("twist")(np.zeros(2), 0.0)
        with pytest.raises(ValueError, match="message on /imu is no sensor_msgs/msg/Imu"):
            writer.write("/imu", "sensor_msgs/msg/Imu", twist, 0.0)
