from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.analysis import Simulator

from systems.cameras import PinholeCamera
from systems.mapping.tag_frames import FrameHistory, TagFrame, TagFrames, camera_through, observe
from systems.markers.family import family
from systems.markers.layout import Marker, MarkerMap
from systems.markers.pnp import rotation_from_vector
from systems.messages import Detections

Array = NDArray[np.float64]

CAMERA = PinholeCamera.from_focal_length(640, 480, 480.0)
KIND = family("36h11")
FORWARD = RotationMatrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
X_WC = RigidTransform(FORWARD, [0.3, -0.1, 0.2])  # looks along x


def marker(tag: int, x: float, y: float, facing_deg: float) -> Marker:
    R = RollPitchYaw(0.0, 0.0, math.radians(facing_deg))
    return Marker(tag, RigidTransform(R, [x, y, 0.25]), 0.2)


MAP = MarkerMap(
    KIND,
    0.2,
    {m.id: m for m in (marker(0, 1.5, 0.1, 215), marker(3, 2.0, -0.5, 150), marker(9, -3, 0, 0))},
)


def seen(stamp: float, ids: list[int], noise: float = 0.0, seed: int = 0) -> Detections:
    corners = np.array(
        [CAMERA.project(X_WC.inverse().multiply(MAP.markers[i].corners().T).T) for i in ids]
    ).reshape(-1, 4, 2)
    corners = corners + noise * np.random.default_rng(seed).standard_normal(corners.shape)
    return Detections(
        stamp=stamp,
        frame_id="camera",
        family=KIND.name,
        ids=np.array(ids, np.int64),
        corners=corners,
        hamming=np.zeros(len(ids), np.int64),
        decision_margin=np.zeros(len(ids)),
    )


def look(detections: Detections, noise: float = 0.3) -> TagFrame:
    return observe(detections, camera=CAMERA, markers=MAP, anchor=0, pixel_noise=noise)


def test_without_noise_frames_are_where_they_are() -> None:
    frame = look(seen(1.5, [3, 0]))
    assert (frame.stamp, frame.frame_id, frame.ids.tolist()) == (1.5, "camera", [3, 0])
    assert not frame.low_observability
    for tag, X_CT in frame.poses():
        assert X_CT.IsNearlyEqualTo(X_WC.inverse() @ MAP.markers[tag].X_WM, 1e-6)
    pose = frame.camera_pose
    assert pose.valid
    assert (pose.frame_id, pose.child_frame_id, pose.markers) == ("map", "camera", 1)
    assert pose.pose.IsNearlyEqualTo(X_WC, 1e-6)
    # Both poses of each tag travel on, the better one first.
    assert frame.R_CT.shape == (2, 2, 3, 3)
    assert (frame.squared_error[:, 0] < frame.squared_error[:, 1]).all()


def test_few_tags_and_no_anchor() -> None:
    alone = look(seen(0.0, [3]))
    assert alone.low_observability
    assert not alone.camera_pose.valid
    assert look(seen(0.0, [])).low_observability
    assert len(look(seen(0.0, []))) == 0


def test_what_is_left_out_and_why() -> None:
    good = seen(0.0, [0, 3])
    twice = good.select(np.array([0, 1, 1]))
    frame = look(twice)
    assert frame.ids.tolist() == [0]
    assert frame.dropped == {"unknown_id": 0, "repeated_id": 2, "no_pose": 0}
    strange = Detections(**{**vars(good), "ids": np.array([0, 77]), "corners": good.corners.copy()})
    assert look(strange).dropped["unknown_id"] == 1
    other = Detections(**{**vars(good), "family": "tag16h5"})
    assert look(other).dropped["unknown_id"] == 2
    corners = good.corners.copy()
    corners[1] = corners[1][[0, 2, 1, 3]]  # a bow
    corners[0, 2] = np.nan
    frame = look(Detections(**{**vars(good), "corners": corners}))
    assert frame.dropped["no_pose"] == 2
    assert frame.low_observability


