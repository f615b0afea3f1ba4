import math

import numpy as np
import pytest
from scipy.optimize import approx_fprime

from systems.formation.bearing_filter import (
    BearingFilterParameters,
    arcs,
    correct,
    moved,
    predict,
    restart,
    start,
)
from systems.formation.bearings import cramer_rao, lateral_pixels, pixel_covariance
from tests.systems.formation.test_bearings import BEACONS, POSE, F

NOISE = BearingFilterParameters(centre_std=3.0, yaw_std=0.01)


def seen_by(x: np.ndarray, k: int, camera: int) -> float:
    """The pixel of a beacon by a model of its own: a camera that is turned, and off centre."""
    turned = x[:3] + np.array([0.0, 0.0, x[5 + camera]])
    return float(lateral_pixels(turned, BEACONS[k : k + 1], F)[0][0] + x[3 + camera])


def test_the_gain_is_the_one_of_numeric_derivatives() -> None:
    random = np.random.default_rng(0)
    A = random.normal(0, 0.01, (7, 7))
    P, x = A @ A.T, np.concatenate([POSE, [0.0, 0.5, 0.0, 0.0]])
    u = seen_by(x, 1, 1) + 0.3
    H = approx_fprime(x, lambda y: seen_by(y, 1, 1), 1e-7)
    gain = P @ H / (H @ P @ H + 0.25)
    corrected, P_after, used, refused = correct(x, P, u, BEACONS[1], F, NOISE, rear=True)
    assert used
    assert not refused
    assert corrected == pytest.approx(x + gain * 0.3, abs=1e-7)
    assert P_after == pytest.approx((np.eye(7) - np.outer(gain, H)) @ P, abs=1e-9)


def test_what_the_camera_cannot_see_is_refused_and_nan_is_nothing() -> None:
    x, P = start(POSE, np.eye(3) * 0.01, NOISE)
    same, P_same, used, refused = correct(x, P, 0.0, BEACONS[2], F, NOISE, rear=False)
    assert (used, refused) == (False, True)
    assert same == pytest.approx(x, abs=1e-14)
    assert np.array_equal(P_same, P)
    _, _, used, refused = correct(x, P, math.nan, BEACONS[2], F, NOISE, rear=True)
    assert (used, refused) == (False, False)


def test_a_misread_marker_is_refused() -> None:
    x, P = start(POSE, np.eye(3) * 0.01**2, BearingFilterParameters())
    u = seen_by(x, 0, 1)  # beacon 0's pixel, said to be of beacon 1
    after, _, used, refused = correct(x, P, u, BEACONS[1], F, NOISE, rear=True)
    assert (used, refused) == (False, True)
    assert after == pytest.approx(x, abs=1e-14)


def test_arcs_are_those_of_circles() -> None:
    pose = np.zeros(3)
    for _ in range(1000):
        pose = moved(pose, np.array([0.001, math.pi / 1000]))
    assert pose == pytest.approx([0.0, 2 / math.pi, math.pi], abs=1e-5)


def test_commands_are_cut_at_the_times_of_pictures() -> None:
    sent = np.array([[0.1, 0.0], [0.2, 0.3], [0.4, 0.0], [9.0, 9.0]])  # the newest first
    travel = list(arcs(sent, 0.1, 1.0, 0.75, 0.95))
    expected = [[0.4 * 0.05, 0.0], [0.2 * 0.1, 0.3 * 0.1], [0.1 * 0.05, 0.0]]
    assert np.array(travel) == pytest.approx(np.array(expected))


@pytest.mark.parametrize("seed", range(5))
def test_no_command_is_left_out(seed: int) -> None:
    """Against a sum over finely divided time."""
    random = np.random.default_rng(seed)
    sent, dt, now = random.normal(size=(21, 2)), 0.05, 7.35
    start_time, end = np.sort(now - 21 * dt * random.random(2))
    times = np.linspace(start_time, end, 200_001)
    index = np.clip(np.floor((now - times) / dt).astype(int), 0, 20)
    expected = np.trapezoid(sent[index], times, axis=0)
    travel = np.sum(list(arcs(sent, dt, now, start_time, end)), axis=0)
    assert travel == pytest.approx(expected, abs=1e-4)


