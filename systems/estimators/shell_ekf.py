"""An error-state Kalman filter of the pose on a shell that learns what is wrong with its sensors.

The model is in `shell_model`, the gyro's memory in `rate_trail`, and the numbers are in
`shell_ekf_parameters`; here is the block.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.estimators.rate_trail import WIDTH, RateTrail, rows_for
from systems.estimators.shell_ekf_parameters import ShellEkfParameters
from systems.estimators.shell_model import (
    BIAS,
    DELAY,
    MOUNTING,
    SCALE,
    SIZE,
    THETA,
    ShellModel,
    State,
    Turn,
    marker_slice,
)
from systems.flow.shell import ShellView
from systems.health import Counts
from systems.markers.layout import MarkerMap
from systems.markers.pnp import rotation_from_vector
from systems.messages import PoseEstimate, RotationIncrement
from systems.noise import sample_index
from systems.shell.angles import angles_of, nearest_rotation, rotation, rotation_vector
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

REASONS = (
    "accepted", "gated", "unconfirmed", "ambiguous", "bad_marker_pose", "stale", "future",
    "restarted", "flow_accepted", "flow_gated", "bad_flow", "stale_flow", "bad_imu",
    "bad_reference",
)  # fmt: skip

_SAME_TIME = 1e-6  # s
_WAIT = 0.1  # s; a marker pose so far ahead of the flow is carried back rather than waited for
_CALIBRATION = np.r_[BIAS, MOUNTING, SCALE, DELAY]
_NOTHING = np.full(11, np.nan)  # no refused pose

# The memory: time of the state, stamps of the last increment and of the last marker pose; then the
# IMU's last sample and for how long it has not changed; then what the gyro is believed to tell now.
_TIME, _FLOW_STAMP, _MARKER_STAMP = 0, 1, 2
_SAMPLE, _UNCHANGED, _RATE = slice(3, 9), 9, slice(10, 13)


@dataclass
class _Now:
    """What one step works on."""

    t: float
    k: int
    state: State
    memory: Array
    trail: RateTrail
    refused: Array
    counts: Counter[str]
    nis: float = math.nan


class ShellEkf(LeafSystem):
    """Estimates the pose on a shell from gyro, flow and marker poses, and calibrates them.

    .. pydrake_system::

        name: ShellEkf
        input_ports:
        - marker_pose
        - increment
        - imu
        - reference_velocity
        output_ports:
        - pose
        - angles
        - covariance
        - calibration
        - nis
        - health

    Args:
        view: the camera as planned, and its place over the shell.
        marker_map: the markers as planned, in shell.
        height: of base_link's origin over the shell, m; it is held.
        parameters: noise and options.
        rate: of the IMU and of the filter, Hz.

    Ports:
        marker_pose (input, PoseEstimate): `X_RB` by the map and the planned mounting; used once for
            each stamp, up to `horizon` late. Ambiguous ones are not used.
        increment (input, RotationIncrement): the body's turn over the shell between two pictures,
            in base_link, by the flow; used once for each stamp, in their order.
        imu (input, vector of 6): [gyro (rad/s), accel (m/s^2)] in base_link; the accelerometer is
            not used. In place of a gyro that is not finite, out of range, or has not changed for
            `imu_silence`, the body goes on as it went until the flow tells.
        reference_velocity (input, vector of 6): of the shell's frame in the world, told in the
            shell's frame, rotation first (rad/s, m/s); only the rotation matters to a gyro. May be
            left unconnected: it stands. While it is not finite it counts as standing.
        pose (output, RigidTransform): `X_RB` of base_link in shell, now: that of the last picture
            carried on by the gyro. The rotation is that of the body as it rocks; the place is on
            the shell's normal that it rocks about.
        angles (output, vector of 3): its [roll, pitch, yaw], rad.
        covariance (output, vector of 36): (6, 6) of the pose, row by row: rotation first, a small
            rotation vector in shell (rad), then the position (m); none along the normal.
        calibration (output, vector of 18): the gyro's bias (3, rad/s), the camera's mounting (3, a
            rotation vector in base_link by which it is turned from the planned one, rad), the
            flow's scale errors (over the shell, and of turns about the normal), the pictures' delay
            beyond their stamps on the IMU's clock (s); then the standard deviations of these nine.
        nis (output, vector of 2): of the last marker pose that was compared, the squared
            Mahalanobis distance by degrees of freedom (1 on average if all is right), refused ones
            included; and how many there were. [NaN, 0] before the first.
        health (output, Health): marker poses accepted, refused by the gate, kept to confirm the
            start, refused as ambiguous, as bad, as too late or from the future; how often it began
            anew; increments accepted, refused by
            the gate, as bad, as too late; IMU samples and reference velocities not used.

    The state is that of the last picture, found on the IMU's clock by the estimated delay. Gravity
    is not used: an accelerometer's bias of up to 20 mg is 1.1 degrees of tilt, more than flow and
    gyro with their errors known lose in a quarter of the routine, and the shell's own tilt would be
    one more unknown. The filter starts with the second of two poses that agree, as a single one may
    be wrong. A pose that does not fit is refused; what starts the filter wrongly nevertheless is
    found out when two refused poses of different markers agree.

    Source: error state and left-multiplied rotation errors: Sola, "Quaternion kinematics for the
    error-state Kalman filter", arXiv:1711.02508, 2017. Camera mounting and delay as states: Li,
    Mourikis, "Online temporal calibration for camera-IMU systems", IJRR 33, 2014. Filtering in the
    pictures' past and carrying on to now is common in autopilots.

    Raises:
        ValueError: height, rate or map out of range.
    """

    def __init__(
        self,
        *,
        view: ShellView,
        marker_map: MarkerMap,
        height: float = 0.0,
        parameters: ShellEkfParameters | None = None,
        rate: float = 300.0,
    ) -> None:
        super().__init__()
        require_positive(rate=rate)
        require_non_negative(height=height)
        self._parameters = p = parameters or ShellEkfParameters()
        self._rate = rate
        markers = list(marker_map)
        require(bool(markers), "marker_map", marker_map.markers, "at least one marker")
        self._ids = [marker.id for marker in markers]
        places = np.array([marker.X_WM.translation() for marker in markers])
        self._directions = places / np.linalg.norm(places, axis=1, keepdims=True)
        self._model = ShellModel(view=view, height=height, noise=p.process_noise())
        self._floor = np.diag(
            np.repeat([p.marker_rotation_noise**2, p.marker_position_noise**2], 3)
        )
        self._marker_pose_input = self.DeclareAbstractInputPort(
            "marker_pose", AbstractValue.Make(PoseEstimate())
        )
        self._increment_input = self.DeclareAbstractInputPort(
            "increment", AbstractValue.Make(RotationIncrement())
        )
        self._imu_input = self.DeclareVectorInputPort("imu", 6)
        self._reference_input = self.DeclareVectorInputPort("reference_velocity", 6)
        n = SIZE + 3 * len(markers)
        self._R = self.DeclareDiscreteState(rotation(np.array(p.initial_angles)).ravel())
        self._x = self.DeclareDiscreteState(n)
        self._P = self.DeclareDiscreteState(p.initial_covariance(len(markers)).ravel())
        memory = np.zeros(13)
        memory[: _SAMPLE.stop] = np.nan
        self._memory = self.DeclareDiscreteState(memory)
        rows = rows_for(2 * p.horizon + _WAIT, rate)
        self._trail = self.DeclareDiscreteState(np.full(rows * WIDTH, np.nan))
        self._refused = self.DeclareDiscreteState(_NOTHING)
        self._nis = self.DeclareDiscreteState([np.nan, 0.0])
        self.DeclarePeriodicDiscreteUpdateEvent(1.0 / rate, 0.0, self._step)
        ticket = {self.time_ticket(), self.xd_ticket()}
        self._pose_output = self.DeclareAbstractOutputPort(
            "pose", lambda: AbstractValue.Make(RigidTransform()), self._calc_pose, ticket
        )
        self._angles_output = self.DeclareVectorOutputPort("angles", 3, self._calc_angles, ticket)
        self._covariance_output = self.DeclareVectorOutputPort(
            "covariance", 36, self._calc_covariance, ticket
        )
        self._calibration_output = self.DeclareVectorOutputPort(
            "calibration",
            2 * len(_CALIBRATION),
            lambda context, output: output.SetFromVector(self._learned(context, _CALIBRATION)),
            {self.discrete_state_ticket(self._x), self.discrete_state_ticket(self._P)},
        )
        self._nis_output = self.DeclareStateOutputPort("nis", self._nis)
        self._counts = Counts(self, *REASONS)

    def marker_pose_input_port(self) -> InputPort:
        """Returns the port of the poses from markers."""
        return self._marker_pose_input

    def increment_input_port(self) -> InputPort:
        """Returns the port of the flow's increments."""
        return self._increment_input

    def imu_input_port(self) -> InputPort:
        """Returns the port of the IMU samples."""
        return self._imu_input

    def reference_velocity_input_port(self) -> InputPort:
        """Returns the port of the reference robot's known motion."""
        return self._reference_input

    def pose_output_port(self) -> OutputPort:
        """Returns the port of the pose."""
        return self._pose_output

    def angles_output_port(self) -> OutputPort:
        """Returns the port of roll, pitch and yaw."""
        return self._angles_output

    def covariance_output_port(self) -> OutputPort:
        """Returns the port of the covariance."""
        return self._covariance_output

    def calibration_output_port(self) -> OutputPort:
        """Returns the port of what has been learned of the sensors."""
        return self._calibration_output

    def nis_output_port(self) -> OutputPort:
        """Returns the port of the last innovation and the number of them."""
        return self._nis_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    def placement(self, context: Context) -> dict[int, tuple[Array, Array]]:
        """Returns by id how each marker is turned from its place by the map, and how surely.

        Returns:
            Rotation vectors (3,) rad about the shell's centre, in its frame, and the standard
            deviations of their components.
        """
        learned = {}
        for k, marker_id in enumerate(self._ids):
            where = marker_slice(k)
            both = self._learned(context, np.r_[where])
            learned[marker_id] = (both[:3], both[3:])
        return learned

    def _learned(self, context: Context, index: NDArray[np.intp]) -> Array:
        state = self._state(context)
        return np.concatenate([state.x[index], np.sqrt(np.diag(state.P)[index])])

    def _state(self, context: Context) -> State:
        x = context.get_discrete_state(self._x).get_value()
        R = context.get_discrete_state(self._R).get_value().reshape(3, 3)
        return State(R, x, context.get_discrete_state(self._P).get_value().reshape(len(x), -1))

    def _trail_of(self, values: Any) -> RateTrail:
        rows = values.reshape(-1, WIDTH)
        return RateTrail(rows, rate=self._rate, age=self._parameters.imu_age)

    # --- One step ---

    def _step(self, context: Context, discrete_state: DiscreteValues) -> None:
        t = context.get_time()
        now = _Now(
            t=t,
            k=sample_index(t, self._rate),
            state=self._state(context),
            memory=discrete_state.get_mutable_value(self._memory),
            trail=self._trail_of(discrete_state.get_mutable_value(self._trail)),
            refused=discrete_state.get_mutable_value(self._refused),
            counts=Counter(),
        )
        before = now.state
        if math.isnan(now.memory[_TIME]):
            now.memory[_TIME] = t
        self._listen(context, now)
        sensors = self._parameters.sensors
        if "flow" in sensors:
            self._take_increment(self._increment_input.Eval(context), now)
        if "marker" in sensors:
            self._take_marker_pose(self._marker_pose_input.Eval(context), now)
        if t - now.memory[_TIME] > self._parameters.horizon:  # no picture: it goes on
            self._advance(now, t - 0.8 * self._parameters.horizon)
        if now.state is not before:
            discrete_state.set_value(self._R, now.state.R.ravel())
            discrete_state.set_value(self._x, now.state.x)
            discrete_state.set_value(self._P, now.state.P.ravel())
        if not math.isnan(now.nis):
            number = context.get_discrete_state(self._nis)[1]
            discrete_state.set_value(self._nis, [now.nis, number + 1])
        self._counts.add(context, discrete_state, **now.counts)

    def _listen(self, context: Context, now: _Now) -> None:
        """Remembers the rates of this moment."""
        p, memory = self._parameters, now.memory
        reference = np.zeros(3)
        if self._reference_input.HasValue(context):
            told = self._reference_input.Eval(context)[:3]
            if np.isfinite(told).all():
                reference = told
            else:
                now.counts["bad_reference"] += 1
        lost = True
        if "imu" in p.sensors:
            sample = self._imu_input.Eval(context)
            changed = bool((sample != memory[_SAMPLE]).any())
            memory[_UNCHANGED] = 0.0 if changed else memory[_UNCHANGED] + 1.0 / self._rate
            memory[_SAMPLE] = sample
            gyro = sample[:3]
            lost = not (np.abs(gyro) <= p.gyro_range).all() or memory[_UNCHANGED] >= p.imu_silence
            if lost:
                now.counts["bad_imu"] += 1
            else:
                memory[_RATE] = gyro
        now.trail.add(now.k, memory[_RATE], reference, lost)

    def _turn(self, now: _Now, start: float, end: float) -> Turn:
        delay = now.state.x[DELAY]
        return now.trail.between(start - delay, end - delay, now.k)

    def _advance(self, now: _Now, stamp: float, way: Array | None = None) -> Array:
        """Carries the state to the time of a picture; returns what the flow is to see of it."""
        turn = self._turn(now, now.memory[_TIME], stamp)._replace(way=way)
        now.state, u, seen = self._model.predict(now.state, turn)
        now.refused[:9] = (now.refused[:9].reshape(3, 3) @ rotation_from_vector(u)).ravel()
        now.memory[_TIME] = stamp
        return seen

    def _take_increment(self, increment: RotationIncrement, now: _Now) -> None:
        p, memory = self._parameters, now.memory
        if not increment.valid or increment.stamp == memory[_FLOW_STAMP]:
            return
        memory[_FLOW_STAMP] = increment.stamp
        dt = increment.stamp - increment.previous_stamp
        sound = dt > 0 and increment.stamp <= now.t + _SAME_TIME
        sound &= bool(np.isfinite(increment.rotation).all())
        if not (sound and _is_covariance(increment.covariance)):
            now.counts["bad_flow"] += 1
            return
        if increment.previous_stamp < memory[_TIME] - _SAME_TIME:
            now.counts["stale_flow"] += 1
            return
        if increment.previous_stamp > memory[_TIME] + _SAME_TIME:
            self._advance(now, increment.previous_stamp)
        R_before = now.state.R
        turn = self._turn(now, increment.previous_stamp, increment.stamp)
        seen = self._advance(now, increment.stamp, increment.rotation)
        slack = p.flow_floor**2 + p.flow_noise**2 * float(increment.rotation @ increment.rotation)
        # Where the rate changes, what is not known of the delay is mostly noise (`delay_slack`).
        bend = turn.rate_after - turn.rate_before
        slack += (p.delay_slack * float(np.linalg.norm(bend))) ** 2 * now.state.P[DELAY, DELAY]
        update = self._model.update_flow(
            now.state, seen, increment.rotation,
            increment.covariance + slack * np.eye(3), p.flow_gate,
        )  # fmt: skip
        now.counts["flow_accepted" if update.accepted else "flow_gated"] += 1
        if update.accepted:
            now.state = update.state
            # What a silent gyro would tell: how the body went last.
            memory[_RATE] = rotation_vector(R_before.T @ now.state.R) / dt + now.state.x[BIAS]

    def _take_marker_pose(self, told: PoseEstimate, now: _Now) -> None:
        p, memory = self._parameters, now.memory
        if not told.valid or told.stamp == memory[_MARKER_STAMP]:
            return
        memory[_MARKER_STAMP] = told.stamp
        R, place = told.pose.rotation().matrix(), told.pose.translation()
        sound = bool(np.isfinite(R).all() and np.isfinite(place).all() and place.any())
        if not (sound and _is_covariance(told.covariance)):
            now.counts["bad_marker_pose"] += 1
        elif told.stamp > now.t + _SAME_TIME:
            now.counts["future"] += 1
        elif told.stamp < memory[_TIME] - p.horizon:
            now.counts["stale"] += 1
        elif told.ambiguous:
            now.counts["ambiguous"] += 1
        else:
            if told.stamp > memory[_TIME] + (_WAIT if "flow" in p.sensors else 0.0):
                self._advance(now, told.stamp)
            turn = self._turn(now, told.stamp, memory[_TIME])
            R_now = R @ rotation_from_vector(self._model.step(now.state, turn)[0])
            moved = np.kron(np.eye(2), R_now @ R.T)
            place = R_now @ (R.T @ place)
            noise = moved @ told.covariance @ moved.T + self._floor
            noise[3:, 3:] += p.height_noise**2 * np.outer(place, place) / (place @ place)
            self._weigh(now, R_now, place, noise)

    def _weigh(self, now: _Now, R: Array, place: Array, noise: Array) -> None:
        """Takes a marker pose of the state's time, starts from it, or refuses it."""
        p, model = self._parameters, self._model
        marker = int(np.argmax(self._directions @ place))
        unknown = float(np.diag(now.state.P)[THETA].max()) > p.start_beyond**2
        state = now.state
        if unknown and not self._agrees_with_refused(now, R):
            now.counts["unconfirmed"] += 1
            now.refused[:] = [*R.ravel(), marker, now.memory[_TIME]]
            return
        if unknown:
            state = model.start(state, R, marker, p.initial_deviation**2)
        update = model.update_marker(state, marker, R, place, noise, p.marker_gate)
        now.nis = update.nis
        another = now.refused[9] != marker
        if not update.accepted and another and self._agrees_with_refused(now, R):
            now.counts["restarted"] += 1
            fresh = State(R, np.zeros_like(state.x), p.initial_covariance(len(self._ids)))
            state = model.start(fresh, R, marker, p.initial_deviation**2)
            update = model.update_marker(state, marker, R, place, noise, p.marker_gate)
        now.counts["accepted" if update.accepted else "gated"] += 1
        if update.accepted:
            now.state = update.state
            now.refused[:] = np.nan
        elif another:
            now.refused[:] = [*R.ravel(), marker, now.memory[_TIME]]

    def _agrees_with_refused(self, now: _Now, R: Array) -> bool:
        before = now.refused[:9].reshape(3, 3)
        if math.isnan(now.refused[9]):
            return False
        angle = np.linalg.norm(rotation_vector(R @ before.T))
        return bool(angle < self._parameters.recovery_angle)

    # --- Outputs ---

    def _ahead(self, context: Context) -> tuple[State, Array]:
        """Returns the state now, and the covariance (SIZE, SIZE) of all but the markers."""
        state = self._state(context)
        state = State(state.R, state.x[:SIZE], state.P[:SIZE, :SIZE])
        start = context.get_discrete_state(self._memory)[_TIME]
        if math.isnan(start):
            return state, state.P
        trail = self._trail_of(context.get_discrete_state(self._trail).get_value())
        newest = trail.newest()
        turn = trail.between(start - state.x[DELAY], context.get_time(), newest)
        # Only the beginning of this interval is uncertain.
        turn = turn._replace(rate_after=np.zeros(3))
        ahead, _, _ = self._model.predict(state, turn)
        return ahead, ahead.P

    def _calc_pose(self, context: Context, output: Any) -> None:
        state, _ = self._ahead(context)
        p, _ = self._model.place(state)
        output.set_value(RigidTransform(RotationMatrix(nearest_rotation(state.R)), p))

    def _calc_angles(self, context: Context, output: Any) -> None:
        output.SetFromVector(angles_of(self._ahead(context)[0].R))

    def _calc_covariance(self, context: Context, output: Any) -> None:
        state, P = self._ahead(context)
        _, by_state = self._model.place(state)
        H = np.vstack([np.eye(3, SIZE), by_state])
        output.SetFromVector((H @ P @ H.T).ravel())


def _is_covariance(P: Array) -> bool:
    """Whether a matrix is finite, symmetric and not negative, and not all zeros."""
    if not (np.isfinite(P).all() and P.any()):
        return False
    least, *_, most = np.linalg.eigvalsh((P + P.T) / 2).tolist()
    return bool(least >= -1e-9 * most and np.abs(P - P.T).max() <= 1e-6 * most)
