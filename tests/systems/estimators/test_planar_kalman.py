from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator

from systems.angles import spatial_pose, wrap
from systems.estimators.planar_kalman import (
    REASONS,
    UNKNOWN,
    PlanarKalmanFilter,
    PlanarKalmanParameters,
    mahalanobis,
    predict,
    update,
)
from systems.messages import PoseEstimate

PARAMETERS = PlanarKalmanParameters(speed_noise=0.05, heading_noise=0.02)
PRINTED = PlanarKalmanParameters(speed_noise=0.05, heading_noise=0.02, rebase=False)


def some_covariance(seed: int, scale: float = 0.1) -> np.ndarray:
    A = np.random.default_rng(seed).normal(0, scale, (3, 3))
    return A @ A.T + 1e-4 * np.eye(3)


# --- The steps, against numbers worked out by hand ---


def test_prediction_worked_out_by_hand() -> None:
    # Heading along y at 0.5 m/s for 0.1 s: y grows by 0.05, and an error of the heading of 1 rad
    # would move x by -0.05.
    x, P = predict(
        np.array([1.0, 2.0, np.pi / 2]), np.diag([0.01, 0.02, 0.03]), 0.5, 1.6, 0.1, PARAMETERS
    )
    np.testing.assert_allclose(x, [1.0, 2.05, 1.6], atol=1e-15)
    np.testing.assert_allclose(
        P,
        [
            [0.01 + 0.0025 * 0.03, 0.0, -0.05 * 0.03],
            [0.0, 0.02 + 0.05**2 * 0.1, 0.0],
            [-0.05 * 0.03, 0.0, 0.03 + 0.02**2 * 0.1],
        ],
        atol=1e-15,
    )


def test_the_printed_prediction_owes_nothing_to_the_last_heading() -> None:
    _, P = predict(
        np.array([1.0, 2.0, np.pi / 2]), np.diag([0.01, 0.02, 0.03]), 0.5, 1.6, 0.1, PRINTED
    )
    expected = np.diag([0.01 + 0.0025 * 0.03, 0.02 + 0.05**2 * 0.1, 0.02**2 * 0.1])
    np.testing.assert_allclose(P, expected, atol=1e-15)


def test_update_worked_out_by_hand() -> None:
    # Equal weights: the middle, half the variance. Unequal: 3 to 1.
    x, P = update(
        np.array([0.0, 0.0, 0.2]),
        np.diag([0.01, 0.03, 0.01]),
        np.array([1.0, 1.0, 0.4]),
        np.diag([0.01, 0.01, 0.03]),
    )
    np.testing.assert_allclose(x, [0.5, 0.75, 0.25], atol=1e-15)
    np.testing.assert_allclose(P, np.diag([0.005, 0.0075, 0.0075]), atol=1e-15)


def test_update_with_correlations_is_the_sum_of_informations() -> None:
    for seed in range(10):
        P, R = some_covariance(2 * seed), some_covariance(2 * seed + 1)
        x, z = np.random.default_rng(seed).normal(0, 0.5, (2, 3))
        information = np.linalg.inv(P) + np.linalg.inv(R)
        x_new, P_new = update(x, P, z, R)
        np.testing.assert_allclose(P_new, np.linalg.inv(information), rtol=1e-8, atol=1e-12)
        expected = np.linalg.solve(information, np.linalg.solve(P, x) + np.linalg.solve(R, z))
        np.testing.assert_allclose(x_new, expected, atol=1e-9)
        np.testing.assert_array_equal(P_new, P_new.T)


def test_the_angle_is_corrected_the_short_way_across_pi() -> None:
    P = R = np.diag([0.01, 0.01, 0.01])
    for before, measured, after in (
        (np.pi - 0.1, -np.pi + 0.3, -np.pi + 0.1),
        (-np.pi + 0.1, np.pi - 0.3, np.pi - 0.1),
        (3.0, -3.0, np.pi),
    ):
        x, _ = update(np.array([0, 0, before]), P, np.array([0, 0, measured]), R)
        assert x[2] == pytest.approx(after, abs=1e-12)
        d = mahalanobis(np.array([0, 0, before]), P, np.array([0, 0, measured]), R)
        assert d == pytest.approx(wrap(measured - before) ** 2 / 0.02)


