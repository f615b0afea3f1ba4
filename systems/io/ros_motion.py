"""Inertial samples, commands, estimates and transforms to ROS 2 messages, and back.

ROS orders a pose's covariance position first, ours is rotation first: it is reordered here and
nowhere else. What ROS has no field for is lost, and named. The readers take ROS 1 messages too.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from systems.io.ros_types import header, message_class, time_from_ros
from systems.messages import PoseEstimate
from systems.validation import require

Array = NDArray[np.float64]

# Where the elements of a position-first covariance stand in a rotation-first one, and the reverse.
_SWAPPED = (6 * np.array([3, 4, 5, 0, 1, 2])[:, None] + [3, 4, 5, 0, 1, 2]).ravel()
_FIELDS = np.concatenate([[4, 5, 6, 1, 2, 3, 0], 7 + _SWAPPED])  # of a pose's vector
_PLANAR = np.ix_([0, 1, 5], [0, 1, 5])  # where x, y, theta stand in a position-first one
_IDENTITY = np.eye(3).ravel()
_NO_ORIENTATION = np.array([-1.0, 0, 0, 0, 0, 0, 0, 0, 0])  # as ROS says it
_QUATERNION_TOLERANCE = 1e-3


class FrameTransform(NamedTuple):
    """A pose of one frame in another, as /tf carries it.

    Attributes:
        stamp: s.
        frame_id: the parent.
        child_frame_id: the child.
        pose: the child's pose in the parent, `X_{parent}{child}`.
    """

    stamp: float
    frame_id: str
    child_frame_id: str
    pose: RigidTransform


def imu_to_ros(
    sample: Array,
    *,
    stamp: float,
    frame_id: str,
    gyro_variance: float = 0.0,
    accel_variance: float = 0.0,
) -> Any:
    """Returns `sensor_msgs/msg/Imu` without orientation.

    Args:
        sample: (6,) [gyro (rad/s), accel (m/s^2)].
        stamp: s.
        frame_id: frame of the sensor.
        gyro_variance: of one axis, (rad/s)^2: noise density squared times the rate; 0 means
            unknown, as ROS has it.
        accel_variance: likewise, (m/s^2)^2.
    """
    vector = message_class("geometry_msgs/msg/Vector3")
    wx, wy, wz, ax, ay, az = np.asarray(sample, float).tolist()
    return message_class("sensor_msgs/msg/Imu")(
        header(stamp, frame_id),
        message_class("geometry_msgs/msg/Quaternion")(0.0, 0.0, 0.0, 1.0),
        _NO_ORIENTATION,
        vector(wx, wy, wz),
        gyro_variance * _IDENTITY,
        vector(ax, ay, az),
        accel_variance * _IDENTITY,
    )


def imu_from_ros(message: Any) -> Array:
    """Returns the sample [gyro (rad/s), accel (m/s^2)] of an `Imu`: (6,)."""
    w, a = message.angular_velocity, message.linear_acceleration
    return np.array([w.x, w.y, w.z, a.x, a.y, a.z])


def command_to_ros(command: Array) -> Any:
    """Returns `geometry_msgs/msg/Twist` of a drive command [v (m/s), omega (rad/s)]."""
    vector = message_class("geometry_msgs/msg/Vector3")
    v, omega = np.asarray(command, float).tolist()
    return message_class("geometry_msgs/msg/Twist")(vector(v, 0.0, 0.0), vector(0.0, 0.0, omega))


def stamped_command_to_ros(command: Array, *, stamp: float, frame_id: str = "base_link") -> Any:
    """Returns `geometry_msgs/msg/TwistStamped` of a drive command [v (m/s), omega (rad/s)]."""
    return message_class("geometry_msgs/msg/TwistStamped")(
        header(stamp, frame_id), command_to_ros(command)
    )


def command_from_ros(message: Any) -> Array:
    """Returns the drive command [v (m/s), omega (rad/s)] of a `Twist` or `TwistStamped`: (2,)."""
    twist = message.twist if hasattr(message, "twist") else message
    return np.array([twist.linear.x, twist.angular.z])


def estimate_to_ros(estimate: PoseEstimate) -> Any:
    """Returns `geometry_msgs/msg/PoseWithCovarianceStamped`.

    The child's frame, the reprojection error, the ambiguity and the number of markers are lost.
    """
    covariance = estimate.covariance.take(_SWAPPED)
    return _with_covariance(estimate.stamp, estimate.frame_id, _pose(estimate.pose), covariance)


def estimate_from_ros(message: Any, *, child_frame_id: str = "base_link") -> PoseEstimate:
    """Returns the estimate of a `PoseWithCovarianceStamped` or an `Odometry`.

    Raises:
        ValueError: a quaternion that is not of length 1.
    """
    return PoseEstimate(
        stamp=time_from_ros(message.header.stamp),
        frame_id=message.header.frame_id,
        child_frame_id=getattr(message, "child_frame_id", "") or child_frame_id,
        pose=_rigid(message.pose.pose.position, message.pose.pose.orientation),
        covariance=np.asarray(message.pose.covariance).take(_SWAPPED).reshape(6, 6),
    )


def planar_estimate_to_ros(
    pose: Array, covariance: Array, *, stamp: float, frame_id: str = "map"
) -> Any:
    """Returns `geometry_msgs/msg/PoseWithCovarianceStamped` of a planar estimate.

    Args:
        pose: (3,) [x (m), y (m), theta (rad)].
        covariance: (3, 3) in that order.
        stamp: s.
        frame_id: the frame that the pose is in.
    """
    spatial = np.zeros((6, 6))
    spatial[_PLANAR] = covariance
    return _with_covariance(stamp, frame_id, _planar_pose(pose), spatial.ravel())


def planar_estimate_from_ros(message: Any) -> tuple[Array, Array]:
    """Returns pose (3,) [x (m), y (m), theta (rad)] and covariance (3, 3) of a planar estimate.

    Theta is in [-pi, pi] and within a few units of the last digit of what was written.
    """
    position, q = message.pose.pose.position, message.pose.pose.orientation
    # The heading of any orientation, and of a quaternion of any length.
    theta = math.atan2(2 * (q.w * q.z + q.x * q.y), q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z)
    covariance = np.asarray(message.pose.covariance).reshape(6, 6)
    return np.array([position.x, position.y, theta]), covariance[_PLANAR]


def odometry_to_ros(
    pose: Array,
    covariance: Array,
    velocity: Array,
    *,
    stamp: float,
    frame_id: str = "odom",
    child_frame_id: str = "base_link",
) -> Any:
    """Returns `nav_msgs/msg/Odometry` of planar odometry.

    Args:
        pose: (3,) [x (m), y (m), theta (rad)] of the child in the frame.
        covariance: (3, 3) in that order.
        velocity: (2,) [v (m/s), omega (rad/s)] in the child's axes. Its covariance is told as
            unknown (zeros).
        stamp: s.
        frame_id: the frame that the pose is in.
        child_frame_id: whose pose it is.
    """
    estimate = planar_estimate_to_ros(pose, covariance, stamp=stamp, frame_id=frame_id)
    return message_class("nav_msgs/msg/Odometry")(
        estimate.header,
        child_frame_id,
        estimate.pose,
        message_class("geometry_msgs/msg/TwistWithCovariance")(
            command_to_ros(velocity), np.zeros(36)
        ),
    )


def odometry_from_ros(message: Any) -> tuple[Array, Array, Array]:
    """Returns pose (3,), its covariance (3, 3) and velocity (2,) of planar odometry."""
    return *planar_estimate_from_ros(message), command_from_ros(message.twist)


def pose_to_ros(pose: RigidTransform, *, stamp: float, frame_id: str) -> Any:
    """Returns `geometry_msgs/msg/PoseStamped`."""
    return message_class("geometry_msgs/msg/PoseStamped")(header(stamp, frame_id), _pose(pose))


def planar_pose_to_ros(pose: Array, *, stamp: float, frame_id: str) -> Any:
    """Returns `geometry_msgs/msg/PoseStamped` of a planar pose (3,) [x (m), y (m), theta (rad)]."""
    return message_class("geometry_msgs/msg/PoseStamped")(
        header(stamp, frame_id), _planar_pose(pose)
    )


def planar_fields(pose: Array) -> tuple[float, float, float, float]:
    """Returns what of a ROS pose a planar one (3,) [x (m), y (m), theta (rad)] tells.

    Returns:
        x and y of the position (m), z and w of the quaternion; the rest is 0.
    """
    x, y, theta = np.asarray(pose, float).tolist()
    return x, y, math.sin(theta / 2), math.cos(theta / 2)


def pose_fields(vector: Array) -> Array:
    """Returns the position (m), then x, y, z, w of the quaternion, of a pose's vector.

    With a covariance after it, (43,), also that in ROS's order.

    Args:
        vector: (7,) as `systems.pose_vector` has it, or with 36 elements more, rotation first.
    """
    return vector.take(_FIELDS[: len(vector)])


def pose_from_ros(message: Any) -> RigidTransform:
    """Returns the pose of a `PoseStamped`.

    Raises:
        ValueError: a quaternion that is not of length 1.
    """
    return _rigid(message.pose.position, message.pose.orientation)


def transforms_to_ros(transforms: Iterable[FrameTransform]) -> Any:
    """Returns `tf2_msgs/msg/TFMessage`, for /tf and /tf_static."""
    stamped = message_class("geometry_msgs/msg/TransformStamped")
    transform = message_class("geometry_msgs/msg/Transform")
    vector = message_class("geometry_msgs/msg/Vector3")
    return message_class("tf2_msgs/msg/TFMessage")(
        [
            stamped(
                header(entry.stamp, entry.frame_id),
                entry.child_frame_id,
                transform(vector(*entry.pose.translation().tolist()), _quaternion(entry.pose)),
            )
            for entry in transforms
        ]
    )


def planar_transforms_to_ros(
    poses: Array, *, stamp: float, frame_id: str, child_frame_ids: Sequence[str]
) -> Any:
    """Returns `tf2_msgs/msg/TFMessage` of planar poses (n, 3) [x (m), y (m), theta (rad)]."""
    stamped = message_class("geometry_msgs/msg/TransformStamped")
    transform = message_class("geometry_msgs/msg/Transform")
    vector = message_class("geometry_msgs/msg/Vector3")
    quaternion = message_class("geometry_msgs/msg/Quaternion")
    transforms = []
    for child, pose in zip(child_frame_ids, poses, strict=True):
        x, y, qz, qw = planar_fields(pose)
        motion = transform(vector(x, y, 0.0), quaternion(0.0, 0.0, qz, qw))
        transforms.append(stamped(header(stamp, frame_id), child, motion))
    return message_class("tf2_msgs/msg/TFMessage")(transforms)


def transforms_from_ros(message: Any) -> list[FrameTransform]:
    """Returns the transforms of a `TFMessage`.

    Raises:
        ValueError: a quaternion that is not of length 1.
    """
    return [
        FrameTransform(
            stamp=time_from_ros(entry.header.stamp),
            frame_id=entry.header.frame_id,
            child_frame_id=entry.child_frame_id,
            pose=_rigid(entry.transform.translation, entry.transform.rotation),
        )
        for entry in message.transforms
    ]


def _with_covariance(stamp: float, frame_id: str, pose: Any, covariance: Array) -> Any:
    return message_class("geometry_msgs/msg/PoseWithCovarianceStamped")(
        header(stamp, frame_id),
        message_class("geometry_msgs/msg/PoseWithCovariance")(pose, covariance),
    )


def _pose(pose: RigidTransform) -> Any:
    position = message_class("geometry_msgs/msg/Point")(*pose.translation().tolist())
    return message_class("geometry_msgs/msg/Pose")(position, _quaternion(pose))


def _planar_pose(pose: Array) -> Any:
    x, y, qz, qw = planar_fields(pose)
    return message_class("geometry_msgs/msg/Pose")(
        message_class("geometry_msgs/msg/Point")(x, y, 0.0),
        message_class("geometry_msgs/msg/Quaternion")(0.0, 0.0, qz, qw),
    )


def _quaternion(pose: RigidTransform) -> Any:
    w, x, y, z = pose.rotation().ToQuaternion().wxyz().tolist()
    return message_class("geometry_msgs/msg/Quaternion")(x, y, z, w)


def _rigid(position: Any, orientation: Any) -> RigidTransform:
    # Any: pydrake's stubs ask for an array type that NumPy's own do not give.
    q: Any = np.array([orientation.w, orientation.x, orientation.y, orientation.z])
    p: Any = np.array([position.x, position.y, position.z])
    length = float(np.linalg.norm(q))
    # Written so that NaN is refused.
    require(abs(length - 1) <= _QUATERNION_TOLERANCE, "length of quaternion", length, "1")
    return RigidTransform(RotationMatrix(Quaternion(q / length)), p)
