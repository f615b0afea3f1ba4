"""An error-state Kalman filter of the pose on a shell that learns what is wrong with its sensors.

What it does with a measurement is in `shell_fusion`, the model in `shell_model`, the gyro's memory
in `rate_trail`, and the numbers are in `shell_ekf_parameters`; here is the block.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.estimators.shell_ekf_parameters import ShellEkfParameters
from systems.estimators.shell_fusion import REASONS, Now, ShellFusion
from systems.estimators.shell_model import (
    BIAS,
    DELAY,
    MOUNTING,
    SCALE,
    SIZE,
    State,
    marker_slice,
)
from systems.flow.shell import ShellView
from systems.health import Counts
from systems.markers.layout import MarkerMap
from systems.messages import PoseEstimate, RotationIncrement
from systems.periods import period
from systems.shell.angles import angles_of, rotation
from systems.small_matrices import folded, unfolded
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

_CALIBRATION = np.r_[BIAS, MOUNTING, SCALE, DELAY]
_NO_INCREMENT, _NO_POSE = RotationIncrement(), PoseEstimate()


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
        p = parameters or ShellEkfParameters()
        markers = list(marker_map)
        require(bool(markers), "marker_map", marker_map.markers, "at least one marker")
        self._ids = [marker.id for marker in markers]
        self._fusion = ShellFusion(
            view=view, marker_map=marker_map, height=height, parameters=p, rate=rate
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
        # Its lower half: Drake copies all discrete state at each update.
        self._P = self.DeclareDiscreteState(folded(p.initial_covariance(len(markers))))
        self._memory = self.DeclareDiscreteState(self._fusion.new_memory())
        self._nis = self.DeclareDiscreteState([np.nan, 0.0])
        self.DeclarePeriodicDiscreteUpdateEvent(period(rate), 0.0, self._step)
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
        values = context.get_discrete_state()
        x = values.get_value(self._x)
        P = unfolded(values.get_value(self._P), len(x))
        return State(values.get_value(self._R).reshape(3, 3), x, P)

    def _step(self, context: Context, discrete_state: DiscreteValues) -> None:
        t, fusion, uses = context.get_time(), self._fusion, self._fusion.parameters.sensors
        memory = discrete_state.get_mutable_value(self._memory)
        moves = self._reference_input.HasValue(context)
        bad_imu, bad_reference = fusion.listen(
            t,
            memory,
            self._imu_input.Eval(context) if "imu" in uses else None,
            self._reference_input.Eval(context) if moves else None,
        )
        increment = self._increment_input.Eval(context) if "flow" in uses else _NO_INCREMENT
        told = self._marker_pose_input.Eval(context) if "marker" in uses else _NO_POSE
        news = fusion.has_news(t, memory, increment, told)
        if not (news or bad_imu or bad_reference):
            return
        counts = Counter(bad_imu=bad_imu, bad_reference=bad_reference)
        if news:
            before = self._state(context)
            now = Now(t, before, memory, counts)
            fusion.take(now, increment, told)
            if now.state is not before:
                discrete_state.set_value(self._R, now.state.R.ravel())
                discrete_state.set_value(self._x, now.state.x)
                discrete_state.set_value(self._P, folded(now.state.P))
            if not math.isnan(now.nis):
                number = context.get_discrete_state(self._nis)[1]
                discrete_state.set_value(self._nis, [now.nis, number + 1])
        self._counts.add(context, discrete_state, **counts)

    def _pose(self, context: Context) -> Array:
        values = context.get_discrete_state()
        R, x = values.get_value(self._R).reshape(3, 3), values.get_value(self._x)
        return self._fusion.pose(context.get_time(), R, x, values.get_value(self._memory))

    def _calc_pose(self, context: Context, output: Any) -> None:
        output.set_value(RigidTransform.MakeUnchecked(self._pose(context)))

    def _calc_angles(self, context: Context, output: Any) -> None:
        output.SetFromVector(angles_of(self._pose(context)[:, :3]))

    def _calc_covariance(self, context: Context, output: Any) -> None:
        values = context.get_discrete_state()
        R, x = values.get_value(self._R).reshape(3, 3), values.get_value(self._x)
        P, memory = values.get_value(self._P), values.get_value(self._memory)
        output.SetFromVector(self._fusion.covariance(context.get_time(), R, x, P, memory).ravel())
