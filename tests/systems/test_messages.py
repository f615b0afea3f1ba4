from __future__ import annotations

import copy
import math
from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from pydrake.common.value import AbstractValue

from systems.messages import (
    CameraImage,
    Detections,
    Health,
    Message,
    PointMatches,
    PoseEstimate,
    RotationIncrement,
    whole_nanoseconds,
)

MESSAGES: list[Message] = [
    CameraImage(),
    Detections(),
    PoseEstimate(),
    Health(),
    PointMatches(),
    RotationIncrement(),
]


@pytest.mark.parametrize("message", MESSAGES, ids=lambda m: type(m).__name__)
def test_a_message_cannot_be_changed(message: Message) -> None:
    for name, value in vars(message).items():
        with pytest.raises(FrozenInstanceError):
            setattr(message, name, value)
        if isinstance(value, np.ndarray):
            assert not value.flags.writeable


@pytest.mark.parametrize("message", MESSAGES, ids=lambda m: type(m).__name__)
def test_copies_and_abstract_values_hold_the_same_object(message: Message) -> None:
    assert copy.copy(message) is message
    assert copy.deepcopy([message])[0] is message
    value = AbstractValue.Make(message)
    assert value.get_value() is message
    assert value.Clone().get_value() is message


@pytest.mark.parametrize(
    "kind", [CameraImage, Detections, PoseEstimate, PointMatches, RotationIncrement]
)
def test_without_a_measurement_the_stamp_is_nan(kind: type) -> None:
    assert math.isnan(kind().stamp)


def test_a_pose_without_a_stamp_is_not_valid() -> None:
    assert not PoseEstimate().valid
    assert PoseEstimate(stamp=0.0).valid


def test_an_increment_without_a_stamp_is_not_valid() -> None:
    assert not RotationIncrement().valid
    assert RotationIncrement(stamp=0.0).valid


def test_matches_are_as_many_as_their_points() -> None:
    assert len(PointMatches()) == 0
    assert len(PointMatches(previous=np.zeros((3, 2)), current=np.ones((3, 2)))) == 3


def test_detections_are_picked_by_mask_and_by_index() -> None:
    corners = np.arange(24.0).reshape(3, 4, 2)
    found = Detections(
        stamp=1.5,
        frame_id="camera",
        family="tag36h11",
        ids=np.array([5, 6, 7]),
        corners=corners,
        hamming=np.array([0, 1, 2]),
        decision_margin=np.array([30.0, 20.0, 10.0]),
    )
    assert len(found) == 3
    for index, rows in (([2, 0], [2, 0]), (np.array([False, True, True]), [1, 2]), ([], [])):
        some = found.select(np.array(index, dtype=None if len(index) else int))
        assert (some.stamp, some.frame_id, some.family) == (1.5, "camera", "tag36h11")
        assert some.ids.tolist() == [5 + r for r in rows]
        np.testing.assert_array_equal(some.corners, corners[rows])
        assert some.hamming.tolist() == rows
        assert some.decision_margin.tolist() == [30.0 - 10 * r for r in rows]


def test_times_are_rounded_to_what_a_recording_keeps() -> None:
    assert whole_nanoseconds(0.1 + 0.2) == 0.3
    for k in range(1000):
        t = whole_nanoseconds(k / 15)
        assert t == round(t * 1e9) / 1e9  # to nanoseconds and back it is the same float
        assert abs(t - k / 15) <= 0.5e-9
