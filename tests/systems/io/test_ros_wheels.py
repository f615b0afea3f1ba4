from __future__ import annotations

import numpy as np
import pytest

from systems.io.ros_types import message_class, typestore
from systems.io.ros_wheels import wheel_angles_from_ros, wheel_angles_to_ros


def test_angles_survive_their_message() -> None:
    angles = np.array([12.5, -3.0])
    message = wheel_angles_to_ros(angles, stamp=1.5, frame_id="robot/encoders")
    assert message.header.frame_id == "robot/encoders"
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1, 500_000_000)
    kind = "sensor_msgs/msg/JointState"
    read = typestore().deserialize_cdr(typestore().serialize_cdr(message, kind), kind)
    assert list(read.name) == ["right_wheel", "left_wheel"]
    np.testing.assert_array_equal(wheel_angles_from_ros(read), angles)


def test_the_wheels_are_found_by_name_among_other_joints() -> None:
    message = wheel_angles_to_ros([1.0, 2.0], stamp=0.0, frame_id="")
    state = message_class("sensor_msgs/msg/JointState")
    names, nothing = ["left_wheel", "arm", "right_wheel"], np.zeros(0)
    other = state(message.header, names, np.array([2.0, 9.0, 1.0]), nothing, nothing)
    np.testing.assert_array_equal(wheel_angles_from_ros(other), [1.0, 2.0])
    lacking = state(message.header, names[:2], np.array([2.0, 9.0]), nothing, nothing)
    with pytest.raises(ValueError, match=r"name is .*: must be among others 'right_wheel'"):
        wheel_angles_from_ros(lacking)
