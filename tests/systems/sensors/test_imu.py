from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import SpatialInertia, UnitInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from scipy.signal import periodogram

from plants.body_state import BodyState
from systems.noise import generator, stream_key
from systems.sensors.imu import Imu, ideal_sample, piece_errors
from systems.sensors.imu_parameters import (
    GRAVITY,
    Bmi088Parameters,
    ImuParameters,
    Mpu6050Parameters,
)

# --- What a perfect sensor measures ---


def test_at_rest_it_reads_g_upward() -> None:
    still = np.zeros(6)
    for rpy, expected in (
        ([0.0, 0.0, 0.7], [0.0, 0.0, GRAVITY]),
        ([np.pi / 2, 0.0, 0.0], [0.0, GRAVITY, 0.0]),  # its y axis points up
        ([0.0, np.pi / 2, 0.0], [-GRAVITY, 0.0, 0.0]),
        ([np.pi, 0.0, 0.0], [0.0, 0.0, -GRAVITY]),
    ):
        X_WB = RigidTransform(RollPitchYaw(rpy), [1.0, 2.0, 3.0])
        sample = ideal_sample(X_WB, still, still, np.array([0.1, 0.2, 0.3]))
        np.testing.assert_allclose(sample, [0.0, 0.0, 0.0, *expected], atol=1e-12)


def test_on_a_turntable_an_offset_feels_the_centripetal_acceleration() -> None:
    omega, alpha, r = 3.0, 0.5, 0.2
    for theta in (0.0, 1.0, 2.5):
        sample = ideal_sample(
            RigidTransform(RollPitchYaw(0, 0, theta), np.zeros(3)),
            np.array([0.0, 0.0, omega, 0.0, 0.0, 0.0]),
            np.array([0.0, 0.0, alpha, 0.0, 0.0, 0.0]),
            np.array([r, 0.0, 0.1]),
        )
        expected = [0.0, 0.0, omega, -(omega**2) * r, alpha * r, GRAVITY]
        np.testing.assert_allclose(sample, expected, atol=1e-12)


def test_the_accelerometer_feels_the_second_derivative_of_its_own_path() -> None:
    # A body that tumbles about a fixed axis at a changing rate while it flies along a curve.
    axis = np.array([1.0, -2.0, 0.5]) / np.linalg.norm([1.0, -2.0, 0.5])
    p_BS = np.array([0.3, -0.1, 0.2])

    def angle(t: float) -> float:
        return 0.4 + 1.5 * t + 0.8 * t**2

    def place(t: float) -> np.ndarray:
        return np.array([np.sin(2 * t), t**3, 0.5 * np.cos(3 * t)])

    def body(t: float) -> RigidTransform:
        a = angle(t)
        W = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        R = np.eye(3) + np.sin(a) * W + (1 - np.cos(a)) * W @ W
        return RigidTransform(RotationMatrix(R), place(t))

    t, h = 0.6, 1e-4
    sensor = [body(t + k * h).multiply(p_BS) for k in (-1, 0, 1)]
    acceleration = (sensor[0] - 2 * sensor[1] + sensor[2]) / h**2
    V = np.concatenate(
        [axis * (1.5 + 1.6 * t), [2 * np.cos(2 * t), 3 * t**2, -1.5 * np.sin(3 * t)]]
    )
    A = np.concatenate([axis * 1.6, [-4 * np.sin(2 * t), 6 * t, -4.5 * np.cos(3 * t)]])
    R_BW = body(t).rotation().matrix().T
    expected = [*(R_BW @ V[:3]), *(R_BW @ (acceleration + np.array([0.0, 0.0, GRAVITY])))]
    np.testing.assert_allclose(ideal_sample(body(t), V, A, p_BS), expected, atol=1e-5)


# --- The block ---