def test_the_covariance_is_what_many_pictures_scatter_by() -> None:
    noise = 0.1  # so little that no pose flips
    poses = [look(seen(0.0, [0], noise, seed), noise).camera_pose for seed in range(1500)]
    places = np.array([p.pose.translation() for p in poses])
    vectors = []
    for p in poses:
        angle_axis = (p.pose.rotation() @ X_WC.rotation().inverse()).ToAngleAxis()
        vectors.append(angle_axis.angle() * angle_axis.axis())
    scatter = np.cov(np.hstack([np.array(vectors), places]).T)
    stated = look(seen(0.0, [0]), noise).camera_pose.covariance
    np.testing.assert_allclose(np.diag(stated), np.diag(scatter), rtol=0.25)
    s = np.sqrt(np.diag(scatter))
    np.testing.assert_allclose(stated / np.outer(s, s), scatter / np.outer(s, s), atol=0.25)
    assert not look(seen(0.0, [0]), noise).camera_pose.ambiguous


def test_the_derivative_of_the_camera_by_the_tag() -> None:
    X_WT, X_CT = MAP.markers[0].X_WM, X_WC.inverse() @ MAP.markers[0].X_WM
    rng = np.random.default_rng(2)
    A = rng.standard_normal((6, 6))
    X, covariance = camera_through(X_WT, X_CT, A @ A.T)
    assert X.IsNearlyEqualTo(X_WC, 1e-12)
    J, step = np.zeros((6, 6)), 1e-6
    for k in range(6):
        d = np.zeros(6)
        d[k] = step
        R = RotationMatrix(rotation_from_vector(d[:3])) @ X_CT.rotation()
        moved = X_WT @ RigidTransform(R, X_CT.translation() + d[3:]).inverse()
        turned = (moved.rotation() @ X_WC.rotation().inverse()).matrix()
        J[:3, k] = np.array([turned[2, 1], turned[0, 2], turned[1, 0]]) / step
        J[3:, k] = (moved.translation() - X_WC.translation()) / step
    np.testing.assert_allclose(covariance, J @ A @ A.T @ J.T, rtol=1e-4, atol=1e-4)


def run(sequence: list[Detections]) -> tuple[TagFrames, Any]:
    system = TagFrames(camera=CAMERA, markers=MAP, anchor=0, rate=10.0)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    for k, detections in enumerate(sequence):
        system.detections_input_port().FixValue(context, detections)
        simulator.AdvanceTo(0.1 * k + 0.05)
    return system, context


def test_the_block_counts_and_remembers() -> None:
    sequence = [
        Detections(), seen(0.1, [0, 3]), seen(0.1, [0, 3]), seen(0.3, [3]), seen(0.2, [0, 3]),
        seen(0.5, []), seen(0.6, [0]),
    ]  # fmt: skip
    system, context = run(sequence)
    history: FrameHistory = system.history_output_port().Eval(context)
    # The same picture again, and one out of order, do not count.
    assert [frame.stamp for frame in history.frames()] == [0.1, 0.3, 0.5, 0.6]
    assert history.count == 4
    assert system.counts_output_port().Eval(context).tolist() == [4, 3, 2]
    assert system.tags_in_view_output_port().Eval(context).tolist() == [1]
    assert system.camera_pose_output_port().Eval(context).valid
    assert system.health_output_port().Eval(context).counts == {
        "unknown_id": 0, "repeated_id": 0, "no_pose": 0,
    }  # fmt: skip


def test_before_the_first_picture_there_is_nothing() -> None:
    system, context = run([Detections()])
    assert math.isnan(system.frame_output_port().Eval(context).stamp)
    assert not system.camera_pose_output_port().Eval(context).valid
    assert system.history_output_port().Eval(context).frames() == []


def test_a_history_is_not_changed_by_what_follows() -> None:
    first = FrameHistory().with_frame(TagFrame(stamp=1.0))
    second = first.with_frame(TagFrame(stamp=2.0))
    assert [f.stamp for f in first.frames()] == [1.0]
    assert [f.stamp for f in second.frames()] == [1.0, 2.0]


def test_bad_arguments() -> None:
    with pytest.raises(ValueError, match="anchor is 5: must be one of the markers: 0, 3, 9"):
        TagFrames(camera=CAMERA, markers=MAP, anchor=5, rate=10.0)
    with pytest.raises(ValueError, match="rate is 0"):
        TagFrames(camera=CAMERA, markers=MAP, anchor=0, rate=0.0)
    with pytest.raises(ValueError, match="pixel_noise is -1"):
        TagFrames(camera=CAMERA, markers=MAP, anchor=0, rate=1.0, pixel_noise=-1.0)
