"""The Kalman filter of [NAV] section 4.2: dead reckoning corrected by marker poses, H = I.

[NAV]: Hussein, Lazkani, Saad, Yehia, "Real-time robot navigation with QR-based localization and
lidar obstacle mapping".
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.angles import planar_pose, wrap
from systems.compiled import compiled, in_rows, packed
from systems.health import Counts
from systems.messages import PoseEstimate
from systems.periods import period
from systems.small_matrices import congruence
from systems.validation import require, require_positive

Array = NDArray[np.float64]

# Where x, y and theta stand in the tangent of a spatial pose (rotation first).
_PLANAR = np.array([3, 4, 2])

UNKNOWN = 1e6  # variance of what has not been measured, m^2 and rad^2
REASONS = ("accepted", "gated", "ambiguous", "bad_marker_pose", "bad_imu", "bad_command")


@dataclass
class PlanarKalmanParameters:
    """Noise and options of the filter.

    Attributes:
        speed_noise: random walk of the distance driven against the commanded speed, m/sqrt(s);
            deliberately large, as in [NAV], since nothing measures the wheels.
        heading_noise: random walk of the integrated gyro, rad/sqrt(s).
        measurement_noise: standard deviations [x (m), y (m), theta (rad)] of a marker pose; empty
            takes the covariance that comes with each pose.
        gate: an update whose squared Mahalanobis distance exceeds this is refused; 16.27 is the
            99.9 % bound of chi-square with 3 degrees of freedom.
        rebase: carry a marker's heading correction on, as an offset to the integrated gyro. False
            is the printed form, in which the next prediction sets theta to the integrated gyro
            again.
        ambiguous: what to do with a marker pose that has two solutions: take the one `nearest`
            to the prediction (within the gate), or `reject` it.
    """

    speed_noise: float = 0.05
    heading_noise: float = 0.02
    measurement_noise: list[float] | None = None
    gate: float = 16.27
    rebase: bool = True
    ambiguous: str = "nearest"

    def __post_init__(self) -> None:
        require_positive(
            speed_noise=self.speed_noise, heading_noise=self.heading_noise, gate=self.gate
        )
        noise = self.measurement_noise
        require(
            noise is None or (len(noise) == 3 and min(noise) > 0),
            "measurement_noise",
            noise,
            "three numbers greater than 0, or left out",
        )
        require(
            self.ambiguous in ("nearest", "reject"),
            "ambiguous",
            self.ambiguous,
            "'nearest' or 'reject'",
        )


def predict(
    x: Array, P: Array, v: float, theta: float, dt: float, parameters: PlanarKalmanParameters
) -> tuple[Array, Array]:
    """Dead-reckons one step ([NAV] 4.2).

    x += v dt cos th, y += v dt sin th, th = `theta` (the integrated gyro and its offset);
    P = F P F' + F_n Q F_n'.

    Args:
        x: (3,) [x (m), y (m), theta (rad)].
        P: (3, 3).
        v: commanded speed, m/s.
        theta: the heading that the gyro gives, rad.
        dt: s.
        parameters: noise; without `rebase` theta owes nothing to the last state, and F says so.

    Returns:
        The predicted state and covariance.
    """
    predicted, grown = np.empty(3), np.empty((3, 3))
    q_v, q_theta = parameters.speed_noise**2 * dt, parameters.heading_noise**2 * dt
    kept = 1.0 if parameters.rebase else 0.0
    _predict(packed(x), in_rows(P, 3), v * dt, theta, q_v, q_theta, kept, predicted, grown)
    return predicted, grown


@compiled("void(f8[::1], f8[:,::1], f8, f8, f8, f8, f8, f8[::1], f8[:,::1])")
def _predict(
    x: Array,
    P: Array,
    step: float,
    theta: float,
    q_v: float,
    q_theta: float,
    kept: float,
    predicted: Array,
    grown: Array,
) -> None:
    c, s = math.cos(x[2]), math.sin(x[2])
    F = np.zeros((3, 3))
    F[0, 0], F[0, 2] = 1.0, -step * s
    F[1, 1], F[1, 2] = 1.0, step * c
    F[2, 2] = kept
    congruence(F, P, grown)
    grown[0, 0] += c * q_v * c
    grown[1, 1] += s * q_v * s
    grown[0, 1] += c * q_v * s
    grown[1, 0] += s * q_v * c
    grown[2, 2] += q_theta
    predicted[0], predicted[1] = x[0] + step * c, x[1] + step * s
    predicted[2] = math.pi - (math.pi - theta) % (2 * math.pi)


def mahalanobis(x: Array, P: Array, z: Array, R: Array) -> float:
    """Returns the squared Mahalanobis distance of a measured pose z from the state."""
    y = z - x
    y[2] = wrap(float(y[2]))
    return float(y @ np.linalg.solve(P + R, y))


def update(x: Array, P: Array, z: Array, R: Array) -> tuple[Array, Array]:
    """Corrects the state by a measured pose, H = I ([NAV] 4.2); the angle is wrapped.

    Args:
        x: (3,) state.
        P: (3, 3).
        z: (3,) measured [x, y, theta].
        R: (3, 3) its covariance.

    Returns:
        The corrected state and covariance.
    """
    y = z - x
    y[2] = wrap(float(y[2]))
    K = np.linalg.solve((P + R).T, P.T).T
    corrected = x + K @ y
    corrected[2] = wrap(float(corrected[2]))
    P = (np.eye(3) - K) @ P
    return corrected, (P + P.T) / 2


def _sound(z: Array, R: Array) -> bool:
    """Whether a measurement is finite and has variances; 0 is what many send who have none."""
    return bool(np.isfinite(z).all() and np.isfinite(R).all() and (np.diag(R) > 0).all())


class PlanarKalmanFilter(LeafSystem):
    """Estimates the planar pose from commanded speed, gyro and marker poses.

    .. pydrake_system::

        name: PlanarKalmanFilter
        input_ports:
        - command
        - imu
        - marker_pose
        - marker_alternative
        output_ports:
        - pose
        - covariance
        - health
        - nis

    Args:
        parameters: noise and options.
        rate: rate of the filter, Hz.

    Ports:
        command (input, vector of 2): [v (m/s), omega (rad/s)] as sent to the wheels; omega is not
            used. A value that is not finite counts as v = 0.
        imu (input, vector of 6): [gyro (rad/s), accel (m/s^2)] in base_link; only the yaw rate is
            used. A value that is not finite leaves the heading as it is.
        marker_pose (input, PoseEstimate): `X_WB` from markers, with covariance; used once for each
            stamp.
        marker_alternative (input, PoseEstimate): the second solution of the same picture.
        pose (output, vector of 3): [x (m), y (m), theta (rad)] of base_link in map, at `rate`;
            zeros until the first marker pose.
        covariance (output, vector of 9): (3, 3) of the pose, row by row; 1e6 on the diagonal until
            the first marker pose.
        health (output, Health): marker poses accepted, refused by the gate, refused as ambiguous,
            not finite or without variances; IMU samples and commands not finite.
        nis (output, vector of 2): of the last marker pose that was compared with the estimate, the
            squared Mahalanobis distance by degrees of freedom (1 on average if all is right),
            refused ones included; and how many there were. [NaN, 0] before the first.

    Source: [NAV] 4.2. We differ in that marker poses carry their own covariance (unless
    `measurement_noise` is given), in the offset (`rebase`), and in the start at the first marker.
    """

    def __init__(
        self, *, parameters: PlanarKalmanParameters | None = None, rate: float = 100.0
    ) -> None:
        super().__init__()
        require_positive(rate=rate)
        self._parameters = parameters or PlanarKalmanParameters()
        self._dt = period(rate)
        self._command_input = self.DeclareVectorInputPort("command", 2)
        self._imu_input = self.DeclareVectorInputPort("imu", 6)
        nothing = AbstractValue.Make(PoseEstimate())
        self._marker_pose_input = self.DeclareAbstractInputPort("marker_pose", nothing)
        self._alternative_input = self.DeclareAbstractInputPort("marker_alternative", nothing)
        self._x = self.DeclareDiscreteState(3)
        self._P = self.DeclareDiscreteState((np.eye(3) * UNKNOWN).ravel())
        # The integrated gyro, its offset to theta, the stamp of the last marker pose looked at.
        self._memory = self.DeclareDiscreteState(np.array([0.0, 0.0, np.nan]))
        self.DeclarePeriodicDiscreteUpdateEvent(self._dt, 0.0, self._step)
        self._pose_output = self.DeclareStateOutputPort("pose", self._x)
        self._covariance_output = self.DeclareStateOutputPort("covariance", self._P)
        self._counts = Counts(self, *REASONS)
        self._nis = self.DeclareDiscreteState([np.nan, 0.0])
        self._nis_output = self.DeclareStateOutputPort("nis", self._nis)

    def command_input_port(self) -> InputPort:
        """Returns the port of the command as sent to the wheels."""
        return self._command_input

    def imu_input_port(self) -> InputPort:
        """Returns the port of the IMU samples."""
        return self._imu_input

    def marker_pose_input_port(self) -> InputPort:
        """Returns the port of the poses from markers."""
        return self._marker_pose_input

    def marker_alternative_input_port(self) -> InputPort:
        """Returns the port of the second solutions."""
        return self._alternative_input

    def pose_output_port(self) -> OutputPort:
        """Returns the port of the estimated pose."""
        return self._pose_output

    def covariance_output_port(self) -> OutputPort:
        """Returns the port of the estimate's covariance."""
        return self._covariance_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    def nis_output_port(self) -> OutputPort:
        """Returns the port of the last innovation and the number of them."""
        return self._nis_output

    def _step(self, context: Context, discrete_state: DiscreteValues) -> None:
        x = context.get_discrete_state(self._x).get_value()
        P = context.get_discrete_state(self._P).get_value().reshape(3, 3)
        theta_imu, offset, last_stamp = context.get_discrete_state(self._memory).get_value()
        counts: Counter[str] = Counter()
        # The state is the pose now: measured first, then carried on to the next step.
        marker_pose = self._marker_pose_input.Eval(context)
        if marker_pose.valid and marker_pose.stamp != last_stamp:
            last_stamp = marker_pose.stamp
            alternative = self._alternative_input.Eval(context)
            verdict, x, P, distance = self._correct(x, P, marker_pose, alternative)
            counts[verdict] += 1
            if not math.isnan(distance):
                number = context.get_discrete_state(self._nis)[1]
                discrete_state.set_value(self._nis, [distance / 3, number + 1])
            if verdict == "accepted" and self._parameters.rebase:
                offset = wrap(float(x[2] - theta_imu))
        yaw_rate = self._imu_input.Eval(context)[2]
        if math.isfinite(yaw_rate):
            theta_imu += yaw_rate * self._dt
        else:
            counts["bad_imu"] += 1
        v = self._command_input.Eval(context)[0]
        if not math.isfinite(v):
            counts["bad_command"] += 1
            v = 0.0
        if P[0, 0] < UNKNOWN:
            x, P = predict(x, P, v, theta_imu + offset, self._dt, self._parameters)
        discrete_state.set_value(self._x, x)
        discrete_state.set_value(self._P, P.ravel())
        discrete_state.set_value(self._memory, [theta_imu, offset, last_stamp])
        self._counts.add(context, discrete_state, **counts)

    def _correct(
        self, x: Array, P: Array, marker_pose: PoseEstimate, alternative: PoseEstimate
    ) -> tuple[str, Array, Array, float]:
        """Returns what became of a marker pose, state and covariance after it, and its distance."""
        choices = [marker_pose]
        if marker_pose.ambiguous:
            if self._parameters.ambiguous == "reject":
                return "ambiguous", x, P, math.nan
            if alternative.valid and alternative.stamp == marker_pose.stamp:
                choices.append(alternative)
        measured = [self._measurement(choice) for choice in choices]
        if not all(_sound(z, R) for z, R in measured):
            return "bad_marker_pose", x, P, math.nan
        if P[0, 0] >= UNKNOWN:  # the first one: there is no prediction to choose by
            if marker_pose.ambiguous:
                return "ambiguous", x, P, math.nan
            return "accepted", *measured[0], math.nan
        distances = [mahalanobis(x, P, z, R) for z, R in measured]
        nearest = int(np.argmin(distances))
        if distances[nearest] > self._parameters.gate:
            return "gated", x, P, distances[nearest]
        return "accepted", *update(x, P, *measured[nearest]), distances[nearest]

    def _measurement(self, estimate: PoseEstimate) -> tuple[Array, Array]:
        noise = self._parameters.measurement_noise
        if noise is not None:
            return planar_pose(estimate.pose), np.diag(np.square(noise))
        return planar_pose(estimate.pose), estimate.covariance[np.ix_(_PLANAR, _PLANAR)].copy()
