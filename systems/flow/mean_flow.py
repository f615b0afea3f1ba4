"""Speed over a shell by the mean of the flow and the scale of a pinhole camera: the plain way."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.flow.shell import ShellView
from systems.health import Counts
from systems.messages import PointMatches
from systems.periods import period
from systems.validation import require_positive

Array = NDArray[np.float64]


def rotational_flow(normalised: Array, w_C: Array) -> Array:
    """Returns how points (n, 2) x/z, y/z move when the camera only turns, 1/s.

    Args:
        normalised: (n, 2).
        w_C: (3,) angular velocity of the camera in its optical frame, rad/s.

    Source: Longuet-Higgins and Prazdny, "The interpretation of a moving retinal image", 1980.
    """
    x, y = normalised[:, 0], normalised[:, 1]
    wx, wy, wz = w_C
    return np.stack(
        [x * y * wx - (1 + x * x) * wy + y * wz, (1 + y * y) * wx - x * y * wy - x * wz], axis=1
    )


def usable(matches: PointMatches, view: ShellView) -> NDArray[np.bool_]:
    """Returns which matches (n,) lie in both pictures."""
    if not matches.previous.shape == matches.current.shape == (len(matches), 2):
        return np.zeros(len(matches), bool)
    return view.inside(matches.previous) & view.inside(matches.current)


def surface_velocity(matches: PointMatches, view: ShellView, w_B: Array | None = None) -> Array:
    """Returns the velocity of a body over the shell.

    Args:
        matches: of two pictures; points that are not in the picture do not count.
        view: the camera and its place.
        w_B: (3,) angular velocity of the body by the gyro, rad/s. Left out, the flow is not
            corrected for rotation: what the shell passes by under the camera's centre is then its
            velocity too, as long as the points lie evenly around the centre.

    Returns:
        (2,) forward and left, m/s, as the shell's surface passes by under the body; zeros when
        there is no match.
    """
    interval = matches.stamp - matches.previous_stamp
    used = usable(matches, view)
    if not used.any() or not interval > 0:
        return np.zeros(2)
    before, after = (view.camera.undistort(p[used]) for p in (matches.previous, matches.current))
    flow = (after - before) / interval
    R_BC = view.X_SC.rotation().matrix()
    height = view.parameters.camera_height
    scale = height
    if w_B is not None:
        flow = flow - rotational_flow((before + after) / 2, w_B @ R_BC)
        # What is left is the camera's own translation, farther from the centre than the surface.
        scale *= view.radius / (view.radius + height)
    mean: Array = R_BC @ [*(-scale * flow.mean(axis=0)), 0.0]
    return mean[:2]


class MeanFlow(LeafSystem):
    """Tells the speed over the shell by the mean of the flow.

    .. pydrake_system::

        name: MeanFlow
        input_ports:
        - matches
        - imu
        output_ports:
        - velocity
        - health

    Args:
        view: the camera and its place over the shell.
        rate: how often new matches are looked at to count bad ones, Hz; at least the camera's.

    Ports:
        matches (input, PointMatches): of two pictures.
        imu (input, vector of 6): [gyro (rad/s), accel (m/s^2)] in B, the present sample. Not
            connected or not finite, the flow is not corrected for rotation.
        velocity (output, vector of 2): forward and left over the shell, in B, m/s; zeros without a
            match.
        health (output, Health): `bad_imu`, matches that met a sample that is not finite;
            `bad_point`, points out of the picture or not finite; `no_flow`, messages without a
            usable match or an interval.

    Every point counts as if it were as far as the surface under the camera: the curvature makes the
    result small by some percent (`systems.flow.sphere_flow` does not). And the gyro feels the
    reference robot's motion too, which this takes for the robot's own.

    Source: Zhang and Lam, "Relative Localization System Design for SnailBot", algorithm 2 and
    section III-C.

    Raises:
        ValueError: rate out of range.
    """

    def __init__(self, *, view: ShellView, rate: float = 60.0) -> None:
        super().__init__()
        require_positive(rate=rate)
        self._view = view
        self._matches_input = self.DeclareAbstractInputPort(
            "matches", AbstractValue.Make(PointMatches())
        )
        self._imu_input = self.DeclareVectorInputPort("imu", 6)
        self._velocity_output = self.DeclareVectorOutputPort(
            "velocity",
            2,
            lambda context, output: output.SetFromVector(self._velocity(context)),
            {self._matches_input.ticket(), self._imu_input.ticket()},
        )
        self._last_stamp = self.DeclareDiscreteState([math.nan])
        self._counts = Counts(self, "bad_imu", "bad_point", "no_flow")
        self.DeclarePeriodicDiscreteUpdateEvent(period(rate), 0.0, self._count)

    def matches_input_port(self) -> InputPort:
        """Returns the port of the matches."""
        return self._matches_input

    def imu_input_port(self) -> InputPort:
        """Returns the port of the gyro."""
        return self._imu_input

    def velocity_output_port(self) -> OutputPort:
        """Returns the port of the velocity."""
        return self._velocity_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    def _gyro(self, context: Context) -> Array | None:
        if not self._imu_input.HasValue(context):
            return None
        w_B: Array = self._imu_input.Eval(context)[:3]
        return w_B

    def _velocity(self, context: Context) -> Array:
        w_B = self._gyro(context)
        if w_B is not None and not np.isfinite(w_B).all():
            w_B = None
        return surface_velocity(self._matches_input.Eval(context), self._view, w_B)

    def _count(self, context: Context, discrete_state: DiscreteValues) -> None:
        matches: PointMatches = self._matches_input.Eval(context)
        last_stamp = context.get_discrete_state(self._last_stamp)[0]
        if math.isnan(matches.stamp) or matches.stamp == last_stamp:
            return
        discrete_state.set_value(self._last_stamp, [matches.stamp])
        w_B = self._gyro(context)
        used = usable(matches, self._view)
        self._counts.add(
            context,
            discrete_state,
            bad_imu=w_B is not None and not np.isfinite(w_B).all(),
            bad_point=int(len(used) - used.sum()),
            no_flow=not (used.any() and matches.stamp > matches.previous_stamp),
        )
