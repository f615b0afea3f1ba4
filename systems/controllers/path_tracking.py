"""What all trackers of a route share: where on the route the robot is, limits, ports.

A reference robot drives along the route at the route's own pace, on a leash: it waits when the real
one falls behind by more than the leash, and is pulled along when that is ahead. So slip is made up
for, and a robot that was stopped goes on from where it stands instead of racing after the clock.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.angles import wrap
from systems.estimators.planar_kalman import UNKNOWN
from systems.health import Counts
from systems.messages import Message
from systems.periods import period
from systems.planners.route import Place, Route
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

_HEADING = 0.5  # m/rad; how much a wrong heading counts where the whole route is searched


@dataclass
class TrackingParameters:
    """What every tracker needs to know.

    Attributes:
        leash: how far along the route the reference may be from the robot's place, m.
        window: how far along the route from its last place the robot's is looked for, m.
        lost: a robot farther than this from the route there is looked for on all of it, m.
        arrival: this near to the end of an open route it has arrived, m.
        delay: from the time of the estimate until the wheels follow the command, s; the robot is
            led from where it will be by then.
        min_speed: m/s; 0 for a robot that does not look behind itself.
        max_speed: m/s.
        max_turn_rate: rad/s.
        max_acceleration: m/s^2.
        max_turn_acceleration: rad/s^2.
    """

    leash: float = 0.1
    window: float = 0.5
    lost: float = 0.5
    arrival: float = 0.02
    delay: float = 0.0
    min_speed: float = 0.0
    max_speed: float = 1.0
    max_turn_rate: float = 2.0
    max_acceleration: float = 1.0
    max_turn_acceleration: float = 10.0

    def __post_init__(self) -> None:
        require_positive(
            leash=self.leash,
            lost=self.lost,
            arrival=self.arrival,
            max_speed=self.max_speed,
            max_turn_rate=self.max_turn_rate,
            max_acceleration=self.max_acceleration,
            max_turn_acceleration=self.max_turn_acceleration,
        )
        require_non_negative(delay=self.delay)
        require(
            self.window >= 2 * self.leash,
            "window",
            self.window,
            f"at least twice the leash of {self.leash:g} m",
        )
        require(
            -self.max_speed <= self.min_speed <= 0,
            "min_speed",
            self.min_speed,
            f"0, or negative down to {-self.max_speed:g} m/s",
        )

    def bounds(self) -> tuple[Array, Array]:
        """Returns the least and the largest command [v (m/s), omega (rad/s)]."""
        most = np.array([self.max_speed, self.max_turn_rate])
        return np.array([self.min_speed, -self.max_turn_rate]), most

    def change(self, dt: float) -> Array:
        """Returns by how much a command [v, omega] may change in dt (s)."""
        return np.array([self.max_acceleration, self.max_turn_acceleration]) * dt


class Progress(NamedTuple):
    """How far a robot has come. Times go on with the laps of a closed route.

    Attributes:
        reference: time on the route of the reference, s.
        place: time on the route of the place beside the robot, s.
        start: where it began, s.
        offset: of the robot to the left of the route, m.
        distance: from the robot to the route, m.
    """

    reference: float
    place: float
    start: float
    offset: float
    distance: float


@dataclass(frozen=True, eq=False)
class TrackingState(Message):
    """What a tracker does, for viewers, recordings and whoever watches over it.

    Attributes:
        stamp: s; NaN before the first estimate.
        status: `waiting` (there is no estimate yet), `tracking` or `arrived`.
        reference: (5,) [x (m), y (m), theta (rad), v (m/s), omega (rad/s)] of the reference.
        run: way along the route to the robot's place, m, laps included.
        laps: of a closed route, since it began.
        offset: of the estimate to the left of the route, m.
        distance: from the estimate to the route, m.
    """

    stamp: float = math.nan
    status: str = "waiting"
    reference: Array = field(default_factory=lambda: np.full(5, math.nan))
    run: float = math.nan
    laps: float = 0.0
    offset: float = math.nan
    distance: float = math.nan


def find_place(route: Route, pose: Array) -> Place:
    """Returns the place of the whole route that fits a pose, its heading included.

    Where a route crosses itself or comes back on itself, the nearest branch may lead elsewhere.
    """
    poses = np.column_stack([route.x, route.y])
    off = ((poses - pose[:2]) ** 2).sum(axis=1)
    turned = _HEADING * wrap(route.theta - pose[2])
    k = int(np.argmin(off + turned * turned))
    return route.closest(pose, near=float(route.t[k]), window=2 * route.length / len(route))


def begin(route: Route, pose: Array) -> Progress:
    """Returns the progress of a robot that begins at a pose (3,)."""
    place = find_place(route, pose)
    return Progress(place.time, place.time, place.time, place.offset, place.distance)


def advance(
    route: Route, progress: Progress, pose: Array, dt: float, parameters: TrackingParameters
) -> Progress:
    """Returns the progress after one more step.

    Args:
        route: the route.
        progress: before.
        pose: (3,) of the robot now.
        dt: the reference's step in time, s.
        parameters: leash and window.
    """
    p = parameters
    found = route.closest(pose, near=progress.place, window=p.window)
    if found.distance > p.lost:
        elsewhere = find_place(route, pose)
        if elsewhere.distance < found.distance - p.leash:
            found = elsewhere
    place = found.time
    if route.closed:  # the same place in the lap that is nearest
        place += round((progress.place - place) / route.duration) * route.duration
    run = float(route.run_at(place))
    reference = progress.reference + dt
    low, high = (float(t) for t in route.time_at(np.array([run - p.leash, run + p.leash])))
    reference = min(max(reference, low), high)
    return Progress(reference, place, progress.start, found.offset, found.distance)


def has_arrived(route: Route, progress: Progress, laps: float, arrival: float) -> bool:
    """Whether the laps are driven, or the end of an open route is reached."""
    if route.closed:
        return progress.place - progress.start >= laps * route.duration
    return float(route.run_at(progress.place)) >= route.length - arrival


def error_of(pose: Array, reference: Array) -> Array:
    """Returns the pose (3,) as seen from the reference pose (3,): ahead (m), left (m), turn."""
    c, s = math.cos(reference[2]), math.sin(reference[2])
    dx, dy = float(pose[0] - reference[0]), float(pose[1] - reference[1])
    turn = wrap(float(pose[2] - reference[2]))
    return np.array([c * dx + s * dy, c * dy - s * dx, turn])


def driven(pose: Array, command: Array, dt: float) -> Array:
    """Returns the pose (3,) after driving [v, omega] along an arc for dt (s)."""
    half = command[1] * dt / 2
    chord = command[0] * dt * np.sinc(half / np.pi)
    middle = pose[2] + half
    return pose + np.array([chord * math.cos(middle), chord * math.sin(middle), 2 * half])


def limited(command: Array, before: Array, dt: float, parameters: TrackingParameters) -> Array:
    """Returns a command within the limits and within reach of the one before.

    A speed that cannot be had takes the turn rate down with it: the robot drives the same curve.
    """
    low, high = parameters.bounds()
    change = parameters.change(dt)

    def reached(wanted: Array) -> Array:
        return np.clip(np.clip(wanted, low, high), before - change, before + change)

    v, omega = command.tolist()
    most = float(reached(command)[0])
    return reached(np.array([v, omega * most / v if 0 < most < v else omega]))


class PathTracker(LeafSystem):
    """Base of the trackers: ports, progress along the route, limits. See `Kanayama` for the ports.

    Args:
        route: what to follow.
        parameters: leash and limits.
        rate: of the commands, Hz.
        laps: of a closed route, after which it stops.
    """

    def __init__(
        self, *, route: Route, parameters: TrackingParameters, rate: float, laps: float
    ) -> None:
        super().__init__()
        require_positive(rate=rate)
        require(laps > 0, "laps", laps, "greater than 0")
        self._route = route
        self._limits = parameters
        self._dt = period(rate)
        self._laps = laps
        self._pose_input = self.DeclareVectorInputPort("pose", 3)
        self._covariance_input = self.DeclareVectorInputPort("covariance", 9)
        self._sent_input = self.DeclareVectorInputPort("sent", 2)
        self._command = self.DeclareDiscreteState(2)
        self._progress = self.DeclareDiscreteState(np.full(len(Progress._fields), math.nan))
        self._stamp = self.DeclareDiscreteState([math.nan, 0.0])  # and whether it has arrived
        self.DeclarePeriodicDiscreteUpdateEvent(self._dt, 0.0, self._step)
        self._command_output = self.DeclareStateOutputPort("command", self._command)
        self._state_output = self.DeclareAbstractOutputPort(
            "state",
            lambda: AbstractValue.Make(TrackingState()),
            self._calc_state,
            {self.discrete_state_ticket(i) for i in (self._progress, self._stamp)},
        )
        self._counts = Counts(self, "bad_pose", "bad_sent")

    def pose_input_port(self) -> InputPort:
        """Returns the port of the estimated pose."""
        return self._pose_input

    def covariance_input_port(self) -> InputPort:
        """Returns the port of the estimate's covariance."""
        return self._covariance_input

    def sent_input_port(self) -> InputPort:
        """Returns the port of the command as sent to the wheels."""
        return self._sent_input

    def command_output_port(self) -> OutputPort:
        """Returns the port of the command."""
        return self._command_output

    def state_output_port(self) -> OutputPort:
        """Returns the port of what the tracker does."""
        return self._state_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    @abstractmethod
    def _track(self, pose: Array, progress: Progress, before: Array) -> Array:
        """Returns the command [v, omega] wanted at a pose; a pure function.

        Args:
            pose: (3,) of the robot when it will follow the command.
            progress: where reference and robot are.
            before: (2,) the command that the wheels follow until then.
        """

    def _step(self, context: Context, discrete_state: DiscreteValues) -> None:
        pose = self._pose_input.Eval(context)
        before = context.get_discrete_state(self._command).get_value()
        sent = self._sent_input.Eval(context) if self._sent_input.HasValue(context) else before
        bad_pose, bad_sent = not np.isfinite(pose).all(), not np.isfinite(sent).all()
        self._counts.add(context, discrete_state, bad_pose=bad_pose, bad_sent=bad_sent)
        before = before if bad_sent else sent
        if bad_pose or not self._covariance_input.Eval(context)[0] < UNKNOWN:
            discrete_state.set_value(self._command, np.zeros(2))
            return
        old = Progress(*context.get_discrete_state(self._progress).get_value().tolist())
        pose = driven(pose, before, self._limits.delay)
        if math.isnan(old.place):
            progress = begin(self._route, pose)
        else:
            # The reference moves by as much as it leads the robot until the next look.
            progress = advance(self._route, old, pose, self._dt, self._limits)
        arrived = has_arrived(self._route, progress, self._laps, self._limits.arrival)
        arrived = arrived or bool(context.get_discrete_state(self._stamp)[1])
        command = np.zeros(2)
        if not arrived:
            wanted = self._track(pose, progress, before)
            command = limited(wanted, before, self._dt, self._limits)
        discrete_state.set_value(self._command, command)
        discrete_state.set_value(self._progress, list(progress))
        discrete_state.set_value(self._stamp, [context.get_time(), arrived])

    def _calc_state(self, context: Context, output: Any) -> None:
        stamp, arrived = context.get_discrete_state(self._stamp).get_value().tolist()
        if math.isnan(stamp):
            output.set_value(TrackingState())
            return
        p = Progress(*context.get_discrete_state(self._progress).get_value().tolist())
        route = self._route
        reference = [*route.poses_at(p.reference), *route.speeds_at(p.reference)]
        output.set_value(
            TrackingState(
                stamp=stamp,
                status="arrived" if arrived else "tracking",
                reference=np.array(reference),
                run=float(route.run_at(p.place)),
                laps=(p.place - p.start) / route.duration if route.closed else 0.0,
                offset=p.offset,
                distance=p.distance,
            )
        )
