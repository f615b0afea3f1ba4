"""Markers found in a picture, straight to the bytes of their ROS message.

Their length changes, so no stencil of `systems.io.stencils` fits them.
"""

from __future__ import annotations

import struct
import sys

import numpy as np

from systems.io.ros_types import sec_and_nanosec
from systems.io.ros_vision import homographies
from systems.io.stencils import SerialisedMessage
from systems.messages import Detections

_ENCAPSULATION = bytes((0, sys.byteorder == "little", 0, 0))
_TIME = struct.Struct("=iI")
_LENGTH = struct.Struct("=I")
_CODE = struct.Struct("=iiff")  # id, hamming, goodness, decision margin


def serialised_detections(detections: Detections) -> SerialisedMessage:
    """Returns `apriltag_msgs/msg/AprilTagDetectionArray`, as `ros_vision.detections_to_ros`.

    Raises:
        ValueError: a stamp or an id that ROS cannot keep.
    """
    n = len(detections)
    numbers = np.empty((n, 19))
    if n:
        H = homographies(detections.corners)
        numbers[:, :2] = H[:, :2, 2]  # the centre
        numbers[:, 2:10] = detections.corners[:, ::-1].reshape(n, 8)
        numbers[:, 10:] = H.reshape(n, 9)
    codes = zip(
        detections.ids.tolist(),
        detections.hamming.tolist(),
        detections.decision_margin.tolist(),
        strict=True,
    )
    family = _string(detections.family)
    body = bytearray(_TIME.pack(*sec_and_nanosec(detections.stamp)))
    body += _string(detections.frame_id)
    _align(body, 4)
    body += _LENGTH.pack(n)
    for row, (number, bits, margin) in zip(numbers, codes, strict=True):
        body += family
        _align(body, 4)
        try:
            body += _CODE.pack(number, bits, 0.0, margin)  # AprilTag 3 has no goodness
        except struct.error as error:
            raise ValueError(f"marker {number}: {error}") from error
        _align(body, 8)
        body += row.tobytes()
    return SerialisedMessage(
        "apriltag_msgs/msg/AprilTagDetectionArray", _ENCAPSULATION + bytes(body)
    )


def _string(text: str) -> bytes:
    data = text.encode() + b"\0"
    return _LENGTH.pack(len(data)) + data


def _align(body: bytearray, to: int) -> None:
    body += bytes(-len(body) % to)