def samples(n: int, **arguments: Any) -> np.ndarray:
    """(n, 6) successive samples at rest."""
    imu = Imu(**arguments)
    simulator = Simulator(imu)
    context = simulator.get_mutable_context()
    imu.pose_input_port().FixValue(context, RigidTransform())
    imu.spatial_velocity_input_port().FixValue(context, np.zeros(6))
    imu.spatial_acceleration_input_port().FixValue(context, np.zeros(6))
    rate = arguments.get("rate", 100.0)
    rows = []
    for k in range(n):
        simulator.AdvanceTo((k + 0.5) / rate)
        rows.append(imu.sample_output_port().Eval(context).copy())
    return np.array(rows)


NOISY = ImuParameters(
    gyro_noise_density=0.002,
    gyro_bias=[0.1, -0.2, 0.3],
    accel_noise_density=0.03,
    accel_bias=[1.0, -2.0, 3.0],
)


@pytest.mark.parametrize("rate", [50.0, 400.0])
def test_noise_is_white_of_the_density_and_about_the_bias(rate: float) -> None:
    n = 2000
    found = samples(n, parameters=NOISY, rate=rate)
    mean = np.array([0.1, -0.2, 0.3, 1.0, -2.0, 3.0 + GRAVITY])
    deviation = np.repeat([0.002, 0.03], 3) * np.sqrt(rate)
    white = (found - mean) / deviation
    assert np.abs(white.mean(axis=0)).max() < 5 / np.sqrt(n)
    np.testing.assert_allclose(white.std(axis=0), 1.0, atol=5 / np.sqrt(2 * n))
    assert np.abs(np.corrcoef(white.T) - np.eye(6)).max() < 5 / np.sqrt(n)
    assert np.abs((white[1:] * white[:-1]).mean(axis=0)).max() < 5 / np.sqrt(n)


def test_without_noise_it_is_exact() -> None:
    expected = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, GRAVITY], (3, 1))
    np.testing.assert_array_equal(samples(3), expected)


def test_a_seed_repeats_the_noise_and_a_name_makes_it_its_own() -> None:
    first = samples(5, parameters=NOISY, seed=3, name="imu")
    np.testing.assert_array_equal(samples(5, parameters=NOISY, seed=3, name="imu"), first)
    for other in ({"seed": 4, "name": "imu"}, {"seed": 3, "name": "other"}):
        assert not np.isin(samples(5, parameters=NOISY, **other), first).any()


def test_a_sample_is_held_until_the_next() -> None:
    imu = Imu(rate=10.0)
    simulator = Simulator(imu)
    context = simulator.get_mutable_context()
    imu.pose_input_port().FixValue(context, RigidTransform())
    imu.spatial_acceleration_input_port().FixValue(context, np.zeros(6))
    found = []
    np.testing.assert_array_equal(imu.sample_output_port().Eval(context), np.zeros(6))
    for t in (0.01, 0.05, 0.09, 0.11, 0.15, 0.21):
        imu.spatial_velocity_input_port().FixValue(context, [0, 0, t, 0, 0, 0])
        simulator.AdvanceTo(t)
        found.append(imu.sample_output_port().Eval(context)[2])
    assert found == [0.01, 0.01, 0.01, 0.11, 0.11, 0.21]


def test_in_free_fall_it_feels_nothing_but_its_own_spin() -> None:
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.001)
    model = plant.AddModelInstance("stone")
    inertia = SpatialInertia(2.0, np.zeros(3), UnitInertia.SolidSphere(0.1))
    body = plant.AddRigidBody("stone", model, inertia)
    plant.Finalize()
    p_BS = np.array([0.1, 0.0, 0.05])
    state = BodyState.AddToBuilder(builder, plant, model)
    imus = [builder.AddSystem(Imu(rate=50.0, p_BS=p)) for p in (np.zeros(3), p_BS)]
    for imu in imus:
        for name in ("pose", "spatial_velocity", "spatial_acceleration"):
            builder.Connect(state.GetOutputPort(name), imu.GetInputPort(name))
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    own = plant.GetMyMutableContextFromRoot(context)
    plant.SetFreeBodyPose(own, body, RigidTransform(RollPitchYaw(0.3, 0.2, 0.1), [0, 0, 100.0]))
    w = np.array([0.0, 0.0, 4.0])
    R_WB = plant.EvalBodyPoseInWorld(own, body).rotation().matrix()
    velocity = np.concatenate([R_WB @ w, [1.0, 2.0, 3.0]])
    plant.SetVelocities(own, model, velocity)
    simulator.AdvanceTo(1.01)
    middle, edge = (
        imu.sample_output_port().Eval(imu.GetMyContextFromRoot(context)) for imu in imus
    )
    np.testing.assert_allclose(middle, [*w, 0.0, 0.0, 0.0], atol=1e-3)
    expected = np.cross(w, np.cross(w, p_BS))
    np.testing.assert_allclose(edge, [*w, *expected], atol=1e-2)


