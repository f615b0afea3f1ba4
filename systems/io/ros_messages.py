"""Which conversion belongs to which ROS message type, for recording and for playing back.

The conversions themselves are in `ros_vision`, `ros_flow`, `ros_motion` and `ros_scan`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from systems.io import ros_flow, ros_motion, ros_scan, ros_vision
from systems.io.ros_detections import serialised_detections
from systems.validation import nearest

Encoder = Callable[[Any, float], Any]
"""Makes the ROS message of a port's value, and of the time for values that carry none (s).

As an object, or as bytes already (`systems.io.stencils.SerialisedMessage`).
"""

Decoder = Callable[[Any], Any]
"""Makes our value of a ROS message, of ROS 2 or ROS 1."""

ENCODERS: Mapping[str, Encoder] = {
    "apriltag_msgs/msg/AprilTagDetectionArray": lambda v, _: serialised_detections(v),
    "geometry_msgs/msg/PoseStamped": lambda v, t: ros_motion.pose_to_ros(
        v, stamp=t, frame_id="map"
    ),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda v, _: ros_motion.estimate_to_ros(v),
    "geometry_msgs/msg/Twist": lambda v, _: ros_motion.command_to_ros(v),
    "geometry_msgs/msg/TwistStamped": lambda v, t: ros_motion.stamped_command_to_ros(v, stamp=t),
    "sensor_msgs/msg/CompressedImage": lambda v, _: ros_vision.image_to_ros(v),
    "sensor_msgs/msg/Imu": lambda v, t: ros_motion.imu_to_ros(v, stamp=t, frame_id="imu"),
    "sensor_msgs/msg/LaserScan": lambda v, _: ros_scan.scan_to_ros(v),
    "sensor_msgs/msg/PointCloud2": lambda v, _: ros_flow.serialised_matches(v),
}

DECODERS: Mapping[str, Decoder] = {
    "apriltag_msgs/msg/AprilTagDetectionArray": ros_vision.detections_from_ros,
    "apriltag_msgs/msg/ApriltagArrayStamped": ros_vision.detections_from_ros,
    "geometry_msgs/msg/PoseStamped": ros_motion.pose_from_ros,
    "geometry_msgs/msg/PoseWithCovarianceStamped": ros_motion.estimate_from_ros,
    "geometry_msgs/msg/Twist": ros_motion.command_from_ros,
    "geometry_msgs/msg/TwistStamped": ros_motion.command_from_ros,
    "nav_msgs/msg/Odometry": ros_motion.estimate_from_ros,
    "sensor_msgs/msg/CameraInfo": ros_vision.camera_from_ros,
    "sensor_msgs/msg/CompressedImage": ros_vision.image_from_ros,
    "sensor_msgs/msg/Image": ros_vision.image_from_ros,
    "sensor_msgs/msg/Imu": ros_motion.imu_from_ros,
    "sensor_msgs/msg/LaserScan": ros_scan.scan_from_ros,
    "sensor_msgs/msg/PointCloud2": ros_flow.matches_from_ros,
    "tf/msg/tfMessage": ros_motion.transforms_from_ros,
    "tf2_msgs/msg/TFMessage": ros_motion.transforms_from_ros,
}


def encoder(msgtype: str) -> Encoder:
    """Returns the usual encoder of a message type.

    Raises:
        ValueError: the type has none.
    """
    return _entry(ENCODERS, msgtype)


def decoder(msgtype: str) -> Decoder:
    """Returns the usual decoder of a message type.

    Raises:
        ValueError: the type has none.
    """
    return _entry(DECODERS, msgtype)


def _entry(table: Mapping[str, Any], msgtype: str) -> Any:
    if msgtype not in table:
        raise ValueError(
            f"message type is {msgtype!r}: no conversion is known, give one; "
            f"{nearest(msgtype, table)}"
        )
    return table[msgtype]
