"""Which way is up, by gyro and accelerometer: the filter of Madgwick."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.health import Counts
from systems.periods import period
from systems.sensors.imu_parameters import GRAVITY
from systems.validation import require_non_negative, require_positive

Quaternion = tuple[float, float, float, float]

IDENTITY: Quaternion = (1.0, 0.0, 0.0, 0.0)


@dataclass
class MadgwickParameters:
    """What the filter believes.

    Attributes:
        beta: gain, how fast the accelerometer pulls, rad/s of half an angle: an error of tilt
            shrinks by 2 beta at most. 0 integrates the gyro alone. [SNAIL] says 0.1 to 0.5.
        start_from_accelerometer: the first good sample gives the tilt; otherwise it starts upright
            and has to converge.
        gyro_range: a rate beyond is a garbled sample, rad/s. The widest range of common sensors.
        accel_range: likewise, m/s^2.
    """

    beta: float = 0.1
    start_from_accelerometer: bool = True
    gyro_range: float = math.radians(2000.0)
    accel_range: float = 24.0 * GRAVITY

    def __post_init__(self) -> None:
        require_non_negative(beta=self.beta)
        require_positive(gyro_range=self.gyro_range, accel_range=self.accel_range)


def madgwick_step(
    q: Quaternion, gyro: Sequence[float], accel: Sequence[float], beta: float, dt: float
) -> Quaternion:
    """Moves an orientation on by one sample.

    The rate of the quaternion is that of the gyro less `beta` along the normalised gradient of
    |f|^2, f being the predicted direction of gravity less the measured one. Plain floats: on four
    numbers they are ten times as fast as arrays.

    Source: S. Madgwick, "An efficient orientation filter for inertial and inertial/magnetic sensor
    arrays", 2010, equations 12, 25, 26, 33 and 34.

    Args:
        q: w, x, y, z of the sensor in the earth's frame, z up; of unit norm.
        gyro: (3,) rad/s, in the sensor.
        accel: (3,) specific force, +g upward at rest, of any unit; zeros: the gyro alone.
        beta: gain, rad/s of half an angle.
        dt: time from this sample to the next, s.

    Returns:
        The orientation, of unit norm.
    """
    w, x, y, z = q
    p, r, s = gyro
    ax, ay, az = accel
    half = 0.5 * dt
    dw = -half * (x * p + y * r + z * s)
    dx = half * (w * p + y * s - z * r)
    dy = half * (w * r - x * s + z * p)
    dz = half * (w * s + x * r - y * p)
    norm = math.sqrt(ax * ax + ay * ay + az * az)
    if norm > 0.0:
        fx = 2.0 * (x * z - w * y) - ax / norm
        fy = 2.0 * (w * x + y * z) - ay / norm
        fz = 1.0 - 2.0 * (x * x + y * y) - az / norm
        gw = x * fy - y * fx
        gx = z * fx + w * fy - 2.0 * x * fz
        gy = z * fy - w * fx - 2.0 * y * fz
        gz = x * fx + y * fy
        norm = math.sqrt(gw * gw + gx * gx + gy * gy + gz * gz)
        if norm > 0.0:
            pull = beta * dt / norm
            dw -= pull * gw
            dx -= pull * gx
            dy -= pull * gy
            dz -= pull * gz
    w += dw
    x += dx
    y += dy
    z += dz
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    return w / norm, x / norm, y / norm, z / norm


def tilt_of(accel: Sequence[float]) -> Quaternion:
    """Returns the orientation of a sensor at rest: the shortest turn from upright.

    Args:
        accel: (3,) what it measures, of any unit, not zeros.

    Returns:
        w, x, y, z of the sensor in the earth's frame, z up; upside down, half a turn about x.
    """
    x, y, z = accel
    w = z + math.hypot(x, y, z)
    norm = math.hypot(w, x, y)
    return (w / norm, y / norm, -x / norm, 0.0) if norm > 0.0 else (0.0, 1.0, 0.0, 0.0)


def _within(vector: Sequence[float], limit: float) -> bool:
    x, y, z = vector
    return abs(x) <= limit and abs(y) <= limit and abs(z) <= limit  # NaN is not


class Madgwick(LeafSystem):
    """Estimates the orientation of an inertial sensor, but for its heading, which drifts.

    .. pydrake_system::

        name: Madgwick
        input_ports:
        - imu
        output_ports:
        - orientation
        - health

    Args:
        parameters: gain and ranges.
        rate: of the samples, Hz.

    Ports:
        imu (input, vector of 6): [gyro (rad/s), accel (m/s^2)] in the sensor's axes. A rate that is
            not finite or beyond its range is no rate: the orientation is held. A force that is not
            finite, beyond its range or zero has no direction: the gyro goes on alone.
        orientation (output, vector of 4): unit quaternion w, x, y, z of the sensor in an earth
            frame with z up, at `rate`; each sample counts when the next one is taken. Identity
            before the first good one.
        health (output, Health): samples with a bad gyro (`bad_gyro`) and with a bad accelerometer
            (`bad_accel`).

    Source: [SNAIL] algorithm 3, which is Madgwick's filter without magnetometer. Madgwick's own
    program starts upright; ours from the first accelerometer sample, unless told not to: of a
    sensor that hangs upside down the error shrinks only as exp(beta t / 2) at first, and not at all
    when it hangs exactly so.

    How fast it pulls depends on where the sensor lies, since Madgwick's gradient does not stay on
    the unit sphere and what the normalisation takes away does not turn: a small error of tilt
    shrinks by 2 beta when the sensor is upright or upside down, by 1.41 beta to 2 beta when it lies
    on its side. No correction turns it about the vertical. Where there is no error left it dithers
    by 2 beta / rate.

    Raises:
        ValueError: rate out of range.
    """

    def __init__(
        self, *, parameters: MadgwickParameters | None = None, rate: float = 300.0
    ) -> None:
        super().__init__()
        require_positive(rate=rate)
        p = parameters or MadgwickParameters()
        self._parameters = p
        self._dt = period(rate)
        self._imu_input = self.DeclareVectorInputPort("imu", 6)
        self._orientation = self.DeclareDiscreteState(list(IDENTITY))
        self._started = self.DeclareDiscreteState([float(not p.start_from_accelerometer)])
        self.DeclarePeriodicDiscreteUpdateEvent(self._dt, 0.0, self._step)
        self._orientation_output = self.DeclareStateOutputPort("orientation", self._orientation)
        self._counts = Counts(self, "bad_gyro", "bad_accel")

    def imu_input_port(self) -> InputPort:
        """Returns the port of the sensor's samples."""
        return self._imu_input

    def orientation_output_port(self) -> OutputPort:
        """Returns the port of the orientation."""
        return self._orientation_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    def _step(self, context: Context, discrete_state: DiscreteValues) -> None:
        if context.get_time() < self._dt / 2:
            return  # the sensor takes its first sample in this very moment
        sample = self._imu_input.Eval(context).tolist()
        gyro, accel = sample[:3], sample[3:]
        p = self._parameters
        bad_gyro = not _within(gyro, p.gyro_range)
        bad_accel = not (_within(accel, p.accel_range) and any(accel))
        if bad_gyro or bad_accel:
            self._counts.add(context, discrete_state, bad_gyro=bad_gyro, bad_accel=bad_accel)
        q = context.get_discrete_state(self._orientation).get_value().tolist()
        beta = p.beta
        if not context.get_discrete_state(self._started).get_value()[0]:
            if bad_accel:
                return
            q = tilt_of(accel)
            beta = 0.0  # this sample has given what it has to give
            discrete_state.set_value(self._started, [1.0])
        if not bad_gyro:
            force = (0.0, 0.0, 0.0) if bad_accel else accel
            q = madgwick_step(q, gyro, force, beta, self._dt)
        discrete_state.set_value(self._orientation, q)