# --- Errors of real ones ---


def turning(parameters: ImuParameters, rates: Any, *, seed: int = 0, n: int = 3) -> np.ndarray:
    """(n, 6) samples of a sensor that turns at constant rates (3,) (rad/s)."""
    imu = Imu(parameters=parameters, seed=seed)
    simulator = Simulator(imu)
    context = simulator.get_mutable_context()
    imu.pose_input_port().FixValue(context, RigidTransform())
    imu.spatial_velocity_input_port().FixValue(context, [*rates, 0.0, 0.0, 0.0])
    imu.spatial_acceleration_input_port().FixValue(context, np.zeros(6))
    rows = []
    for k in range(n):
        simulator.AdvanceTo((k + 0.5) / 100.0)
        rows.append(imu.sample_output_port().Eval(context).copy())
    return np.array(rows)


def test_the_mpu6050_counts_as_its_sheet_says() -> None:
    p = Mpu6050Parameters()
    assert 2**15 / math.degrees(p.gyro_range or 0) == pytest.approx(131, abs=0.1)  # LSB/(deg/s)
    assert 2**15 / ((p.accel_range or 0) / GRAVITY) == 16384  # LSB/g
    # 0.05 deg/s rms at a bandwidth of 100 Hz, by the same sheet.
    assert math.degrees(p.gyro_noise_density) * math.sqrt(100.0) == pytest.approx(0.05)
    assert p.accel_noise_density == pytest.approx(400e-6 * 9.81)
    assert [round(math.degrees(b), 6) for b in p.gyro_bias_tolerance] == [20.0] * 3
    assert [b / GRAVITY for b in p.accel_bias_tolerance] == pytest.approx([0.05, 0.05, 0.08])


DIGITAL = ImuParameters(gyro_range=math.radians(250.0), accel_range=2 * GRAVITY, bits=16)


def test_it_tells_whole_steps() -> None:
    step = math.radians(250.0) / 32768
    found = turning(DIGITAL, [0.4 * step, 0.6 * step, math.radians(1.0)])[-1]
    np.testing.assert_allclose(found[:3] / step, [0, 1, 131], atol=1e-9)
    assert found[5] == GRAVITY  # 16384 of them
    # Noise is rounded too.
    noisy = dataclasses.replace(DIGITAL, gyro_noise_density=0.01, accel_noise_density=0.1)
    for row in turning(noisy, np.zeros(3), n=20):
        counts = row / np.repeat([step, 2 * GRAVITY / 32768], 3)
        np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)
        assert np.abs(counts[:3]).max() > 1


def test_it_saturates() -> None:
    step = math.radians(250.0) / 32768
    found = turning(DIGITAL, np.radians([251.0, -400.0, 249.0]))[-1]
    # Two's complement: one step less upward.
    np.testing.assert_allclose(found[:2] / step, [32767, -32768])
    assert math.degrees(found[2]) == pytest.approx(249.0, abs=0.01)
    # Without steps it ends at the range itself; a bias counts against it.
    smooth = ImuParameters(gyro_range=2.0, gyro_bias=[0.5, 0.0, 0.0])
    found = turning(smooth, [1.9, 5.0, 1.9])[-1]
    np.testing.assert_allclose(found, [2.0, 2.0, 1.9, 0.0, 0.0, GRAVITY], atol=1e-12)


