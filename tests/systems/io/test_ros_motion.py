"""Inertial samples, commands, estimates and transforms to ROS messages, and back."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from systems.io import ros_motion
from systems.io.ros_motion import FrameTransform
from systems.io.ros_types import time_from_ros, typestore
from systems.messages import PoseEstimate

POSE = RigidTransform(RollPitchYaw(0.3, -0.7, 2.1), [1.5, -2.25, 0.125])


def over_the_wire(message):
    store = typestore()
    msgtype = message.__msgtype__
    return store.deserialize_cdr(bytes(store.serialize_cdr(message, msgtype)), msgtype)


def random_covariance(n):
    a = np.random.default_rng(n).normal(size=(n, n))
    return a @ a.T


def assert_close(X, Y):
    np.testing.assert_allclose(X.GetAsMatrix4(), Y.GetAsMatrix4(), atol=2e-15)


def test_an_inertial_sample_survives_exactly():
    sample = np.random.default_rng(0).normal(size=6)
    message = over_the_wire(
        ros_motion.imu_to_ros(
            sample, stamp=0.01, frame_id="imu", gyro_variance=1e-4, accel_variance=4e-2
        )
    )
    np.testing.assert_array_equal(ros_motion.imu_from_ros(message), sample)
    assert time_from_ros(message.header.stamp) == 0.01
    assert message.orientation_covariance[0] == -1  # ROS: there is no orientation
    np.testing.assert_array_equal(
        np.asarray(message.angular_velocity_covariance).reshape(3, 3), 1e-4 * np.eye(3)
    )
    np.testing.assert_array_equal(
        np.asarray(message.linear_acceleration_covariance).reshape(3, 3), 4e-2 * np.eye(3)
    )


def test_a_command_survives_exactly_stamped_or_not():
    command = np.array([0.1 + 0.2, -1 / 3])
    plain = over_the_wire(ros_motion.command_to_ros(command))
    stamped = over_the_wire(ros_motion.stamped_command_to_ros(command, stamp=1.0))
    assert (plain.linear.x, plain.angular.z) == tuple(command)
    for message in (plain, stamped):
        np.testing.assert_array_equal(ros_motion.command_from_ros(message), command)


def test_an_estimate_survives():
    estimate = PoseEstimate(
        stamp=1527206460.125,
        frame_id="map",
        child_frame_id="base_link",
        pose=POSE,
        covariance=random_covariance(6),
    )
    back = ros_motion.estimate_from_ros(over_the_wire(ros_motion.estimate_to_ros(estimate)))
    assert (back.stamp, back.frame_id, back.child_frame_id) == (
        estimate.stamp,
        "map",
        "base_link",
    )
    np.testing.assert_array_equal(back.covariance, estimate.covariance)
    assert_close(back.pose, POSE)


def test_the_covariance_is_reordered_for_ros():
    variances = np.array([1.0, 2, 3, 40, 50, 60])  # rotation about x, y, z; position x, y, z
    covariance = np.diag(variances)
    covariance[0, 4] = covariance[4, 0] = 0.5  # rotation about x with position y
    message = ros_motion.estimate_to_ros(PoseEstimate(stamp=0.0, covariance=covariance))
    theirs = np.asarray(message.pose.covariance).reshape(6, 6)
    assert np.diag(theirs).tolist() == [40, 50, 60, 1, 2, 3]  # position first
    assert theirs[1, 3] == theirs[3, 1] == 0.5


def test_the_childs_frame_of_odometry_is_kept():
    estimate = PoseEstimate(stamp=0.0, frame_id="odom", covariance=np.eye(6))
    message = ros_motion.estimate_to_ros(estimate)
    message.child_frame_id = "wheels"
    assert ros_motion.estimate_from_ros(message).child_frame_id == "wheels"


@pytest.mark.parametrize("theta", [0.0, 0.1, -3.0, 3.14159, math.pi, -math.pi / 2, 1e-12])
def test_a_planar_estimate_survives(theta):
    pose = np.array([0.1, -7.7, theta])
    covariance = random_covariance(3)
    message = over_the_wire(
        ros_motion.planar_estimate_to_ros(pose, covariance, stamp=0.5, frame_id="map")
    )
    back, back_covariance = ros_motion.planar_estimate_from_ros(message)
    np.testing.assert_array_equal(back[:2], pose[:2])
    assert abs(back[2] - theta) < 1e-15
    np.testing.assert_array_equal(back_covariance, covariance)


def test_a_planar_estimate_is_the_spatial_one_for_others():
    message = ros_motion.planar_estimate_to_ros(
        np.array([1.0, 2.0, 0.7]), np.diag([0.01, 0.04, 0.09]), stamp=0.0
    )
    estimate = ros_motion.estimate_from_ros(message)
    assert_close(estimate.pose, RigidTransform(RollPitchYaw(0, 0, 0.7), [1.0, 2.0, 0.0]))
    assert np.diag(estimate.covariance).tolist() == [0, 0, 0.09, 0.01, 0.04, 0]


def test_the_heading_of_a_tilted_pose_is_its_yaw():
    message = ros_motion.estimate_to_ros(PoseEstimate(stamp=0.0, pose=POSE, covariance=np.eye(6)))
    pose, _ = ros_motion.planar_estimate_from_ros(message)
    np.testing.assert_allclose(pose, [1.5, -2.25, 2.1], atol=1e-14)


def test_poses_and_transforms_survive():
    stamped = over_the_wire(ros_motion.pose_to_ros(POSE, stamp=1.0, frame_id="map"))
    assert_close(ros_motion.pose_from_ros(stamped), POSE)
    transforms = [
        FrameTransform(0.25, "map", "odom", RigidTransform()),
        FrameTransform(0.5, "odom", "base_link", POSE),
    ]
    back = ros_motion.transforms_from_ros(over_the_wire(ros_motion.transforms_to_ros(transforms)))
    assert [entry[:3] for entry in back] == [entry[:3] for entry in transforms]
    for ours, theirs in zip(transforms, back, strict=True):
        assert_close(ours.pose, theirs.pose)


@pytest.mark.parametrize("q", [(0.0, 0, 0, 0), (0, 0, 0, 1.1), (math.nan, 0, 0, 1)])
def test_quaternions_that_are_none_are_refused(q):
    message = ros_motion.pose_to_ros(POSE, stamp=0.0, frame_id="map")
    orientation = message.pose.orientation
    orientation.x, orientation.y, orientation.z, orientation.w = q
    with pytest.raises(ValueError, match="length of quaternion"):
        ros_motion.pose_from_ros(message)


def test_nothing_measured_is_no_message():
    with pytest.raises(ValueError, match="time is nan"):
        ros_motion.estimate_to_ros(PoseEstimate())


def test_odometry_survives_both_ways():
    pose, velocity = np.array([1.5, -2.0, 2.8]), np.array([0.3, -0.2])
    covariance = random_covariance(3)
    message = over_the_wire(
        ros_motion.odometry_to_ros(
            pose, covariance, velocity, stamp=2.25, child_frame_id="limo/base_link"
        )
    )
    assert message.__msgtype__ == "nav_msgs/msg/Odometry"
    assert (message.header.frame_id, message.child_frame_id) == ("odom", "limo/base_link")
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (2, 250_000_000)
    found = ros_motion.odometry_from_ros(message)
    for value, expected in zip(found, (pose, covariance, velocity), strict=True):
        np.testing.assert_allclose(value, expected, atol=1e-12)
    # In ROS the position comes first, and the heading is a turn about z.
    full = np.asarray(message.pose.covariance).reshape(6, 6)
    assert full[5, 5] == covariance[2, 2]
    assert full[0, 5] == covariance[0, 2]
    assert message.twist.twist.angular.z == -0.2
