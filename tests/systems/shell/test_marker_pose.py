from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from systems.markers.localizer import LocalizerParameters
from systems.messages import Detections, PoseEstimate
from systems.shell.angles import angle_differences, angles_of, rotation, rotation_error
from systems.shell.layout import marker_places, shell_markers
from systems.shell.marker_pose import (
    ShellMarkerPose,
    candidate_pose,
    shell_localizer,
    without_rotations,
)
from tests.systems.shell.shell_world import CAMERA, HEIGHT, MAP, RADIUS, X_BC, detections, pose

DEG = math.radians(1.0)
LOCALIZER = shell_localizer(marker_map=MAP, camera=CAMERA, X_BC=X_BC)


def over(marker_id: int, roll: float = 0.3, aside: float = 0.0) -> np.ndarray:
    """[roll, pitch, yaw] of a robot that stands over that marker, `aside` (rad) of its middle."""
    pitch, yaw = marker_places()[marker_id]
    return np.array([roll, pitch - abs(aside), yaw + aside])


def offset(found: PoseEstimate, true: RigidTransform) -> np.ndarray:
    """(6,) error as the covariance has it."""
    phi = rotation_error(found.pose.rotation().matrix(), true.rotation().matrix())
    return np.concatenate([phi, found.pose.translation() - true.translation()])


@pytest.mark.parametrize("marker_id", MAP.markers)
def test_over_every_marker_at_any_heading_the_pose_is_exact(marker_id: int) -> None:
    for roll in np.radians([0.0, 37.0, 90.0, 180.0, -120.0]):
        true = pose(over(marker_id, roll, aside=0.15 * DEG))
        seen = detections(true, stamp=2.5)
        assert seen.ids.tolist() == [marker_id]
        found = LOCALIZER.locate(seen).pose
        assert (found.frame_id, found.child_frame_id, found.stamp) == ("shell", "base_link", 2.5)
        np.testing.assert_allclose(offset(found, true), 0.0, atol=1e-7)


def test_markers_laid_out_on_the_tangent_plane_would_err() -> None:
    # The wrong answer: the corners of a bent marker taken to be as high as its middle.
    flat = shell_markers(radius=RADIUS)
    raised = {
        k: type(m)(k, m.X_WM @ RigidTransform([0.083e-3, 0, 0]), m.size)
        for k, m in flat.markers.items()
    }
    wrong = shell_localizer(
        marker_map=type(flat)(flat.family, flat.size, raised, flat.frame), camera=CAMERA, X_BC=X_BC
    )
    true = pose(over(16))
    found = wrong.locate(detections(true)).pose
    height = np.linalg.norm(found.pose.translation())
    assert height - (RADIUS + HEIGHT) == pytest.approx(0.083e-3, rel=0.01)


def test_a_candidate_is_the_chain_of_map_sight_and_mounting() -> None:
    for marker_id in (1, 4, 11, 20):
        true = pose(over(marker_id, roll=-1.0))
        X_RM = MAP.markers[marker_id].X_WM
        X_CM = (true @ X_BC).inverse() @ X_RM
        found = candidate_pose(X_RM, X_CM, X_BC.inverse())
        assert found.IsNearlyEqualTo(true, 1e-14)
        # And by hand, with homogeneous matrices.
        product = (
            X_RM.GetAsMatrix4()
            @ np.linalg.inv(X_CM.GetAsMatrix4())
            @ np.linalg.inv(X_BC.GetAsMatrix4())
        )
        np.testing.assert_allclose(found.GetAsMatrix4(), product, atol=1e-12)


def test_as_printed_the_pose_lacks_the_markers_rotation() -> None:
    printed = shell_localizer(marker_map=MAP, camera=CAMERA, X_BC=X_BC, marker_rotation=False)
    for marker_id in MAP.markers:
        true = pose(over(marker_id, roll=0.5, aside=0.15 * DEG))
        found = printed.locate(detections(true)).pose
        X_RM = MAP.markers[marker_id].X_WM
        X_CM = (true @ X_BC).inverse() @ X_RM
        dropped = RigidTransform(X_RM.translation())
        assert found.pose.IsNearlyEqualTo(candidate_pose(dropped, X_CM, X_BC.inverse()), 1e-6)
        error = np.linalg.norm(offset(found, true)[:3])
        if marker_id == 14:  # yaw 0, pitch 0: the one that is parallel to the sphere's frame
            assert error < 1e-6
        else:
            assert error == pytest.approx(X_RM.rotation().ToAngleAxis().angle(), abs=1e-6)
            assert error > 25 * DEG


