"""Time as ROS keeps it, and message definitions."""

from __future__ import annotations

import random
from fractions import Fraction

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from systems.io import ros_types
from systems.io.ros_types import nanoseconds, seconds, time_from_ros, time_to_ros
from systems.messages import whole_nanoseconds


@pytest.mark.parametrize("start", [0, 10**9, 86_400 * 10**9, 1_527_206_460 * 10**9, -(10**12)])
def test_a_stamp_of_whole_nanoseconds_is_read_back_as_the_same_float(start):
    draw = random.Random(1)
    for _ in range(2000):
        stamp = (start + draw.randrange(10**12)) / 10**9
        assert time_from_ros(time_to_ros(stamp)) == stamp
        assert seconds(nanoseconds(stamp)) == stamp


def test_periodic_times_survive_as_sensors_stamp_them():
    for k in range(20_000):
        stamp = whole_nanoseconds(k * 0.01)
        assert time_from_ros(time_to_ros(stamp)) == stamp
        assert nanoseconds(k * 0.01) == k * 10**7


def test_nanoseconds_are_the_nearest_ones_of_the_exact_float():
    draw = random.Random(2)
    for scale in (1e-3, 1.0, 1e3, 1e6, 1.6e9):
        for _ in range(500):
            t = draw.uniform(-scale, scale)
            error = abs(Fraction(t) * 10**9 - nanoseconds(t))
            assert error <= Fraction(1, 2) + Fraction(1, 10**6)


def test_negative_times_keep_the_nanoseconds_positive():
    time = time_to_ros(-0.25)
    assert (time.sec, time.nanosec) == (-1, 750_000_000)


@pytest.mark.parametrize("t", [float("nan"), float("inf"), 2.0**31, -(2.0**31) - 1])
def test_times_that_ros_cannot_hold_are_refused(t):
    with pytest.raises(ValueError, match="time is"):
        time_to_ros(t)


def test_a_definition_holds_all_that_it_depends_on():
    name = "apriltag_msgs/msg/AprilTagDetectionArray"
    types = get_types_from_msg(ros_types.definition(name), name)
    fresh = get_typestore(Stores.EMPTY)
    fresh.register(types)
    fresh.get_msgdef(name)  # raises when a part is missing
    fields = [field for field, _ in types["apriltag_msgs/msg/AprilTagDetection"][1]]
    assert fields == [
        "family",
        "id",
        "hamming",
        "goodness",
        "decision_margin",
        "centre",
        "corners",
        "homography",
    ]


def test_comments_in_a_definition_do_not_make_another_type():
    text = "# a comment\nbuiltin_interfaces/Time stamp # and one more\n\nstring frame_id\n"
    assert ros_types.typestore_for("std_msgs/msg/Header", text, "msg") is ros_types.typestore()


def test_other_fields_make_another_type():
    text = "uint32 seq\ntime stamp\nstring frame_id\n"  # ROS 1's
    store = ros_types.typestore_for("std_msgs/msg/Header", text, "msg")
    assert store is not ros_types.typestore()
    message = store.types["std_msgs/msg/Header"](7, ros_types.time_to_ros(1.5), "map")
    data = store.serialize_ros1(message, "std_msgs/msg/Header")
    back = ros_types.deserialise(
        data, msgtype="std_msgs/msg/Header", text=text, encoding="msg", ros1=True
    )
    assert (back.seq, back.frame_id, time_from_ros(back.stamp)) == (7, "map", 1.5)


def test_an_idl_definition_is_read():
    text = (
        "=" * 80 + "\nIDL: mine/msg/Pair\nmodule mine { module msg { struct Pair {"
        " double first; double second; }; }; };\n"
    )
    store = ros_types.typestore_for("mine/msg/Pair", text, "idl")
    data = store.serialize_cdr(store.types["mine/msg/Pair"](1.0, 2.0), "mine/msg/Pair")
    back = ros_types.deserialise(
        data, msgtype="mine/msg/Pair", text=text, encoding="idl", ros1=False
    )
    assert (back.first, back.second) == (1.0, 2.0)


@pytest.mark.parametrize(
    ("msgtype", "text", "reason"),
    [
        ("mine/msg/Unheard", "", "no standard message and the recording does not define it"),
        ("mine/msg/Broken", "this is {no definition", "cannot be read"),
        ("mine/msg/Open", "mine/Missing part\n", "cannot be read"),
    ],
)
def test_a_type_that_cannot_be_read_says_so_in_one_line(msgtype, text, reason):
    with pytest.raises(ValueError, match=reason) as caught:
        ros_types.typestore_for(msgtype, text, "msg")
    assert msgtype in str(caught.value)
    assert "\n" not in str(caught.value)


def test_bytes_that_do_not_fit_say_so():
    with pytest.raises(ValueError, match="sensor_msgs/msg/Imu cannot be read"):
        ros_types.deserialise(
            b"\x00\x01\x00\x00short",
            msgtype="sensor_msgs/msg/Imu",
            text="",
            encoding="msg",
            ros1=False,
        )
