"""What all avoiders share: ports, the check of the scan, turning to look for a way, giving up."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.angles import wrap
from systems.avoiders.surroundings import (
    REMEMBERED,
    extend,
    step_between,
    surroundings,
)
from systems.health import Counts
from systems.messages import AvoiderState, Scan
from systems.periods import period
from systems.pose_trail import empty_trail
from systems.scans import SCAN_FAULTS, scan_fault
from systems.validation import require, require_positive

Array = NDArray[np.float64]

STATUSES = ("clear", "avoiding", "turning", "blocked", "blind")

# How far beside the robot the local goal lies that makes the controller turn in place, m: a
# controller with v = k_p rho hardly drives for it.
_BESIDE = 1e-3


@dataclass
class AvoiderParameters:
    """What all avoiders have.

    Attributes:
        max_scan_age: how long after its first ray a scan is used, s; two turns of the lidar and
            what is late.
        give_up_after: how long it turns in place without finding a free direction, s, unless a
            whole turn is done before.
    """

    max_scan_age: float = 0.6
    give_up_after: float = 10.0

    def __post_init__(self) -> None:
        require_positive(
            max_scan_age=self.max_scan_age,
            give_up_after=self.give_up_after,
        )


@dataclass(frozen=True)
class Hull:
    """The robot's outline: a rectangle along its x axis.

    Attributes:
        front: from the body's origin to the foremost point, m.
        rear: to the rearmost, m.
        half_width: m.
    """

    front: float
    rear: float
    half_width: float

    @property
    def radius(self) -> float:
        """Radius of the circle about the origin that holds the hull, m."""
        return math.hypot(max(self.front, self.rear), self.half_width)


@dataclass(frozen=True)
class View:
    """What an avoider chooses by.

    Attributes:
        now: s.
        pose: (3,) [x (m), y (m), theta (rad)] in map.
        goal: (2,) m, in map.
        points: (k, 2) m, what stands around, in the body's frame.
        twist: (2,) [v (m/s), omega (rad/s)], as last sent to the wheels.
    """

    now: float
    pose: Array
    goal: Array
    points: Array
    twist: Array

    @property
    def distance(self) -> float:
        """How far the goal is, m."""
        return math.hypot(self.goal[0] - self.pose[0], self.goal[1] - self.pose[1])

    @property
    def bearing(self) -> float:
        """Where the goal is seen from the body, rad; 0 on the goal."""
        x, y, theta = self.pose.tolist()
        c, s = math.cos(theta), math.sin(theta)
        dx, dy = float(self.goal[0]) - x, float(self.goal[1]) - y
        return math.atan2(c * dy - s * dx, c * dx + s * dy)

    def ahead(self, bearing: float, distance: float) -> Array:
        """Returns the point (2,) in map that lies in this direction of the body."""
        x, y, theta = self.pose.tolist()
        angle = theta + bearing
        return np.array((x + distance * math.cos(angle), y + distance * math.sin(angle)))


@dataclass(frozen=True)
class Choice:
    """What an avoider makes of a view.

    Attributes:
        bearing: the chosen direction in the body's frame, rad; None when none is free.
        angles: (n,) middles of the sectors in the body's frame, rad.
        density: (n,) how full each is.
        free: (n,) bool, which may be chosen.
        clear: the way to the goal is free.
        local_goal: (2,) m, in map; None to turn in place toward the bearing.
        memory: the algorithm's own, for the next time.
        command: [v (m/s), omega (rad/s)], of an avoider that drives.
        turns: how fast it may turn in place to the left and to the right, rad/s, of one that
            drives, when no direction is free.
    """

    bearing: float | None
    angles: Array
    density: Array
    free: NDArray[np.bool_]
    clear: bool = False
    local_goal: Array | None = None
    memory: Array = field(default_factory=lambda: np.zeros(1))
    command: Array = field(default_factory=lambda: np.zeros(2))
    turns: Array = field(default_factory=lambda: np.zeros(2))


@dataclass
class _Patience:
    """How long it has looked for a free direction; kept as a vector in the Context.

    Attributes:
        side: where it turns, +1 left, -1 right; 0 while a direction is free.
        turned: by how much, rad.
        time: for how long, s.
    """

    side: float = 0.0
    turned: float = 0.0
    time: float = 0.0

    def after(self, view: View, turn: float, dt: float) -> _Patience:
        """Returns it after another `dt` s without a free direction, in which it turned by `turn`.

        It turns to the side of the goal, and keeps to that side.
        """
        if self.side == 0:
            return _Patience(side=1.0 if view.bearing >= 0 else -1.0)
        return _Patience(self.side, self.turned + turn, self.time + dt)

    def is_over(self, parameters: AvoiderParameters) -> bool:
        """Tells whether it is time to give up."""
        return abs(self.turned) >= 2 * math.pi or self.time >= parameters.give_up_after


class Avoider(LeafSystem):
    """Base of the avoiders: a subclass implements `_choose`.

    Everything is held between updates, but the local goal of a robot that stands or turns in place
    moves with the pose: else the controller would drive back to where it was at the last update.

    Args:
        parameters: of the subclass.
        rate: how often it looks, Hz.
        lidar_pose: (3,) [x (m), y (m), yaw (rad)] of the lidar in base_link.
        hull: [front, rear, half_width] of the robot about base_link, m.
        sectors: how many directions the state shows.
        memory: of the algorithm, at the start.

    Raises:
        ValueError: rate, lidar_pose or hull out of range.
    """

    def __init__(
        self,
        *,
        parameters: AvoiderParameters,
        rate: float,
        lidar_pose: Sequence[float] | Array,
        hull: Sequence[float] | Array,
        sectors: int,
        memory: Array,
    ) -> None:
        super().__init__()
        require_positive(rate=rate)
        self._lidar_pose = np.array(lidar_pose, float)
        require(
            self._lidar_pose.shape == (3,) and bool(np.isfinite(self._lidar_pose).all()),
            "lidar_pose",
            self._lidar_pose.tolist(),
            "three finite numbers [x (m), y (m), yaw (rad)]",
        )
        sides = np.array(hull, float)
        require(
            sides.shape == (3,) and bool((sides > 0).all() and np.isfinite(sides).all()),
            "hull",
            sides.tolist(),
            "three numbers greater than 0 [front, rear, half_width] (m)",
        )
        self._hull = Hull(*(float(side) for side in sides))
        self._limits = parameters
        self._dt = period(rate)
        self._pose_input = self.DeclareVectorInputPort("pose", 3)
        self._goal_input = self.DeclareVectorInputPort("goal", 2)
        self._scan_input = self.DeclareAbstractInputPort("scan", AbstractValue.Make(Scan()))
        self._command_input = self.DeclareVectorInputPort("command", 2)
        # Number of the status, stamp of the scan, direction in map, whether the local goal is
        # relative to the robot, and the local goal.
        blind = [STATUSES.index("blind"), math.nan, math.nan, 1.0, 0.0, 0.0]
        self._verdict = self.DeclareDiscreteState(np.array(blind))
        self._sectors = self.DeclareDiscreteState(np.zeros(3 * sectors))  # angles, density, free
        self._command = self.DeclareDiscreteState(2)
        self._memory = self.DeclareDiscreteState(memory)
        self._patience = self.DeclareDiscreteState(3)
        # The last pose, then the way here in a frame that does not jump, then points too near.
        self._last = self.DeclareDiscreteState(3)
        trail = empty_trail(duration=parameters.max_scan_age, rate=rate)
        self._trail = self.DeclareDiscreteState(trail.ravel())
        self._near = self.DeclareDiscreteState(np.full(2 * REMEMBERED, math.nan))
        self.DeclarePeriodicDiscreteUpdateEvent(self._dt, 0.0, self._look)
        verdict = self.discrete_state_ticket(self._verdict)
        self._goal_output = self.DeclareVectorOutputPort(
            "goal",
            2,
            self._calc_goal,
            {verdict, self.discrete_state_ticket(self._last), self._pose_input.ticket()},
        )
        self._state_output = self.DeclareAbstractOutputPort(
            "state",
            lambda: AbstractValue.Make(AvoiderState()),
            self._calc_state,
            {verdict, self.discrete_state_ticket(self._sectors)},
        )
        self._counts = Counts(self, *SCAN_FAULTS, "bad_pose", "bad_goal", "bad_command")

    def pose_input_port(self) -> InputPort:
        """Returns the port of the estimated pose."""
        return self._pose_input

    def goal_input_port(self) -> InputPort:
        """Returns the port of the goal."""
        return self._goal_input

    def scan_input_port(self) -> InputPort:
        """Returns the port of the scans."""
        return self._scan_input

    def command_input_port(self) -> InputPort:
        """Returns the port of the command as sent to the wheels."""
        return self._command_input

    def goal_output_port(self) -> OutputPort:
        """Returns the port of the local goal."""
        return self._goal_output

    def state_output_port(self) -> OutputPort:
        """Returns the port of what it sees and wants."""
        return self._state_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    @abstractmethod
    def _choose(self, view: View, memory: Array) -> Choice:
        """Chooses where to go; a pure function of view and memory."""

    def _look(self, context: Context, discrete_state: DiscreteValues) -> None:
        now = context.get_time()
        pose = self._pose_input.Eval(context)
        goal = self._goal_input.Eval(context)
        scan = self._scan_input.Eval(context)
        twist = self._command_input.Eval(context)
        fault = scan_fault(scan, now, self._limits.max_scan_age)
        sound = [all(map(math.isfinite, value.tolist())) for value in (pose, goal, twist)]
        self._counts.add(
            context,
            discrete_state,
            bad_pose=not sound[0],
            bad_goal=not sound[1],
            bad_command=not sound[2],
            **({fault: 1} if fault else {}),
        )
        if not sound[2]:
            twist = np.zeros(2)
        turn, trail = self._follow(context, discrete_state, now, pose, twist)
        if fault or not sound[0] or not sound[1]:
            stamp = scan.stamp if fault in (None, "stale_scan") else math.nan
            self._decide(discrete_state, "blind", stamp, math.nan, np.zeros(2), anchored=True)
            discrete_state.set_value(self._command, np.zeros(2))
            return
        remembered = context.get_discrete_state(self._near).get_value().reshape(-1, 2)
        points, remembered = surroundings(scan, self._lidar_pose, trail, remembered)
        discrete_state.set_value(self._near, remembered.ravel())
        view = View(now, pose, goal, points, twist)
        choice = self._choose(view, context.get_discrete_state(self._memory).get_value())
        discrete_state.set_value(self._memory, choice.memory)
        shown = np.concatenate([wrap(choice.angles + pose[2]), choice.density, choice.free])
        discrete_state.set_value(self._sectors, shown)
        patience = _Patience()
        if choice.bearing is None:
            before = _Patience(*context.get_discrete_state(self._patience).get_value())
            patience = before.after(view, turn, self._dt)
        discrete_state.set_value(self._patience, [patience.side, patience.turned, patience.time])
        self._act(discrete_state, view, choice, patience, scan.stamp)

    def _follow(
        self,
        context: Context,
        discrete_state: DiscreteValues,
        now: float,
        pose: Array,
        twist: Array,
    ) -> tuple[float, Array]:
        """Adds to the trail; returns by how much the robot turned since the last time, and it."""
        trail = discrete_state.get_mutable_value(self._trail).reshape(-1, 4)
        last = context.get_discrete_state(self._last).get_value()
        dt = now - float(trail[-1, 0])
        step = np.zeros(3)
        if math.isfinite(dt):
            step = step_between(last, pose, twist, dt)
        trail[:] = extend(trail, now, step)
        if all(map(math.isfinite, pose.tolist())):
            discrete_state.set_value(self._last, pose)
        return float(step[2]), trail

    def _act(
        self,
        discrete_state: DiscreteValues,
        view: View,
        choice: Choice,
        patience: _Patience,
        stamp: float,
    ) -> None:
        """Makes a verdict of a choice."""
        bearing, command = choice.bearing, choice.command
        direction = math.nan if bearing is None else wrap(float(view.pose[2]) + bearing)
        local_goal = None
        if bearing is not None:
            status, local_goal = "clear" if choice.clear else "avoiding", choice.local_goal
            beside = view.ahead(bearing, _BESIDE)
        elif patience.is_over(self._limits):
            status, command, beside = "blocked", np.zeros(2), view.pose[:2]
        else:
            status, (left, right) = "turning", choice.turns
            command = np.array([0.0, left or -right if patience.side > 0 else -right or left])
            beside = view.ahead(patience.side * math.pi / 2, _BESIDE)
        anchored = local_goal is None
        goal = beside - view.pose[:2] if local_goal is None else local_goal
        self._decide(discrete_state, status, stamp, direction, goal, anchored=anchored)
        discrete_state.set_value(self._command, command)

    def _decide(
        self,
        discrete_state: DiscreteValues,
        status: str,
        stamp: float,
        direction: float,
        goal: Array,
        *,
        anchored: bool,
    ) -> None:
        verdict = [STATUSES.index(status), stamp, direction, float(anchored), *goal.tolist()]
        discrete_state.set_value(self._verdict, verdict)

    def _calc_goal(self, context: Context, output: Any) -> None:
        *_, anchored, x, y = context.get_discrete_state(self._verdict).get_value().tolist()
        if anchored:
            pose = self._pose_input.Eval(context).tolist()
            if not all(map(math.isfinite, pose)):
                pose = context.get_discrete_state(self._last).get_value().tolist()
            x, y = x + pose[0], y + pose[1]
        output.SetFromVector((x, y))

    def _calc_state(self, context: Context, output: Any) -> None:
        verdict = context.get_discrete_state(self._verdict).get_value()
        status, stamp, direction = verdict[:3].tolist()
        sectors = context.get_discrete_state(self._sectors).get_value().reshape(3, -1)
        seen = status != STATUSES.index("blind")
        angles, density, free = sectors if seen else np.zeros((3, 0))
        output.set_value(
            AvoiderState(
                stamp=stamp,
                status=STATUSES[int(status)],
                angles=angles.copy(),
                density=density.copy(),
                free=free > 0.5,
                direction=direction,
            )
        )
