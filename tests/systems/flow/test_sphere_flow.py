from __future__ import annotations

import re
from functools import cache
from typing import Any

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from systems.cameras import PinholeCamera
from systems.flow.lucas_kanade import LucasKanadeParameters, corners, track
from systems.flow.mean_flow import surface_velocity
from systems.flow.rotation_fit import common_turn, nearest_turn
from systems.flow.shell import ShellView, ShellViewParameters
from systems.flow.sphere_flow import (
    SphereFlow,
    SphereFlowEstimator,
    SphereFlowParameters,
    pair_rotations,
)
from systems.messages import PointMatches
from systems.shell.angles import angles_of, rotation_vector
from systems.shell.angles import rotation as from_angles
from tests.systems.flow.shell_images import CAMERA, on_the_equator, picture, rotation

DT = 1 / 60
RADIUS = 0.075
BENT = PinholeCamera(640, 480, CAMERA.K, np.array([-0.2, 0.05, 1e-3, -2e-3, 0.0]))
TILTED = ShellViewParameters(camera_tilt=[0.02, -0.03, 0.05])
VIEW = ShellView(camera=CAMERA)


def matches(
    w: np.ndarray,
    view: ShellView = VIEW,
    *,
    n: int = 300,
    noise: float = 0.0,
    outliers: float = 0.0,
    seed: int = 0,
) -> PointMatches:
    """What a tracker would find of evenly spread points, by Drake's rotations."""
    rng = np.random.default_rng(seed)
    before = rng.random((n, 2)) * [639, 479]
    points = view.back_project(before) @ rotation(w).matrix()  # p_B2 = R_B1B2' p_B1
    p_C = (points - view.X_SC.translation()) @ view.X_SC.rotation().matrix()
    after = view.camera.project(p_C) + noise * rng.standard_normal((n, 2))
    wrong = rng.random(n) < outliers
    after[wrong] = rng.random((int(wrong.sum()), 2)) * [639, 479]
    kept = view.inside(after)
    return PointMatches(1.0 + seed, 1.0 + seed - DT, "camera", before[kept], after[kept])


# --- The parts ---


def test_the_nearest_turn_is_the_rotation_and_never_a_reflection() -> None:
    rng = np.random.default_rng(3)
    R = rotation(np.array([0.3, -1.2, 0.7])).matrix()
    p = rng.standard_normal((20, 3))
    np.testing.assert_allclose(nearest_turn(p, p @ R.T), R, atol=1e-12)
    flat = p * [1, 1, 1e-9]  # on a plane a mirror would fit as well
    np.testing.assert_allclose(nearest_turn(flat, flat @ R.T), R, atol=1e-6)
    assert np.linalg.det(nearest_turn(p, -p)) == pytest.approx(1.0)


def test_which_points_agree_with_the_turn_of_all() -> None:
    rng = np.random.default_rng(8)
    before = rng.standard_normal((40, 3))
    before /= np.linalg.norm(before, axis=1, keepdims=True)
    after = before @ rotation(np.array([0.1, 0.2, -0.3])).matrix().T
    after[[3, 17]] = after[[17, 3]]
    turn, together = np.empty((3, 3)), np.empty(40, bool)
    assert common_turn(before, after, 0.95, turn, together) == 38
    assert np.flatnonzero(~together).tolist() == [3, 17]
    np.testing.assert_array_equal(turn, nearest_turn(before, after))


def test_a_pair_gives_its_rotation() -> None:
    rng = np.random.default_rng(4)
    pairs = rng.standard_normal((50, 2, 3))
    pairs /= np.linalg.norm(pairs, axis=2, keepdims=True)
    R = np.stack([rotation(v).matrix() for v in rng.standard_normal((50, 3))])
    np.testing.assert_allclose(
        pair_rotations(pairs, np.einsum("bij,bkj->bki", R, pairs)), R, atol=1e-9
    )


# --- The fit ---


