from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import ahrs
import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from scipy.io import loadmat
from scipy.spatial.transform import Rotation

from systems.estimators.madgwick import (
    IDENTITY,
    Madgwick,
    MadgwickParameters,
    Quaternion,
    madgwick_step,
    tilt_of,
)
from systems.sensors.imu import Imu
from systems.sensors.imu_parameters import GRAVITY, Bmi088Parameters, ImuParameters

Array = NDArray[np.float64]

RATE = 300.0
DT = 1.0 / RATE
REST = [0.0, 0.0, 0.0]
UP = [0.0, 0.0, GRAVITY]

# --- Quaternions, written again ---


def product(a: Any, b: Any) -> Array:
    (aw, *av), (bw, *bv) = a, b
    av, bv = np.array(av), np.array(bv)
    return np.array([aw * bw - av @ bv, *(aw * bv + bw * av + np.cross(av, bv))])


def conjugate(q: Any) -> Array:
    return np.array(q) * [1, -1, -1, -1]


def turn(axis: Any, angle: float) -> Quaternion:
    axis = np.array(axis) / np.linalg.norm(axis)
    return (math.cos(angle / 2), *(math.sin(angle / 2) * axis).tolist())


def angle_between(a: Any, b: Any) -> Array:
    """Angle of the turn from one to the other, rad; rows, or one."""
    a, b = np.atleast_2d(a), np.atleast_2d(b)
    sign = np.where((a * b).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    # Of the chord: the arc cosine of a dot product is blind below 1e-8.
    return 4 * np.arcsin(np.clip(np.linalg.norm(a - sign * b, axis=1) / 2, 0, 1))


def up_in_sensor(q: Any) -> Array:
    """(n, 3) the earth's z axis in the sensor."""
    turned: Array = Rotation.from_quat(np.roll(q, -1, axis=1)).inv().apply([0.0, 0.0, 1.0])
    return turned


def tilt_error(a: Any, b: Any) -> Array:
    """Angle between the two ideas of up, rad."""
    u, v = up_in_sensor(np.atleast_2d(a)), up_in_sensor(np.atleast_2d(b))
    return np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), (u * v).sum(axis=1))


def run(
    gyro: Array, accel: Array, beta: float, dt: float, q: Quaternion, step: Callable = madgwick_step
) -> Array:
    """(n + 1, 4) the start and what follows each sample."""
    found = [q]
    for rate, force in zip(gyro.tolist(), accel.tolist(), strict=True):
        q = step(q, rate, force, beta, dt)
        found.append(q)
    return np.array(found)


def paper_step(q: Quaternion, gyro: Any, accel: Any, beta: float, dt: float) -> Quaternion:
    """The paper's equations with matrices: 12, 25, 26, 34, 33."""
    w, x, y, z = q
    a = np.array(accel) / np.linalg.norm(accel)
    f = np.array([2 * (x * z - w * y), 2 * (w * x + y * z), 2 * (0.5 - x * x - y * y)]) - a
    J = np.array(
        [[-2 * y, 2 * z, -2 * w, 2 * x], [2 * x, 2 * w, 2 * z, 2 * y], [0, -4 * x, -4 * y, 0]]
    )
    gradient = J.T @ f
    rate = 0.5 * product(q, [0, *gyro]) - beta * gradient / np.linalg.norm(gradient)
    new = np.array(q) + dt * rate
    return tuple((new / np.linalg.norm(new)).tolist())


def shaken(n: int, seed: int) -> tuple[Array, Array, Array]:
    """A sensor that tumbles: (n, 3) rates, (n, 3) forces with noise, (n + 1, 4) the truth."""
    random = np.random.default_rng(seed)
    t = np.arange(n)[:, None] * DT
    phase = random.uniform(0, 2 * math.pi, (2, 3))
    gyro = 1.5 * np.sin(2.1 * t + phase[0]) + np.sin(0.7 * t + phase[1])
    truth = [np.array(IDENTITY)]
    for rate in gyro:
        angle = float(np.linalg.norm(rate)) * DT
        truth.append(product(truth[-1], turn(rate, angle)))
    accel = GRAVITY * up_in_sensor(truth[:-1]) + random.normal(0, 1.0, (n, 3))
    return gyro, accel, np.array(truth)


# --- The step ---


