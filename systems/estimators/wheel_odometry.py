"""Where a robot with two driven sides is by its wheels alone: odometry, and its calibration."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.angles import wrap
from systems.health import Counts
from systems.periods import period
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]


@dataclass
class WheelOdometryParameters:
    """How far odometry is to be trusted: random walks by what was driven.

    Attributes:
        distance_noise: of the way, m by the root of a metre.
        turn_noise: of the heading by turning, rad by the root of a radian.
        drift_noise: of the heading by driving, rad by the root of a metre.
    """

    distance_noise: float = 0.02
    turn_noise: float = 0.03
    drift_noise: float = 0.01

    def __post_init__(self) -> None:
        require_non_negative(**vars(self))


def moved(pose: Array, way: float, turn: float) -> Array:
    """Returns the pose [x (m), y (m), theta (rad)] after an arc of length `way` that turns.

    Args:
        pose: (3,) before it.
        way: of base_link, m.
        turn: rad.
    """
    chord = way * np.sinc(turn / (2 * np.pi))
    direction = pose[2] + turn / 2
    return np.array(
        [
            pose[0] + chord * math.cos(direction),
            pose[1] + chord * math.sin(direction),
            wrap(float(pose[2] + turn)),
        ]
    )


def moved_covariance(
    covariance: Array, heading: float, way: float, turn: float, p: WheelOdometryParameters
) -> Array:
    """Returns the covariance (3, 3) of the pose after such an arc.

    Args:
        covariance: (3, 3) before it, of [x, y, theta].
        heading: before it, rad.
        way: m.
        turn: rad.
        p: of the noise.
    """
    direction = heading + turn / 2
    c, s = math.cos(direction), math.sin(direction)
    F = np.array([[1.0, 0.0, -way * s], [0.0, 1.0, way * c], [0.0, 0.0, 1.0]])
    G = np.array([[c, -way * s / 2], [s, way * c / 2], [0.0, 1.0]])
    variances = np.array(
        [
            p.distance_noise**2 * abs(way),
            p.turn_noise**2 * abs(turn) + p.drift_noise**2 * abs(way),
        ]
    )
    grown: Array = F @ covariance @ F.T + (G * variances) @ G.T
    return grown


def effective_track(differences: ArrayLike, turns: ArrayLike, wheel_radius: float) -> float:
    """Returns the track that fits a calibration best, m, by least squares.

    Turn the robot in place some times and compare what the wheels did to what an independent
    measurement (a camera, a wall) says of the heading.

    Args:
        differences: (n,) of the wheels' angles, right less left, of each run, rad.
        turns: (n,) of the robot in each run, rad, not wrapped.
        wheel_radius: m.

    Raises:
        ValueError: nothing turned, or the wheels turned against the robot.
    """
    d, theta = np.asarray(differences, float), np.asarray(turns, float)
    squares = float(theta @ theta)
    require(squares > 0, "turns", theta.tolist(), "other than 0 somewhere")
    track = wheel_radius * float(d @ theta) / squares
    require(track > 0, "differences", d.tolist(), "of the turns' sign: right less left")
    return track


class WheelOdometry(LeafSystem):
    """Integrates the counts of two sides' encoders to a pose in the frame `odom`.

    .. pydrake_system::

        name: WheelOdometry
        input_ports:
        - ticks
        output_ports:
        - pose
        - covariance
        - velocity
        - health

    Args:
        ticks_per_turn: of a wheel.
        wheel_radius: m.
        track: distance of two wheels that would turn the robot alike without slip, m: the
            effective one of a skid-steered robot (see `effective_track`).
        rate: how often the counts are read, Hz; the encoders'.
        max_speed: faster than this no wheel turns, rad/s: a counter that leaps has been reset.
        parameters: of the noise.

    Ports:
        ticks (input, vector of 2): counts [right, left]. Not finite: dropped and counted; the next
            ones make up for it.
        pose (output, vector of 3): [x (m), y (m), theta (rad)] of base_link in `odom`, which is
            where base_link was at the first reading; theta in (-pi, pi]; at `rate`.
        covariance (output, vector of 9): of the pose, (3, 3) row by row.
        velocity (output, vector of 2): [v (m/s), omega (rad/s)] from the last reading to this one.
        health (output, Health): `bad_ticks`, counts that were not finite; `leap`, counts that were
            too far from those before, which are taken for no motion.

    Raises:
        ValueError: an argument out of range.
    """

    def __init__(
        self,
        *,
        ticks_per_turn: float,
        wheel_radius: float,
        track: float,
        rate: float = 50.0,
        max_speed: float = 100.0,
        parameters: WheelOdometryParameters | None = None,
    ) -> None:
        super().__init__()
        require_positive(
            ticks_per_turn=ticks_per_turn,
            wheel_radius=wheel_radius,
            track=track,
            rate=rate,
            max_speed=max_speed,
        )
        self._parameters = parameters or WheelOdometryParameters()
        self._way_per_tick = 2 * math.pi * wheel_radius / ticks_per_turn
        self._track = track
        self._rate = rate
        self._most = max_speed / rate * ticks_per_turn / (2 * math.pi)
        self._ticks_input = self.DeclareVectorInputPort("ticks", 2)
        self._last = self.DeclareDiscreteState([math.nan, math.nan, math.nan])  # ticks, their time
        self._pose = self.DeclareDiscreteState(3)
        self._covariance = self.DeclareDiscreteState(9)
        self._velocity = self.DeclareDiscreteState(2)
        self.DeclarePeriodicDiscreteUpdateEvent(period(rate), 0.0, self._read)
        self._pose_output = self.DeclareStateOutputPort("pose", self._pose)
        self._covariance_output = self.DeclareStateOutputPort("covariance", self._covariance)
        self._velocity_output = self.DeclareStateOutputPort("velocity", self._velocity)
        self._counts = Counts(self, "bad_ticks", "leap")

    def ticks_input_port(self) -> InputPort:
        """Returns the port of the counts."""
        return self._ticks_input

    def pose_output_port(self) -> OutputPort:
        """Returns the port of the pose."""
        return self._pose_output

    def covariance_output_port(self) -> OutputPort:
        """Returns the port of the covariance."""
        return self._covariance_output

    def velocity_output_port(self) -> OutputPort:
        """Returns the port of the velocity."""
        return self._velocity_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of what was dropped."""
        return self._counts.output_port

    def _read(self, context: Context, discrete_state: DiscreteValues) -> None:
        ticks, t = self._ticks_input.Eval(context), context.get_time()
        if not np.isfinite(ticks).all():
            self._counts.add(context, discrete_state, bad_ticks=1)
            return
        last: Any = context.get_discrete_state(self._last).get_value()
        discrete_state.set_value(self._last, np.array([*ticks, t]))
        if math.isnan(last[2]):
            return
        steps = (t - last[2]) * self._rate  # more than one after readings that were dropped
        if (np.abs(ticks - last[:2]) > self._most * max(steps, 1.0)).any():
            self._counts.add(context, discrete_state, leap=1)
            return
        right, left = self._way_per_tick * (ticks - last[:2])
        way, turn = (right + left) / 2, (right - left) / self._track
        pose = context.get_discrete_state(self._pose).get_value()
        covariance = context.get_discrete_state(self._covariance).get_value().reshape(3, 3)
        grown = moved_covariance(covariance, pose[2], way, turn, self._parameters)
        discrete_state.set_value(self._pose, moved(pose, way, turn))
        discrete_state.set_value(self._covariance, grown.ravel())
        discrete_state.set_value(self._velocity, np.array([way, turn]) / (t - last[2]))
