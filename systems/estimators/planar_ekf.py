"""An extended Kalman filter of the planar pose that learns what is wrong with gyro and wheels.

The model is in `planar_model`, what comes late is dealt with in `delayed`, when to begin anew in
`relocation`, and the numbers are in `planar_ekf_parameters`; here is the block.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.angles import planar_pose
from systems.estimators.delayed import WIDTH, Memory, rows_for
from systems.estimators.planar_ekf_parameters import PlanarEkfParameters
from systems.estimators.planar_model import (
    BIAS,
    GYRO_SCALE,
    SCALE,
    SIZE,
    Correction,
    Drive,
    Measurement,
    is_covariance,
    unknown,
)
from systems.estimators.relocation import Agreement, refused
from systems.health import Counts
from systems.messages import PoseEstimate
from systems.noise import sample_index
from systems.periods import period
from systems.validation import require_positive

Array = NDArray[np.float64]

# Where x, y and theta stand in the tangent of a spatial pose (rotation first).
_PLANAR = np.ix_([3, 4, 2], [3, 4, 2])
_SAME_TIME = 1e-6  # s; a stamp this much after now is not from the future

REASONS = (
    "accepted",
    "gated",
    "ambiguous",
    "bad_marker_pose",
    "stale",
    "future",
    "repeated",
    "restarted",
    "bad_imu",
    "bad_command",
    "bad_wheel_speeds",
)


def lagged(value: float, target: float, lag: float, dt: float) -> tuple[float, float]:
    """Follows a target with a first-order lag for one step.

    Args:
        value: at the beginning.
        target: constant over the step.
        lag: time constant, s; 0 follows at once.
        dt: s.

    Returns:
        The value at the end, and its mean over the step.
    """
    if lag == 0.0:
        return target, target
    rest = math.exp(-dt / lag)
    return target + (value - target) * rest, target + (value - target) * lag / dt * (1 - rest)


class PlanarEkf(LeafSystem):
    """Estimates the planar pose from commanded speed, gyro and marker poses that may come late.

    .. pydrake_system::

        name: PlanarEkf
        input_ports:
        - command
        - imu
        - marker_pose
        - marker_alternative
        - wheel_speeds
        output_ports:
        - pose
        - covariance
        - health
        - nis

    Args:
        parameters: noise and options.
        rate: rate of the filter, Hz.

    Ports:
        command (input, vector of 2): [v (m/s), omega (rad/s)] as sent to the wheels; omega bridges
            the gyro's delay and stands in while it fails. One that is not finite counts as zeros.
        imu (input, vector of 6): [gyro (rad/s), accel (m/s^2)] in base_link; only the yaw rate is
            used. In place of one that is not finite or out of range stands omega.
        marker_pose (input, PoseEstimate): `X_WB` from markers, with covariance, at the time of its
            stamp; used once for each stamp, up to `horizon` late and in any order.
        marker_alternative (input, PoseEstimate): the second solution of the same picture.
        wheel_speeds (input, vector of 2): [right, left] (rad/s) by encoders, in place of the
            commanded speed; may be left unconnected. Samples that are not finite are not used.
        pose (output, vector of 3): [x (m), y (m), theta (rad)] of base_link in map, at `rate`;
            zeros until the first marker pose that is not ambiguous.
        covariance (output, vector of 9): (3, 3) of the pose, row by row; 1e6 on the diagonal until
            that marker pose.
        health (output, Health): marker poses accepted (those started from among them), refused by
            the gate, as ambiguous, as not finite or without a covariance, as older than `horizon`,
            from the future, seen before; how often it began anew; IMU samples, commands and wheel
            speeds not used. Each marker pose counts once, when it arrives, though one that comes
            later and is older may change what the filter thinks of it.
        nis (output, vector of 2): of the last marker pose that was compared with the estimate, the
            squared Mahalanobis distance by degrees of freedom (1 on average if all is right),
            refused ones included; and how many there were. [NaN, 0] before the first.

    Source: the textbook filter (Bar-Shalom, Li, Kirubarajan, "Estimation with applications to
    tracking and navigation", 2001, chapter 5: Joseph's form, NEES, NIS). Errors of the odometry as
    states: Martinelli, Tomatis, Siegwart, "Simultaneous localization and odometry self calibration
    for mobile robot", Autonomous Robots 22, 2007. The rest is said in `delayed` and `relocation`.
    """

    def __init__(
        self, *, parameters: PlanarEkfParameters | None = None, rate: float = 100.0
    ) -> None:
        super().__init__()
        require_positive(rate=rate)
        self._parameters = p = parameters or PlanarEkfParameters()
        self._rate = rate
        self._noise = np.array(p.process_noise())
        self._rules = np.array([p.stamp_noise**2, p.squared_gate(), p.ambiguous == "nearest"])
        self._floor = np.diag(np.square(p.measurement_floor))
        self._unknown = unknown(p.gyro_bias_std, p.scale_std, p.gyro_scale_std, p.scale_wander)
        self._gyro_ticks = 1 + round(p.gyro_delay * rate)
        self._command_input = self.DeclareVectorInputPort("command", 2)
        self._imu_input = self.DeclareVectorInputPort("imu", 6)
        nothing = AbstractValue.Make(PoseEstimate())
        self._marker_pose_input = self.DeclareAbstractInputPort("marker_pose", nothing)
        self._alternative_input = self.DeclareAbstractInputPort("marker_alternative", nothing)
        self._wheel_speeds_input = self.DeclareVectorInputPort("wheel_speeds", 2)
        x, P = self._unknown
        self._x = self.DeclareDiscreteState(x)
        self._P = self.DeclareDiscreteState(P.ravel())
        self._memory = self.DeclareDiscreteState(np.full(rows_for(p.horizon, rate) * WIDTH, np.nan))
        self._motors = self.DeclareDiscreteState(2)  # speed and turn rate after the lag
        self._last_stamp = self.DeclareDiscreteState([np.nan])
        self._agreement = self.DeclareDiscreteState(Agreement.to_vector(None))
        self._nis = self.DeclareDiscreteState([np.nan, 0.0])
        self.DeclarePeriodicDiscreteUpdateEvent(period(rate), 0.0, self._step)
        self._pose_output = self.DeclareVectorOutputPort(
            "pose", 3, self._calc_pose, {self.discrete_state_ticket(self._x)}
        )
        self._covariance_output = self.DeclareVectorOutputPort(
            "covariance", 9, self._calc_covariance, {self.discrete_state_ticket(self._P)}
        )
        self._counts = Counts(self, *REASONS)
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

    def wheel_speeds_input_port(self) -> InputPort:
        """Returns the port of the encoders' speeds."""
        return self._wheel_speeds_input

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

    def gyro_bias(self, context: Context) -> tuple[float, float]:
        """Returns the estimated bias of the gyro and its standard deviation, rad/s."""
        return self._learned(context, BIAS)

    def wheel_scale(self, context: Context) -> tuple[float, float]:
        """Returns the estimated true speed by commanded speed, in the mean, and its deviation."""
        return self._learned(context, SCALE)

    def gyro_scale(self, context: Context) -> tuple[float, float]:
        """Returns the estimated true turn by measured turn and its standard deviation."""
        return self._learned(context, GYRO_SCALE)

    def _learned(self, context: Context, i: int) -> tuple[float, float]:
        x = context.get_discrete_state(self._x)
        P = context.get_discrete_state(self._P)
        return float(x[i]), math.sqrt(P[i * SIZE + i])

    def _step(self, context: Context, discrete_state: DiscreteValues) -> None:
        # The state is the pose now. What the inputs say carries it to the next tick.
        k = sample_index(context.get_time(), self._rate)
        counts: Counter[str] = Counter()
        rows = discrete_state.get_mutable_value(self._memory).reshape(-1, WIDTH)
        memory = Memory(rows, self._rate)
        x = discrete_state.get_mutable_value(self._x)
        P = discrete_state.get_mutable_value(self._P).reshape(SIZE, SIZE)
        memory.begin(k, x, P, self._drive(context, discrete_state, counts))
        first = self._measure_yaw_rate(context, memory, k, counts)
        measurement, several = self._arrival(context, discrete_state, memory, k, counts)
        if measurement is None:
            found = memory.replay(first, k, self._noise, self._rules)
        else:
            memory.put(k, measurement)
            first = min(first, memory.tick_of(measurement.stamp), k)
            found = memory.replay(first, k, self._noise, self._rules, look_at=measurement.stamp)
            counts["accepted" if found.verdict == "started" else found.verdict] += 1
            if not math.isnan(found.nis):
                number = context.get_discrete_state(self._nis)[1]
                discrete_state.set_value(self._nis, [found.nis, number + 1])
            if self._must_begin_anew(context, discrete_state, measurement, several, found):
                counts["restarted"] += 1
                memory.forget(*self._unknown)
                memory.put(k, measurement)
                found = memory.replay(first, k, self._noise, self._rules)
        x[:], P[:] = found.x, found.P
        if counts:
            self._counts.add(context, discrete_state, **counts)

    def _drive(
        self, context: Context, discrete_state: DiscreteValues, counts: Counter[str]
    ) -> Drive:
        """Returns speed and expected turn rate over the tick that begins."""
        p, dt = self._parameters, 1.0 / self._rate
        turning = p.yaw_rate_change**2 * dt
        command = self._command_input.Eval(context).tolist()
        variance = 0.0
        if not all(map(math.isfinite, command)):
            counts["bad_command"] += 1
            command, variance = [0.0, 0.0], p.lost_speed_noise**2
        motors = discrete_state.get_mutable_value(self._motors)
        v, omega = motors.tolist()
        motors[0], speed = lagged(v, command[0], p.speed_lag, dt)
        motors[1], turn_rate = lagged(omega, command[1], p.speed_lag, dt)
        if self._wheel_speeds_input.HasValue(context):
            measured = p.wheel_radius * float(np.mean(self._wheel_speeds_input.Eval(context)))
            if math.isfinite(measured):
                return Drive(measured, turn_rate, 0.0, turning)
            counts["bad_wheel_speeds"] += 1
        return Drive(speed, turn_rate, variance, turning)

    def _measure_yaw_rate(
        self, context: Context, memory: Memory, k: int, counts: Counter[str]
    ) -> int:
        """Puts the gyro's sample where it belongs; returns the tick from which things changed."""
        p = self._parameters
        yaw_rate, variance = float(self._imu_input.Eval(context)[2]), 0.0
        if not abs(yaw_rate) <= p.gyro_range:
            counts["bad_imu"] += 1
            yaw_rate, variance = math.nan, p.lost_turn_noise**2
        return memory.measure_yaw_rate(k - self._gyro_ticks, yaw_rate, variance, k)

    def _arrival(
        self,
        context: Context,
        discrete_state: DiscreteValues,
        memory: Memory,
        k: int,
        counts: Counter[str],
    ) -> tuple[Measurement | None, bool]:
        """Returns a new measurement that can be used, and whether it rests on several markers."""
        estimate: PoseEstimate = self._marker_pose_input.Eval(context)
        last_stamp = context.get_discrete_state(self._last_stamp)[0]
        if not estimate.valid or estimate.stamp == last_stamp:
            return None, False
        discrete_state.set_value(self._last_stamp, [estimate.stamp])
        now = context.get_time()
        if not estimate.stamp <= now + _SAME_TIME:
            counts["future"] += 1
        elif now - estimate.stamp > self._parameters.horizon or not memory.reaches(
            min(memory.tick_of(estimate.stamp), k), k
        ):
            counts["stale"] += 1
        elif memory.has_stamp(estimate.stamp):
            counts["repeated"] += 1
        else:
            choices: list[Any] = [estimate]
            alternative: PoseEstimate = self._alternative_input.Eval(context)
            if estimate.ambiguous and alternative.stamp == estimate.stamp:
                choices.append(alternative)
            poses = np.array([planar_pose(choice.pose) for choice in choices])
            covariances = np.array([choice.covariance[_PLANAR] for choice in choices])
            if np.isfinite(poses).all() and all(map(is_covariance, covariances)):
                measurement = Measurement(
                    estimate.stamp, poses, covariances + self._floor, estimate.ambiguous
                )
                return measurement, estimate.markers > 1
            counts["bad_marker_pose"] += 1
        return None, False

    def _must_begin_anew(
        self,
        context: Context,
        discrete_state: DiscreteValues,
        measurement: Measurement,
        several: bool,
        found: Correction,
    ) -> bool:
        """Weighs what became of a measurement; returns whether the estimate has to be given up."""
        p = self._parameters
        if found.verdict == "ambiguous" or (found.verdict == "gated" and measurement.ambiguous):
            return False
        before = Agreement.from_vector(context.get_discrete_state(self._agreement).get_value())
        after = None
        if found.verdict == "gated":
            after = refused(
                before,
                stamp=measurement.stamp,
                x=found.x_before[:3],
                P=found.P_before[:3, :3],
                z=measurement.poses[0],
                R=measurement.covariances[0],
                several=several,
                gate=p.squared_gate(),
                longest_gap=p.horizon,
            )
            if after.several >= p.recovery_time or after.all >= p.recovery_time_single:
                discrete_state.set_value(self._agreement, Agreement.to_vector(None))
                return True
        elif before is None:
            return False
        discrete_state.set_value(self._agreement, Agreement.to_vector(after))
        return False

    def _calc_pose(self, context: Context, output: Any) -> None:
        output.SetFromVector(context.get_discrete_state(self._x).get_value()[:3])

    def _calc_covariance(self, context: Context, output: Any) -> None:
        P = context.get_discrete_state(self._P).get_value().reshape(SIZE, SIZE)
        output.SetFromVector(P[:3, :3].ravel())
