"""Drives once around a circuit as a person would who sees the track: for unattended teaching."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.health import Counts
from systems.noise import generator, stream_key
from systems.periods import period
from systems.planners.closed_curve import ClosedCurve
from systems.validation import require_non_negative, require_positive

Array = NDArray[np.float64]

_WAVES = 3  # of which a person's swaying consists
_WITHIN = 1.0  # m of the route, before and after where the robot was, in which it is looked for


@dataclass
class ScriptedDriverParameters:
    """How it is driven.

    Attributes:
        speed: m/s.
        rate: how often the driver steers, Hz.
        lookahead: how far along the route the driver looks, m.
        sway: how far the driver strays from the route, m, root mean square.
        sway_length: of a swing from side to side and back, about, m of the route.
        overrun: how far the driver goes on past the start, m.
        seed: of the swaying.
    """

    speed: float = 0.3
    rate: float = 20.0
    lookahead: float = 0.3
    sway: float = 0.015
    sway_length: float = 3.0
    overrun: float = 0.2
    seed: int = 0

    def __post_init__(self) -> None:
        require_positive(
            speed=self.speed,
            rate=self.rate,
            lookahead=self.lookahead,
            sway_length=self.sway_length,
        )
        require_non_negative(sway=self.sway, overrun=self.overrun)


def steer_toward(pose: ArrayLike, target: ArrayLike) -> float:
    """Returns the curvature (1/m) of the arc that leads from a pose through a point: pure pursuit.

    Args:
        pose: (3,) [x (m), y (m), theta (rad)].
        target: (2,) m.

    Source: Coulter, "Implementation of the Pure Pursuit Path Tracking Algorithm", 1992.
    """
    x, y, theta = np.asarray(pose, float)
    dx, dy = np.asarray(target, float) - (x, y)
    aside = -math.sin(theta) * dx + math.cos(theta) * dy
    return float(2 * aside / max(dx * dx + dy * dy, 1e-9))


class ScriptedDriver(LeafSystem):
    """Follows a closed route once at constant speed and stops a little past its start.

    .. pydrake_system::

        name: ScriptedDriver
        input_ports:
        - pose
        output_ports:
        - command
        - finished
        - health

    Args:
        route: (n, 2) m, the points that the route goes through (`ClosedCurve`).
        parameters: how it is driven.

    Ports:
        pose (input, vector of 3): [x (m), y (m), theta (rad)] of the robot, as somebody sees it who
            stands by. Not finite: dropped and counted, and the last command goes on.
        command (output, vector of 2): [v (m/s), omega (rad/s)], at `rate`.
        finished (output, vector of 1): 1 when the driver has stopped, 0 before.
        health (output, Health): `bad_pose`, poses that were not finite.

    Raises:
        ValueError: the route is none, or a parameter is out of range.
    """

    def __init__(
        self, *, route: ArrayLike, parameters: ScriptedDriverParameters | None = None
    ) -> None:
        super().__init__()
        p = parameters or ScriptedDriverParameters()
        self._parameters = p
        self._curve = ClosedCurve(route)
        random = generator(stream_key(p.seed, "scripted driver"), 0)
        # Whole waves, so that the end meets the beginning.
        waves = max(1, round(self._curve.length / p.sway_length)) + np.arange(_WAVES) - 1
        self._waves = np.maximum(waves, 1)
        self._phases = random.uniform(0, 2 * math.pi, _WAVES)
        self._pose_input = self.DeclareVectorInputPort("pose", 3)
        self._command = self.DeclareDiscreteState(2)
        self._finished = self.DeclareDiscreteState(1)
        self._way = self.DeclareDiscreteState([math.nan])  # along the route so far, m
        self.DeclarePeriodicDiscreteUpdateEvent(period(p.rate), 0.0, self._steer)
        self._command_output = self.DeclareStateOutputPort("command", self._command)
        self._finished_output = self.DeclareStateOutputPort("finished", self._finished)
        self._counts = Counts(self, "bad_pose")

    def pose_input_port(self) -> InputPort:
        """Returns the port of the pose."""
        return self._pose_input

    def command_output_port(self) -> OutputPort:
        """Returns the port of the command."""
        return self._command_output

    def finished_output_port(self) -> OutputPort:
        """Returns the port that says when the driver has stopped."""
        return self._finished_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of what was dropped."""
        return self._counts.output_port

    def sway(self, way: float) -> float:
        """Returns how far to the left of the route the driver aims at a way along it, m."""
        angles = 2 * math.pi * self._waves * way / self._curve.length + self._phases
        return float(self._parameters.sway * math.sqrt(2 / _WAVES) * np.sin(angles).sum())

    def _steer(self, context: Context, discrete_state: DiscreteValues) -> None:
        pose = self._pose_input.Eval(context)
        if not np.isfinite(pose).all():
            self._counts.add(context, discrete_state, bad_pose=1)
            return
        p, curve = self._parameters, self._curve
        way: Any = context.get_discrete_state(self._way)[0]
        if math.isnan(way):
            # Who starts a little behind the start has not been around yet.
            nearest = curve.nearest(pose[:2])
            way = (nearest + curve.length / 2) % curve.length - curve.length / 2
        else:
            nearest = curve.nearest(pose[:2], around=way % curve.length, within=_WITHIN)
            way += (nearest - way + curve.length / 2) % curve.length - curve.length / 2
        discrete_state.set_value(self._way, [way])
        if way >= curve.length + p.overrun:
            discrete_state.set_value(self._command, np.zeros(2))
            discrete_state.set_value(self._finished, [1.0])
            return
        aim = way + p.lookahead
        place, heading = curve.at(aim)
        left = np.array([-math.sin(heading), math.cos(heading)])
        curvature = steer_toward(pose, place + self.sway(aim) * left)
        discrete_state.set_value(self._command, np.array([p.speed, p.speed * curvature]))
