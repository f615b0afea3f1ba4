"""Markers found in a picture, straight to bytes: those that rosbags would write."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from systems.io.ros_detections import serialised_detections
from systems.io.ros_types import typestore
from systems.io.ros_vision import detections_from_ros, detections_to_ros
from systems.messages import Detections

TAGS = "apriltag_msgs/msg/AprilTagDetectionArray"


def found(rng, n, family="tag36h11", frame_id="front/optical"):
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    centres = rng.uniform(50, 600, (n, 1, 2))
    return Detections(
        stamp=float(rng.uniform(0, 1e9)),
        frame_id=frame_id,
        family=family,
        ids=rng.integers(0, 500, n),
        corners=centres + 40 * square + rng.normal(0, 3, (n, 4, 2)),
        hamming=rng.integers(0, 3, n),
        decision_margin=np.where(rng.random(n) < 0.3, np.nan, rng.uniform(0, 200, n)),
    )


@pytest.mark.parametrize("n", [0, 1, 2, 7])
@pytest.mark.parametrize("family", ["tag36h11", "DICT_4X4_50", ""])
def test_the_bytes_are_those_of_rosbags(n, family):
    rng = np.random.default_rng(n)
    for length in range(12):  # of the frame's name: it moves all that follows
        detections = found(rng, n, family, "x" * length)
        expected = typestore().serialize_cdr(detections_to_ros(detections), TAGS)
        written = serialised_detections(detections)
        assert written.__msgtype__ == TAGS
        assert written.data == bytes(expected)


def test_they_are_read_back():
    detections = found(np.random.default_rng(3), 4)
    message = typestore().deserialize_cdr(serialised_detections(detections).data, TAGS)
    back = detections_from_ros(message)
    assert (back.stamp, back.family) == (round(detections.stamp, 9), detections.family)
    np.testing.assert_array_equal(back.ids, detections.ids)
    np.testing.assert_array_equal(back.corners, detections.corners)


def test_what_ros_cannot_keep_is_refused():
    detections = found(np.random.default_rng(4), 2)
    with pytest.raises(ValueError, match=f"marker {2**31}"):
        serialised_detections(replace(detections, ids=np.array([3, 2**31])))
    with pytest.raises(ValueError, match="time is nan"):
        serialised_detections(replace(detections, stamp=np.nan))