def test_a_piece_has_errors_of_its_own_within_the_tolerances() -> None:
    p = Mpu6050Parameters()
    pieces = [piece_errors(p, np.random.default_rng(seed)) for seed in range(400)]
    bias = np.array([b for _, b in pieces]) / [*p.gyro_bias_tolerance, *p.accel_bias_tolerance]
    scale = np.array([np.diag(m) - 1 for m, _ in pieces]) / 0.03
    for errors in (bias, scale):
        assert np.abs(errors).max() <= 1.0
        # Uniform: a third of the square of the tolerance.
        np.testing.assert_allclose(errors.mean(axis=0), 0.0, atol=5 / np.sqrt(3 * 400))
        np.testing.assert_allclose((errors**2).mean(axis=0), 1 / 3, atol=0.08)
        assert np.abs(np.corrcoef(errors.T) - np.eye(6)).max() < 5 / np.sqrt(400)
    matrices = np.array([m for m, _ in pieces])
    assert np.abs(matrices[:, :3, 3:]).max() == 0  # an accelerometer is no gyro
    assert 0.019 < np.abs(matrices[:, :3, :3] - np.eye(3) * matrices[:, :3, :3]).max() <= 0.02


def test_scale_and_cross_axis_errors_multiply_what_is_true() -> None:
    p = ImuParameters(gyro_scale_tolerance=0.03, accel_scale_tolerance=0.1)
    one, two = (turning(p, [0.0, 0.0, w])[-1] for w in (1.0, 2.0))
    assert one[2] != 1.0
    assert abs(one[2] - 1.0) <= 0.03
    np.testing.assert_allclose(two[:3], 2 * one[:3])
    assert one[5] == two[5] != GRAVITY
    np.testing.assert_array_equal(one[[0, 1, 3, 4]], 0.0)
    crossed = turning(ImuParameters(cross_axis_tolerance=0.02), [0.0, 0.0, 1.0])[-1]
    assert crossed[2] == 1.0
    assert 0 < np.abs(crossed[:2]).max() <= 0.02


def test_the_errors_of_a_piece_stay_and_the_seed_chooses_the_piece() -> None:
    p = ImuParameters(
        gyro_bias=[0.0, 0.0, 1.0],
        gyro_bias_tolerance=[0.1, 0.0, 0.1],
        accel_bias_tolerance=[0.0, 0.5, 0.0],
    )
    rows = turning(p, np.zeros(3), seed=5, n=5)
    np.testing.assert_array_equal(rows, np.tile(rows[0], (5, 1)))
    assert 0 < abs(rows[0, 0]) <= 0.1
    assert rows[0, 1] == 0
    assert 0 < abs(rows[0, 2] - 1.0) <= 0.1
    assert 0 < abs(rows[0, 4]) <= 0.5
    np.testing.assert_array_equal(turning(p, np.zeros(3), seed=5), rows[:3])
    assert (turning(p, np.zeros(3), seed=6)[0] != rows[0]).sum() == 3


def test_the_seed_in_the_context_is_the_one_that_counts() -> None:
    imu = Imu(parameters=Mpu6050Parameters(), seed=5)
    simulator = Simulator(imu)
    context = simulator.get_mutable_context()
    imu.pose_input_port().FixValue(context, RigidTransform())
    for port in (imu.spatial_velocity_input_port(), imu.spatial_acceleration_input_port()):
        port.FixValue(context, np.zeros(6))
    context.get_mutable_numeric_parameter(0).SetFromVector([6.0])
    simulator.AdvanceTo(0.005)
    found = imu.sample_output_port().Eval(context)
    np.testing.assert_array_equal(found, turning(Mpu6050Parameters(), np.zeros(3), seed=6)[0])