@pytest.mark.parametrize(
    "view",
    [VIEW, ShellView(camera=BENT), ShellView(camera=CAMERA, parameters=TILTED)],
    ids=["plain", "distorted", "tilted"],
)
def test_exact_matches_give_the_exact_rotation(view: ShellView) -> None:
    for w in ([0.0, 0.0, 0.0], [0.01, 0.02, -0.05], [-0.03, 0.001, 0.0]):
        found = SphereFlowEstimator(view=view).fit(matches(np.array(w), view)).increment
        assert found.valid
        assert found.inlier_share == 1.0
        np.testing.assert_allclose(found.rotation, w, atol=1e-9)


def test_a_wrong_radius_scales_the_rotation_over_the_shell_but_not_the_turn() -> None:
    # By hand, in the middle of the picture: the surface passes by as before, at another radius.
    thin = SphereFlowEstimator(
        view=ShellView(camera=CAMERA, parameters=ShellViewParameters(radius=0.0375))
    )
    w = np.array([0.002, 0.004, 0.01])
    seen = matches(w, n=5000)
    middle = np.abs(seen.previous - CAMERA.K[:2, 2]).max(axis=1) < 60
    seen = PointMatches(1.0, 1.0 - DT, "", seen.previous[middle], seen.current[middle])
    found = thin.fit(seen).increment.rotation
    np.testing.assert_allclose(found, [2 * w[0], 2 * w[1], w[2]], rtol=0.003)


def test_the_covariance_is_what_noise_does() -> None:
    estimator = SphereFlowEstimator(view=VIEW)
    w = np.array([0.005, 0.02, 0.01])
    found = [estimator.fit(matches(w, n=150, noise=0.2, seed=k)).increment for k in range(400)]
    errors = np.array([f.rotation - w for f in found])
    covariances = np.array([f.covariance for f in found])
    deviation = errors.std(axis=0)
    claimed = np.sqrt(np.diag(covariances.mean(axis=0)))
    np.testing.assert_allclose(claimed, deviation, rtol=0.12)  # 3.4 sigma of 400 draws
    nees = [e @ np.linalg.solve(C, e) / 3 for e, C in zip(errors, covariances, strict=True)]
    assert np.mean(nees) == pytest.approx(1.0, abs=4 * np.sqrt(2 / 1200))
    assert np.abs(errors.mean(axis=0) / deviation).max() < 4 / np.sqrt(400)


def test_residuals_above_the_stated_noise_count_and_below_do_not() -> None:
    w = np.array([0.0, 0.01, 0.0])
    stated = SphereFlowParameters(pixel_noise=0.1)
    deviations = []
    for noise in (0.0, 0.05, 0.2):
        found = SphereFlowEstimator(view=VIEW, parameters=stated).fit(matches(w, noise=noise))
        deviations.append(np.sqrt(found.increment.covariance[1, 1]))
    assert deviations[1] == pytest.approx(deviations[0], rel=1e-3)
    assert deviations[2] == pytest.approx(2 * deviations[0], rel=0.15)


def test_points_that_share_their_error_widen_the_covariance() -> None:
    w = np.array([0.0, 0.01, 0.0])
    one, four = (
        SphereFlowEstimator(view=VIEW, parameters=SphereFlowParameters(points_per_error=k))
        .fit(matches(w, noise=0.1))
        .increment.covariance
        for k in (1.0, 4.0)
    )
    np.testing.assert_allclose(four, 4 * one)


def test_outliers_are_left_out() -> None:
    estimator = SphereFlowEstimator(view=VIEW)
    w = np.array([-0.004, 0.02, 0.03])
    for seed in range(20):
        found = estimator.fit(matches(w, noise=0.1, outliers=0.5, seed=seed)).increment
        assert 0.3 < found.inlier_share < 0.65
        error = found.rotation - w
        assert error @ np.linalg.solve(found.covariance, error) < 25  # 4.3 sigma
    everything = matches(w, noise=0.1, outliers=0.5)
    before, after = (VIEW.back_project(p) for p in (everything.previous, everything.current))
    plain = rotation_vector(nearest_turn(before, after).T)
    assert np.abs(plain - w).max() > 100 * np.abs(error).max()  # what outliers do to least squares


