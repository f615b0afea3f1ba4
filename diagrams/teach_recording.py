"""What teaching puts into a recording beyond the station's signals, as standard messages."""

from __future__ import annotations

from typing import Any

import numpy as np

from diagrams.channels import Signal
from systems.io.ros_motion import (
    FrameTransform,
    estimate_to_ros,
    odometry_from_ros,
    odometry_to_ros,
    planar_fields,
    transforms_to_ros,
)
from systems.io.ros_types import message_class
from systems.io.stencils import Stencil
from systems.mapping.tag_frames import TagFrame
from systems.messages import PoseEstimate


def odometry_signal(robot: str, rate: float) -> Signal:
    """Returns the signal of wheel odometry: (14,) pose, covariance by rows, velocity."""

    def example(t: float) -> Any:
        return odometry_to_ros(
            np.full(3, np.nan),
            np.full((3, 3), np.nan),
            np.full(2, np.nan),
            stamp=t,
            frame_id=f"{robot}/odom",
            child_frame_id=f"{robot}/base_link",
        )

    def decode(message: Any) -> np.ndarray:
        return np.concatenate([part.ravel() for part in odometry_from_ros(message)])

    return Signal(
        port=f"{robot}.odom",
        topic=f"/{robot}/odom",
        encode=Stencil(example, lambda value: [*planar_fields(value[:3]), *value[3:]]),
        decode=decode,
        model=14,
        rate=rate,
        played=False,
    )


def camera_pose_signal(robot: str, rate: float) -> Signal:
    """Returns the signal of the camera's pose in the map, through the anchor."""
    return Signal(
        port=f"{robot}.camera_pose",
        topic=f"/{robot}/camera_pose",
        encode=lambda value, _: estimate_to_ros(value),
        decode=None,
        model=PoseEstimate(),
        rate=rate,
        played=False,
    )


def tag_transforms_signal(robot: str, rate: float) -> Signal:
    """Returns the signal of the tags' better poses in the camera: `{family}:{id}` in /tf."""

    def encode(frame: TagFrame, _: float) -> Any:
        family = frame.detections.family
        return transforms_to_ros(
            FrameTransform(frame.stamp, frame.frame_id, f"{family}:{tag}", X_CT)
            for tag, X_CT in frame.poses()
        )

    return Signal(
        port=f"{robot}.tag_frames",
        topic="/tf",
        encode=encode,
        decode=None,
        model=TagFrame(),
        rate=rate,
        played=False,
    )


def low_observability_signal(robot: str, rate: float) -> Signal:
    """Returns the signal of whether the latest picture shows fewer than two tags."""
    return Signal(
        port=f"{robot}.tags_in_view",
        topic=f"/{robot}/low_observability",
        encode=lambda value, _: message_class("std_msgs/msg/Bool")(bool(value[0] < 2)),
        decode=lambda message: np.array([0.0 if message.data else 2.0]),
        model=1,
        rate=rate,
        played=False,
    )