def test_the_covariance_follows_the_motion_of_the_state() -> None:
    """F P F' by numeric derivatives of the motion, for a batch of two robots."""
    random = np.random.default_rng(1)
    quiet = BearingFilterParameters(distance_noise=0.0, turn_noise=0.0, drift_noise=0.0)
    A = random.normal(size=(2, 7, 7))
    P, x = A @ A.transpose(0, 2, 1), random.normal(0, 0.5, (2, 7))
    travel = np.array([[0.3, -0.2], [-0.1, 0.4]])
    after = predict(x, P, travel, quiet)[1]
    for k in range(2):
        F = np.eye(7)
        F[:3, :3] = [
            approx_fprime(x[k, :3], lambda y, i=i, k=k: moved(y, travel[k])[i], 1e-7)
            for i in range(3)
        ]
        assert after[k] == pytest.approx(F @ P[k] @ F.T, abs=1e-5)


def test_prediction_grows_with_distance_and_not_in_its_steps() -> None:
    parameters = BearingFilterParameters(distance_noise=0.02, drift_noise=0.03, turn_noise=0.0)
    x, P = start(np.zeros(3), np.zeros((3, 3)), parameters)
    once = predict(x, P, np.array([1.0, 0.0]), parameters)[1]
    for _ in range(100):
        x, P = predict(x, P, np.array([0.01, 0.0]), parameters)
    assert P[0, 0] == pytest.approx(0.02**2)
    assert P[2, 2] == pytest.approx(once[2, 2]) == pytest.approx(0.03**2)
    assert P[1, 1] == pytest.approx(0.03**2 / 3, rel=0.03)  # the integral of a random walk


def test_a_restart_is_the_resection_with_its_bound() -> None:
    u = lateral_pixels(POSE, BEACONS, F)[0]
    guess = POSE + np.array([0.2, -0.1, 0.1])
    parameters = BearingFilterParameters(centre_std=3.0)
    x, P, found = restart(u, BEACONS, F, guess, parameters, rear=True)
    assert found
    assert x[:3] == pytest.approx(POSE, abs=1e-8)
    bound = cramer_rao(POSE, BEACONS, F, pixel_covariance(3, 0.5, 3.0))
    assert P[:3, :3] == pytest.approx(bound, rel=1e-3, abs=1e-8)
    assert P[4, 4] == pytest.approx(9.0, rel=1e-3)  # of one place the centre stays unknown
    assert abs(P[4, :3]).max() > 1e-3  # but its share in the pose is known


def test_standing_still_averages() -> None:
    random = np.random.default_rng(3)
    x, P = start(
        POSE + np.array([0.01, 0.01, 0.005]), np.eye(3) * 0.03**2, BearingFilterParameters()
    )
    for _ in range(100):
        for k in range(3):
            u = seen_by(np.concatenate([POSE, np.zeros(4)]), k, 1) + random.normal(0, 0.5)
            x, P, _, _ = correct(x, P, u, BEACONS[k], F, BearingFilterParameters(), rear=True)
    bound = cramer_rao(POSE, BEACONS, F, pixel_covariance(3, 0.5, 0.0, frames=100))
    assert np.sqrt(np.diag(P)[:3]) == pytest.approx(np.sqrt(np.diag(bound)), rel=0.03)
    error = x[:3] - POSE
    assert error @ np.linalg.solve(P[:3, :3], error) < 16.3  # chi-square, 99.9 %


@pytest.mark.parametrize("field", ["pixel_std", "gate", "centre_std", "drift_noise"])
def test_nonsense_is_refused(field: str) -> None:
    with pytest.raises(ValueError, match=f"{field} is -1"):
        BearingFilterParameters(**{field: -1.0})
