"""Is the robot getting anywhere? Says when it is time to give a waypoint up."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.health import Counts
from systems.messages import Path
from systems.periods import period
from systems.planners.polyline import length_of, rest_of
from systems.validation import require_non_negative, require_positive

Array = NDArray[np.float64]


@dataclass
class ProgressParameters:
    """When a robot counts as stuck.

    Attributes:
        step: what counts as progress: by this much less is left than ever before, m.
        patience: how long there may be none, s.
        slowest: speed at which it is expected to make up for a detour, m/s.
    """

    step: float = 0.1
    patience: float = 40.0
    slowest: float = 0.1

    def __post_init__(self) -> None:
        require_positive(step=self.step, slowest=self.slowest)
        require_non_negative(patience=self.patience)


def left_to_go(points: Array, position: Array, goal: Array) -> float:
    """Returns how far it is to the goal, m: along a path and on from its end, or straight.

    Args:
        points: (n, 2) m, the path; empty when there is none.
        position: (2,) m.
        goal: (2,) m.
    """
    if len(points) == 0:
        return math.dist(position, goal)
    rest = rest_of(points, position)
    return math.dist(position, rest[0]) + length_of(rest) + math.dist(rest[-1], goal)


class ProgressMonitor(LeafSystem):
    """Says that the robot is stuck when for long it has come no nearer to its waypoint.

    .. pydrake_system::

        name: ProgressMonitor
        input_ports:
        - pose
        - goal
        - path
        output_ports:
        - stuck
        - health

    Args:
        parameters: when it counts as stuck.
        rate: how often it is looked at, Hz.

    Ports:
        pose (input, vector of 3): [x (m), y (m), theta (rad)] of base_link in map, the estimate.
            While it is not finite the time goes on, and nothing counts as progress.
        goal (input, vector of 2): [x, y] (m) of the waypoint in map. When it changes, all starts
            anew; one that is not finite is no change.
        path (input, Path): in map, from a planner. Need not be connected: then the straight
            distance to the waypoint is what is left to go.
        stuck (output, vector of 1): 1 while it is stuck, else 0; updated at `rate`.
        health (output, Health): poses, waypoints and paths that were not finite.

    Let b be the least that was ever left to go to this waypoint, seen at t_b, and m the most that
    was left since. The robot is stuck when t - t_b > patience + (m - b) / slowest. So a detour that
    has turned out to be needed gets the time that it takes; and as m is bounded for a robot that
    circles, or wavers between two ways, it is found out in the end.

    Nav2's progress checkers ask instead that the robot leave a circle within a time; one that
    circles in a dead end does so for ever.
    """

    def __init__(self, *, parameters: ProgressParameters | None = None, rate: float = 5.0) -> None:
        super().__init__()
        require_positive(rate=rate)
        self._parameters = parameters or ProgressParameters()
        self._pose_input = self.DeclareVectorInputPort("pose", 3)
        self._goal_input = self.DeclareVectorInputPort("goal", 2)
        self._path_input = self.DeclareAbstractInputPort("path", AbstractValue.Make(Path()))
        # The waypoint, the least that was left to go to it, when that was, and the most since.
        self._best = self.DeclareDiscreteState(np.full(5, math.nan))
        self._stuck = self.DeclareDiscreteState(1)
        self.DeclarePeriodicDiscreteUpdateEvent(period(rate), 0.0, self._look)
        self._stuck_output = self.DeclareStateOutputPort("stuck", self._stuck)
        self._counts = Counts(self, "bad_pose", "bad_goal", "bad_path")

    def pose_input_port(self) -> InputPort:
        """Returns the port of the estimated pose."""
        return self._pose_input

    def goal_input_port(self) -> InputPort:
        """Returns the port of the waypoint."""
        return self._goal_input

    def path_input_port(self) -> InputPort:
        """Returns the port of the path."""
        return self._path_input

    def stuck_output_port(self) -> OutputPort:
        """Returns the port that says whether it is stuck."""
        return self._stuck_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    def _look(self, context: Context, discrete_state: DiscreteValues) -> None:
        p, now = self._parameters, context.get_time()
        position, goal = self._pose_input.Eval(context)[:2], self._goal_input.Eval(context)
        path = np.zeros((0, 2))
        if self._path_input.HasValue(context):
            path = self._path_input.Eval(context).points
        *old_goal, best, since, most = context.get_discrete_state(self._best).get_value().tolist()
        bad_pose, bad_goal, bad_path = (
            not np.isfinite(values).all() for values in (position, goal, path)
        )
        self._counts.add(
            context, discrete_state, bad_pose=bad_pose, bad_goal=bad_goal, bad_path=bad_path
        )
        if bad_goal:
            goal = np.array(old_goal)
        elif goal.tolist() != old_goal:
            best, since, most = math.inf, now, 0.0
        if math.isnan(since):  # there has been no waypoint yet
            return
        if not bad_pose:
            left = left_to_go(path[:0] if bad_path else path, position, goal)
            if left < best - p.step:
                best, since, most = left, now, left
            most = max(most, left)
        detour = most - best if math.isfinite(best) else 0.0
        stuck = now - since > p.patience + detour / p.slowest
        discrete_state.set_value(self._best, [*goal.tolist(), best, since, most])
        discrete_state.set_value(self._stuck, [1.0 if stuck else 0.0])
