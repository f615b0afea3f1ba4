"""The rule-based pose on a shell ([SNAIL] Algorithm 4): markers when seen, else flow and IMU.

[SNAIL]: Zhang, Lam, "Relative Localization System Design for SnailBot: A Modular
Self-reconfigurable Robot".
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.health import Counts
from systems.markers.pnp import cross_matrix, rotation_from_vector
from systems.messages import PoseEstimate
from systems.periods import period
from systems.shell.angles import angles_of, nearest_rotation, rotation, rotation_vector
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

REASONS = ("accepted", "bad_marker_pose", "bad_flow", "bad_orientation", "bad_imu")


@dataclass
class ShellRuleParameters:
    """Options of the rule, and what it says of its own error.

    Attributes:
        roll: between markers the heading turns with the `orientation` of the attitude filter (the
            paper's way), or with the bare `gyro`.
        max_turn_rate: an orientation that turned faster than this has jumped and is not believed,
            rad/s.
        initial_angles: [roll, pitch, yaw] until the first marker, rad.
        initial_deviation: standard deviation of each component of their rotation, rad. The default
            says that nothing is known: it is that of a uniform angle.
        drift: growth of that deviation without a marker, rad/sqrt(s). The rule itself claims none:
            the default is what 2 % of flow scale and 0.3 deg/s of gyro bias leave between two
            markers 39 mm apart at 30 mm/s.
    """

    roll: str = "orientation"
    max_turn_rate: float = 10.0
    initial_angles: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    initial_deviation: float = np.pi / np.sqrt(3)
    drift: float = 0.01

    def __post_init__(self) -> None:
        require(self.roll in ("orientation", "gyro"), "roll", self.roll, "'orientation' or 'gyro'")
        require_positive(max_turn_rate=self.max_turn_rate, initial_deviation=self.initial_deviation)
        require_non_negative(drift=self.drift)
        require(
            len(self.initial_angles) == 3 and bool(np.isfinite(self.initial_angles).all()),
            "initial_angles",
            self.initial_angles,
            "three finite numbers [roll, pitch, yaw] (rad)",
        )


def rolled(R: Array, p: Array, step: Array, turn: float, radius: float) -> tuple[Array, Array]:
    """Returns the pose after a step over the sphere.

    In angles: the step changes pitch and yaw, the turn the roll. As one rotation about the sphere's
    centre it has no gap at the pole.

    Args:
        R: (3, 3) `R_RB`.
        p: (3,) `p_RB`, m; its height over the sphere is kept.
        step: (2,) way of the body over the surface [forward, left], m.
        turn: about the outward normal, rad.
        radius: of the sphere, m.
    """
    moved = nearest_rotation(
        R @ rotation_from_vector(np.array([-step[1] / radius, step[0] / radius, turn]))
    )
    return moved, moved @ R.T @ p


def grown(P: Array, turn_R: Array, p: Array, p_moved: Array, variance: float) -> Array:
    """Returns the covariance after a step: the pose moved about the centre, its rotation drifted.

    Of the error (phi, d) of rotation and position, d - phi x p turns with the body and phi stays;
    then phi takes on noise, which carries the position along.

    Args:
        P: (6, 6), rotation first, in R.
        turn_R: (3, 3) the rotation about the centre, in R.
        p: (3,) `p_RB` before, m.
        p_moved: (3,) after, m.
        variance: of each component of the added rotation, rad^2.
    """
    F = np.eye(6)
    F[3:, :3] = turn_R @ cross_matrix(p) - cross_matrix(p_moved)
    F[3:, 3:] = turn_R
    G = np.vstack([np.eye(3), -cross_matrix(p_moved)])
    P = F @ P @ F.T + variance * G @ G.T
    return (P + P.T) / 2


def turn_about_normal(before: Array, now: Array) -> float:
    """Returns the angle (rad) about the body's z from one orientation to the next.

    Args:
        before: (4,) quaternion w, x, y, z of the body in a frame that does not turn.
        now: (4,).
    """
    step = (
        Quaternion(before / np.linalg.norm(before))
        .inverse()
        .multiply(Quaternion(now / np.linalg.norm(now)))
    )
    return float(rotation_vector(step.rotation())[2])


def _is_rotation(q: Array) -> bool:
    return bool(np.isfinite(q).all() and abs(np.linalg.norm(q) - 1) < 1e-3)


class ShellRule(LeafSystem):
    """Gives the pose by the markers when one is seen, else carries it on by flow and IMU.

    .. pydrake_system::

        name: ShellRule
        input_ports:
        - marker_pose
        - flow
        - orientation
        - imu
        output_ports:
        - pose
        - angles
        - covariance
        - health

    Args:
        radius: of the shell, m.
        height: of base_link's origin over the shell before the first marker, m.
        parameters: options.
        rate: of the rule, Hz.

    Ports:
        marker_pose (input, PoseEstimate): `X_RB` from markers; used once for each stamp, as if it
            told the present. Not finite: dropped.
        flow (input, vector of 2): velocity of the robot over the shell's surface [forward, left],
            m/s, in base_link. Not finite: counts as standing still.
        orientation (input, vector of 4): quaternion w, x, y, z of base_link in a frame that does
            not turn, by the attitude filter; its heading is free. Not finite, not of unit length or
            jumped: the gyro stands in.
        imu (input, vector of 6): [gyro (rad/s), accel (m/s^2)] in base_link; only the rate about
            the normal is used, where the orientation is not. Not finite: no turn.
        pose (output, RigidTransform): `X_RB` of base_link in shell, at `rate`; the parameters'
            initial pose until the first marker.
        angles (output, vector of 3): its [roll, pitch, yaw], rad.
        covariance (output, vector of 36): (6, 6) of the pose, row by row: rotation first, a small
            rotation vector in shell (rad), then the position (m). That of the last marker pose,
            grown by `drift`.
        health (output, Health): marker poses accepted and dropped, other samples dropped.

    Source: [SNAIL] Algorithm 4: pitch and yaw by flow, roll by the IMU. It has no gate, knows no
    delay and does not weigh. We differ in that the steps are rotations, not sums of angles, which
    have no meaning at the pole, and in that roll follows the orientation's change since the last
    marker: by gravity alone it would be unknown on top. The reference robot must not turn.

    Raises:
        ValueError: radius, height or rate out of range.
    """

    def __init__(
        self,
        *,
        radius: float,
        height: float = 0.0,
        parameters: ShellRuleParameters | None = None,
        rate: float = 60.0,
    ) -> None:
        super().__init__()
        require_positive(radius=radius, rate=rate)
        require_non_negative(height=height)
        self._parameters = p = parameters or ShellRuleParameters()
        self._radius = radius
        self._dt = period(rate)
        self._marker_pose_input = self.DeclareAbstractInputPort(
            "marker_pose", AbstractValue.Make(PoseEstimate())
        )
        self._flow_input = self.DeclareVectorInputPort("flow", 2)
        self._orientation_input = self.DeclareVectorInputPort("orientation", 4)
        self._imu_input = self.DeclareVectorInputPort("imu", 6)
        R = rotation(np.array(p.initial_angles))
        position = (radius + height) * R[:, 2]
        # R_RB row by row, then p_RB.
        self._pose = self.DeclareDiscreteState(np.concatenate([R.ravel(), position]))
        initial = grown(np.zeros((6, 6)), np.eye(3), position, position, p.initial_deviation**2)
        self._P = self.DeclareDiscreteState(initial.ravel())
        # The orientation at the last step, then the stamp of the last marker pose looked at.
        self._memory = self.DeclareDiscreteState(np.full(5, np.nan))
        self.DeclarePeriodicDiscreteUpdateEvent(self._dt, 0.0, self._step)
        ticket = {self.discrete_state_ticket(self._pose)}
        self._pose_output = self.DeclareAbstractOutputPort(
            "pose",
            lambda: AbstractValue.Make(RigidTransform()),
            lambda context, output: output.set_value(self._transform(context)),
            ticket,
        )
        self._angles_output = self.DeclareVectorOutputPort(
            "angles",
            3,
            lambda context, output: output.SetFromVector(angles_of(self._rotation(context))),
            ticket,
        )
        self._covariance_output = self.DeclareStateOutputPort("covariance", self._P)
        self._counts = Counts(self, *REASONS)

    def marker_pose_input_port(self) -> InputPort:
        """Returns the port of the poses from markers."""
        return self._marker_pose_input

    def flow_input_port(self) -> InputPort:
        """Returns the port of the velocity over the surface."""
        return self._flow_input

    def orientation_input_port(self) -> InputPort:
        """Returns the port of the attitude filter's quaternion."""
        return self._orientation_input

    def imu_input_port(self) -> InputPort:
        """Returns the port of the IMU samples."""
        return self._imu_input

    def pose_output_port(self) -> OutputPort:
        """Returns the port of the pose."""
        return self._pose_output

    def angles_output_port(self) -> OutputPort:
        """Returns the port of roll, pitch and yaw."""
        return self._angles_output

    def covariance_output_port(self) -> OutputPort:
        """Returns the port of the covariance."""
        return self._covariance_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    def _rotation(self, context: Context) -> Array:
        R: Array = context.get_discrete_state(self._pose).get_value()[:9].reshape(3, 3)
        return R

    def _transform(self, context: Context) -> RigidTransform:
        p = context.get_discrete_state(self._pose).get_value()[9:]
        return RigidTransform(RotationMatrix(self._rotation(context)), p)

    def _step(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = context.get_discrete_state(self._pose).get_value()
        R, p = state[:9].reshape(3, 3), state[9:]
        P = context.get_discrete_state(self._P).get_value().reshape(6, 6)
        memory = context.get_discrete_state(self._memory).get_value()
        counts: Counter[str] = Counter()
        orientation = self._orientation_input.Eval(context)
        seen = self._seen(context, memory[4], counts)
        step, turn = np.zeros(2), 0.0
        if context.get_time() > self._dt / 2:  # else the sensors are about to take their first
            step, turn = self._motion(context, orientation, memory[:4], counts)
        if seen is not None:
            R, p = seen.pose.rotation().matrix(), seen.pose.translation()
            P = seen.covariance
        else:
            R_moved, p_moved = rolled(R, p, step, turn, self._radius)
            variance = self._parameters.drift**2 * self._dt
            P = grown(P, R_moved @ R.T, p, p_moved, variance)
            R, p = R_moved, p_moved
        stamp = self._marker_pose_input.Eval(context).stamp
        discrete_state.set_value(self._pose, np.concatenate([R.ravel(), p]))
        discrete_state.set_value(self._P, P.ravel())
        discrete_state.set_value(self._memory, [*orientation, stamp])
        self._counts.add(context, discrete_state, **counts)

    def _seen(
        self, context: Context, last_stamp: float, counts: Counter[str]
    ) -> PoseEstimate | None:
        """Returns the marker pose if it is a new one that can be used."""
        estimate = self._marker_pose_input.Eval(context)
        if not estimate.valid or estimate.stamp == last_stamp:
            return None
        sound = np.isfinite(estimate.pose.GetAsMatrix34()).all()
        sound &= np.isfinite(estimate.covariance).all()
        counts["accepted" if sound else "bad_marker_pose"] += 1
        return estimate if sound else None

    def _motion(
        self, context: Context, orientation: Array, before: Array, counts: Counter[str]
    ) -> tuple[Array, float]:
        """Returns the way [forward, left] (m) and the turn (rad) since the last step."""
        flow = self._flow_input.Eval(context)
        if not np.isfinite(flow).all():
            counts["bad_flow"] += 1
            flow = np.zeros(2)
        spin = self._imu_input.Eval(context)[2]
        if not np.isfinite(spin):
            counts["bad_imu"] += 1
            spin = 0.0
        turn = float(spin) * self._dt
        if self._parameters.roll == "gyro":
            return flow * self._dt, turn
        if not _is_rotation(orientation):
            counts["bad_orientation"] += 1
        elif _is_rotation(before):
            by_orientation = turn_about_normal(before, orientation)
            if abs(by_orientation) <= self._parameters.max_turn_rate * self._dt:
                turn = by_orientation
            else:
                counts["bad_orientation"] += 1
        return flow * self._dt, turn
