"""How a station's ports are written into a recording, and played from one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.math import RigidTransform

from diagrams.schema import ScenarioError
from systems.angles import planar_pose
from systems.io.bag import BagReader
from systems.io.playback import MessagePlayback, VectorPlayback, read_channel
from systems.io.recorder import Channel
from systems.io.ros_motion import (
    command_from_ros,
    command_to_ros,
    estimate_to_ros,
    imu_from_ros,
    imu_to_ros,
    planar_estimate_from_ros,
    planar_estimate_to_ros,
    planar_fields,
    planar_pose_to_ros,
    planar_transforms_to_ros,
    pose_fields,
    pose_from_ros,
    pose_to_ros,
)
from systems.io.ros_types import message_class
from systems.io.ros_wheels import wheel_angles_from_ros, wheel_angles_to_ros
from systems.io.stencils import Stencil
from systems.messages import CameraImage, Detections, PointMatches, PoseEstimate, Scan
from systems.pose_vector import pose_to_vector
from systems.shell.angles import SHELL_FRAME

_NOWHERE = RigidTransform.MakeUnchecked(np.full((3, 4), np.nan))  # for stencils


@dataclass(frozen=True)
class Signal:
    """One port of a station and its topic: both ways.

    Attributes:
        port: name of the port.
        topic: in the recording.
        encode: message type, or function of value and time (s), as `Channel` takes it.
        decode: makes the port's value of the ROS message; None takes the type's usual one.
        model: size of the vector, or an example of the message.
        rate: how often the port changes, Hz.
        played: whether blocks are fed by it when the recording is played back.
    """

    port: str
    topic: str
    encode: str | Callable[[Any, float], Any]
    decode: Callable[[Any], Any] | None
    model: Any
    rate: float
    played: bool = True

    def channel(self, rate: float, repeat: float = 0.0) -> Channel:
        """Returns the recorder's channel.

        What is played back is looked at, at `rate` (Hz), the rate of the fastest consumer, which
        then sees each value at the time at which it saw it first. Messages are written when their
        stamp is new, vectors that do not change once in `repeat` (s; 0: always).
        """
        vector = isinstance(self.model, int)
        return Channel(
            port=self.port,
            topic=self.topic,
            encode=self.encode,
            model=self.model,
            rate=rate if self.played else self.rate,
            only_new=not vector,
            repeat=repeat if vector else 0.0,
        )

    def player(self, reader: BagReader) -> tuple[MessagePlayback | VectorPlayback, float]:
        """Returns the block that plays the port from a recording, and the time of its end (s).

        Times count from the recording's first message.

        Raises:
            ScenarioError: the recording lacks the topic.
        """
        topics = reader.topics()
        if self.topic not in topics:
            have = ", ".join(sorted(topics))
            raise ScenarioError(
                f"recording {reader.path}: lacks the topic {self.topic}; has {have}"
            )
        entries = read_channel(reader, self.topic, self.decode, origin=reader.start)
        end = entries[-1].log_time * 1e-9 if entries else 0.0
        if isinstance(self.model, int):
            return VectorPlayback(entries=entries, size=self.model), end
        return MessagePlayback(entries=entries, nothing=self.model), end


def topic_of(port: str) -> str:
    """Returns the topic of a station's port: dots become slashes."""
    return "/" + port.replace(".", "/")


def imu_signal(device: str, rate: float, gyro_density: float, accel_density: float) -> Signal:
    """Returns the signal of an inertial sensor; its densities become the message's variances."""
    return Signal(
        port=f"{device}.sample",
        topic=topic_of(device),
        encode=Stencil(
            lambda t: imu_to_ros(
                np.full(6, np.nan),
                stamp=t,
                frame_id=device.replace(".", "/"),
                gyro_variance=gyro_density**2 * rate,
                accel_variance=accel_density**2 * rate,
            )
        ),
        decode=imu_from_ros,
        model=6,
        rate=rate,
    )


def command_signal(device: str, rate: float) -> Signal:
    """Returns the signal of the drive command as sent."""
    return Signal(
        port=f"{device}.sent",
        topic=topic_of(f"{device}.sent"),
        encode=Stencil(lambda _: command_to_ros(np.full(2, np.nan))),
        decode=command_from_ros,
        model=2,
        rate=rate,
    )


def ticks_signal(device: str, rate: float, ticks_per_turn: float) -> Signal:
    """Returns the signal of wheel encoders; the message has the angles that they count."""
    angle = 2 * np.pi / ticks_per_turn
    return Signal(
        port=f"{device}.ticks",
        topic=topic_of(device),
        encode=Stencil(
            lambda t: wheel_angles_to_ros(
                np.full(2, np.nan), stamp=t, frame_id=device.replace(".", "/")
            ),
            lambda ticks: angle * ticks,
        ),
        decode=lambda message: np.rint(wheel_angles_from_ros(message) / angle),
        model=2,
        rate=rate,
    )