def test_it_is_the_paper_s_equations() -> None:
    random = np.random.default_rng(1)
    for _ in range(200):
        q = random.normal(size=4)
        q /= np.linalg.norm(q)
        gyro, accel = random.normal(0, 3, 3), random.normal(0, 9, 3)
        beta, dt = random.uniform(0.01, 1), random.uniform(1e-3, 1e-2)
        found = madgwick_step(tuple(q.tolist()), gyro.tolist(), accel.tolist(), beta, dt)
        np.testing.assert_allclose(found, paper_step(q, gyro, accel, beta, dt), atol=1e-14)


def test_a_turn_by_the_gyro_goes_the_right_way() -> None:
    # A quarter turn to the left about z, then one about the sensor's own x: y ends upward.
    rate = math.radians(90.0)
    gyro = np.repeat([[0.0, 0.0, rate], [rate, 0.0, 0.0]], 3000, axis=0)
    (*_, q) = run(gyro, np.zeros((6000, 3)), 0.0, 1 / 3000, IDENTITY)
    R = RotationMatrix([[0, 0, 1], [1, 0, 0], [0, 1, 0]])  # columns: x to y, y to z, z to x
    w = R.ToQuaternion()
    np.testing.assert_allclose(q, [w.w(), w.x(), w.y(), w.z()], atol=1e-6)


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, -1, 0], [0, 0, 1], [1, -2, 3]])
def test_a_constant_rate_turns_by_the_arc_tangent_at_each_step(axis: list[float]) -> None:
    rate, n = 2.0, 1500
    gyro = np.tile(rate * np.array(axis) / np.linalg.norm(axis), (n, 1))
    (*_, q) = run(gyro, np.zeros((n, 3)), 0.3, DT, IDENTITY)
    assert angle_between(q, turn(axis, n * 2 * math.atan(rate * DT / 2)))[0] < 1e-11
    # That is the first order's error: (rate dt)^3 / 12 a step.
    behind = n * (rate * DT) ** 3 / 12
    assert angle_between(q, turn(axis, n * rate * DT))[0] == pytest.approx(behind, rel=1e-3)


def tilt_by_the_differential_equation(tilt: float, beta: float, t: float, n: int = 2000) -> float:
    """The gradient at a tilt of 2 h, worked out by hand: 4 sin h (cos h along the turn, 2 sin h
    along the quaternion itself, which the normalisation takes away)."""

    def rate(tilt: float) -> float:
        c, s = math.cos(tilt / 2), math.sin(tilt / 2)
        return -2 * beta * c / math.hypot(c, 2 * s)

    for _ in range(n):
        middle = tilt + rate(tilt) * t / n / 2
        tilt += rate(middle) * t / n
    return tilt


@pytest.mark.parametrize("heading", [0.0, 2.0])
@pytest.mark.parametrize("tilt", [0.5, 1.5, 3.0])
def test_gravity_pulls_a_tilt_in_as_the_gradient_says(tilt: float, heading: float) -> None:
    beta, n = 0.2, 300
    axis = [math.cos(0.3), math.sin(0.3), 0.0]
    start = tuple(product(turn([0, 0, 1], heading), turn(axis, tilt)))
    found = run(np.zeros((n, 3)), np.tile(UP, (n, 1)), beta, DT, start)
    for k in (30, 300):
        expected = tilt_by_the_differential_equation(tilt, beta, k * DT)
        assert tilt_error(found[k], IDENTITY)[0] == pytest.approx(expected, abs=2e-4)
    # A small tilt goes by 2 beta: here is nearly none of the other part.
    if tilt == 0.5:
        rate = (0.02 - tilt_by_the_differential_equation(0.02, beta, 0.01)) / 0.01
        assert rate == pytest.approx(2 * beta, rel=1e-3)
        # The other way it would run off.
        away = run(np.zeros((n, 3)), np.tile(UP, (n, 1)), -beta, DT, start)
        assert tilt_error(away[-1], IDENTITY)[0] > tilt + 0.2


def test_on_its_side_it_pulls_less_one_way_as_the_docstring_says() -> None:
    beta, tilt = 0.2, 0.01
    side = tilt_of([0.0, 1.0, 0.0])
    for axis, share in (([1, 0, 0], math.sqrt(0.5)), ([0, 0, 1], 1.0)):
        start = tuple(product(side, turn(axis, tilt)))  # about the sensor's x, and its z
        assert tilt_error(start, side)[0] == pytest.approx(tilt)
        q = madgwick_step(start, REST, [0.0, GRAVITY, 0.0], beta, 1e-3)
        moved = tilt - tilt_error(q, side)[0]
        assert moved == pytest.approx(2 * beta * share * 1e-3, rel=0.02)