def test_mahalanobis_worked_out_by_hand() -> None:
    S = np.array([[2.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 0.5]])
    # S^-1 of the upper block is [[2, -1], [-1, 2]] / 3.
    found = mahalanobis(np.zeros(3), S / 2, np.array([1.0, 2.0, 0.5]), S / 2)
    assert found == pytest.approx((2 - 4 + 8) / 3 + 0.25 / 0.5)


@pytest.mark.parametrize("parameters", [PARAMETERS, PRINTED])
def test_the_covariance_is_carried_by_the_derivatives(parameters: PlanarKalmanParameters) -> None:
    # P' = F P F' + F_n Q F_n', F and F_n by differences of the motion itself.
    dt, v, omega, h = 0.1, 0.4, 0.7, 1e-6

    def motion(x: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Distance and heading carry noise; the heading is the gyro's (and its offset's)."""
        distance = v * dt + noise[0]
        base = x[2] if parameters.rebase else 0.8
        return np.array(
            [
                x[0] + distance * np.cos(x[2]),
                x[1] + distance * np.sin(x[2]),
                base + omega * dt + noise[1],
            ]
        )

    x, P = np.array([0.3, -0.2, 0.8]), some_covariance(3)
    F = np.column_stack(
        [(motion(x + s, np.zeros(2)) - motion(x - s, np.zeros(2))) / (2 * h) for s in h * np.eye(3)]
    )
    F_n = np.column_stack([(motion(x, s) - motion(x, -s)) / (2 * h) for s in h * np.eye(2)])
    Q = np.diag([parameters.speed_noise**2, parameters.heading_noise**2]) * dt
    x_new, P_new = predict(x, P, v, 0.8 + omega * dt, dt, parameters)
    np.testing.assert_allclose(x_new, motion(x, np.zeros(2)), atol=1e-12)
    np.testing.assert_allclose(P_new, F @ P @ F.T + F_n @ Q @ F_n.T, atol=1e-9)


def test_straight_ahead_it_is_the_textbook_filter() -> None:
    # Along a fixed heading of 0 the distance is a scalar random walk with drift.
    rng = np.random.default_rng(4)
    parameters = PlanarKalmanParameters(speed_noise=0.3, heading_noise=1e-9)
    x, P = np.zeros(3), np.diag([0.5, 0.5, 1e-18])
    scalar, variance = 0.0, 0.5
    dt, r = 0.1, 0.04
    for _ in range(50):
        v, z = rng.normal(size=2)
        x, P = predict(x, P, v, 0.0, dt, parameters)
        x, P = update(x, P, np.array([z, 0.0, 0.0]), np.diag([r, 1.0, 1.0]))
        scalar, variance = scalar + v * dt, variance + 0.09 * dt
        gain = variance / (variance + r)
        scalar, variance = scalar + gain * (z - scalar), (1 - gain) * variance
        assert x[0] == pytest.approx(scalar, abs=1e-9)
        assert P[0, 0] == pytest.approx(variance, rel=1e-9)


def test_the_errors_are_as_large_as_it_says() -> None:
    # Truth and measurements drawn from the filter's own model: NEES is chi-square(3).
    rng = np.random.default_rng(5)
    dt, v, omega = 0.02, 0.3, 0.4
    nees = []
    for _ in range(60):
        R = np.diag([0.02, 0.03, 0.04]) ** 2
        true = np.array([0.0, 0.0, 0.3])
        x, P = rng.multivariate_normal(true, R), R
        for k in range(1, 101):
            # The gyro says omega; how far the body really turned and drove is random.
            driven = v * dt + rng.normal(0, PARAMETERS.speed_noise * np.sqrt(dt))
            turned = omega * dt + rng.normal(0, PARAMETERS.heading_noise * np.sqrt(dt))
            true += np.array([driven * np.cos(true[2]), driven * np.sin(true[2]), turned])
            x, P = predict(x, P, v, x[2] + omega * dt, dt, PARAMETERS)
            if k % 20 == 0:
                x, P = update(x, P, true + rng.multivariate_normal(np.zeros(3), R), R)
        e = x - true
        e[2] = wrap(e[2])
        nees.append(e @ np.linalg.solve(P, e))
    # The mean of 60 chi-squares of 3 has the standard deviation sqrt(6 / 60) = 0.32.
    assert 2.1 < np.mean(nees) < 3.9


# --- The block ---

RATE = 100.0
DT = 1 / RATE


class Rig:
    """The block in a simulator, its inputs fixed at will."""

    def __init__(self, **parameters: Any) -> None:
        self.block = PlanarKalmanFilter(parameters=PlanarKalmanParameters(**parameters), rate=RATE)
        self.simulator = Simulator(self.block)
        self.context = self.simulator.get_mutable_context()
        self.steps = 0
        self.command()
        self.gyro()
        self.marker()

    def command(self, v: float = 0.0, omega: float = 0.0) -> None:
        self.block.command_input_port().FixValue(self.context, [v, omega])

    def gyro(self, yaw_rate: float = 0.0, other: float = 0.0) -> None:
        sample = [other, other, yaw_rate, other, other, other]
        self.block.imu_input_port().FixValue(self.context, sample)

    def marker(
        self, pose: PoseEstimate | None = None, alternative: PoseEstimate | None = None
    ) -> None:
        for port, value in (
            (self.block.marker_pose_input_port(), pose),
            (self.block.marker_alternative_input_port(), alternative),
        ):
            port.FixValue(self.context, value or PoseEstimate())

    def step(self, n: int = 1) -> None:
        # Updates happen at 0, DT, 2 DT, ...; stop between two of them.
        self.steps += n
        self.simulator.AdvanceTo((self.steps - 0.5) * DT)

    @property
    def pose(self) -> np.ndarray:
        return self.block.pose_output_port().Eval(self.context).copy()

    @property
    def covariance(self) -> np.ndarray:
        return self.block.covariance_output_port().Eval(self.context).reshape(3, 3).copy()

    @property
    def counts(self) -> dict[str, int]:
        counts = self.block.health_output_port().Eval(self.context).counts
        assert set(counts) == set(REASONS)
        return {reason: n for reason, n in counts.items() if n}


def marker(
    pose: Any,
    stamp: float,
    deviation: Any = (0.02, 0.02, 0.05),
    ambiguous: bool = False,
    X_WB: RigidTransform | None = None,
) -> PoseEstimate:
    """X_WB by markers; deviations of x, y, theta."""
    x, y, theta = deviation
    return PoseEstimate(
        stamp=stamp,
        pose=X_WB or spatial_pose(np.array(pose, float)),
        # Rotation first, then position.
        covariance=np.diag(np.square([9.0, 9.0, theta, x, y, 9.0])),
        ambiguous=ambiguous,
        markers=1,
    )


def test_before_the_first_marker_it_knows_nothing() -> None:
    rig = Rig()
    rig.command(v=0.3)
    rig.gyro(0.5)
    rig.step(20)
    np.testing.assert_array_equal(rig.pose, np.zeros(3))
    np.testing.assert_array_equal(rig.covariance, UNKNOWN * np.eye(3))
    assert rig.counts == {}


def test_it_starts_at_the_first_marker_pose() -> None:
    rig = Rig()
    rig.gyro(0.5)
    rig.step(50)  # the gyro has turned by 0.25 rad before anyone knew from where
    rig.marker(marker([1.0, 2.0, 3.0], stamp=0.5))
    rig.step()
    np.testing.assert_allclose(rig.pose, [1.0, 2.0, 3.0 + 0.5 * DT], atol=1e-12)
    # One step has been driven on from there.
    drift = DT * np.square([0.05 * np.cos(3.0), 0.05 * np.sin(3.0), 0.02])
    expected = np.square([0.02, 0.02, 0.05]) + drift
    np.testing.assert_allclose(np.diag(rig.covariance), expected, rtol=1e-9)
    assert rig.counts == {"accepted": 1}


def test_from_there_it_dead_reckons() -> None:
    rig = Rig()
    rig.marker(marker([1.0, 2.0, 3.0], stamp=0.0))
    rig.command(v=0.4, omega=99.0)  # what counts is the gyro
    rig.gyro(0.5, other=7.0)
    rig.step(200)
    # An arc of radius v / omega, as exact as steps of 5 mrad are.
    theta = 3.0 + 0.5 * 2.0
    arc = 0.8 * np.array([np.sin(theta) - np.sin(3.0), np.cos(3.0) - np.cos(theta)])
    np.testing.assert_allclose(rig.pose, [1.0 + arc[0], 2.0 + arc[1], wrap(theta)], atol=3e-3)
    assert rig.counts == {"accepted": 1}


def test_a_stamp_is_used_once() -> None:
    rig = Rig()
    rig.marker(marker([0.0, 0.0, 0.0], stamp=0.0))
    rig.step()
    rig.marker(marker([0.05, 0.0, 0.0], stamp=0.1))
    rig.step(1)
    once = rig.pose[0]
    rig.step(30)  # the same picture stays on the port
    assert rig.counts == {"accepted": 2}
    assert rig.pose[0] == once
    variance = rig.covariance[0, 0]
    rig.marker(marker([0.05, 0.0, 0.0], stamp=0.2))
    rig.step()
    assert rig.counts == {"accepted": 3}
    assert rig.pose[0] > once
    assert rig.covariance[0, 0] < variance


def test_it_averages_measurements_by_their_covariance() -> None:
    # At rest, and without noise of its own, the filter is the weighted mean of all marker poses.
    rng = np.random.default_rng(6)
    rig = Rig(speed_noise=1e-9, heading_noise=1e-9)
    poses = rng.normal([1.0, 2.0, 0.3], 0.02, (10, 3))
    deviations = rng.uniform(0.01, 0.05, (10, 3))
    for k, (pose, deviation) in enumerate(zip(poses, deviations, strict=True)):
        rig.marker(marker(pose, stamp=0.1 * k, deviation=deviation))
        rig.step(2)
    weights = 1 / deviations**2
    np.testing.assert_allclose(rig.pose, (weights * poses).sum(0) / weights.sum(0), atol=1e-9)
    np.testing.assert_allclose(np.diag(rig.covariance), 1 / weights.sum(0), rtol=1e-6)


def test_given_measurement_noise_stands_in_for_the_poses_own() -> None:
    rig = Rig(speed_noise=1e-9, heading_noise=1e-9, measurement_noise=[0.1, 0.2, 0.3])
    rig.marker(marker([1.0, 2.0, 0.3], stamp=0.0))
    rig.step()
    np.testing.assert_allclose(np.diag(rig.covariance), [0.01, 0.04, 0.09], rtol=1e-6)


def test_the_heading_correction_is_carried_on_unless_it_is_printed() -> None:
    # The first marker says 0.5 rad, the gyro has not moved from 0. As printed, the next prediction
    # sets the heading to the gyro's again: the correction is thrown away, every time.
    ours, printed = Rig(), Rig(rebase=False)
    for rig, heading in ((ours, 0.5), (printed, 0.0)):
        rig.marker(marker([0.0, 0.0, 0.5], stamp=0.0))
        rig.command(v=1.0)
        rig.step(100)
        assert rig.counts == {"accepted": 1}
        assert rig.pose[2] == pytest.approx(heading, abs=1e-12)
        # So it drives off in another direction; the very first step still knew better.
        first = DT * np.array([np.cos(0.5), np.sin(0.5)])
        rest = 0.99 * np.array([np.cos(heading), np.sin(heading)])
        np.testing.assert_allclose(rig.pose[:2], first + rest, atol=1e-12)
    # Later corrections fare no better.
    for rig, heading in ((ours, 0.6), (printed, 0.0)):
        rig.command(v=0.0)
        accurate = (1.0, 1.0, 1e-5)
        measured = [*rig.pose[:2], 0.6 if rig is ours else 0.002]
        rig.marker(marker(measured, stamp=1.0, deviation=accurate))
        rig.step(2)
        assert rig.counts == {"accepted": 2}
        assert rig.pose[2] == pytest.approx(heading, abs=1e-3)


def test_a_bias_of_the_gyro_is_reset_by_markers() -> None:
    ours, printed = Rig(gate=1e6), Rig(gate=1e6, rebase=False)
    for rig in (ours, printed):
        rig.gyro(0.05)  # at rest
        for k in range(20):
            rig.marker(marker([0.0, 0.0, 0.0], stamp=0.5 * k, deviation=(0.02, 0.02, 0.001)))
            rig.step(50)
    # Half a second of bias against ten.
    assert ours.pose[2] == pytest.approx(0.05 * 0.5, abs=5e-3)
    assert printed.pose[2] == pytest.approx(0.05 * 10.0, abs=5e-3)


def test_heading_is_wrapped() -> None:
    rig = Rig()
    rig.marker(marker([0.0, 0.0, 3.1], stamp=0.0))
    rig.gyro(1.0)
    rig.step(10)
    assert rig.pose[2] == pytest.approx(3.2 - 2 * np.pi, abs=1e-9)
    rig.marker(marker([0.0, 0.0, 3.1], stamp=0.1, deviation=(0.02, 0.02, 1e-4)))
    rig.step()
    assert abs(wrap(rig.pose[2] - 3.11)) < 1e-3


def test_an_innovation_beyond_the_gate_is_refused() -> None:
    # 0.02 m of deviation either side: sqrt(16.27 * 2) * 0.02 m is 0.114 m.
    for offset, verdict in ((0.10, "accepted"), (0.13, "gated")):
        rig = Rig(speed_noise=1e-9, heading_noise=1e-9)
        rig.marker(marker([0.0, 0.0, 0.0], stamp=0.0))
        rig.step()
        rig.marker(marker([offset, 0.0, 0.0], stamp=0.1))
        rig.step()
        rig.marker()
        rig.step()
        moved = offset / 2 if verdict == "accepted" else 0.0
        assert rig.pose[0] == pytest.approx(moved, abs=1e-6)
        expected = {"accepted": 1} | {verdict: 1 + (verdict == "accepted")}
        assert rig.counts == expected


def test_the_innovation_is_reported_accepted_or_not() -> None:
    rig = Rig(speed_noise=1e-9, heading_noise=1e-9)

    def nis() -> list[float]:
        return rig.block.nis_output_port().Eval(rig.context).tolist()

    rig.step(5)
    assert math.isnan(nis()[0])
    assert nis()[1] == 0
    rig.marker(marker([0.0, 0.0, 0.0], stamp=0.1))
    rig.step(5)
    assert nis()[1] == 0  # there was nothing to compare the first with
    for k, (x, squared) in enumerate(((0.04, 0.04**2 / 8e-4), (0.52, 0.50**2 / 6e-4))):
        rig.marker(marker([x, 0.0, 0.0], stamp=0.2 + k))
        rig.step(5)
        assert nis() == [pytest.approx(squared / 3, rel=1e-6), k + 1]
    rig.marker(marker([0.0, 0.0, 0.0], stamp=9.0, deviation=(0.0, 0.0, 0.0)))
    rig.step(5)
    assert nis()[1] == 2
    assert rig.counts == {"accepted": 2, "gated": 1, "bad_marker_pose": 1}


def test_of_two_solutions_the_one_nearest_to_the_prediction_is_taken() -> None:
    right, wrong = [0.01, 0.0, 0.02], [0.30, 0.2, 0.60]
    for pair in ((right, wrong), (wrong, right)):
        rig = Rig()
        rig.marker(marker([0.0, 0.0, 0.0], stamp=0.0))
        rig.step()
        rig.marker(*(marker(pose, stamp=0.1, ambiguous=True) for pose in pair))
        rig.step()
        assert rig.counts == {"accepted": 2}
        assert 0.0 < rig.pose[0] < 0.01
        assert 0.0 < rig.pose[2] < 0.02


def test_two_solutions_are_refused_on_request() -> None:
    rig = Rig(ambiguous="reject")
    rig.marker(marker([0.0, 0.0, 0.0], stamp=0.0))
    rig.step()
    rig.marker(marker([0.01, 0.0, 0.0], stamp=0.1, ambiguous=True), marker([0.3, 0, 0], stamp=0.1))
    rig.step()
    assert rig.counts == {"accepted": 1, "ambiguous": 1}
    assert rig.pose[0] == 0.0


def test_it_does_not_start_at_one_of_two_solutions() -> None:
    rig = Rig()
    rig.marker(marker([0.0, 0, 0.5], stamp=0.0, ambiguous=True), marker([0.0, 0, -0.5], stamp=0.0))
    rig.step(5)
    assert rig.counts == {"ambiguous": 1}
    np.testing.assert_array_equal(rig.covariance, UNKNOWN * np.eye(3))


def test_the_alternative_of_another_picture_is_no_choice() -> None:
    rig = Rig()
    rig.marker(marker([0.0, 0.0, 0.0], stamp=0.0))
    rig.step()
    stale = marker([0.0, 0.0, 0.0], stamp=0.05)
    rig.marker(marker([0.5, 0.0, 0.0], stamp=0.1, ambiguous=True), stale)
    rig.step()
    assert rig.counts == {"accepted": 1, "gated": 1}


def bad_covariance(value: float) -> PoseEstimate:
    covariance = np.diag(np.full(6, 0.01))
    covariance[3, 4] = covariance[4, 3] = value
    return PoseEstimate(stamp=0.1, covariance=covariance)


@pytest.mark.parametrize(
    "bad",
    [
        marker(None, stamp=0.1, X_WB=RigidTransform([math.nan, 0.0, 0.0])),
        marker(None, stamp=0.1, X_WB=RigidTransform([0.0, math.inf, 0.0])),
        PoseEstimate(stamp=0.1),
        bad_covariance(math.nan),
        bad_covariance(math.inf),
        marker([0.0, 0.0, 0.0], stamp=0.1, deviation=(0.0, 0.0, 0.0)),
    ],
    ids=["nan place", "inf place", "no covariance", "nan covariance", "inf covariance", "perfect"],
)
@pytest.mark.parametrize("started", [False, True])
def test_a_bad_marker_pose_is_dropped_and_counted(bad: PoseEstimate, started: bool) -> None:
    rig = Rig()
    if started:
        rig.marker(marker([1.0, 2.0, 0.5], stamp=0.0))
        rig.step()
    before = rig.pose
    rig.marker(bad)
    rig.step(3)
    assert rig.counts == {"bad_marker_pose": 1} | ({"accepted": 1} if started else {})
    np.testing.assert_array_equal(rig.pose, before)
    assert np.isfinite(rig.covariance).all()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_bad_samples_are_dropped_and_counted(value: float) -> None:
    rig = Rig()
    rig.marker(marker([0.0, 0.0, 0.0], stamp=0.0))
    rig.command(v=1.0)
    rig.gyro(1.0)
    rig.step(10)
    theta, x = rig.pose[2], rig.pose[0]
    rig.gyro(value)
    rig.step(3)
    assert rig.pose[2] == pytest.approx(theta)
    assert rig.pose[0] > x  # it drives on
    x = rig.pose[0]
    rig.command(v=value)
    rig.step(4)
    assert rig.pose[0] == x
    assert rig.counts == {"accepted": 1, "bad_imu": 7, "bad_command": 4}
    # What the filter does not use may be what it likes.
    rig.gyro(1.0, other=value)
    rig.command(v=1.0, omega=value)
    rig.step(10)
    assert rig.counts == {"accepted": 1, "bad_imu": 7, "bad_command": 4}
    assert np.isfinite(rig.pose).all()
    assert rig.pose[2] == pytest.approx(theta + 0.1)


def test_a_tilted_body_counts_by_its_yaw() -> None:
    rig = Rig()
    X_WB = RigidTransform(RollPitchYaw(0.1, -0.1, 0.7), [1.0, 2.0, 0.3])
    rig.marker(marker(None, stamp=0.0, X_WB=X_WB))
    rig.step()
    np.testing.assert_allclose(rig.pose, [1.0, 2.0, 0.7], atol=1e-12)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("speed_noise", 0.0),
        ("heading_noise", -1.0),
        ("gate", math.nan),
        ("measurement_noise", [0.1, 0.1]),
        ("measurement_noise", [0.1, 0.1, 0.0]),
        ("ambiguous", "guess"),
    ],
)
def test_nonsense_is_refused(field: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{field} is .*: must be "):
        PlanarKalmanParameters(**{field: value})


def test_a_rate_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match=r"rate is 0\.0: must be greater than 0"):
        PlanarKalmanFilter(rate=0.0)