def image_signal(device: str, rate: float) -> Signal:
    """Returns the signal of a camera's pictures."""
    return Signal(
        port=f"{device}.image",
        topic=topic_of(f"{device}.image.compressed"),
        encode="sensor_msgs/msg/CompressedImage",
        decode=None,
        model=CameraImage(),
        rate=rate,
    )


def detections_signal(device: str, rate: float) -> Signal:
    """Returns the signal of a camera's detections."""
    return Signal(
        port=f"{device}.detections",
        topic=topic_of(f"{device}.detections"),
        encode="apriltag_msgs/msg/AprilTagDetectionArray",
        decode=None,
        model=Detections(),
        rate=rate,
    )


def scan_signal(device: str, rate: float) -> Signal:
    """Returns the signal of a lidar's scans."""
    return Signal(
        port=f"{device}.scan",
        topic=topic_of(f"{device}.scan"),
        encode="sensor_msgs/msg/LaserScan",
        decode=None,
        model=Scan(),
        rate=rate,
    )


def truth_signal(robot: str) -> Signal:
    """Returns the signal of a robot's true planar pose."""
    return Signal(
        port=f"truth.{robot}.pose",
        topic=f"/truth/{robot}/pose",
        encode=Stencil(
            lambda t: planar_pose_to_ros(np.full(3, np.nan), stamp=t, frame_id="map"),
            planar_fields,
        ),
        decode=lambda message: planar_pose(pose_from_ros(message)),
        model=3,
        rate=50.0,
        played=False,
    )


def estimate_signal(robot: str, rate: float) -> Signal:
    """Returns the signal of a planar estimate: (12,) the pose, then its covariance by rows."""
    return Signal(
        port=f"{robot}.estimate",
        topic=f"/{robot}/estimate",
        encode=Stencil(
            lambda t: planar_estimate_to_ros(
                np.full(3, np.nan), np.full((3, 3), np.nan), stamp=t, frame_id="map"
            ),
            lambda value: [*planar_fields(value[:3]), *value[3:]],
        ),
        decode=lambda message: np.concatenate(
            [part.ravel() for part in planar_estimate_from_ros(message)]
        ),
        model=12,
        rate=rate,
        played=False,
    )


def planar_frames(children: Sequence[str]) -> Stencil:
    """Returns the encoder of /tf for a vector that begins with the frames' planar poses in map."""
    n = len(children)
    return Stencil(
        lambda t: planar_transforms_to_ros(
            np.full((n, 3), np.nan), stamp=t, frame_id="map", child_frame_ids=children
        ),
        lambda value: [x for k in range(n) for x in planar_fields(value[3 * k : 3 * k + 3])],
    )


def matches_signal(device: str, rate: float) -> Signal:
    """Returns the signal of the points that a camera finds in two pictures."""
    return Signal(
        port=f"{device}.matches",
        topic=topic_of(f"{device}.matches"),
        encode="sensor_msgs/msg/PointCloud2",
        decode=None,
        model=PointMatches(),
        rate=rate,
    )


def shell_truth_signal(robot: str) -> Signal:
    """Returns the signal of a robot's true pose on a shell, as `PoseToVector` gives it."""
    return Signal(
        port=f"truth.{robot}.pose",
        topic=f"/truth/{robot}/pose",
        encode=Stencil(lambda t: pose_to_ros(_NOWHERE, stamp=t, frame_id=SHELL_FRAME), pose_fields),
        decode=lambda message: pose_to_vector(pose_from_ros(message)),
        model=7,
        rate=50.0,
        played=False,
    )


def shell_estimate_signal(robot: str, rate: float) -> Signal:
    """Returns the signal of an estimate on a shell: (43,) the pose's vector, then its covariance.

    The covariance is by rows, rotation first.
    """
    return Signal(
        port=f"{robot}.estimate",
        topic=f"/{robot}/estimate",
        encode=Stencil(
            lambda t: estimate_to_ros(PoseEstimate(t, SHELL_FRAME, pose=_NOWHERE)), pose_fields
        ),
        decode=None,
        model=43,
        rate=rate,
        played=False,
    )


def chain_signal(rate: float) -> Signal:
    """Returns the signal of the last robot's pose on the first shell, composed along a chain."""
    return Signal(
        port="chain.estimate",
        topic="/chain/estimate",
        encode="geometry_msgs/msg/PoseWithCovarianceStamped",
        decode=None,
        model=PoseEstimate(),
        rate=rate,
        played=False,
    )


def number_signal(port: str, rate: float) -> Signal:
    """Returns the signal of a single number that is written down only."""
    return Signal(
        port=port,
        topic=topic_of(port),
        encode=Stencil(lambda _: message_class("std_msgs/msg/Float64")(np.nan)),
        decode=lambda message: np.array([float(message.data)]),
        model=1,
        rate=rate,
        played=False,
    )