def test_without_rotations_places_and_ids_stay() -> None:
    printed = without_rotations(MAP)
    assert list(printed.markers) == list(MAP.markers)
    for marker in printed:
        assert marker.X_WM.rotation().IsExactlyIdentity()
        np.testing.assert_array_equal(
            marker.X_WM.translation(), MAP.markers[marker.id].X_WM.translation()
        )


def test_errors_are_inside_the_covariance() -> None:
    noise = 0.3
    noisy = shell_localizer(
        marker_map=MAP,
        camera=CAMERA,
        X_BC=X_BC,
        parameters=LocalizerParameters(pixel_noise=noise),
    )
    rng = np.random.default_rng(8)
    nees, worst = [], 0.0
    for k in range(300):
        true = pose(
            over(int(rng.integers(1, 26)), rng.uniform(-3, 3), rng.uniform(-0.15, 0.15) * DEG)
        )
        found = noisy.locate(detections(true, noise=noise, seed=k))
        # Of the two minima the one that is meant: a flip is not what is tested here.
        errors = [offset(f, true) for f in (found.pose, found.alternative) if f.valid]
        error = min(errors, key=lambda e: float(np.linalg.norm(e[:3])))
        nees.append(error @ np.linalg.solve(found.pose.covariance, error) / 6)
        worst = max(worst, float(np.linalg.norm(error[:3])))
    # Chi-square of 6 x 300 degrees of freedom: 1 +- 3.3 %. Mirror images stand in for some.
    assert np.mean(nees) == pytest.approx(1.0, abs=0.15)
    assert worst < 2 * DEG


# --- The block ---


def test_the_block_reports_pose_and_angles() -> None:
    system = ShellMarkerPose(localizer=LOCALIZER, rate=60.0)
    context = system.CreateDefaultContext()
    angles = over(10, roll=-2.0, aside=0.15 * DEG)
    true = pose(angles)
    system.detections_input_port().FixValue(context, detections(true, stamp=1.0))
    estimate = system.pose_output_port().Eval(context)
    np.testing.assert_allclose(offset(estimate, true), 0.0, atol=1e-7)
    found = system.angles_output_port().Eval(context)
    np.testing.assert_array_equal(found, angles_of(estimate.pose.rotation().matrix()))
    np.testing.assert_allclose(angle_differences(rotation(found), rotation(angles)), 0.0, atol=1e-6)


def test_between_markers_there_is_no_pose_and_no_angle() -> None:
    system = ShellMarkerPose(localizer=LOCALIZER, rate=60.0)
    context = system.CreateDefaultContext()
    seen = detections(pose(np.array([0.0, 15 * DEG, 0.0])), stamp=1.0)
    assert len(seen) == 0
    system.detections_input_port().FixValue(context, seen)
    assert not system.pose_output_port().Eval(context).valid
    assert np.isnan(system.angles_output_port().Eval(context)).all()
    system.detections_input_port().FixValue(context, Detections())
    assert np.isnan(system.angles_output_port().Eval(context)).all()


def test_most_of_the_way_no_marker_is_in_view() -> None:
    # The premise of the whole fusion, from the geometry of [SNAIL]: over the pole 10 mm of picture
    # hold a marker of 5 mm with its margin (6.7 mm) for 3.3 of every 39.3 mm.
    ways = [pose(np.array([0.0, a, 0.0])) for a in np.linspace(0, np.pi / 2, 2000)]
    share = np.mean([len(detections(X)) for X in ways])
    picture = 480 / 481 * (10e-3)  # m, at the height of the surface
    expected = (picture - 0.005 * 8 / 6) / (RADIUS * math.radians(30))
    assert share == pytest.approx(expected, rel=0.1)


def test_it_is_the_same_whatever_the_height_of_the_body() -> None:
    # base_link may lie anywhere on the normal as long as the mounting says so.
    low = RigidTransform(RotationMatrix(X_BC.rotation()), [0, 0, 0.010])
    localizer = shell_localizer(marker_map=MAP, camera=CAMERA, X_BC=low)
    true = pose(over(9))
    X_RC = true @ X_BC
    seen = detections(true)
    assert localizer.locate(seen).pose.pose.IsNearlyEqualTo(X_RC @ low.inverse(), 1e-7)
    assert np.linalg.norm(localizer.locate(seen).pose.pose.translation()) == pytest.approx(RADIUS)
