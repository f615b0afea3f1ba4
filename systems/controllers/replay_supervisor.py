"""Watches over a replay: slows, stops and waits when sight, place or way are not what they must be.

It stands between the tracker and the drive and can only take speed away, v and omega alike, so the
robot stays on the curve that the tracker has chosen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.controllers.path_tracking import TrackingState
from systems.estimators.planar_kalman import UNKNOWN
from systems.health import Counts
from systems.messages import Health, Message
from systems.periods import period
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

_NEAR = 0.02  # m; so much more than is to be left to an obstacle counts as no way either

# What the robot does, the first that holds. In the first eight it stands.
STATUSES = (
    "waiting",  # nothing is known of the pose yet
    "arrived",  # the tracker has come to the end
    "lost",  # not seen, or not sure of the place, for too long
    "doubtful",  # what is seen has been refused: put elsewhere, or tags were moved
    "relocalised",  # the estimate has begun anew: it stands until that has settled
    "off_route",  # too far from the route to drive back by itself
    "blind_ahead",  # nothing is known of the way ahead
    "blocked",  # something stands on the route
    "slowing",  # something stands on the route, farther on
    "blind",  # drives on by odometry, slower
    "driving",
)


@dataclass
class SupervisorParameters:
    """When to slow, to stop and to go on.

    Attributes:
        slow_after: time without an accepted sight from which on it slows, s.
        stop_after: at which it stands, s.
        slow_radius: of the 95 % circle of the position, from which on it slows, m.
        stop_radius: at which it stands, m.
        slowest: part of the speed that is left just before it stands.
        refusals: sights refused one after the other after which it stands.
        settle_time: how long it stands after the estimate has begun anew, s.
        off_route: distance from the route at which it stands, m.
        stop_distance: what is to be left to an obstacle, m.
        deceleration: by which it slows before one, m/s^2.
        clear_time: how long the way must be free before it goes on, s.
    """

    slow_after: float = 0.5
    stop_after: float = 5.0
    slow_radius: float = 0.05
    stop_radius: float = 0.2
    slowest: float = 0.4
    refusals: int = 3
    settle_time: float = 1.0
    off_route: float = 0.4
    stop_distance: float = 0.25
    deceleration: float = 0.5
    clear_time: float = 1.0

    def __post_init__(self) -> None:
        require_positive(
            slow_radius=self.slow_radius,
            off_route=self.off_route,
            stop_distance=self.stop_distance,
            deceleration=self.deceleration,
            refusals=self.refusals,
        )
        require_non_negative(
            slow_after=self.slow_after, settle_time=self.settle_time, clear_time=self.clear_time
        )
        for stop, slow in (("stop_after", "slow_after"), ("stop_radius", "slow_radius")):
            least = getattr(self, slow)
            require(
                least < getattr(self, stop) < math.inf,
                stop,
                getattr(self, stop),
                f"finite, greater than {slow} = {least:g}",
            )
        require(0 < self.slowest <= 1, "slowest", self.slowest, "above 0, at most 1")


class View(NamedTuple):
    """What there is to go by.

    Attributes:
        now: s.
        known: whether there is an estimate.
        radius: of the 95 % circle of the position, m.
        accepted: sights that the estimator has accepted so far.
        refused: and refused.
        restarts: how often it has begun anew.
        arrived: whether the tracker has.
        distance: from the route, m.
        free: way ahead that is free, m; infinite without an obstacle, NaN if nobody knows.
        speed: as commanded, m/s.
    """

    now: float
    known: bool
    radius: float
    accepted: float
    refused: float
    restarts: float
    arrived: bool
    distance: float
    free: float
    speed: float


class Memory(NamedTuple):
    """What is kept from one look to the next.

    Attributes:
        accepted: sights accepted until then.
        seen: time of the last, s.
        refused: sights refused until the last that was accepted.
        restarts: how often the estimator had begun anew.
        restarted: when it last did, s.
        blocked: when the way was last blocked while the robot was to stand, s.
    """

    accepted: float = 0.0
    seen: float = -math.inf
    refused: float = 0.0
    restarts: float = 0.0
    restarted: float = -math.inf
    blocked: float = -math.inf


@dataclass(frozen=True, eq=False)
class ReplayState(Message):
    """What the supervisor lets the robot do.

    Attributes:
        stamp: s; NaN before the first look.
        status: one of `STATUSES`.
        scale: part of the commanded speed that is left, 0 to 1.
        sight_age: time since the last sight that was accepted, s; infinite before the first.
        radius: of the 95 % circle of the position, m.
        free: way ahead that is free, m.
    """

    stamp: float = math.nan
    status: str = "waiting"
    scale: float = 0.0
    sight_age: float = math.inf
    radius: float = math.inf
    free: float = math.inf


def radius_95(covariance: Array) -> float:
    """Returns the radius of the 95 % circle by the larger axis of a covariance (3, 3), m."""
    a, b, d = float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])
    largest = (a + d) / 2 + math.hypot((a - d) / 2, b)
    return math.sqrt(5.991 * max(largest, 0.0))


def supervise(
    view: View, memory: Memory, parameters: SupervisorParameters
) -> tuple[str, float, Memory]:
    """Returns the status, the part of the speed that is left, and the memory after a look."""
    p, now = parameters, view.now
    if view.accepted > memory.accepted:
        memory = memory._replace(accepted=view.accepted, seen=now, refused=view.refused)
    if view.restarts > memory.restarts:
        memory = memory._replace(restarts=view.restarts, restarted=now, seen=now)
        memory = memory._replace(refused=view.refused)
    age = now - memory.seen
    free = p.stop_distance if math.isnan(view.free) else view.free
    near = view.free <= p.stop_distance + _NEAR
    if near:
        memory = memory._replace(blocked=now)
    sure = _left(view.radius, p.slow_radius, p.stop_radius, p.slowest)
    fading = min(_left(age, p.slow_after, p.stop_after, p.slowest), sure)
    braking = math.sqrt(2 * p.deceleration * max(free - p.stop_distance, 0.0))
    room = min(1.0, braking / abs(view.speed)) if view.speed else 1.0
    holds = {
        "waiting": not view.known,
        "arrived": view.arrived,
        # What stands in the way may hide the tags too: a robot that waits for it knows where it is.
        "lost": fading == 0.0 and not (near and sure > 0.0),
        "doubtful": view.refused - memory.refused >= p.refusals,
        "relocalised": now - memory.restarted < p.settle_time,
        "off_route": view.distance > p.off_route,
        "blind_ahead": math.isnan(view.free),
        "blocked": now - memory.blocked < p.clear_time or near,
        "slowing": room < 1.0 and room <= fading,
        "blind": fading < 1.0,
        "driving": True,
    }
    status = next(name for name in STATUSES if holds[name])
    stands = STATUSES.index(status) < STATUSES.index("slowing")
    return status, 0.0 if stands else min(room, fading), memory


def _left(value: float, slow: float, stop: float, slowest: float) -> float:
    """Returns the part of the speed that is left: 1 up to slow, down to slowest at stop, then 0."""
    if not value < stop:
        return 0.0
    return 1.0 - (1.0 - slowest) * max(value - slow, 0.0) / (stop - slow)


class ReplaySupervisor(LeafSystem):
    """Takes speed away from a tracker's command when it is not safe to drive that fast.

    .. pydrake_system::

        name: ReplaySupervisor
        input_ports:
        - command
        - covariance
        - estimator_health
        - tracking
        - free_distance
        output_ports:
        - command
        - state
        - verdict
        - health

    Args:
        parameters: when to slow, to stop and to go on.
        rate: of the looks, Hz; the tracker's or more.
        offset: how late in its period it looks, s: behind a tracker of the same rate it would else
            get each command one period late.

    Ports:
        command (input, vector of 2): [v (m/s), omega (rad/s)] of the tracker. One that is not
            finite counts as zeros.
        covariance (input, vector of 9): (3, 3) of the estimated pose, row by row.
        estimator_health (input, Health): of `PlanarEkf`, for its counts `accepted`, `gated` and
            `restarted`.
        tracking (input, TrackingState): how far the robot is from the route, and whether it has
            arrived.
        free_distance (input, vector of 1): way ahead along the route that is free, m, as from
            `RouteClearance`: infinite where nothing stands, NaN where nobody knows. May be left
            unconnected: then nothing is looked for.
        command (output, vector of 2): what is left of the tracker's, at `rate`.
        state (output, ReplayState): status (see `STATUSES`) and reasons.
        verdict (output, vector of 6): the same as numbers: time (s; NaN before the first look),
            index of the status, scale, age of the last accepted sight (s), radius (m), free way
            ahead (m).
        health (output, Health): commands that were not finite; how often the robot had to stand
            because it was lost, because the estimate began anew, and because the way was blocked.

    That a robot which was put elsewhere finds itself again is the estimator's work (see
    `systems.estimators.relocation`); here it stands from the first refusals until that is done.
    """

    def __init__(
        self,
        *,
        parameters: SupervisorParameters | None = None,
        rate: float = 20.0,
        offset: float = 0.0,
    ) -> None:
        super().__init__()
        require_positive(rate=rate)
        require(0 <= offset < 1 / rate, "offset", offset, f"from 0 to below {1 / rate:g} s")
        self._parameters = parameters or SupervisorParameters()
        self._command_input = self.DeclareVectorInputPort("command", 2)
        self._covariance_input = self.DeclareVectorInputPort("covariance", 9)
        self._estimator_input = self.DeclareAbstractInputPort(
            "estimator_health", AbstractValue.Make(Health())
        )
        self._tracking_input = self.DeclareAbstractInputPort(
            "tracking", AbstractValue.Make(TrackingState())
        )
        self._free_input = self.DeclareVectorInputPort("free_distance", 1)
        self._command = self.DeclareDiscreteState(2)
        self._memory = self.DeclareDiscreteState(list(Memory()))
        # Time, status, scale, age of the last sight, radius, free way.
        self._verdict = self.DeclareDiscreteState([math.nan, 0.0, 0.0, math.inf, math.inf, 0.0])
        self.DeclarePeriodicDiscreteUpdateEvent(period(rate), offset, self._look)
        self._command_output = self.DeclareStateOutputPort("command", self._command)
        self._state_output = self.DeclareAbstractOutputPort(
            "state",
            lambda: AbstractValue.Make(ReplayState()),
            self._calc_state,
            {self.discrete_state_ticket(self._verdict)},
        )
        self._verdict_output = self.DeclareStateOutputPort("verdict", self._verdict)
        self._counts = Counts(self, "bad_command", "lost", "relocalised", "blocked")

    def command_input_port(self) -> InputPort:
        """Returns the port of the tracker's command."""
        return self._command_input

    def covariance_input_port(self) -> InputPort:
        """Returns the port of the estimate's covariance."""
        return self._covariance_input

    def estimator_health_input_port(self) -> InputPort:
        """Returns the port of the estimator's counts."""
        return self._estimator_input

    def tracking_input_port(self) -> InputPort:
        """Returns the port of the tracker's state."""
        return self._tracking_input

    def free_distance_input_port(self) -> InputPort:
        """Returns the port of the free way ahead."""
        return self._free_input

    def command_output_port(self) -> OutputPort:
        """Returns the port of the command that is left."""
        return self._command_output

    def state_output_port(self) -> OutputPort:
        """Returns the port of what it lets the robot do."""
        return self._state_output

    def verdict_output_port(self) -> OutputPort:
        """Returns the port of the state as numbers."""
        return self._verdict_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    def _look(self, context: Context, discrete_state: DiscreteValues) -> None:
        command = self._command_input.Eval(context)
        bad = not np.isfinite(command).all()
        if bad:
            command = np.zeros(2)
        covariance = self._covariance_input.Eval(context).reshape(3, 3)
        estimator: Health = self._estimator_input.Eval(context)
        tracking: TrackingState = self._tracking_input.Eval(context)
        connected = self._free_input.HasValue(context)
        count = estimator.counts.get
        view = View(
            now=context.get_time(),
            known=bool(covariance[0, 0] < UNKNOWN),
            radius=radius_95(covariance),
            accepted=count("accepted", 0),
            refused=count("gated", 0),
            restarts=count("restarted", 0),
            arrived=tracking.status == "arrived",
            distance=tracking.distance,
            free=float(self._free_input.Eval(context)[0]) if connected else math.inf,
            speed=float(command[0]),
        )
        memory = Memory(*context.get_discrete_state(self._memory).get_value().tolist())
        status, scale, memory = supervise(view, memory, self._parameters)
        before = STATUSES[int(context.get_discrete_state(self._verdict)[1])]
        fresh = {status: 1} if status != before else {}
        self._counts.add(
            context,
            discrete_state,
            bad_command=bad,
            **{name: fresh.get(name, 0) for name in ("lost", "relocalised", "blocked")},
        )
        discrete_state.set_value(self._command, scale * command)
        discrete_state.set_value(self._memory, list(memory))
        verdict = [view.now, STATUSES.index(status), scale, view.now - memory.seen]
        discrete_state.set_value(self._verdict, [*verdict, view.radius, view.free])

    def _calc_state(self, context: Context, output: Any) -> None:
        stamp, status, *rest = context.get_discrete_state(self._verdict).get_value().tolist()
        output.set_value(ReplayState(stamp, STATUSES[int(status)], *rest))