def allan_variance(rows: np.ndarray, cluster: int) -> np.ndarray:
    """Overlapping Allan variance of each column, of means over `cluster` samples (IEEE 952)."""
    total = np.vstack([np.zeros(rows.shape[1]), rows.cumsum(axis=0)])
    means = (total[cluster:] - total[:-cluster]) / cluster
    return ((means[cluster:] - means[:-cluster]) ** 2).mean(axis=0) / 2


def test_the_allan_deviation_shows_noise_and_drift() -> None:
    rate, T = 20.0, 2.0
    p = ImuParameters(
        gyro_noise_density=0.002,
        gyro_drift=0.004,
        gyro_drift_time=T,
        accel_noise_density=0.03,
        accel_drift=0.05,
        accel_drift_time=T,
    )
    rows = samples(30_000, parameters=p, rate=rate)
    noise, drift = np.repeat([0.002, 0.03], 3), np.repeat([0.004, 0.05], 3)
    np.testing.assert_allclose(rows.mean(axis=0)[:5], 0.0, atol=0.01)
    for cluster in (1, 4, 20, 40, 80, 200):
        tau = cluster / rate
        # IEEE 952, C.1.1.7: exponentially correlated noise; and white noise N^2 / tau.
        x = tau / T
        correlated = 2 * drift**2 / x * (1 - (3 - 4 * np.exp(-x) + np.exp(-2 * x)) / (2 * x))
        expected = noise**2 / tau + correlated
        found = allan_variance(rows, cluster)
        # Each column is a series of its own. n clusters tell a variance to sqrt(2 / n) of it.
        spread = 4 * np.sqrt(2 * cluster / len(rows))
        np.testing.assert_allclose(found, expected, rtol=spread)
        for kind in (slice(0, 3), slice(3, 6)):
            ratio = (found[kind] / expected[kind]).mean()
            assert ratio == pytest.approx(1.0, abs=spread / np.sqrt(3)), tau
    # Neither alone would do.
    tau = 40 / rate
    assert (allan_variance(rows, 40) > 2 * noise**2 / tau).all()
    assert (allan_variance(rows, 1) > 5 * 2 / 3 * drift**2 / (T * rate)).all()


@pytest.mark.parametrize("rate", [5.0, 50.0])
def test_the_drift_wanders_alike_at_any_rate(rate: float) -> None:
    p = ImuParameters(gyro_drift=0.1, gyro_drift_time=0.5, accel_drift=0.1, accel_drift_time=0.5)
    # Stationary from the first sample on: over 300 seeds, then along one run.
    first = np.array([samples(1, parameters=p, rate=rate, seed=s)[0] for s in range(150)])
    first[:, 5] -= GRAVITY
    assert (first**2).mean() == pytest.approx(0.01, rel=5 * np.sqrt(2 / 900))
    rows = samples(int(400 * rate), parameters=p, rate=rate)
    rows[:, 5] -= GRAVITY
    assert (rows**2).mean() == pytest.approx(0.01, rel=0.15)
    lag = round(0.4 * rate)
    found = (rows[lag:] * rows[:-lag]).mean() / (rows**2).mean()
    assert found == pytest.approx(math.exp(-0.8), abs=0.08)


def test_it_does_not_matter_how_often_it_is_looked_at() -> None:
    p = Mpu6050Parameters()
    once = samples(30, parameters=p, seed=2)
    imu = Imu(parameters=p, seed=2)
    simulator = Simulator(imu)
    context = simulator.get_mutable_context()
    imu.pose_input_port().FixValue(context, RigidTransform())
    for port in (imu.spatial_velocity_input_port(), imu.spatial_acceleration_input_port()):
        port.FixValue(context, np.zeros(6))
    simulator.AdvanceTo(0.103)
    saved = context.Clone()
    for _ in range(2):  # once, and once more from the same moment
        simulator.get_mutable_context().SetTimeStateAndParametersFrom(saved)
        simulator.reset_context(simulator.get_mutable_context().Clone())
        simulator.AdvanceTo(0.295)
        found = imu.sample_output_port().Eval(simulator.get_context())
        np.testing.assert_array_equal(found, once[29])


