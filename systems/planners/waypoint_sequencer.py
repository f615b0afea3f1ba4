"""Which waypoint is next ([NAV] section 4.3: the next one inside 0.30 m)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.periods import period
from systems.validation import require, require_positive


class WaypointSequencer(LeafSystem):
    """Hands out the waypoints one after the other, the next when one is reached.

    .. pydrake_system::

        name: WaypointSequencer
        input_ports:
        - pose
        output_ports:
        - goal
        - waypoints_reached

    Args:
        waypoints: (n, 2) m, in map, in the order of the visit.
        radius: a waypoint counts as reached inside this distance, m.
        rate: how often arrival is looked at, Hz.

    Ports:
        pose (input, vector of 3): [x (m), y (m), theta (rad)] of base_link in map, the estimate;
            one that is not finite does not arrive.
        goal (output, vector of 2): [x, y] (m) of the waypoint to drive to; the last one for good.
        waypoints_reached (output, vector of 1): how many, updated at `rate`.

    Raises:
        ValueError: no waypoint, or one that is not finite.
    """

    def __init__(
        self, *, waypoints: NDArray[np.float64], radius: float = 0.30, rate: float = 20.0
    ) -> None:
        super().__init__()
        waypoints = np.atleast_2d(np.asarray(waypoints, float))
        require(
            waypoints.shape[1:] == (2,)
            and waypoints.size > 0
            and bool(np.isfinite(waypoints).all()),
            "waypoints",
            waypoints.tolist(),
            "a list of at least one [x, y]",
        )
        require_positive(radius=radius, rate=rate)
        self._waypoints = waypoints
        self._radius = radius
        self._pose_input = self.DeclareVectorInputPort("pose", 3)
        self._reached = self.DeclareDiscreteState(1)
        self.DeclarePeriodicDiscreteUpdateEvent(period(rate), 0.0, self._look_at_arrival)
        ticket = {self.discrete_state_ticket(self._reached)}
        self._goal_output = self.DeclareVectorOutputPort("goal", 2, self._calc_goal, ticket)
        self._reached_output = self.DeclareStateOutputPort("waypoints_reached", self._reached)

    def pose_input_port(self) -> InputPort:
        """Returns the port of the estimated pose."""
        return self._pose_input

    def goal_output_port(self) -> OutputPort:
        """Returns the port of the waypoint to drive to."""
        return self._goal_output

    def waypoints_reached_output_port(self) -> OutputPort:
        """Returns the port of the number of waypoints reached."""
        return self._reached_output

    def _look_at_arrival(self, context: Context, discrete_state: DiscreteValues) -> None:
        index = int(context.get_discrete_state(self._reached)[0])
        if index < len(self._waypoints):
            position = self._pose_input.Eval(context)[:2]
            if math.dist(self._waypoints[index], position) < self._radius:
                discrete_state.set_value(self._reached, [index + 1.0])

    def _calc_goal(self, context: Context, output: Any) -> None:
        index = int(context.get_discrete_state(self._reached)[0])
        output.SetFromVector(self._waypoints[min(index, len(self._waypoints) - 1)])
