"""Driving along great circles of a sphere: legs, guidance along one, and a route of many.

[SNAIL]: Zhang, Lam, "Relative Localization System Design for SnailBot: A Modular
Self-reconfigurable Robot".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import (
    Context,
    DiscreteValues,
    InputPort,
    LeafSystem,
    OutputPort,
    ValueProducer,
)

from systems.angles import wrap
from systems.periods import period
from systems.shell.angles import rotation
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]


@dataclass
class ShellRouteParameters:
    """Speeds and gains of the route's controller.

    Attributes:
        speed: along a leg, m/s.
        min_speed: at a leg's end, m/s.
        k_speed: speed by the distance to the end of the leg, 1/s.
        k_heading: turning rate by the error of heading, 1/s. From 4 speed / lookahead on it does
            not shoot over the circle (the linearised law is then critically damped).
        lookahead: how far ahead on the great circle the robot aims, m.
        max_turn_rate: rad/s.
        turn_in_place_beyond: no driving while the error of heading exceeds this, rad.
        position_tolerance: a leg has been driven when so much is left, m.
        heading_tolerance: a leg of no length is done at this error of heading, rad.
    """

    speed: float = 0.03
    min_speed: float = 0.003
    k_speed: float = 3.0
    k_heading: float = 4.0
    lookahead: float = 0.03
    max_turn_rate: float = 1.0
    turn_in_place_beyond: float = math.radians(20.0)
    position_tolerance: float = 0.0003
    heading_tolerance: float = math.radians(0.5)

    def __post_init__(self) -> None:
        require_positive(**vars(self))
        require(
            self.min_speed <= self.speed,
            "min_speed",
            self.min_speed,
            f"at most speed = {self.speed:g} m/s",
        )


@dataclass(frozen=True)
class Leg:
    """A piece of a great circle, driven forward.

    Attributes:
        roll: heading at its start, rad.
        pitch: of its start, rad.
        yaw: of its start, rad.
        arc: its length as an angle, rad; 0 is a turn to that heading on the spot.
    """

    roll: float
    pitch: float
    yaw: float
    arc: float

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            require(math.isfinite(value), name, value, "finite")
        require_non_negative(arc=self.arc)

    def frame(self) -> Array:
        """Returns `R_RL` (3, 3): x along the leg at its start, z the normal there."""
        return rotation(np.array([self.roll, self.pitch, self.yaw]))


def routine(iterations: int) -> list[Leg]:
    """Returns the paper's routine ([SNAIL] V-B).

    From yaw 0, pitch 0 over the pole to yaw 180, pitch 0; turn by 90 degrees; along the equator to
    yaw 90 and on to yaw 0; turn back by 90 degrees; and again. (Over the pole roll changes from 0
    to 180; the turns take it to 90, and to 0.)

    Args:
        iterations: how often.
    """
    require(iterations >= 1, "iterations", iterations, "1 or greater")
    over_the_pole = Leg(0.0, 0.0, 0.0, math.pi)
    along_the_equator = Leg(math.pi / 2, 0.0, math.pi, math.pi)
    return [over_the_pole, along_the_equator] * iterations + [Leg(0.0, 0.0, 0.0, 0.0)]


class OnLeg(NamedTuple):
    """Where a robot is with regard to a leg.

    Attributes:
        along: angle from the start, along the great circle, rad in (-pi, pi].
        left: angle by which it is to the left of the circle, rad.
        heading: direction of the leg as seen by the robot, to the left of ahead, rad.
    """

    along: float
    left: float
    heading: float


def on_leg(R_RB: Array, R_RL: Array) -> OnLeg:
    """Returns where the robot is with regard to a leg that starts in frame L.

    At the two poles of the great circle, 90 degrees off it, there is no direction: it is 0.
    """
    # The robot as seen from the start of the leg; its z_B is where it stands.
    (ax, bx, x), (_, _, y), (az, bz, z) = (R_RL.T @ R_RB).tolist()
    # `along` grows in the direction y_L x z_B = (z, 0, -x), which is to be seen from the robot.
    return OnLeg(
        along=math.atan2(x, z),
        left=math.asin(min(max(y, -1.0), 1.0)),
        heading=math.atan2(z * bx - x * bz, z * ax - x * az),
    )


def follow(
    where: OnLeg, remaining: float, radius: float, parameters: ShellRouteParameters
) -> list[float]:
    """Returns [v (m/s), omega (rad/s)] that follows a great circle to its end.

    It aims at the point of the circle that lies `lookahead` ahead of the robot, turns toward it in
    proportion, and drives when it looks there.

    Args:
        where: on the leg.
        remaining: angle to the leg's end, rad.
        radius: of the sphere, m.
        parameters: speeds and gains.
    """
    p = parameters
    error = wrap(where.heading - math.atan(radius * math.tan(where.left) / p.lookahead))
    omega = min(max(p.k_heading * error, -p.max_turn_rate), p.max_turn_rate)
    v = min(max(p.k_speed * remaining * radius, p.min_speed), p.speed)
    return [v * max(0.0, 1.0 - abs(error) / p.turn_in_place_beyond), omega]


class ShellRoute(LeafSystem):
    """Drives a route of great circles over a sphere, on whatever pose it is given.

    .. pydrake_system::

        name: ShellRoute
        input_ports:
        - pose
        output_ports:
        - command
        - progress

    Args:
        legs: one after the other, such as `routine(5)`; each should start where the last one ends.
            The robot turns to each one's heading on the spot.
        radius: of the sphere, m.
        parameters: speeds and gains.
        rate: how often it looks whether a leg is done, Hz.

    Ports:
        pose (input, RigidTransform): `X_RB` of base_link in the sphere's frame, the estimate or the
            truth; only its rotation is used.
        command (output, vector of 2): [v (m/s) over the surface, omega (rad/s) about the outward
            normal], a function of the pose at every moment; zeros at the end of the route.
        progress (output, vector of 2): [index of the leg, angle driven along it (rad)], at `rate`;
            the index is the number of legs when the route is done.

    Source: the routine is [SNAIL] V-B; it does not say by what law its robot was steered. Aiming at
    a point ahead is the line-of-sight guidance of ships, T. I. Fossen, "Handbook of Marine Craft
    Hydrodynamics and Motion Control", 2011, section 10.3, on a circle instead of a line.

    Raises:
        ValueError: no legs, or radius or rate out of range.
    """

    def __init__(
        self,
        *,
        legs: Sequence[Leg],
        radius: float,
        parameters: ShellRouteParameters | None = None,
        rate: float = 60.0,
    ) -> None:
        super().__init__()
        require_positive(radius=radius, rate=rate)
        require(len(legs) > 0, "legs", list(legs), "at least one")
        self._legs = tuple(legs)
        self._frames = [leg.frame() for leg in legs]
        self._radius = radius
        self._parameters = parameters or ShellRouteParameters()
        self._pose_input = self.DeclareAbstractInputPort(
            "pose", AbstractValue.Make(RigidTransform())
        )
        self._progress = self.DeclareDiscreteState([0.0, 0.0])
        self.DeclarePeriodicDiscreteUpdateEvent(period(rate), 0.0, self._advance)
        self._where = self.DeclareCacheEntry(
            "where it is on its way",
            ValueProducer(allocate=lambda: AbstractValue.Make([]), calc=self._calc_where),
            {self._pose_input.ticket(), self.discrete_state_ticket(self._progress)},
        )
        self._command_output = self.DeclareVectorOutputPort(
            "command", 2, self._calc_command, {self._where.ticket()}
        )
        self._progress_output = self.DeclareStateOutputPort("progress", self._progress)

    def pose_input_port(self) -> InputPort:
        """Returns the port of the pose to drive on."""
        return self._pose_input

    def command_output_port(self) -> OutputPort:
        """Returns the port of the drive command."""
        return self._command_output

    def progress_output_port(self) -> OutputPort:
        """Returns the port of the leg and the angle along it."""
        return self._progress_output

    def _calc_where(self, context: Context, output: AbstractValue) -> None:
        """Puts out leg, place and the angle driven along it, which may exceed half a turn.

        Nothing at the end of the route.
        """
        index, driven = context.get_discrete_state(self._progress).get_value().tolist()
        if index >= len(self._legs):
            output.set_value([])
            return
        R_RB = self._pose_input.Eval(context).rotation().matrix()
        where = on_leg(R_RB, self._frames[int(index)])
        output.set_value([int(index), where, driven + wrap(where.along - driven)])

    def _advance(self, context: Context, discrete_state: DiscreteValues) -> None:
        now = self._where.Eval(context)
        if not now:
            return
        index, where, driven = now
        arc = self._legs[index].arc
        if arc > 0:
            reached = (arc - driven) * self._radius <= self._parameters.position_tolerance
        else:
            reached = abs(where.heading) <= self._parameters.heading_tolerance
        discrete_state.set_value(self._progress, [index + 1, 0.0] if reached else [index, driven])

    def _calc_command(self, context: Context, output: Any) -> None:
        now = self._where.Eval(context)
        if not now:
            output.SetFromVector([0.0, 0.0])
            return
        index, where, driven = now
        leg = self._legs[index]
        if leg.arc == 0:
            where = where._replace(left=0.0)
        command = follow(where, leg.arc - driven, self._radius, self._parameters)
        output.SetFromVector(command if leg.arc > 0 else [0.0, command[1]])
