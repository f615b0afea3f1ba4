"""An inertial sensor: angular rate and specific force, with the errors of real ones."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.compiled import compiled, packed
from systems.noise import NoiseStream, sample_index
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

GRAVITY = 9.81  # m/s^2, as Drake's UniformGravityFieldElement

_PIECE = 2**64  # of the noise stream: no sample has so high a number


@dataclass
class ImuParameters:
    """Errors of an inertial sensor. Three numbers are [x, y, z] in the sensor's frame.

    A tolerance is what the maker grants from one piece to the next: the seed draws an error of this
    piece, uniformly from within, which then stays. The drift is a Gauss-Markov process: it wanders
    about 0 with the standard deviation `drift` and forgets in `drift_time`.

    The vibration is what motors and wheels shake the sensor with, as true motion: noise in a band,
    each axis by itself. The sensor has no filter before it samples, so what lies above half its
    rate shows folded down.

    Attributes:
        gyro_noise_density: rad/s/sqrt(Hz).
        gyro_bias: constant, rad/s.
        gyro_bias_tolerance: rad/s, each axis.
        gyro_drift: rad/s.
        gyro_drift_time: s.
        gyro_scale_tolerance: relative, each axis.
        gyro_range: the largest rate that is told, rad/s; left out: any.
        accel_noise_density: m/s^2/sqrt(Hz).
        accel_bias: constant, m/s^2.
        accel_bias_tolerance: m/s^2, each axis.
        accel_drift: m/s^2.
        accel_drift_time: s.
        accel_scale_tolerance: relative, each axis.
        accel_range: m/s^2; left out: any.
        cross_axis_tolerance: share of each other axis that shows on an axis, of both sensors.
        bits: of a number that the sensor tells, which has 2^bits steps from -range to +range; 0 for
            no steps. Needs the ranges.
        vibration_frequency: middle of the band, Hz.
        vibration_bandwidth: from half power to half power, Hz; 0 is a pure tone.
        gyro_vibration: root mean square, rad/s.
        accel_vibration: root mean square, m/s^2.
    """

    gyro_noise_density: float = 0.0
    gyro_bias: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    gyro_bias_tolerance: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    gyro_drift: float = 0.0
    gyro_drift_time: float = 100.0
    gyro_scale_tolerance: float = 0.0
    gyro_range: float | None = None
    accel_noise_density: float = 0.0
    accel_bias: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    accel_bias_tolerance: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    accel_drift: float = 0.0
    accel_drift_time: float = 100.0
    accel_scale_tolerance: float = 0.0
    accel_range: float | None = None
    cross_axis_tolerance: float = 0.0
    bits: int = 0
    vibration_frequency: float = 100.0
    vibration_bandwidth: float = 10.0
    gyro_vibration: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    accel_vibration: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])

    def __post_init__(self) -> None:
        for kind in ("gyro", "accel"):
            for name in ("noise_density", "drift", "scale_tolerance"):
                require_non_negative(**{f"{kind}_{name}": getattr(self, f"{kind}_{name}")})
            require_positive(**{f"{kind}_drift_time": getattr(self, f"{kind}_drift_time")})
            for name in (f"{kind}_bias", f"{kind}_bias_tolerance", f"{kind}_vibration"):
                value = getattr(self, name)
                least = -np.inf if name.endswith("bias") else 0.0
                require(
                    len(value) == 3 and bool(np.isfinite(value).all()) and min(value) >= least,
                    name,
                    value,
                    "three finite numbers" + (", 0 or greater" if least == 0.0 else ""),
                )
            limit = getattr(self, f"{kind}_range")
            if limit is not None:
                require_positive(**{f"{kind}_range": limit})
        require_non_negative(
            cross_axis_tolerance=self.cross_axis_tolerance,
            vibration_frequency=self.vibration_frequency,
            vibration_bandwidth=self.vibration_bandwidth,
        )
        require(0 <= self.bits <= 32, "bits", self.bits, "0 to 32")
        unlimited = self.gyro_range is None or self.accel_range is None
        require(not (self.bits and unlimited), "bits", self.bits, "0 unless both ranges are given")


@dataclass
class Mpu6050Parameters(ImuParameters):
    """The InvenSense MPU-6050 in its finest ranges; every figure can be overridden.

    Source: MPU-6000/MPU-6050 Product Specification, revision 3.4, tables 6.1 and 6.2: gyro +-250
    deg/s at 131 LSB/(deg/s), rate noise 0.005 deg/s/sqrt(Hz), zero-rate output within +-20 deg/s,
    sensitivity within 3 %; accelerometer +-2 g at 16384 LSB/g, 400 ug/sqrt(Hz), zero-g output
    within 50 mg (x, y) and 80 mg (z), calibration within 3 %; cross-axis within 2 %; 16 bits. The
    sheet gives no drift at rest. Ours stands for the warmth: it grants 20 deg/s from 25 to 85
    degrees C, so a twentieth of a kelvin is worth 0.017 deg/s, and 60 mg from 0 to 70 degrees C.
    """

    gyro_noise_density: float = math.radians(0.005)
    gyro_bias_tolerance: list[float] = field(default_factory=lambda: [math.radians(20.0)] * 3)
    gyro_drift: float = math.radians(0.017)
    gyro_scale_tolerance: float = 0.03
    gyro_range: float | None = math.radians(250.0)
    accel_noise_density: float = 400e-6 * GRAVITY
    accel_bias_tolerance: list[float] = field(
        default_factory=lambda: [0.05 * GRAVITY, 0.05 * GRAVITY, 0.08 * GRAVITY]
    )
    accel_drift: float = 50e-6 * GRAVITY
    accel_scale_tolerance: float = 0.03
    accel_range: float | None = 2.0 * GRAVITY
    cross_axis_tolerance: float = 0.02
    bits: int = 16


@dataclass
class Bmi088Parameters(ImuParameters):
    """The Bosch BMI088 as [SNAIL] sets it, on a robot with small motors.

    Source: BMI088 Data Sheet, BST-BMI088-DS001, chapter 1: gyro +-125 deg/s at 262.144
    LSB/(deg/s), 0.014 deg/s/sqrt(Hz), zero-rate offset +-1 deg/s, sensitivity within 1 %,
    cross-axis 1 %; accelerometer 160 (x, y) and 190 (z) ug/sqrt(Hz), of which we take the larger,
    zero-g offset +-20 mg; 16 bits. No tolerance is given for the accelerometer's sensitivity. Drift
    as of the MPU-6050: a twentieth of a kelvin, at 0.015 deg/s and 0.2 mg per kelvin.

    +-2 g is what [SNAIL] says; the chip's own smallest range is +-3 g (the +-2 g are the BMI085's).

    No sheet gives the vibration. Ours is an assumption: the robot shakes by half a micrometre (rms)
    at 100 Hz, a rotor's 6000 turns a minute, which is 0.2 m/s^2, and rocks by as much over 20 mm,
    half its base, which is 0.9 deg/s.
    """

    gyro_noise_density: float = math.radians(0.014)
    gyro_bias_tolerance: list[float] = field(default_factory=lambda: [math.radians(1.0)] * 3)
    gyro_drift: float = math.radians(0.015 / 20)
    gyro_scale_tolerance: float = 0.01
    gyro_range: float | None = math.radians(125.0)
    accel_noise_density: float = 190e-6 * GRAVITY
    accel_bias_tolerance: list[float] = field(default_factory=lambda: [0.02 * GRAVITY] * 3)
    accel_drift: float = 0.2e-3 / 20 * GRAVITY
    accel_range: float | None = 2.0 * GRAVITY
    cross_axis_tolerance: float = 0.01
    bits: int = 16
    gyro_vibration: list[float] = field(default_factory=lambda: [math.radians(0.9)] * 3)
    accel_vibration: list[float] = field(default_factory=lambda: [0.2] * 3)


def piece_errors(parameters: ImuParameters, random: np.random.Generator) -> tuple[Array, Array]:
    """Draws the errors of one piece.

    Args:
        parameters: the tolerances.
        random: of the piece.

    Returns:
        (6, 6) what multiplies the true [gyro, accel], 1 but for scale errors and cross-axis
        sensitivity, and (6,) the bias.
    """
    p = parameters
    bias = np.array([*p.gyro_bias, *p.accel_bias])
    bias += random.uniform(-1, 1, 6) * [*p.gyro_bias_tolerance, *p.accel_bias_tolerance]
    matrix = np.zeros((6, 6))
    for k, scale in ((0, p.gyro_scale_tolerance), (3, p.accel_scale_tolerance)):
        block = random.uniform(-1, 1, (3, 3))
        block *= np.where(np.eye(3) == 1, scale, p.cross_axis_tolerance)
        matrix[k : k + 3, k : k + 3] = np.eye(3) + block
    return matrix, bias


def digital(sample: Array, limit: Array, bits: int) -> Array:
    """Returns samples (..., 6) as a sensor of that range (6,) tells them, in steps of 2^bits."""
    told = np.array(sample, float, order="C")
    _make_digital(told.reshape(-1), packed(limit), bits)
    return told


@compiled("void(f8[::1], f8[::1], i8)")
def _make_digital(sample: Array, limit: Array, bits: int) -> None:
    """Changes samples, one after the other."""
    half = 2.0 ** (bits - 1)
    for k in range(len(sample)):
        most = limit[k % 6]
        if bits:
            step = most / half
            whole = np.rint(sample[k] / step)
            sample[k] = np.minimum(np.maximum(whole, -half), half - 1) * step
        else:
            sample[k] = np.minimum(np.maximum(sample[k], -most), most)


def ideal_sample(X_WB: RigidTransform, V_WB: Array, A_WB: Array, p_BS: Array) -> Array:
    """Returns what a perfect sensor at S, fixed to the body B with B's axes, measures.

    Args:
        X_WB: pose of the body.
        V_WB: (6,) spatial velocity of B in W: angular (rad/s), then of B's origin (m/s).
        A_WB: (6,) spatial acceleration of B in W: angular (rad/s^2), then of B's origin (m/s^2).
        p_BS: (3,) position of the sensor in the body, m.

    Returns:
        (6,) angular velocity (rad/s) and specific force (m/s^2), in B; at rest the force is +g
        upward.
    """
    sample = np.empty(6)
    R_WB = packed(X_WB.rotation().matrix())
    _ideal_sample(R_WB, packed(V_WB), packed(A_WB), packed(p_BS), sample)
    return sample


@compiled("void(f8[:,::1], f8[::1], f8[::1], f8[::1], f8[::1])")
def _ideal_sample(R: Array, V: Array, A: Array, p: Array, sample: Array) -> None:
    for i in range(3):  # in B: angular velocity, specific force at B's origin
        sample[i] = R[0, i] * V[0] + R[1, i] * V[1] + R[2, i] * V[2]
        sample[3 + i] = R[0, i] * A[3] + R[1, i] * A[4] + R[2, i] * (A[5] + GRAVITY)
    wx, wy, wz = sample[0], sample[1], sample[2]
    ax = R[0, 0] * A[0] + R[1, 0] * A[1] + R[2, 0] * A[2]
    ay = R[0, 1] * A[0] + R[1, 1] * A[1] + R[2, 1] * A[2]
    az = R[0, 2] * A[0] + R[1, 2] * A[1] + R[2, 2] * A[2]
    # f + a x p + w x (w x p)
    along, square = wx * p[0] + wy * p[1] + wz * p[2], wx * wx + wy * wy + wz * wz
    sample[3] += ay * p[2] - az * p[1] + wx * along - p[0] * square
    sample[4] += az * p[0] - ax * p[2] + wy * along - p[1] * square
    sample[5] += ax * p[1] - ay * p[0] + wz * along - p[2] * square


# Rows of what is the same at each sample, (5, 6).
_WHITE, _LIMIT, _FORGET, _DRIFT_KICK, _SHAKE_KICK = range(5)
# What a piece has, beside its matrix: places in one vector.
_MATRIX, _BIAS, _DRIFT, _VIBRATION = slice(36), slice(36, 42), slice(42, 48), slice(48, 60)


@compiled(
    "void(f8[:,::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[:,::1], c16, f8[::1], i8, f8[::1])"
)
def _take_sample(
    R: Array,
    V: Array,
    A: Array,
    p: Array,
    piece: Array,
    constants: Array,
    turn: complex,
    noise: Array,
    bits: int,
    sample: Array,
) -> None:
    """Writes what the sensor tells, and carries its vibration and drift on to the next sample.

    Args:
        R: (3, 3) as V (6,), A (6,) and p (3,) see `ideal_sample`.
        V: (6,).
        A: (6,).
        p: (3,).
        piece: (60,) scale and cross-axis errors (6, 6), bias (6,), drift (6,), and vibration as six
            complex numbers (12,); the last two are changed.
        constants: (5, 6) standard deviation of the white noise; range; what the drift is multiplied
            with, deviation of what is added to it; deviation of what is added to the vibration.
        turn: what the vibration is multiplied with.
        noise: (6, 12, 18 or 24) normal numbers: white, and those of the drift (6) and of the
            vibration (12), where the sensor has them.
        bits: see `ImuParameters`.
        sample: (6,), written.
    """
    _ideal_sample(R, V, A, p, sample)
    matrix, bias = piece[_MATRIX].reshape(6, 6), piece[_BIAS]
    drift, vibration = piece[_DRIFT], piece[_VIBRATION]
    if len(noise) >= 18:
        first = len(noise) - 12
        for i in range(6):
            re, im = vibration[2 * i], vibration[2 * i + 1]
            kick = constants[_SHAKE_KICK, i]
            sample[i] += re
            vibration[2 * i] = turn.real * re - turn.imag * im + kick * noise[first + 2 * i]
            vibration[2 * i + 1] = turn.real * im + turn.imag * re + kick * noise[first + 2 * i + 1]
    true = sample.copy()
    for i in range(6):
        told = bias[i] + constants[_WHITE, i] * noise[i]
        for j in range(6):
            told += matrix[i, j] * true[j]
        if len(noise) % 12 == 0:
            told += drift[i]
            drift[i] = constants[_FORGET, i] * drift[i] + constants[_DRIFT_KICK, i] * noise[6 + i]
        sample[i] = told
    _make_digital(sample, constants[_LIMIT], bits)


class Imu(LeafSystem):
    """Samples a body's angular rate and specific force.

    .. pydrake_system::

        name: Imu
        input_ports:
        - pose
        - spatial_velocity
        - spatial_acceleration
        output_ports:
        - sample

    Args:
        parameters: errors.
        rate: samples a second, Hz.
        p_BS: position of the sensor in the body, m.
        seed: of the noise, a parameter of the Context.
        name: of the noise stream.

    Ports:
        pose (input, RigidTransform): `X_WB`.
        spatial_velocity (input, vector of 6): of the body in W, rotation first (rad/s, m/s).
        spatial_acceleration (input, vector of 6): likewise (rad/s^2, m/s^2).
        sample (output, vector of 6): [gyro (rad/s), accel (m/s^2)] in the body's axes, held between
            samples; zeros before the first.

    White noise of density d sampled at `rate` has the standard deviation d sqrt(rate). The errors
    of the piece, the first drift and the first vibration are drawn when a simulation is
    initialized, and are state from then on; without an initialization the piece is perfect but for
    the given bias. The drift b follows b' = f b + s sqrt(1 - f^2) n, f = exp(-1 / (rate T)), at
    each sample: stationary with the deviation s and the correlation time T, whatever the rate. The
    vibration is the real part of the same process in complex numbers, with f turning by 2 pi
    frequency / rate and T = 1 / (pi bandwidth).

    Raises:
        ValueError: rate, seed or position out of range.
    """

    def __init__(
        self,
        *,
        parameters: ImuParameters | None = None,
        rate: float = 100.0,
        p_BS: Array | None = None,
        seed: int = 0,
        name: str = "imu",
    ) -> None:
        super().__init__()
        require_positive(rate=rate)
        p = parameters or ImuParameters()
        self._parameters = p
        self._rate = rate
        self._drift_deviation = np.repeat([p.gyro_drift, p.accel_drift], 3)
        self._shake = np.array([*p.gyro_vibration, *p.accel_vibration])
        forget = np.exp(-1.0 / (rate * np.repeat([p.gyro_drift_time, p.accel_drift_time], 3)))
        decay = math.exp(-math.pi * p.vibration_bandwidth / rate)
        self._turn = decay * np.exp(2j * math.pi * p.vibration_frequency / rate)
        constants = np.empty((5, 6))
        constants[_WHITE] = np.repeat([p.gyro_noise_density, p.accel_noise_density], 3)
        constants[_WHITE] *= np.sqrt(rate)
        constants[_LIMIT] = np.repeat(
            [np.inf if limit is None else limit for limit in (p.gyro_range, p.accel_range)], 3
        )
        constants[_FORGET] = forget
        constants[_DRIFT_KICK] = self._drift_deviation * np.sqrt(1.0 - forget**2)
        constants[_SHAKE_KICK] = self._shake * math.sqrt(1.0 - decay**2)
        self._constants = constants
        # What a sensor does not have costs nothing at each of its samples.
        self._noises = 6 + 6 * bool(self._drift_deviation.any()) + 12 * bool(self._shake.any())
        self._p_BS = np.zeros(3) if p_BS is None else np.array(p_BS, float)
        sound = self._p_BS.shape == (3,) and bool(np.isfinite(self._p_BS).all())
        require(sound, "p_BS", self._p_BS.tolist(), "three finite numbers (m)")
        self._noise = NoiseStream(self, seed=seed, name=name)
        self._pose_input = self.DeclareAbstractInputPort(
            "pose", AbstractValue.Make(RigidTransform())
        )
        self._velocity_input = self.DeclareVectorInputPort("spatial_velocity", 6)
        self._acceleration_input = self.DeclareVectorInputPort("spatial_acceleration", 6)
        self._sample = self.DeclareDiscreteState(6)
        bias = [*p.gyro_bias, *p.accel_bias]
        self._piece = self.DeclareDiscreteState(np.r_[np.eye(6).ravel(), bias, np.zeros(18)])
        self.DeclareInitializationDiscreteUpdateEvent(self._switch_on)
        self.DeclarePeriodicDiscreteUpdateEvent(1.0 / rate, 0.0, self._measure)
        self._sample_output = self.DeclareStateOutputPort("sample", self._sample)

    def pose_input_port(self) -> InputPort:
        """Returns the port of the body's pose."""
        return self._pose_input

    def spatial_velocity_input_port(self) -> InputPort:
        """Returns the port of the body's velocity."""
        return self._velocity_input

    def spatial_acceleration_input_port(self) -> InputPort:
        """Returns the port of the body's acceleration."""
        return self._acceleration_input

    def sample_output_port(self) -> OutputPort:
        """Returns the port of the samples."""
        return self._sample_output

    def _switch_on(self, context: Context, discrete_state: DiscreteValues) -> None:
        random = self._noise.generator(context, _PIECE)
        matrix, bias = piece_errors(self._parameters, random)
        drift = self._drift_deviation * random.standard_normal(6)
        vibration = np.repeat(self._shake, 2) * random.standard_normal(12)
        piece = np.concatenate([matrix.ravel(), bias, drift, vibration])
        discrete_state.set_value(self._piece, piece)

    def _measure(self, context: Context, discrete_state: DiscreteValues) -> None:
        index = sample_index(context.get_time(), self._rate)
        _take_sample(
            packed(self._pose_input.Eval(context).rotation().matrix()),
            packed(self._velocity_input.Eval(context)),
            packed(self._acceleration_input.Eval(context)),
            self._p_BS,
            discrete_state.get_mutable_value(self._piece),
            self._constants,
            self._turn,
            packed(self._noise.normals(context, index, self._noises)),
            self._parameters.bits,
            discrete_state.get_mutable_value(self._sample),
        )