def test_from_upside_down_it_hardly_gets_away_so_it_starts_from_the_accelerometer() -> None:
    down = (0.0, 1.0, 0.0, 0.0)
    assert tilt_error(down, IDENTITY)[0] == pytest.approx(math.pi)
    stuck = run(np.zeros((3000, 3)), np.tile(UP, (3000, 1)), 0.5, DT, down)
    np.testing.assert_array_equal(stuck[-1], down)
    # Off by a little it leaves as exp(beta t / 2).
    found = run(np.zeros((600, 3)), np.tile(UP, (600, 1)), 0.5, DT, turn([1, 0, 0], math.pi - 1e-3))
    left = math.pi - tilt_error(found[-1], IDENTITY)[0]
    assert left == pytest.approx(1e-3 * math.exp(0.5 * 600 * DT / 2), rel=0.01)


def test_no_correction_turns_it_about_the_vertical() -> None:
    random = np.random.default_rng(2)
    for _ in range(100):
        q = random.normal(size=4)
        q = tuple((q / np.linalg.norm(q)).tolist())
        corrected = madgwick_step(q, REST, random.normal(size=3).tolist(), 0.5, 0.01)
        _, x, y, z = product(corrected, conjugate(q))  # in the earth's frame
        assert abs(z) < 1e-15
        assert math.hypot(x, y) > 1e-4


def test_the_heading_is_not_observed() -> None:
    gyro, accel, _ = shaken(2000, seed=3)
    # From a tilt: where there is none, what rounds off chooses the way.
    found = run(gyro, accel, 0.2, DT, turn([1, 2, 0], 0.1))
    about = turn([0, 0, 1], 1.2)
    other = run(gyro, accel, 0.2, DT, tuple(product(about, found[0])))
    np.testing.assert_allclose(other, [product(about, q) for q in found], atol=1e-11)
    # A tilt, by contrast, is forgotten.
    tilted = run(gyro, accel, 0.2, DT, tuple(product(turn([1, 0, 0], 0.3), found[0])))
    assert tilt_error(tilted[0], found[0])[0] == pytest.approx(0.3)
    assert tilt_error(tilted[-1], found[-1])[0] < 0.01


def test_the_norm_is_one() -> None:
    random = np.random.default_rng(4)
    gyro, accel = random.normal(0, 30, (20_000, 3)), random.normal(0, 20, (20_000, 3))
    accel[::7] = 0.0
    accel[3::7] *= 1e-200
    gyro[::5] *= 1e6
    found = run(gyro, accel, 0.5, DT, IDENTITY)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-15)


def test_at_no_error_it_dithers_by_two_beta_over_the_rate() -> None:
    beta = 0.3
    truth = turn([1.0, 2.0, 0.5], 1.0)
    accel = np.tile(up_in_sensor([truth]), (2000, 1))
    found = run(np.zeros((2000, 3)), accel, beta, DT, tuple(product(turn([1, 0, 0], 0.1), truth)))
    assert tilt_error(found[-500:], np.tile(truth, (500, 1))).max() <= 2 * beta * DT * 1.001


@pytest.mark.parametrize(("share", "holds"), [(0.8, True), (1.2, False)])
def test_it_holds_against_a_gyro_error_of_up_to_two_beta(share: float, holds: bool) -> None:
    beta, n = 0.05, 12_000
    gyro = np.tile([share * 2 * beta, 0.0, 0.0], (n, 1))
    error = tilt_error(run(gyro, np.tile(UP, (n, 1)), beta, DT, IDENTITY)[-1], IDENTITY)[0]
    assert error <= 4 * beta * DT if holds else error > 0.3


def test_it_finds_the_tilt_of_a_tumbling_sensor_and_wrong_axes_or_signs_do_not() -> None:
    gyro, accel, truth = shaken(9000, seed=5)

    def rms(gyro: Array, accel: Array) -> float:
        found = run(gyro, accel, 0.04, DT, tilt_of(accel[0].tolist()))
        return math.degrees(np.sqrt(np.mean(tilt_error(found[900:], truth[900:]) ** 2)))

    good = rms(gyro, accel)
    assert good < 1.0
    swap = [1, 0, 2]
    for wrong in (
        (-gyro, accel),
        (gyro[:, swap], accel),
        (gyro, accel[:, swap]),
        (gyro, -accel),
        (np.degrees(gyro), accel),
        (np.zeros_like(gyro), accel),
    ):
        assert rms(*wrong) > 10 * good


