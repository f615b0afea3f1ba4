"""An inertial sensor: angular rate and specific force, with the errors of real ones."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.compiled import compiled, packed
from systems.noise import NoiseStream, sample_index
from systems.periods import period
from systems.sensors.imu_parameters import GRAVITY, ImuParameters
from systems.validation import require, require_positive

Array = NDArray[np.float64]

_PIECE = 2**64  # of the noise stream: no sample has so high a number


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
    _ideal_sample(packed(X_WB.GetAsMatrix34()), packed(V_WB), packed(A_WB), packed(p_BS), sample)
    return sample


@compiled("void(f8[:,::1], f8[::1], f8[::1], f8[::1], f8[::1])")
def _ideal_sample(R: Array, V: Array, A: Array, p: Array, sample: Array) -> None:
    # R may have more columns: it is the pose (3, 4).
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
    X: Array,
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
        X: (3, 4) as V (6,), A (6,) and p (3,) see `ideal_sample`.
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
    _ideal_sample(X, V, A, p, sample)
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
        self.DeclarePeriodicDiscreteUpdateEvent(period(rate), 0.0, self._measure)
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
            packed(self._pose_input.Eval(context).GetAsMatrix34()),
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