def test_the_same_matches_give_the_same_answer() -> None:
    a, b = (SphereFlowEstimator(view=VIEW).fit(matches(np.array([0.0, 0.01, 0.0]), noise=0.3,
            outliers=0.3)).increment for _ in range(2))  # fmt: skip
    np.testing.assert_array_equal(a.rotation, b.rotation)
    np.testing.assert_array_equal(a.covariance, b.covariance)


def test_increments_drive_a_pose_over_the_shell() -> None:
    # Heading to the pole, forward is more latitude; heading along the equator, longitude.
    def after(angles: list[float], w: list[float]) -> np.ndarray:
        found = SphereFlowEstimator(view=VIEW).fit(matches(np.array(w))).increment.rotation
        return angles_of(from_angles(np.array(angles)) @ rotation(found).matrix())

    np.testing.assert_allclose(after([0, 0.2, 1.0], [0, 0.01, 0]), [0, 0.21, 1.0], atol=1e-9)
    east = after([-np.pi / 2, 0, 1.0], [0, 0.01, 0])
    np.testing.assert_allclose(east, [-np.pi / 2, 0, 1.01], atol=1e-9)
    np.testing.assert_allclose(after([0.3, 0.2, 1], [0, 0, 0.01]), [0.31, 0.2, 1], atol=1e-9)


# --- Bad matches ---

GOOD = matches(np.array([0.0, 0.01, 0.0]))
RANDOM = np.random.default_rng(0)


@pytest.mark.parametrize(
    ("bad", "dropped"),
    [
        (PointMatches(), {}),
        (PointMatches(1.0, 0.9), {"few_points": 1}),
        (PointMatches(1.0, 1.0, "", GOOD.previous, GOOD.current), {"bad_matches": 1}),
        (PointMatches(1.0, np.nan, "", GOOD.previous, GOOD.current), {"bad_matches": 1}),
        (PointMatches(np.inf, 0.0, "", GOOD.previous, GOOD.current), {"bad_matches": 1}),
        (PointMatches(1.0, 0.9, "", GOOD.previous, GOOD.current[1:]), {"bad_matches": 1}),
        (PointMatches(1.0, 0.9, "", GOOD.previous[:9], GOOD.current[:9]), {"few_points": 1}),
        (
            PointMatches(1.0, 0.9, "", GOOD.previous, GOOD.current * np.nan),
            {"bad_point": len(GOOD), "few_points": 1},
        ),
        (
            PointMatches(1.0, 0.9, "", GOOD.previous * 1e300, GOOD.current),
            {"bad_point": len(GOOD), "few_points": 1},
        ),
        (
            PointMatches(1.0, 0.9, "", *(RANDOM.random((2, 99, 2)) * [639, 479])),
            {"no_agreement": 1},
        ),
        (
            PointMatches(1.0, 0.9, "", *(50.0 + 1e-4 * RANDOM.random((1, 99, 2)) + [[[0]], [[9]]])),
            {"no_agreement": 1},
        ),
        # All at one place: no pair has a direction.
        (
            PointMatches(1.0, 0.9, "", np.full((20, 2), 50.0), np.full((20, 2), 60.0)),
            {"no_agreement": 1},
        ),
    ],
)
def test_bad_matches_give_no_increment(bad: PointMatches, dropped: dict[str, int]) -> None:
    fit = SphereFlowEstimator(view=VIEW).fit(bad)
    assert not fit.increment.valid
    assert {reason: n for reason, n in fit.dropped.items() if n} == dropped