# --- The tilt at rest ---


def test_the_tilt_at_rest_by_hand() -> None:
    half = math.sqrt(0.5)
    assert tilt_of(UP) == IDENTITY
    # Its y axis points up: it was turned to the right by a quarter about x.
    np.testing.assert_allclose(tilt_of([0.0, 1.0, 0.0]), [half, half, 0, 0], atol=1e-15)
    np.testing.assert_allclose(tilt_of([2.0, 0.0, 0.0]), [half, 0, -half, 0], atol=1e-15)
    assert tilt_of([0.0, 0.0, -9.8]) == (0.0, 1.0, 0.0, 0.0)


def test_the_tilt_at_rest_has_gravity_where_it_was_measured_and_turns_level() -> None:
    random = np.random.default_rng(6)
    forces = [*random.normal(0, 9, (100, 3)), np.array([1e-9, -2e-9, -9.8])]
    for force in forces:
        q = tilt_of(force.tolist())
        np.testing.assert_allclose(up_in_sensor([q])[0], force / np.linalg.norm(force), atol=1e-7)
        assert np.linalg.norm(q) == pytest.approx(1, abs=1e-15)
        assert q[3] == 0
        # No shorter turn does it.
        assert 2 * math.acos(q[0]) == pytest.approx(
            math.acos(force[2] / np.linalg.norm(force)), abs=1e-7
        )


# --- Against `ahrs` and real recordings ---


def run_ahrs(gyro: Array, accel: Array, beta: float, dt: float, q: Quaternion) -> Array:
    """(n + 1, 4) the start and what follows each sample."""
    peer = ahrs.filters.Madgwick(gain_imu=beta, Dt=dt)
    # It skips a sample altogether when the gyro tells exact zeros.
    assert gyro.any(axis=1).all()
    found = [np.array(q)]
    for rate, force in zip(gyro, accel, strict=True):
        found.append(peer.updateIMU(found[-1], rate, force))
    return np.array(found)


def test_it_is_the_same_as_ahrs() -> None:
    random = np.random.default_rng(7)
    gyro, accel, _ = shaken(4000, seed=7)
    gyro[2000:] += random.normal(0, 5, (2000, 3))
    accel[2000:] = random.normal(0, 10, (2000, 3))
    accel[::50] = 0.0
    start = turn([1, 2, 3], 2.0)
    for beta in (0.04, 0.5):
        peer = run_ahrs(gyro, accel, beta, DT, start)
        assert angle_between(run(gyro, accel, beta, DT, start), peer).max() <= 1e-6
        # A slip would show.
        assert angle_between(run(gyro, accel, beta * 1.01, DT, start), peer).max() > 1e-4


SLOW, FAST = "02_undisturbed_slow_rotation_B", "07_undisturbed_fast_rotation_B"


class Recording:
    """One of BROAD (Laidig et al., "BROAD: A Benchmark for Robust Inertial Orientation Estimation",
    Data 2021), with optical truth."""

    def __init__(self, path: Path) -> None:
        data = loadmat(path)
        self.gyro, self.accel = data["imu_gyr"], data["imu_acc"]
        self.dt = 1.0 / data["sampling_rate"].item()
        self.truth = data["opt_quat"]
        self.scored = (data["movement"].ravel() == 1) & np.isfinite(self.truth).all(axis=1)

    def run(self, gyro: Array, accel: Array, beta: float = 0.04) -> Array:
        """(n, 4): the first from the accelerometer, each other by its own sample."""
        return run(gyro[1:], accel[1:], beta, self.dt, tilt_of(accel[0].tolist()))

    def inclination_rmse(self, found: Array) -> float:
        """Degrees, over the movement."""
        error = tilt_error(found[self.scored], self.truth[self.scored])
        return math.degrees(np.sqrt(np.mean(error**2)))


@pytest.mark.recording
@pytest.mark.parametrize(("name", "limit"), [(SLOW, 0.65), (FAST, 2.1)])
def test_the_inclination_of_a_real_sensor(recordings: Path, name: str, limit: float) -> None:
    recording = Recording(recordings / "broad_imu" / f"{name}.mat")
    assert recording.scored.sum() > 30_000
    gyro, accel = recording.gyro, recording.accel
    assert recording.inclination_rmse(recording.run(gyro, accel)) <= limit
    for wrong in ((-gyro, accel), (gyro[:, [1, 0, 2]], accel), (gyro, -accel)):
        assert recording.inclination_rmse(recording.run(*wrong)) > 5 * limit


