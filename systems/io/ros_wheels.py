"""Wheel angles to ROS 2 messages, and back."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from systems.io.ros_types import header, message_class
from systems.validation import require

Array = NDArray[np.float64]

WHEELS = ("right_wheel", "left_wheel")


def wheel_angles_to_ros(angles: ArrayLike, *, stamp: float, frame_id: str) -> Any:
    """Returns `sensor_msgs/msg/JointState` of the angles (2,) [right, left] (rad).

    Args:
        angles: (2,) [right, left] (rad).
        stamp: s.
        frame_id: frame of the encoders.
    """
    nothing = np.zeros(0)
    return message_class("sensor_msgs/msg/JointState")(
        header(stamp, frame_id), list(WHEELS), np.array(angles, float), nothing, nothing
    )


def wheel_angles_from_ros(message: Any) -> Array:
    """Returns the angles (2,) [right, left] (rad) of a `JointState`, whatever else it names.

    Raises:
        ValueError: it lacks a wheel.
    """
    names = list(message.name)
    for wheel in WHEELS:
        require(wheel in names, "name", names, f"among others {wheel!r}")
    return np.array([message.position[names.index(wheel)] for wheel in WHEELS])
