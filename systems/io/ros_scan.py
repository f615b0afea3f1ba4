"""Lidar scans to ROS messages, and back. The reader takes ROS 1 messages too."""

from __future__ import annotations

from typing import Any

import numpy as np

from systems.io.ros_types import header, message_class, time_from_ros
from systems.messages import Scan


def scan_to_ros(scan: Scan) -> Any:
    """Returns `sensor_msgs/msg/LaserScan`, without intensities.

    ROS keeps all its numbers but the stamp in single precision. `scan_time`, from one scan to the
    next, is taken as that of a turn without a pause.
    """
    n = len(scan)
    return message_class("sensor_msgs/msg/LaserScan")(
        header=header(scan.stamp, scan.frame_id),
        angle_min=scan.angle_min,
        angle_max=scan.angle_min + max(n - 1, 0) * scan.angle_increment,
        angle_increment=scan.angle_increment,
        time_increment=scan.time_increment,
        scan_time=n * scan.time_increment,
        range_min=scan.range_min,
        range_max=scan.range_max,
        ranges=scan.ranges.astype(np.float32),
        intensities=np.zeros(0, np.float32),
    )


def scan_from_ros(message: Any) -> Scan:
    """Returns the scan of a `LaserScan`.

    Of REP 117's three kinds of ranges that are none, +inf (nothing in reach) and NaN stay; -inf
    (something nearer than range_min) becomes NaN, as a failed measurement does. Intensities are
    lost.
    """
    ranges = np.array(message.ranges, np.float64)
    ranges[np.isneginf(ranges)] = np.nan
    return Scan(
        stamp=time_from_ros(message.header.stamp),
        frame_id=message.header.frame_id,
        angle_min=float(message.angle_min),
        angle_increment=float(message.angle_increment),
        time_increment=float(message.time_increment),
        range_min=float(message.range_min),
        range_max=float(message.range_max),
        ranges=ranges,
    )
