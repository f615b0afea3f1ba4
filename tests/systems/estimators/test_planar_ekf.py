from __future__ import annotations

import dataclasses
import math
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.math import RigidTransform, cos, sin
from pydrake.systems.analysis import Simulator

from systems.angles import wrap
from systems.estimators.planar_ekf import REASONS, PlanarEkf, lagged
from systems.estimators.planar_ekf_parameters import PlanarEkfParameters
from systems.estimators.planar_kalman import UNKNOWN, PlanarKalmanFilter
from systems.estimators.planar_model import (
    SIZE,
    Drive,
    Measurement,
    ProcessNoise,
    chi_square_3,
    correct,
    is_covariance,
    linearize,
    predict,
    unknown,
    update,
)
from systems.messages import PoseEstimate
from tests.planar_log import (
    RATE,
    PlanarLog,
    Result,
    Truth,
    arcs,
    drive,
    estimate,
    listen,
    on_port,
    wrapped,
)

NOISE = PlanarEkfParameters().process_noise()
WANDERING = PlanarEkfParameters(scale_wander=0.02, scale_wander_time=0.5).process_noise()
DT = 1 / RATE


def some_covariance(seed: int, size: int, scale: float = 0.1) -> np.ndarray:
    A = np.random.default_rng(seed).normal(0, scale, (size, size))
    return A @ A.T + 1e-5 * np.eye(size)


# --- The model ---


def motion(
    x: Any, w: Any, speed: float, yaw_rate: float, dt: float, fading: float = 0.0
) -> np.ndarray:
    """One step as physics has it; w: what noise adds along, across, to the heading and the rest."""
    turn = x[5] * (yaw_rate - x[3]) * dt + w[2]
    middle = x[2] + turn / 2
    along = (x[4] + x[6]) * speed * dt + w[0]
    return np.array(
        [
            x[0] + along * cos(middle) - w[1] * sin(middle),
            x[1] + along * sin(middle) + w[1] * cos(middle),
            x[2] + turn,
            x[3] + w[3],
            x[4] + w[4],
            x[5] + w[5],
            math.exp(-fading * dt) * x[6] + w[6],
        ]
    )