def test_the_bmi088_counts_as_its_sheet_says() -> None:
    p = Bmi088Parameters()
    assert 2**15 / math.degrees(p.gyro_range or 0) == pytest.approx(262.144)  # LSB/(deg/s)
    assert 2**15 / ((p.accel_range or 0) / GRAVITY) == 16384  # LSB/g, were there such a range
    # 0.1 deg/s rms at a bandwidth of 47 Hz, by the same sheet.
    assert math.degrees(p.gyro_noise_density) * math.sqrt(47.0) == pytest.approx(0.1, abs=0.005)
    assert p.accel_noise_density == pytest.approx(190e-6 * 9.81)
    assert [round(math.degrees(b), 6) for b in p.gyro_bias_tolerance] == [1.0] * 3
    assert [b / GRAVITY for b in p.accel_bias_tolerance] == pytest.approx([0.02] * 3)
    # The shaking is one motion: half a micrometre at 100 Hz, over 20 mm.
    speed = 0.5e-6 * 2 * math.pi * p.vibration_frequency
    assert p.accel_vibration == pytest.approx(
        [speed * 2 * math.pi * p.vibration_frequency] * 3, rel=0.02
    )
    assert p.gyro_vibration == pytest.approx([speed / 0.020] * 3, rel=0.02)
    # At rest at 300 Hz it shows all of that, in whole steps and about its offsets.
    rows = samples(900, parameters=p, rate=300.0, seed=4)
    gyro = math.hypot(p.gyro_vibration[0], p.gyro_noise_density * math.sqrt(300.0))
    accel = math.hypot(p.accel_vibration[0], p.accel_noise_density * math.sqrt(300.0))
    np.testing.assert_allclose(rows.std(axis=0), np.repeat([gyro, accel], 3), rtol=0.3)
    steps = rows / np.repeat([math.radians(125.0), 2 * GRAVITY], 3) * 2**15
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)
    offset = rows.mean(axis=0) - [0, 0, 0, 0, 0, GRAVITY]
    assert (np.abs(offset[:3]) < math.radians(1.05)).all()
    assert (np.abs(offset[3:]) < 0.035 * GRAVITY).all()  # 1 % across the axes beside 20 mg


SHAKEN = ImuParameters(
    vibration_frequency=30.0,
    vibration_bandwidth=4.0,
    gyro_vibration=[0.1, 0.2, 0.0],
    accel_vibration=[0.0, 1.0, 2.0],
)
SHAKE = np.array([0.1, 0.2, 0.0, 0.0, 1.0, 2.0])


def test_the_vibration_has_its_strength_on_each_axis_from_the_first_sample_on() -> None:
    first = np.array([samples(1, parameters=SHAKEN, seed=s)[0] for s in range(200)])
    rows = samples(6000, parameters=SHAKEN)
    for found, number in ((first, 200), (rows, 6000 / 100 * math.pi * 4.0)):
        found = found - [0, 0, 0, 0, 0, GRAVITY]
        assert (found[:, [2, 3]] == 0).all()
        power = (found**2).mean(axis=0)[SHAKE > 0] / SHAKE[SHAKE > 0] ** 2
        # So many independent draws tell a variance to sqrt(2 / number) of it.
        np.testing.assert_allclose(power, 1.0, atol=4 * math.sqrt(2 / number))
    shaking = rows[:, SHAKE > 0]
    assert np.abs(np.corrcoef(shaking.T) - np.eye(4)).max() < 0.35  # each axis by itself