@pytest.mark.recording
@pytest.mark.parametrize("name", [SLOW, FAST])
def test_it_is_the_same_as_ahrs_on_a_real_sensor(recordings: Path, name: str) -> None:
    recording = Recording(recordings / "broad_imu" / f"{name}.mat")
    gyro, accel = recording.gyro.copy(), recording.accel
    gyro[~gyro.any(axis=1)] = 1e-12
    peer = run_ahrs(gyro[1:], accel[1:], 0.04, recording.dt, tilt_of(accel[0].tolist()))
    assert angle_between(recording.run(gyro, accel), peer).max() <= 1e-6


# --- The block ---


class Samples(LeafSystem):
    """Sends row k from k / RATE on; before, at 0, zeros, as a sensor does."""

    def __init__(self, rows: Array) -> None:
        super().__init__()
        state = self.DeclareDiscreteState(6)
        self.DeclarePeriodicDiscreteUpdateEvent(
            DT,
            0.0,
            lambda context, values: values.set_value(
                state, rows[min(round(context.get_time() * RATE), len(rows) - 1)]
            ),
        )
        self.DeclareStateOutputPort("sample", state)


class Rig:
    def __init__(self, source: LeafSystem, **parameters: Any) -> None:
        builder = DiagramBuilder()
        builder.AddSystem(source)
        self.block = builder.AddSystem(
            Madgwick(parameters=MadgwickParameters(**parameters), rate=RATE)
        )
        builder.Connect(source.GetOutputPort("sample"), self.block.imu_input_port())
        self.simulator = Simulator(builder.Build())
        self.context = self.block.GetMyContextFromRoot(self.simulator.get_context())

    def after(self, number: int) -> Array:
        """The orientation when so many samples have been looked at."""
        self.simulator.AdvanceTo((number + 0.5) * DT)
        return self.block.orientation_output_port().Eval(self.context).copy()

    @property
    def counts(self) -> dict[str, int]:
        return dict(self.block.health_output_port().Eval(self.context).counts)


def rows_of(gyro: Array, accel: Array) -> Array:
    return np.hstack([gyro, accel])


def test_the_block_is_the_loop() -> None:
    gyro, accel, _ = shaken(300, seed=8)
    rig = Rig(Samples(rows_of(gyro, accel)), beta=0.2)
    assert rig.after(0).tolist() == list(IDENTITY)
    # The first sample gives the tilt and its own turn.
    start = madgwick_step(tilt_of(accel[0].tolist()), gyro[0].tolist(), accel[0].tolist(), 0, DT)
    expected = run(gyro[1:], accel[1:], 0.2, DT, start)
    for k in (1, 2, 3, 299):
        np.testing.assert_array_equal(rig.after(k), expected[k - 1])
    assert rig.counts == {"bad_gyro": 0, "bad_accel": 0}


def test_it_may_start_upright() -> None:
    gyro, accel, _ = shaken(50, seed=9)
    rig = Rig(Samples(rows_of(gyro, accel)), beta=0.2, start_from_accelerometer=False)
    np.testing.assert_array_equal(rig.after(49), run(gyro, accel, 0.2, DT, IDENTITY)[49])


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e4, -1e4])
def test_bad_samples_are_dropped_and_counted(value: float) -> None:
    gyro, accel, _ = shaken(60, seed=10)
    broken = rows_of(gyro, accel)
    broken[[20, 21], 1] = value  # its gyro
    broken[[30, 31, 40], 5] = value  # its accelerometer
    broken[40, 0] = value  # and both
    broken[45, 3:] = 0.0
    rig = Rig(Samples(broken), beta=0.2)
    q = rig.after(1)
    for k in range(1, 59):
        if k not in (20, 21, 40):
            force = np.zeros(3) if k in (30, 31, 45) else accel[k]
            q = madgwick_step(tuple(q), gyro[k].tolist(), force.tolist(), 0.2, DT)
        np.testing.assert_array_equal(rig.after(k + 1), q)
    assert rig.counts == {"bad_gyro": 3, "bad_accel": 4}