def derivatives(
    x: np.ndarray, speed: float, yaw_rate: float, dt: float, fading: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    xw = InitializeAutoDiff(np.concatenate([x, np.zeros(SIZE)]))[:, 0]
    moved = motion(xw[:SIZE], xw[SIZE:], speed, yaw_rate, dt, fading)
    gradient = ExtractGradient(moved)
    return gradient[:, :SIZE], gradient[:, SIZE:], ExtractValue(moved)[:, 0]


@pytest.mark.parametrize("seed", range(8))
def test_the_derivatives_are_those_of_automatic_differentiation(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = np.concatenate([rng.uniform(-1, 1, 3), rng.normal(0, 0.1, 1), rng.uniform(0.8, 1.2, 2)])
    x = np.append(x, rng.normal(0, 0.1))
    speed, yaw_rate, dt = rng.uniform(-0.5, 0.5), rng.uniform(-3, 3), rng.uniform(0.001, 0.2)
    fading = rng.uniform(0, 5)
    F, G, after = linearize(x, Drive(speed, yaw_rate), dt, fading)
    expected_F, expected_G, expected = derivatives(x, speed, yaw_rate, dt, fading)
    np.testing.assert_allclose(F, expected_F, atol=1e-14)
    np.testing.assert_allclose(G, expected_G, atol=1e-14)
    np.testing.assert_allclose(after, expected, atol=1e-14)


def test_noise_grows_as_it_says() -> None:
    # Straight along x for 2 s at 0.5 m/s in one step, nothing uncertain at first.
    x, _ = unknown(0.1, 0.1, 0.1)
    _, P = predict(x, np.zeros((SIZE, SIZE)), Drive(0.5, 0.0, 0.01, 0.02), 2.0, NOISE)
    assert P[0, 0] == pytest.approx(2 * (NOISE.speed + 0.01) + NOISE.slip * 1.0)
    heading = 2 * (NOISE.gyro + 0.02)
    assert P[2, 2] == pytest.approx(heading)
    assert P[1, 1] == pytest.approx(heading * 0.5**2)  # half of the turn, over 1 m
    np.testing.assert_allclose(
        np.diag(P)[3:], 2 * np.array([NOISE.bias, NOISE.scale, NOISE.gyro_scale, 0.0])
    )
    # On the spot by 3 rad: along only time counts, across and in heading the turn does.
    _, P = predict(x, np.zeros((SIZE, SIZE)), Drive(0.0, 1.5), 2.0, NOISE)
    assert P[2, 2] == pytest.approx(2 * NOISE.gyro + 3 * NOISE.turn)
    assert P[0, 0] + P[1, 1] == pytest.approx(2 * NOISE.speed + 3 * NOISE.side)


@pytest.mark.parametrize("noise", [NOISE, WANDERING])
def test_two_half_steps_are_one_step(noise: ProcessNoise) -> None:
    x = np.array([0.3, -0.2, 0.8, 0.02, 1.05, 0.98, 1e-3])
    P = some_covariance(1, SIZE)
    P[6] = P[:, 6] = 0.0  # how it moves the robot within a step is not looked at
    whole = predict(x, P, Drive(0.3, 0.5), 0.01, noise)
    halves = predict(*predict(x, P, Drive(0.3, 0.5), 0.004, noise), Drive(0.3, 0.5), 0.006, noise)
    np.testing.assert_allclose(halves[0], whole[0], atol=1e-7)
    np.testing.assert_allclose(halves[1], whole[1], atol=1e-7)


def test_slip_that_comes_and_goes_fades_and_its_variance_stays() -> None:
    """Straight ahead, as integrals of a Gauss-Markov process of deviation 0.1 and 0.8 s have it."""
    v, T, sigma, time = 0.5, 3.0, 0.1, 0.8
    x, P = unknown(0.1, 0.0, 0.0, sigma)
    x[6] = 0.2
    P[:3, :3] = 0.0
    quiet = ProcessNoise(*[0.0] * 8, wander=sigma**2, fading=1 / time)
    for _ in range(3000):
        x, P = predict(x, P, Drive(v, 0.0), T / 3000, quiet)
    assert x[6] == pytest.approx(0.2 * math.exp(-T / time))
    assert P[6, 6] == pytest.approx(sigma**2)
    assert x[0] == pytest.approx(v * (T + 0.2 * time * (1 - math.exp(-T / time))), rel=1e-3)
    spread = 2 * time * (T - time * (1 - math.exp(-T / time)))
    assert P[0, 0] == pytest.approx((v * sigma) ** 2 * spread, rel=2e-3)
    # Known at the beginning it is uncertain only later on.
    P[:], x[:] = 0.0, 0.0
    for _ in range(3000):
        x, P = predict(x, P, Drive(v, 0.0), T / 3000, quiet)
    a = math.exp(-T / time)
    spread = time**2 * (2 * T / time - 3 + 4 * a - a * a)
    assert P[0, 0] == pytest.approx((v * sigma) ** 2 * spread, rel=2e-3)
    assert P[6, 6] == pytest.approx(sigma**2 * (1 - a * a))


def test_a_full_circle_ends_where_it_began() -> None:
    x, P = unknown(0.1, 0.1, 0.1)
    for _ in range(1000):
        x, P = predict(x, P, Drive(0.3, 2 * np.pi / 10), 0.01, NOISE)
        assert -np.pi < x[2] <= np.pi
    np.testing.assert_allclose(wrapped(x[None, :3])[0], np.zeros(3), atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_the_update_is_the_sum_of_informations(seed: int) -> None:
    P, R = some_covariance(seed, SIZE), some_covariance(seed + 50, 3)
    x, z = np.random.default_rng(seed).normal(0, 0.3, SIZE), np.array([0.2, 0.1, -0.2])
    information = np.linalg.inv(P)
    information[:3, :3] += np.linalg.inv(R)
    right = np.linalg.solve(P, x)
    right[:3] += np.linalg.solve(R, z)
    x_new, P_new = update(x, P, z, R)
    np.testing.assert_allclose(x_new, np.linalg.solve(information, right), atol=1e-8)
    np.testing.assert_allclose(P_new, np.linalg.inv(information), atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_josephs_form_is_exact_where_the_short_one_is_not(seed: int) -> None:
    # A prediction of kilometres and a measurement of micrometres: 18 orders of magnitude.
    P, R = np.eye(SIZE), 1e-12 * np.eye(3)
    P[:6, :6] = some_covariance(seed, 6, scale=1e3)
    K = np.linalg.solve(P[:3, :3] + R, P[:3]).T
    short = (P - K @ P[:3])[:3, :3]
    assert np.abs(short - R).max() > 1e-11  # zeros or negative variances
    _, P_new = update(np.zeros(SIZE), P, np.zeros(3), R)
    np.testing.assert_allclose(P_new[:3, :3], R, rtol=1e-3, atol=1e-15)
    np.testing.assert_array_equal(P_new, P_new.T)


def test_the_heading_is_corrected_the_short_way_across_pi() -> None:
    x = np.array([0.0, 0.0, np.pi - 0.1, 0.0, 1.0, 1.0, 0.0])
    after, _ = update(x, np.eye(SIZE), np.array([0.0, 0.0, -np.pi + 0.3]), np.eye(3))
    assert after[2] == pytest.approx(-np.pi + 0.1)


def test_chi_square_as_tables_have_it() -> None:
    for probability, quantile in ((0.5, 2.366), (0.95, 7.815), (0.99, 11.345), (0.999, 16.266)):
        assert chi_square_3(probability) == pytest.approx(quantile, abs=5e-4)


def test_what_is_a_covariance() -> None:
    assert is_covariance(np.diag([1e-12, 1.0, 1e-4]))
    assert is_covariance(some_covariance(0, 3))
    indefinite = np.eye(3)
    indefinite[0, 2] = indefinite[2, 0] = 1.1
    for R in (np.zeros((3, 3)), np.diag([1, 1, 0.0]), -np.eye(3), indefinite, UNKNOWN * np.eye(3),
              np.full((3, 3), np.nan), np.diag([1, np.inf, 1])):  # fmt: skip
        assert not is_covariance(R)


def test_an_error_of_the_stamp_counts_as_far_as_the_robot_moves() -> None:
    _, P = unknown(1e-6, 1e-6, 1e-6)
    x = np.array([0.0, 0.0, np.pi / 2, 0.1, 0.4, 1.0, 0.1])
    P[:3, :3] = 1e-12 * np.eye(3)
    z = np.array([[0.0, 0.03, np.pi / 2]])

    def nis(speed: float) -> float:
        seen = Measurement(0.0, z, 1e-4 * np.eye(3)[None])
        found = correct(
            x, P, seen, Drive(speed, 0.1), stamp_variance=0.01**2, gate=1e9, take_ambiguous=True
        )
        return found.nis

    assert nis(0.0) == pytest.approx(9 / 3, rel=1e-3)
    # At (0.4 + 0.1) x 4 m/s along y, 10 ms are 2 cm: the variance is (1^2 + 2^2) cm^2.
    assert nis(4.0) == pytest.approx(9 / 5 / 3, rel=1e-3)


def test_a_lag_worked_out_by_hand() -> None:
    assert lagged(0.1, 0.5, 0.0, 0.01) == (0.5, 0.5)
    value, mean = lagged(0.0, 1.0, 0.1, 0.1)
    assert value == pytest.approx(1 - math.exp(-1))
    assert mean == pytest.approx(math.exp(-1))  # 1 - (1 - e^-1)
    fine = 0.0
    for _ in range(100):  # the same in small steps
        fine, _ = lagged(fine, 1.0, 0.1, 0.001)
    assert fine == pytest.approx(value)


# --- Late pictures ---


def late(log: PlanarLog, latencies: np.ndarray) -> PlanarLog:
    """The same drive, its pictures heard of with other latencies."""
    pictures = {m.stamp: m for m in log.marker_poses if m.valid}
    arrivals = [(t + d, pictures[t]) for (t, d) in zip(sorted(pictures), latencies, strict=False)]
    return dataclasses.replace(log, marker_poses=on_port(arrivals, len(log)))


def shuffled_latencies(n: int) -> np.ndarray:
    # One in three waits for up to 0.4 s and is overtaken by up to five others.
    rng = np.random.default_rng(7)
    return np.where(rng.uniform(size=n) < 1 / 3, rng.uniform(0.1, 0.4, n), rng.uniform(0, 0.05, n))


@pytest.mark.parametrize("seed", range(3))
def test_late_and_overtaken_pictures_give_what_pictures_in_order_give(seed: int) -> None:
    log = drive(arcs(6.0, seed), seed, Truth(latency=(0.0, 0.0)), dark=(5.4, 9.0))
    mixed = late(log, shuffled_latencies(100))
    stamps = [m.stamp for m in mixed.marker_poses if m.valid]
    assert sum(b < a for a, b in pairwise(stamps)) >= 5
    (in_order,), (delayed,) = listen(log, PlanarEkf()), listen(mixed, PlanarEkf())
    assert set(delayed.counts) <= {"accepted", "gated"}
    assert sum(delayed.counts.values()) == sum(in_order.counts.values()) == 81
    np.testing.assert_allclose(delayed.pose[-1], in_order.pose[-1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(delayed.covariance[-1], in_order.covariance[-1], rtol=1e-9)
    # It mattered: until they came, the estimates differed.
    assert np.abs(delayed.pose - in_order.pose)[100:500].max() > 1e-3


def test_the_start_itself_may_be_overtaken() -> None:
    log = drive(arcs(3.0, 4), 4, Truth(latency=(0.0, 0.0)))
    latencies = np.full(45, 0.02)
    latencies[0] = 0.3
    (in_order,), (delayed,) = listen(log, PlanarEkf()), listen(late(log, latencies), PlanarEkf())
    np.testing.assert_allclose(delayed.pose[-1], in_order.pose[-1], rtol=0, atol=1e-12)


def test_it_is_the_filter_that_knows_everything_beforehand() -> None:
    # An independent one: no memory, no ticks, derivatives by automatic differentiation, and all
    # pictures at hand. The last moments are driven evenly, so that nothing has to be guessed.
    command = np.vstack([arcs(2.0, 5), np.tile([0.2, 0.3], (60, 1))])
    truth = Truth(latency=(0.0, 0.0), gyro_noise=0.0, turn_noise=0.0, bias_walk=0.0)
    log = late(drive(command, 5, truth, dark=(2.3, 9.0)), shuffled_latencies(100))
    parameters = PlanarEkfParameters(scale_wander=0.05, scale_wander_time=0.4)
    (found,) = listen(log, PlanarEkf(parameters=parameters))
    pictures = sorted({m.stamp: m for m in log.marker_poses if m.valid}.items())
    wander, wander_time = parameters.scale_wander, parameters.scale_wander_time
    x = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0])
    P = np.diag(
        np.square(
            [0, 0, 0, parameters.gyro_bias_std, parameters.scale_std, parameters.gyro_scale_std,
             wander]
        )
    )  # fmt: skip
    gyro = np.append(log.yaw_rate[2:], [log.yaw_rate[-1]] * 2)
    times = sorted({k * DT for k in range(len(log))} | {stamp for stamp, _ in pictures})
    started = False
    for t, following in pairwise(times):
        k = math.floor(t * RATE + 1e-6)
        v, omega = log.command[k, 0], gyro[k]
        while pictures and pictures[0][0] == t:
            message = pictures.pop(0)[1]
            R = message.covariance[np.ix_([3, 4, 2], [3, 4, 2])]
            X = message.pose
            z = np.array([*X.translation()[:2], math.atan2(*X.rotation().matrix()[[1, 0], 0])])
            heading = x[2] if started else z[2]
            along = (x[4] + x[6]) * v
            rates = np.array(
                [along * np.cos(heading), along * np.sin(heading), x[5] * (omega - x[3])]
            )
            R = R + parameters.stamp_noise**2 * np.outer(rates, rates)
            if not started:
                started, x[:3], P[:3, :3] = True, z, R
                continue
            y = z - x[:3]
            y[2] = wrap(y[2])
            K = P[:, :3] @ np.linalg.inv(P[:3, :3] + R)
            x, P = x + K @ y, P - K @ P[:3]
        if started:
            F, G, x = derivatives(x, v, omega, following - t, 1 / wander_time)
            # The turn of the last two ticks is guessed from one sample: its error counts three
            # times instead of once, with one tick's variance, so 9 - 1 = 8 for the two.
            guess = 4.0 if k >= len(log) - 3 else 1.0
            growth = [
                NOISE.speed + NOISE.slip * abs(v), NOISE.side * abs(omega),
                (NOISE.gyro + NOISE.turn * abs(omega)) * guess,
                NOISE.bias, NOISE.scale, NOISE.gyro_scale,
                wander**2 * (1 - math.exp(-2 * (following - t) / wander_time)) / (following - t),
            ]  # fmt: skip
            P = F @ P @ F.T + G @ np.diag(growth) @ G.T * (following - t)
    x[2] = wrap(x[2])
    np.testing.assert_allclose(found.pose[-1], x[:3], rtol=0, atol=1e-6)
    # The block does the last ticks in one, and slip does not fade within a step.
    np.testing.assert_allclose(found.covariance[-1], P[:3, :3], rtol=1e-3, atol=1e-9)
    ekf = found.block
    assert ekf.gyro_bias(found.context)[0] == pytest.approx(x[3], abs=1e-6)
    assert ekf.wheel_scale(found.context)[0] == pytest.approx(x[4], abs=1e-6)
    assert ekf.gyro_scale(found.context)[0] == pytest.approx(x[5], abs=1e-6)


def test_a_delay_of_the_gyro_is_made_good() -> None:
    truth = Truth(latency=(0.0, 0.03), deviations=(0.0005, 0.001), stamp_noise=0.0, bias=0.0)
    right, wrong = [], []
    for seed in range(3):
        log = drive(arcs(10.0, seed), seed, truth)
        a, b = listen(log, PlanarEkf(), PlanarEkf(parameters=PlanarEkfParameters(gyro_delay=0.03)))
        right.append(rms(a.errors(log)[200:, 2]))
        wrong.append(rms(b.errors(log)[200:, 2]))
    assert np.mean(right) < 0.6 * np.mean(wrong)


def test_a_lag_of_the_motors_is_made_good() -> None:
    truth = Truth(lag=0.1, deviations=(0.001, 0.005))
    for seed in range(3):
        log = drive(arcs(15.0, seed), seed, truth)
        knows, ignores = listen(
            log, PlanarEkf(parameters=PlanarEkfParameters(speed_lag=0.1)), PlanarEkf()
        )
        errors = [rms(r.errors(log)[200:, :2]) for r in (knows, ignores)]
        assert errors[0] < 0.8 * errors[1]
        assert knows.nis.mean() < 1.15 < ignores.nis.mean()


# --- Many drives ---

SEEDS = range(30)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


DARK = 19.9  # s; the last picture, then 0.2 m/s for 5 s
SEEN = slice(20, round(DARK * RATE))


@cache
def driven() -> list[tuple[PlanarLog, Result, Result]]:
    found = []
    for seed in SEEDS:
        command = np.vstack([arcs(20.0, seed), arcs(5.0, seed + 100, speed=0.2)])
        log = drive(command, seed, dark=(DARK, 99.0))
        found.append((log, *listen(log, PlanarEkf(), PlanarKalmanFilter())))
    return found


def test_the_errors_are_as_large_as_it_says() -> None:
    nees = [ours.nees(log)[SEEN].mean() for log, ours, _ in driven()]
    assert 0.8 < np.mean(nees) < 1.25
    nis = [ours.nis.mean() for _, ours, _ in driven()]
    assert 0.8 < np.mean(nis) < 1.25
    # Beyond the 99.9 % gate is a thousandth, if all is right.
    gated = sum(ours.counts.get("gated", 0) for _, ours, _ in driven())
    assert gated < 0.01 * sum(len(ours.nis) for _, ours, _ in driven())


def test_it_errs_at_most_half_as_much_as_the_papers() -> None:
    ours = np.vstack([ours.errors(log)[SEEN] for log, ours, _ in driven()])
    theirs = np.vstack([theirs.errors(log)[SEEN] for log, _, theirs in driven()])
    assert rms(ours[:, :2]) <= 0.5 * rms(theirs[:, :2])
    assert rms(ours[:, 2]) <= 0.5 * rms(theirs[:, 2])


def test_five_seconds_without_a_marker() -> None:
    errors, inside = [], 0
    for log, found, _ in driven():
        e, P = found.errors(log)[-1, :2], found.covariance[-1, :2, :2]
        errors.append(e)
        inside += e @ np.linalg.solve(P, e) <= 5.991  # 95 % of chi-square with 2
        assert P.trace() > 4 * found.covariance[SEEN.stop - 10, :2, :2].trace()
    assert math.sqrt(np.mean(np.sum(np.square(errors), axis=1))) <= 0.10
    assert inside >= 0.9 * len(SEEDS)


def test_bias_and_scales_are_found() -> None:
    for seed in range(5):
        truth = Truth(bias=0.05, scale=1.05, gyro_scale=0.98, bias_walk=0.0, scale_walk=0.0)
        log = drive(arcs(30.0, seed), seed, truth)
        (found,) = listen(log, PlanarEkf())
        for (value, std), true, least in (
            (found.block.gyro_bias(found.context), 0.05, 0.003),
            (found.block.wheel_scale(found.context), 1.05, 0.015),
            (found.block.gyro_scale(found.context), 0.98, 0.008),
        ):
            assert std < least
            assert abs(value - true) < min(3 * std, least)


# --- The block ---


class Rig:
    """The block in a simulator, its inputs fixed at will."""

    def __init__(self, **parameters: Any) -> None:
        self.block = PlanarEkf(parameters=PlanarEkfParameters(**parameters), rate=RATE)
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

    def see(self, pose: Any, **more: Any) -> None:
        """A picture that is taken and heard of at the next tick, then that tick."""
        self.marker(marker(pose, stamp=self.steps * DT, **more))
        self.step()

    @property
    def pose(self) -> np.ndarray:
        return self.block.pose_output_port().Eval(self.context).copy()

    @property
    def covariance(self) -> np.ndarray:
        return self.block.covariance_output_port().Eval(self.context).reshape(3, 3).copy()

    @property
    def nis(self) -> list[float]:
        return self.block.nis_output_port().Eval(self.context).tolist()

    @property
    def counts(self) -> dict[str, int]:
        counts = self.block.health_output_port().Eval(self.context).counts
        assert set(counts) == set(REASONS)
        return {reason: n for reason, n in counts.items() if n}


def marker(
    pose: Any,
    stamp: float,
    deviation: Any = (0.01, 0.01, 0.01),
    ambiguous: bool = False,
    markers: int = 2,
) -> PoseEstimate:
    R = np.diag(np.square(deviation))
    return estimate(pose, R, stamp, ambiguous=ambiguous, markers=markers)


def test_before_the_first_marker_it_knows_nothing() -> None:
    rig = Rig()
    rig.command(v=0.3)
    rig.gyro(0.5)
    rig.step(20)
    np.testing.assert_array_equal(rig.pose, np.zeros(3))
    np.testing.assert_array_equal(rig.covariance, UNKNOWN * np.eye(3))
    assert rig.counts == {}
    assert math.isnan(rig.nis[0])
    assert rig.nis[1] == 0


def test_it_starts_at_the_time_of_the_picture() -> None:
    # 0.1 s after a picture of a robot that drives along y, it is 4 cm further on, and turned.
    rig = Rig()
    rig.command(v=0.4)
    rig.gyro(0.2)
    rig.step(50)
    rig.marker(marker([1.0, 2.0, np.pi / 2], stamp=0.4))
    rig.step()
    np.testing.assert_allclose(rig.pose, [0.9995, 2.044, np.pi / 2 + 0.022], atol=1e-4)
    assert rig.counts == {"accepted": 1}
    assert rig.nis[1] == 0


def test_the_innovation_is_reported_accepted_or_not() -> None:
    rig = Rig(speed_noise=0.0)
    rig.see([0.0, 0.0, 0.0])
    rig.see([0.02, 0.0, 0.0])  # 2 deviations of the difference squared: 4 / 2, by 3
    assert rig.nis == [pytest.approx(2 / 3, rel=1e-3), 1]
    rig.see([0.5, 0.0, 0.0])
    assert rig.nis == [pytest.approx(0.49**2 / 1.5e-4 / 3, rel=1e-2), 2]
    assert rig.counts == {"accepted": 2, "gated": 1}
    rig.step(10)
    assert rig.nis[1] == 2


def test_gates_by_probability_and_by_number_are_the_same() -> None:
    # 0.01 m either side: sqrt(16.27 * 2) * 0.01 m is 0.057 m.
    for gate in (0.999, 16.27):
        for offset, verdict in ((0.055, "accepted"), (0.059, "gated")):
            rig = Rig(gate=gate, speed_noise=0.0)
            rig.see([0.0, 0.0, 0.0])
            rig.see([offset, 0.0, 0.0])
            assert rig.counts == {"accepted": 1} | {verdict: 1 + (verdict == "accepted")}


def test_at_rest_it_stays_where_it_is() -> None:
    rig = Rig(gyro_bias_std=1e-3)
    rig.see([1.0, 2.0, 0.3])
    rig.step(1000)
    np.testing.assert_allclose(rig.pose, [1.0, 2.0, 0.3], atol=1e-12)
    assert np.sqrt(np.diag(rig.covariance)[:2]).max() < 0.02


def test_a_map_that_is_off_is_allowed_for() -> None:
    rig = Rig(measurement_floor=[0.02, 0.03, 0.0])
    rig.see([0.0, 0.0, 0.0])
    expected = np.square([0.01, 0.01]) + np.square([0.02, 0.03])
    np.testing.assert_allclose(np.diag(rig.covariance)[:2], expected, rtol=1e-2)


def test_encoders_take_the_commands_place() -> None:
    rig = Rig(wheel_radius=0.05)
    rig.see([0.0, 0.0, 0.0])
    rig.command(v=0.1)
    rig.block.wheel_speeds_input_port().FixValue(rig.context, [11.0, 9.0])
    rig.step(100)
    assert rig.pose[0] == pytest.approx(0.5, abs=0.002)
    rig.block.wheel_speeds_input_port().FixValue(rig.context, [np.nan, 9.0])
    rig.step(100)
    assert rig.pose[0] == pytest.approx(0.6, abs=0.002)
    assert rig.counts == {"accepted": 1, "bad_wheel_speeds": 100}


# --- Two solutions ---


def test_of_two_solutions_the_one_nearest_to_the_prediction_is_taken() -> None:
    right, wrong = [0.01, 0.0, 0.01], [0.30, 0.2, 0.60]
    for pair in ((right, wrong), (wrong, right)):
        rig = Rig()
        rig.see([0.0, 0.0, 0.0])
        rig.marker(*(marker(pose, stamp=DT, ambiguous=True) for pose in pair))
        rig.step()
        assert rig.counts == {"accepted": 2}
        assert 0.0 < rig.pose[0] < 0.01


def test_two_solutions_are_refused_on_request() -> None:
    rig = Rig(ambiguous="reject")
    rig.see([0.0, 0.0, 0.0])
    rig.see([0.01, 0.0, 0.0], ambiguous=True)
    assert rig.counts == {"accepted": 1, "ambiguous": 1}
    assert rig.pose[0] == 0.0
    assert rig.nis[1] == 0


def test_it_never_starts_nor_restarts_at_one_of_two_solutions() -> None:
    rig = Rig()
    for _ in range(5):
        rig.see([0.0, 0.0, 0.5], ambiguous=True)
    assert rig.counts == {"ambiguous": 5}
    np.testing.assert_array_equal(rig.covariance, UNKNOWN * np.eye(3))
    rig.see([0.0, 0.0, 0.5])
    for _ in range(300):
        rig.see([2.0, 0.0, -0.5], ambiguous=True)
    assert rig.counts == {"ambiguous": 5, "accepted": 1, "gated": 300}


# --- Carried away, or misled ---


def carried(seconds: float, markers: int, **parameters: Any) -> tuple[Rig, float | None]:
    """A robot that drives and is put elsewhere after 2 s; when it has found itself again."""
    rig = Rig(gyro_bias_std=0.02, **parameters)
    rig.command(v=0.2)
    rig.gyro(0.3)
    turn = np.random.default_rng(3)
    found = None
    for k in range(round((2 + seconds) * 10)):
        t = k / 10
        theta = 0.3 * t
        pose = np.array([np.sin(theta) / 1.5, (1 - np.cos(theta)) / 1.5, theta])
        if t >= 2:  # mirrored about, and away
            pose = np.array([3.0 - pose[0], 1.0 - pose[1], wrap(theta + np.pi)])
        rig.see(pose + turn.normal(0, 0.01, 3), markers=markers)
        rig.step(9)
        if t >= 2 and np.hypot(*(rig.pose[:2] - pose[:2])) < 0.1:
            found = found or t - 2
    return rig, found


def test_a_robot_that_is_carried_away_finds_itself_again() -> None:
    rig, found = carried(4.0, markers=3)
    assert found is not None
    assert 0.9 <= found <= 1.3
    assert rig.counts["restarted"] == 1
    assert rig.counts["gated"] == pytest.approx(10 * found + 1, abs=1.1)
    assert rig.counts["accepted"] > 40


def test_by_single_markers_it_takes_longer() -> None:
    rig, found = carried(8.0, markers=1, recovery_time_single=5.0)
    assert found == pytest.approx(5.0, abs=0.3)
    rig, found = carried(8.0, markers=1, recovery_time_single=math.inf)
    assert found is None
    assert "restarted" not in rig.counts


def test_a_wrong_start_is_given_up() -> None:
    rig = Rig()
    rig.see([5.0, 5.0, 1.0])
    for _ in range(30):
        rig.see([0.0, 0.0, 0.0])
        rig.step(5)
    np.testing.assert_allclose(rig.pose, np.zeros(3), atol=0.01)
    assert rig.counts["restarted"] == 1


def test_one_marker_moved_by_half_a_metre_does_not_take_it_away() -> None:
    # It drives along x, and for 8 s has but that marker in view, then others.
    rig = Rig(gyro_bias_std=0.01)
    rig.command(v=0.2)
    noise = np.random.default_rng(1)
    worst = 0.0
    for k in range(150):
        t = k / 10
        shift = np.array([0.0, 0.5, 0.0]) if 3 <= t < 11 else np.zeros(3)
        z = np.array([0.2 * t, 0.0, 0.0]) + shift + noise.normal(0, 0.01, 3)
        rig.see(z, markers=1)
        worst = max(worst, float(np.hypot(rig.pose[0] - 0.2 * t, rig.pose[1])))
        rig.step(9)
    assert rig.counts == {"accepted": 70, "gated": 80}
    assert worst < 0.06


def test_a_picture_that_is_frozen_while_the_robot_drives_does_not_either() -> None:
    rig = Rig(gyro_bias_std=0.01)
    rig.command(v=0.2)
    for k in range(30):
        rig.see([0.02 * k, 0.0, 0.0], markers=4)
        rig.step(9)
    for _ in range(100):  # fresh stamps on one old picture
        rig.see([0.58, 0.0, 0.0], markers=4)
        rig.step(9)
    assert "restarted" not in rig.counts
    assert rig.pose[0] > 2.4
    assert rig.counts["gated"] > 90


def test_refused_poses_that_do_not_agree_change_nothing() -> None:
    rig = Rig(gyro_bias_std=1e-3)
    rig.see([0.0, 0.0, 0.0])
    rng = np.random.default_rng(0)
    for _ in range(300):
        rig.see(rng.uniform(1, 3, 3), markers=4)
        rig.step(2)
    assert rig.counts == {"accepted": 1, "gated": 300}
    np.testing.assert_allclose(rig.pose, np.zeros(3), atol=1e-12)


# --- Bad samples ---


def test_stamps_that_cannot_be() -> None:
    rig = Rig()
    rig.see([0.0, 0.0, 0.0])
    rig.step(99)
    before = rig.covariance
    for stamp, reason in ((2.0, "future"), (0.3, "stale"), (-1.0, "stale"), (math.inf, "future")):
        rig.marker(marker([0.01, 0.0, 0.0], stamp=stamp))
        n = rig.counts.get(reason, 0)
        rig.step(3)
        assert rig.counts[reason] == n + 1  # once for each stamp
    assert rig.counts == {"accepted": 1, "future": 2, "stale": 2}
    assert np.trace(rig.covariance) > np.trace(before)
    assert rig.pose[0] == 0.0
    # One that has been seen before comes back after another.
    for stamp in (1.00, 1.05, 1.00):
        rig.marker(marker([0.0, 0.0, 0.0], stamp=stamp))
        rig.step()
    assert rig.counts == {"accepted": 3, "future": 2, "stale": 2, "repeated": 1}


def test_a_frozen_camera_is_used_once() -> None:
    rig = Rig()
    rig.command(v=0.2)
    rig.see([0.0, 0.0, 0.0])
    rig.step(300)
    assert rig.counts == {"accepted": 1}
    assert rig.pose[0] == pytest.approx(0.602, abs=1e-3)
    assert rig.covariance[0, 0] > 0.05**2


def with_covariance(R: np.ndarray) -> PoseEstimate:
    return estimate([0.0, 0.0, 0.0], R, 0.005)


@pytest.mark.parametrize(
    "bad",
    [
        PoseEstimate(stamp=0.005),
        PoseEstimate(stamp=0.005, covariance=np.zeros((6, 6))),
        PoseEstimate(
            stamp=0.005, pose=RigidTransform([np.nan, 0.0, 0.0]), covariance=0.01 * np.eye(6)
        ),
        PoseEstimate(
            stamp=0.005, pose=RigidTransform([0.0, np.inf, 0.0]), covariance=0.01 * np.eye(6)
        ),
        with_covariance(np.diag([0.01, np.inf, 0.01])),
        with_covariance(np.diag([0.01, -0.01, 0.01])),
    ],
    ids=["no covariance", "zeros", "nan place", "inf place", "inf covariance", "negative"],
)
@pytest.mark.parametrize("started", [False, True])
def test_a_bad_marker_pose_is_dropped_and_counted(bad: PoseEstimate, started: bool) -> None:
    rig = Rig()
    if started:
        rig.see([1.0, 2.0, 0.5])
    else:
        rig.step()
    before = rig.pose
    rig.marker(bad)
    rig.step(3)
    assert rig.counts == {"bad_marker_pose": 1} | ({"accepted": 1} if started else {})
    np.testing.assert_allclose(rig.pose, before, atol=1e-12)
    assert np.isfinite(rig.covariance).all()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e6])
def test_a_gyro_that_fails_is_bridged_by_the_command(value: float) -> None:
    rig = Rig(gyro_delay=0.0)
    rig.see([0.0, 0.0, 0.0])
    rig.command(v=0.0, omega=0.5)
    rig.gyro(0.5)
    rig.step(100)
    sure = rig.covariance[2, 2]
    rig.gyro(value)
    rig.step(100)
    assert rig.counts == {"accepted": 1, "bad_imu": 100}
    assert rig.pose[2] == pytest.approx(1.0, abs=0.02)
    assert rig.covariance[2, 2] > sure + 0.9 * 0.3**2
    # What is not used may be what it likes.
    rig.gyro(0.5, other=math.nan)
    rig.step(10)
    assert rig.counts == {"accepted": 1, "bad_imu": 100}


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_bad_command_is_a_stop_that_nobody_is_sure_of(value: float) -> None:
    rig = Rig(scale_std=1e-3)
    rig.see([0.0, 0.0, 0.0])
    rig.command(v=0.3)
    rig.step(100)
    sure, x = rig.covariance[0, 0], rig.pose[0]
    rig.command(v=value)
    rig.step(100)
    assert rig.counts == {"accepted": 1, "bad_command": 100}
    assert rig.pose[0] == pytest.approx(x, abs=1e-9)
    assert rig.covariance[0, 0] == pytest.approx(sure + 0.1**2, rel=0.02)


def test_a_simulation_that_begins_late_works() -> None:
    rig = Rig()
    rig.context.SetTime(100.0)
    rig.simulator.Initialize()
    rig.marker(marker([1.0, 0.0, 0.0], stamp=99.95))
    rig.simulator.AdvanceTo(100.005)
    assert rig.counts == {"stale": 1}
    rig.marker(marker([1.0, 0.0, 0.0], stamp=100.004))
    rig.simulator.AdvanceTo(100.1)
    assert rig.counts == {"stale": 1, "accepted": 1}
    np.testing.assert_allclose(rig.pose, [1.0, 0.0, 0.0], atol=1e-9)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("speed_noise", -1.0),
        ("scale_std", 0.0),
        ("scale_wander", -0.1),
        ("scale_wander_time", 0.0),
        ("gyro_noise", math.nan),
        ("speed_lag", -0.1),
        ("gate", 0.0),
        ("measurement_floor", [0.1, 0.1]),
        ("measurement_floor", [0.1, 0.1, -0.1]),
        ("ambiguous", "guess"),
        ("horizon", 0.0),
        ("gyro_delay", 0.6),
        ("recovery_time", 0.0),
        ("recovery_time_single", math.nan),
    ],
)
def test_nonsense_is_refused(field: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{field} is .*: must be "):
        PlanarEkfParameters(**{field: value})


def test_a_rate_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match=r"rate is 0\.0: must be greater than 0"):
        PlanarEkf(rate=0.0)


def test_what_the_gyro_has_not_told_of_yet_widens_the_heading_until_it_has() -> None:
    log = drive(arcs(5.0, 3), 3)
    parameters = [PlanarEkfParameters(gyro_delay=0.02, yaw_rate_change=c) for c in (0.0, 0.3)]
    still, jerky = listen(log, *(PlanarEkf(parameters=p) for p in parameters))
    # Three ticks of 10 ms: the delay's two and the one that is foretold.
    more = jerky.covariance[-100:, 2, 2] - still.covariance[-100:, 2, 2]
    np.testing.assert_allclose(more, 3 * (0.3 * 0.01) ** 2, rtol=0.1)
    # What has been heard of leaves nothing behind.
    np.testing.assert_allclose(jerky.pose[-100:], still.pose[-100:], atol=1e-3)
