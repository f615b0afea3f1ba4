"""Lidar scans to ROS messages, and back."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from systems.io.ros_messages import decoder, encoder
from systems.io.ros_scan import scan_from_ros, scan_to_ros
from systems.io.ros_types import message_class, typestore
from systems.messages import Scan
from systems.sensors.lidar import LidarParameters, turn_of

LASER_SCAN = "sensor_msgs/msg/LaserScan"


def over_the_wire(message: Any) -> Any:
    """The message after CDR and back, by another serialiser than ours: rosbags'."""
    store = typestore()
    return store.deserialize_cdr(bytes(store.serialize_cdr(message, LASER_SCAN)), LASER_SCAN)


def some_scan(n: int = 360) -> Scan:
    turn = turn_of(LidarParameters(rays=n), end=12.345678901, frame_id="robot/lidar")
    ranges = np.random.default_rng(0).uniform(0.15, 12.0, n).astype(np.float32).astype(float)
    ranges[1], ranges[3] = math.inf, math.nan
    values = {name: getattr(turn, name) for name in ("stamp", "frame_id", *NUMBERS)}
    return Scan(**values, ranges=ranges)


NUMBERS = ("angle_min", "angle_increment", "time_increment", "range_min", "range_max")


@pytest.mark.parametrize("n", [360, 4])
def test_a_scan_of_the_lidar_survives_exactly(n: int) -> None:
    scan = some_scan(n)
    back = scan_from_ros(over_the_wire(scan_to_ros(scan)))
    for name in ("stamp", "frame_id", *NUMBERS):
        assert getattr(back, name) == getattr(scan, name), name
    assert back.ranges.dtype == np.float64
    np.testing.assert_array_equal(back.ranges, scan.ranges)
    np.testing.assert_array_equal(back.angles, scan.angles)


def test_others_read_what_we_mean() -> None:
    scan = some_scan()
    message = over_the_wire(scan_to_ros(scan))
    assert message.header.frame_id == "robot/lidar"
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (
        math.floor(scan.stamp),
        round(1e9 * (scan.stamp % 1)),
    )
    assert message.angle_min == pytest.approx(-math.pi, abs=1e-6)
    assert message.angle_max == pytest.approx(math.radians(179), abs=1e-6)  # of the last ray
    assert message.angle_increment == pytest.approx(math.radians(1), rel=1e-6)
    assert message.scan_time == pytest.approx(1 / 5.5, rel=1e-6)
    assert message.scan_time / message.time_increment == pytest.approx(360, rel=1e-6)
    assert len(message.ranges) == 360
    assert len(message.intensities) == 0
    assert np.asarray(message.ranges).dtype == np.float32
    assert message.ranges[1] == math.inf
    assert math.isnan(message.ranges[3])


def test_an_empty_scan_is_no_error() -> None:
    back = scan_from_ros(over_the_wire(scan_to_ros(Scan(stamp=1.0, range_max=10.0))))
    assert len(back) == 0
    assert back.stamp == 1.0


def laser_scan(**changes: Any) -> Any:
    """A message of another driver: 270 degrees, turning clockwise, with intensities."""
    fields = {
        "header": scan_to_ros(some_scan()).header,
        "angle_min": 2.35,
        "angle_max": -2.35,
        "angle_increment": -0.047,
        "time_increment": 1e-4,
        "scan_time": 0.025,
        "range_min": 0.05,
        "range_max": 30.0,
        "ranges": np.full(101, 2.5, np.float32),
        "intensities": np.full(101, 47.0, np.float32),
    }
    return message_class(LASER_SCAN)(**(fields | changes))


def test_a_scan_of_another_lidar_is_read() -> None:
    scan = scan_from_ros(over_the_wire(laser_scan()))
    assert scan.angles[0] == pytest.approx(2.35, abs=1e-6)
    assert scan.angles[-1] == pytest.approx(-2.35, abs=1e-5)
    assert scan.range_max == 30.0
    assert scan.ranges.tolist() == [2.5] * 101


def test_the_words_of_rep_117_for_no_range() -> None:
    ranges = np.array([math.inf, math.nan, -math.inf, 1.0], np.float32)
    scan = scan_from_ros(over_the_wire(laser_scan(ranges=ranges)))
    np.testing.assert_array_equal(scan.ranges, [math.inf, math.nan, math.nan, 1.0])
    assert ranges[2] == -math.inf  # the message is as it was


def test_it_is_the_usual_conversion_of_its_type() -> None:
    scan = some_scan()
    message = encoder(LASER_SCAN)(scan, 99.0)
    assert message.__msgtype__ == LASER_SCAN
    np.testing.assert_array_equal(decoder(LASER_SCAN)(message).ranges, scan.ranges)


def test_ros_1_is_read_too() -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types
    header = types["std_msgs/msg/Header"](7, types["builtin_interfaces/msg/Time"](3, 250), "laser")
    ranges = np.array([0.5, math.inf], np.float32)
    none = np.zeros(0, np.float32)
    message = types[LASER_SCAN](header, -0.5, 0.5, 1.0, 0.01, 0.1, 0.125, 8.0, ranges, none)
    data = bytes(store.serialize_ros1(message, LASER_SCAN))
    scan = scan_from_ros(store.deserialize_ros1(data, LASER_SCAN))
    assert (scan.stamp, scan.frame_id) == (3.00000025, "laser")
    assert (scan.angle_min, scan.angle_increment, scan.range_min) == (-0.5, 1.0, 0.125)
    np.testing.assert_array_equal(scan.ranges, [0.5, math.inf])
