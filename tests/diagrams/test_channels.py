"""What a station's vectors become in a recording, and back."""

from __future__ import annotations

import numpy as np
import pytest

from diagrams import channels
from diagrams.surroundings import clearance_signal
from diagrams.teach_recording import odometry_signal
from systems.angles import spatial_pose
from systems.io.ros_motion import estimate_from_ros, transforms_from_ros
from systems.io.ros_types import time_from_ros, typestore
from systems.pose_vector import pose_to_vector

SIGNALS = [
    channels.imu_signal("robot.imu", 100.0, 1e-4, 2e-3),
    channels.command_signal("robot.drive", 20.0),
    channels.ticks_signal("robot.encoders", 50.0, 1440.0),
    channels.truth_signal("robot"),
    channels.estimate_signal("robot", 50.0),
    channels.number_signal("robot.speed", 10.0),
    clearance_signal("robot"),
    odometry_signal("robot", 50.0),
]


def through_the_file(encode, value, t):
    written = encode(value, t)
    message = typestore().deserialize_cdr(written.data, written.__msgtype__)
    if hasattr(message, "header"):
        assert time_from_ros(message.header.stamp) == t
    return message


@pytest.mark.parametrize("signal", SIGNALS, ids=lambda signal: signal.port)
def test_a_vector_survives_the_recording(signal):
    rng = np.random.default_rng(0)
    for t in (0.0, 0.25, 1527206460.125):
        value = rng.uniform(-3.0, 3.0, signal.model)
        if signal.port.endswith(".ticks"):
            value = np.rint(1e4 * value)
        read = signal.decode(through_the_file(signal.encode, value, t))
        np.testing.assert_allclose(read, value, rtol=0, atol=2e-15)


def test_inertial_samples_tell_their_variances():
    signal = channels.imu_signal("robot.imu", 100.0, 1e-4, 2e-3)
    message = through_the_file(signal.encode, np.arange(6.0), 1.0)
    assert message.header.frame_id == "robot/imu"
    for name, variance in (("angular_velocity", 1e-6), ("linear_acceleration", 4e-4)):
        covariance = getattr(message, f"{name}_covariance").reshape(3, 3)
        np.testing.assert_allclose(covariance, variance * np.eye(3), rtol=1e-12)


def test_a_pose_on_a_shell_survives_with_its_covariance():
    rng = np.random.default_rng(1)
    truth, estimate = (
        channels.shell_truth_signal("robot"), channels.shell_estimate_signal("robot", 50.0)
    )  # fmt: skip
    for t in (0.0, 1527206460.125):
        q = rng.normal(size=4) * [0, 1, 1, 1] + [3, 0, 0, 0]
        value = np.concatenate([q / np.linalg.norm(q), rng.uniform(-0.1, 0.1, 3), rng.random(36)])
        message = through_the_file(truth.encode, value[:7], t)
        np.testing.assert_allclose(truth.decode(message), value[:7], rtol=0, atol=2e-15)
        message = through_the_file(estimate.encode, value, t)
        assert message.header.frame_id == "shell"
        read = estimate_from_ros(message)
        np.testing.assert_allclose(pose_to_vector(read.pose), value[:7], rtol=0, atol=2e-15)
        np.testing.assert_array_equal(read.covariance.ravel(), value[7:])


def test_planar_poses_become_frames_of_the_map():
    names = ["one/base_link", "another/base_link"]
    poses = np.array([[1.0, -2.0, 0.5], [0.25, 3.0, -3.0]])
    # What follows the poses in the vector is not for /tf.
    message = through_the_file(channels.planar_frames(names), np.append(poses.ravel(), 9.0), 2.5)
    for transform, name, pose in zip(transforms_from_ros(message), names, poses, strict=True):
        assert (transform.stamp, transform.frame_id) == (2.5, "map")
        assert transform.child_frame_id == name
        np.testing.assert_allclose(
            transform.pose.GetAsMatrix34(), spatial_pose(pose).GetAsMatrix34(), atol=2e-15
        )