def test_it_waits_for_the_first_good_accelerometer() -> None:
    gyro, accel, _ = shaken(20, seed=11)
    rows = rows_of(gyro, accel)
    rows[:5, 4] = math.nan
    rows[5, 0] = math.nan  # the tilt alone is good
    rig = Rig(Samples(rows), beta=0.2)
    assert rig.after(5).tolist() == list(IDENTITY)
    np.testing.assert_array_equal(rig.after(6), tilt_of(accel[5].tolist()))
    assert rig.counts == {"bad_gyro": 1, "bad_accel": 5}


def test_nothing_but_bad_samples_leaves_it_finite() -> None:
    rig = Rig(Samples(np.full((700, 6), math.nan)))
    assert rig.after(600).tolist() == list(IDENTITY)
    assert rig.counts == {"bad_gyro": 600, "bad_accel": 600}


class Roll(LeafSystem):
    """A body that turns steadily about a level axis, over and over."""

    OMEGA = np.array([0.4, -0.3, 0.0])

    def __init__(self) -> None:
        super().__init__()
        self.DeclareAbstractOutputPort(
            "pose",
            lambda: AbstractValue.Make(RigidTransform()),
            lambda context, output: output.set_value(
                RigidTransform(self.rotation(context.get_time()), np.zeros(3))
            ),
        )

    def rotation(self, t: float) -> RotationMatrix:
        speed = float(np.linalg.norm(self.OMEGA))
        turned = RotationMatrix(AngleAxis(speed * t, self.OMEGA / speed))
        return turned @ RotationMatrix(RollPitchYaw(0.4, 0.3, 0.2))

    def quaternion(self, t: float) -> Array:
        q = self.rotation(t).ToQuaternion()
        return np.array([q.w(), q.x(), q.y(), q.z()])


def rolling(parameters: ImuParameters, beta: float, seed: int = 0) -> Array:
    """(n,) errors of tilt, rad, twenty times a second for 13 s of rolling."""
    builder = DiagramBuilder()
    body = builder.AddSystem(Roll())
    imu = builder.AddSystem(Imu(parameters=parameters, rate=RATE, seed=seed))
    block = builder.AddSystem(Madgwick(parameters=MadgwickParameters(beta=beta), rate=RATE))
    builder.Connect(body.GetOutputPort("pose"), imu.pose_input_port())
    builder.Connect(imu.sample_output_port(), block.imu_input_port())
    diagram = builder.Build()
    simulator = Simulator(diagram)
    own = imu.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    imu.spatial_velocity_input_port().FixValue(own, [*Roll.OMEGA, 0, 0, 0])
    imu.spatial_acceleration_input_port().FixValue(own, np.zeros(6))
    errors = []
    for k in range(15, 3900, 15):
        simulator.AdvanceTo((k + 0.5) * DT)
        q = block.orientation_output_port().Eval(
            block.GetMyContextFromRoot(simulator.get_context())
        )
        errors.append(tilt_error(q, body.quaternion(k * DT))[0])
    return np.array(errors)


def test_a_perfect_sensor_on_a_rolling_body_has_no_lag() -> None:
    # A sample late would be 0.5 rad/s / 300 Hz = 1.7 mrad.
    assert rolling(ImuParameters(), beta=0.04).max() < 4e-4


def test_a_bmi088_on_a_rolling_body_is_as_good_as_its_offsets() -> None:
    errors = [rolling(Bmi088Parameters(), beta=0.1, seed=seed) for seed in range(3)]
    # 20 mg on each of three axes are 2 degrees at most; the vibration is averaged away.
    assert math.degrees(np.max(errors)) < 2.0
    # More gain lets more of the vibration through.
    still = Bmi088Parameters(accel_bias_tolerance=[0.0] * 3, gyro_bias_tolerance=[0.0] * 3)
    low, high = (np.sqrt(np.mean(rolling(still, beta=beta) ** 2)) for beta in (0.02, 1.0))
    assert low < high


@pytest.mark.parametrize(
    ("field", "value"),
    [("beta", -0.1), ("beta", math.nan), ("gyro_range", 0.0), ("accel_range", math.inf)],
)
def test_nonsense_is_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{field} is .*: must be "):
        MadgwickParameters(**{field: value})


def test_a_block_of_nonsense_is_refused() -> None:
    with pytest.raises(ValueError, match=r"rate is 0\.0: must be greater than 0"):
        Madgwick(rate=0.0)