def test_some_bad_points_do_not_hurt_the_others() -> None:
    current = GOOD.current.copy()
    current[::3] = np.nan
    fit = SphereFlowEstimator(view=VIEW).fit(PointMatches(1.0, 0.9, "", GOOD.previous, current))
    np.testing.assert_allclose(fit.increment.rotation, [0.0, 0.01, 0.0], atol=1e-9)
    assert fit.dropped["bad_point"] == len(GOOD.current[::3])


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"pixel_noise": 0.0}, "pixel_noise is 0.0: must be greater than 0"),
        ({"min_inliers": 2}, "min_inliers is 2: must be 3 or greater"),
        ({"min_inlier_share": 1.2}, "min_inlier_share is 1.2: must be 0 to 1"),
        ({"points_per_error": 0.5}, "points_per_error is 0.5: must be 1 or greater"),
        ({"hypotheses": 0}, "hypotheses is 0: must be 1 or greater"),
    ],
)
def test_bad_parameters_are_refused(bad: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        SphereFlowParameters(**bad)


# --- Pictures of the steel ---


@cache
def steel(speed: float, moved: bool) -> np.ndarray:
    R_RB = on_the_equator(0.3 + speed, 0.4)
    return picture(
        R_RB @ rotation(moved * increment(speed)),
        noise=1.5,
        seed=int(1e4 * speed) + moved,
        supersampling=3,
    )


def increment(speed: float) -> np.ndarray:
    """Forward at that speed (m/s) for one picture's time, and turning a little."""
    return np.array([0.0, speed * DT / RADIUS, 0.002])


def tracked(speed: float, predicted: np.ndarray | None) -> PointMatches:
    before, after = steel(speed, False), steel(speed, True)
    parameters = LucasKanadeParameters()
    points = corners(before, parameters)
    start = None if predicted is None else VIEW.turned(points, predicted)
    found, good = track(before, after, points, parameters, start)
    good &= VIEW.inside(found)
    return PointMatches(1.0, 1.0 - DT, "", points[good], found[good])


@pytest.mark.parametrize(("speed", "limit"), [(0.01, 0.005), (0.05, 0.005), (0.12, 0.01)])
def test_the_scale_of_the_flow_on_steel_is_right(speed: float, limit: float) -> None:
    # The gyro is 5 % and 1 deg/s off.
    w = increment(speed)
    found = SphereFlowEstimator(view=VIEW).fit(tracked(speed, 1.05 * w + np.radians(1.0) * DT))
    assert abs(found.increment.rotation[1] / w[1] - 1) < limit
    assert abs(found.increment.rotation[0]) < limit * w[1]
    assert abs(found.increment.rotation[2] - w[2]) < 2e-4
    error = found.increment.rotation - w
    assert error @ np.linalg.solve(found.increment.covariance, error) < 25


def test_without_a_prediction_the_steel_aliases_and_nobody_would_notice() -> None:
    w = increment(0.12)  # a whole pitch of the holes between two pictures
    found = SphereFlowEstimator(view=VIEW).fit(tracked(0.12, None)).increment
    assert found.inlier_share > 0.9
    assert abs(found.rotation[1]) < 0.1 * w[1]


def test_the_mean_of_the_flow_is_some_percent_low() -> None:
    w = increment(0.05)
    seen = tracked(0.05, w)
    plain = surface_velocity(seen, VIEW)[0] / 0.05 - 1
    corrected = surface_velocity(seen, VIEW, w / DT)[0] / 0.05 - 1
    assert -0.035 < plain < -0.02
    assert -0.02 < corrected < -0.01


# --- The block ---


def test_the_block_fits_once_and_counts() -> None:
    block = SphereFlow(estimator=SphereFlowEstimator(view=VIEW), rate=60.0)
    simulator = Simulator(block)
    context = simulator.get_mutable_context()
    port = block.matches_input_port()
    port.FixValue(context, GOOD)
    found = block.increment_output_port().Eval(context)
    assert (found.stamp, found.previous_stamp, found.frame_id) == (1.0, 1.0 - DT, "base_link")
    simulator.AdvanceTo(0.1)
    assert block.increment_output_port().Eval(context) is found
    assert not any(block.health_output_port().Eval(context).counts.values())
    port.FixValue(context, PointMatches(2.0, 1.9))
    assert not block.increment_output_port().Eval(context).valid
    simulator.AdvanceTo(0.2)  # counted once, however often it is looked at
    assert block.health_output_port().Eval(context).counts["few_points"] == 1