@pytest.mark.parametrize(
    ("rate", "shown"),
    [(300.0, 30.0), (100.0, 30.0), (40.0, 10.0), (33.0, 3.0)],  # the last two are folded down
)
def test_the_vibration_lies_in_its_band_at_any_rate(rate: float, shown: float) -> None:
    p = dataclasses.replace(SHAKEN, vibration_bandwidth=0.5)
    n = int(100 * rate)
    rows = (samples(n, parameters=p, rate=rate, seed=2) - [0, 0, 0, 0, 0, GRAVITY])[:, SHAKE > 0]
    rows = rows / SHAKE[SHAKE > 0]
    # Correlation of a band of the Cauchy shape about the middle, by its Fourier transform.
    for lag in range(1, 8):
        tau = lag / rate
        expected = math.exp(-math.pi * 0.5 * tau) * math.cos(2 * math.pi * 30.0 * tau)
        found = (rows[lag:] * rows[:-lag]).mean() / (rows**2).mean()
        assert found == pytest.approx(expected, abs=0.05)
    # Half of the power lies between the points of half power; it peaks at the middle.
    frequency, density = periodogram(rows, fs=rate, axis=0)
    power = density.sum(axis=1)
    within = np.abs(frequency - shown) <= 0.25
    assert power[within].sum() / power.sum() == pytest.approx(0.5, abs=0.1)
    assert abs(frequency[power.argmax()] - shown) < 0.5


def test_without_a_bandwidth_the_vibration_is_a_pure_tone() -> None:
    p = dataclasses.replace(SHAKEN, vibration_bandwidth=0.0)
    rows = samples(50, parameters=p) - [0, 0, 0, 0, 0, GRAVITY]
    double = 2 * math.cos(2 * math.pi * 30.0 / 100.0)
    np.testing.assert_allclose(rows[2:] + rows[:-2], double * rows[1:-1], atol=1e-12)
    assert np.abs(rows[:, SHAKE > 0]).max(axis=0).min() > 0.01


def test_the_vibration_is_motion_which_the_sensor_distorts_and_cuts_off() -> None:
    rows = samples(200, parameters=SHAKEN)
    wrong = dataclasses.replace(SHAKEN, accel_scale_tolerance=0.1)
    scaled = samples(200, parameters=wrong)
    gain = scaled[:, 4] / rows[:, 4]
    np.testing.assert_allclose(gain, gain[0])
    assert 0 < abs(gain[0] - 1) <= 0.1
    cut = samples(200, parameters=dataclasses.replace(SHAKEN, accel_range=GRAVITY + 0.5))
    np.testing.assert_allclose(cut, np.clip(rows, -GRAVITY - 0.5, GRAVITY + 0.5))
    assert (cut[:, 5] == GRAVITY + 0.5).any()


def test_a_sensor_that_does_not_vibrate_draws_what_it_always_drew() -> None:
    found = samples(3, parameters=ImuParameters(gyro_noise_density=0.1), seed=8, name="it")
    drawn = generator(stream_key(8, "it"), 0).standard_normal((64, 6))[:3, :3]
    np.testing.assert_allclose(found[:, :3], 0.1 * 10.0 * drawn, atol=1e-15)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("gyro_noise_density", -1.0),
        ("gyro_drift", -1.0),
        ("accel_drift_time", 0.0),
        ("accel_scale_tolerance", math.inf),
        ("gyro_range", 0.0),
        ("accel_bias_tolerance", [0.1, -0.1, 0.1]),
        ("gyro_bias_tolerance", [0.1]),
        ("cross_axis_tolerance", -0.1),
        ("bits", 33),
        ("bits", 16),  # of what range?
        ("accel_noise_density", math.nan),
        ("gyro_bias", [0.0, 0.0]),
        ("accel_bias", [0.0, math.inf, 0.0]),
        ("gyro_vibration", [0.1, -0.1, 0.1]),
        ("accel_vibration", [0.1, math.nan, 0.1]),
        ("accel_vibration", [0.1]),
        ("vibration_frequency", -1.0),
        ("vibration_bandwidth", math.inf),
    ],
)
def test_nonsense_is_refused(field: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{field} is .*: must be "):
        ImuParameters(**{field: value})


@pytest.mark.parametrize(
    ("field", "value"),
    [("rate", 0.0), ("seed", -1), ("p_BS", [0.0, 0.0]), ("p_BS", [0, 0, np.nan])],
)
def test_a_block_of_nonsense_is_refused(field: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{field} is .*: must be "):
        Imu(**{field: value})
