"""The shortest way on an occupancy grid that keeps its distance.

The cheapest way on the cells (A*, see `grid_search`), pulled straight where that costs no more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, EventStatus, InputPort, LeafSystem, OutputPort, State

from systems.health import Counts
from systems.messages import OccupancyGrid, Path
from systems.periods import period
from systems.planners.cost_map import (
    CostMap,
    cost_map,
    driving_cost,
    is_clear,
    line_cost,
    nearest_reachable,
    steering_point,
    way_out,
)
from systems.planners.grid_search import shortest_way
from systems.planners.polyline import rest_of
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]


@dataclass
class AStarParameters:
    """What a way costs, and when it is planned anew.

    Attributes:
        radius: nothing occupied may come nearer to the robot's centre than this, m, nor than the
            circle that holds the hull.
        soft_margin: beyond the radius, ways cost more up to this distance, m.
        soft_cost: extra cost of a metre at the radius; falls with the square to 0 at soft_margin. A
            detour of some metres is better than a gap that the avoider may shrink from.
        unknown_cost: extra cost of a metre of what has not been seen.
        occupied_above: log-odds above which a cell is occupied.
        escape: how far start and goal are moved out of what is too near to an obstacle, m.
        lookahead: how far along the path the goal is put at most, m.
        replan_period: a path that is still free is planned anew after this, s.
        improvement: by which part a new path must be cheaper to replace one that is still free.
        patience: how long no way may be found before the goal counts as out of reach, s.
        max_side: longest side of the area planned on, m; a goal farther away is not planned for.
    """

    radius: float = 0.15
    soft_margin: float = 0.2
    soft_cost: float = 8.0
    unknown_cost: float = 0.5
    occupied_above: float = 0.5
    escape: float = 0.5
    lookahead: float = 0.6
    replan_period: float = 2.0
    improvement: float = 0.1
    patience: float = 10.0
    max_side: float = 60.0

    def __post_init__(self) -> None:
        require_positive(
            radius=self.radius,
            lookahead=self.lookahead,
            replan_period=self.replan_period,
            max_side=self.max_side,
        )
        require_non_negative(
            soft_margin=self.soft_margin,
            soft_cost=self.soft_cost,
            unknown_cost=self.unknown_cost,
            occupied_above=self.occupied_above,
            escape=self.escape,
            patience=self.patience,
        )
        require(0 <= self.improvement < 1, "improvement", self.improvement, "0 or more, below 1")


def pulled_straight(costs: CostMap, points: Array) -> Array:
    """Returns the corners of a path (n, 2) m after all shortcuts that cost no more than it does."""
    metre = costs.at(points, costs.cost)
    steps = np.hypot(*np.diff(points, axis=0).T)
    spent = np.concatenate([[0.0], np.cumsum(steps * (metre[1:] + metre[:-1]) / 2)])
    corners = [0]
    while corners[-1] < len(points) - 1:
        here = corners[-1]
        step, reached = 1, here + 1
        # Ever farther while it pays, then ever less: few looks, and nearly always the farthest.
        while step:
            there = min(reached + step, len(points) - 1)
            direct = line_cost(costs, points[here], points[there])
            if there > reached and direct <= (spent[there] - spent[here]) * (1 + 1e-9):
                reached, step = there, step * 2
            else:
                step //= 2
        corners.append(reached)
    return points[corners]


class Plan(NamedTuple):
    """A way found.

    Attributes:
        points: (n, 2) m, from the start; to the goal, or as near as one can get.
        complete: whether it leads to the goal.
    """

    points: Array
    complete: bool


def plan(costs: CostMap, start: Array, goal: Array, escape: float) -> Plan | None:
    """Returns the way from start to goal, (2,) m each, both on the map.

    A start too near to an obstacle is left by the shortest way; a goal too near to one is replaced
    by the nearest place that it could be left to; if that cannot be reached, the way leads to the
    reachable place nearest to the goal. None when the robot cannot leave its start.

    Args:
        costs: what it costs to drive where.
        start: m.
        goal: m.
        escape: how far start and goal are moved at most, m.
    """
    out = way_out(costs, costs.cell(start), escape)
    if out is None:
        return None
    into = way_out(costs, costs.cell(goal), escape)
    wanted = into[-1] if into else costs.cell(goal)
    target = nearest_reachable(costs.cost, out[-1], wanted)
    way = shortest_way(costs.cost, out[-1], target)
    complete = into is not None and target == wanted
    points = np.array([costs.middle(cell) for cell in way or []])
    if into is not None and len(into) == 1 and complete:
        points[-1] = goal
    if len(out) > 1:
        # What is too near has no cost to compare by: the way out stays as it is.
        leaving = np.array([start, *(costs.middle(cell) for cell in out[1:-1])])
        return Plan(np.concatenate([leaving, pulled_straight(costs, points)]), complete)
    if len(points) == 1:
        return Plan(np.array([start, points[0]]), complete)
    points[0] = start
    return Plan(pulled_straight(costs, points), complete)


class AStarPlanner(LeafSystem):
    """Plans the way to a waypoint on the occupancy grid, and says where to steer next.

    .. pydrake_system::

        name: AStarPlanner
        input_ports:
        - pose
        - goal
        - grid
        output_ports:
        - goal
        - path
        - reachable
        - health

    Args:
        hull: [front, rear, half_width] of the robot about base_link, m; left out, the radius of the
            parameters is all the room it needs.
        parameters: what a way costs, and when it is planned anew.
        rate: how often the path is looked at, Hz.

    Ports:
        pose (input, vector of 3): [x (m), y (m), theta (rad)] of base_link in map, the estimate.
        goal (input, vector of 2): [x, y] (m) of the waypoint in map.
        grid (input, OccupancyGrid): in map. What it does not hold is unknown: passable, at some
            cost. An empty grid, or one without a stamp, gives the straight path.
        goal (output, vector of 2): [x, y] (m) of the place on the path to steer to, in map: at
            most the look-ahead along it, with a clear straight line to it. Updated at `rate`. The
            waypoint itself when the robot stands in what is occupied, so that there is no path.
        path (output, Path): in map, from where it was planned to the waypoint. When the waypoint
            cannot be reached, to the reachable place nearest to it: there the robot waits, and may
            see that there is a way after all. Empty when there is none.
        reachable (output, vector of 1): 0 when for the time of the patience no plan has led to the
            waypoint; else 1.
        health (output, Health): plans that did not lead to the waypoint; poses, waypoints (not
            finite, or too far away) and grids that could not be used, while all outputs are held.

    A path is planned when the waypoint changes, when the old one is blocked, and every
    `replan_period`; in the last case it replaces the old one only if it is cheaper by a part, so
    that the robot does not waver between two ways around.

    Raises:
        ValueError: hull or rate out of range.
    """

    def __init__(
        self,
        *,
        hull: Sequence[float] | None = None,
        parameters: AStarParameters | None = None,
        rate: float = 5.0,
    ) -> None:
        super().__init__()
        require_positive(rate=rate)
        self._parameters = parameters or AStarParameters()
        self._radius = self._parameters.radius
        if hull is not None:
            sound = len(hull) == 3 and bool(np.isfinite(hull).all()) and min(hull) > 0
            require(sound, "hull", hull, "[front, rear, half_width], each greater than 0 (m)")
            self._radius = max(self._radius, math.hypot(max(hull[:2]), hull[2]))
        self._pose_input = self.DeclareVectorInputPort("pose", 3)
        self._goal_input = self.DeclareVectorInputPort("goal", 2)
        self._grid_input = self.DeclareAbstractInputPort(
            "grid", AbstractValue.Make(OccupancyGrid())
        )
        self._steer = self.DeclareDiscreteState(2)
        self._reachable = self.DeclareDiscreteState([1.0])
        # The waypoint that the path leads to, whether it gets there, when it was planned, and since
        # when no plan has got there.
        self._memory = self.DeclareDiscreteState(np.full(5, math.nan))
        self._path = self.DeclareAbstractState(AbstractValue.Make(Path(frame_id="map")))
        self.DeclarePeriodicUnrestrictedUpdateEvent(period(rate), 0.0, self._look)
        self._goal_output = self.DeclareStateOutputPort("goal", self._steer)
        self._path_output = self.DeclareStateOutputPort("path", self._path)
        self._reachable_output = self.DeclareStateOutputPort("reachable", self._reachable)
        self._counts = Counts(self, "no_path", "bad_pose", "bad_goal", "bad_grid")

    def pose_input_port(self) -> InputPort:
        """Returns the port of the estimated pose."""
        return self._pose_input

    def goal_input_port(self) -> InputPort:
        """Returns the port of the waypoint."""
        return self._goal_input

    def grid_input_port(self) -> InputPort:
        """Returns the port of the grid."""
        return self._grid_input

    def goal_output_port(self) -> OutputPort:
        """Returns the port of the place to steer to."""
        return self._goal_output

    def path_output_port(self) -> OutputPort:
        """Returns the port of the path."""
        return self._path_output

    def reachable_output_port(self) -> OutputPort:
        """Returns the port that says whether the waypoint can be reached."""
        return self._reachable_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    def _costs(self, grid: OccupancyGrid, *points: Array) -> CostMap:
        p = self._parameters
        return cost_map(
            grid,
            *points,
            radius=self._radius,
            soft_margin=p.soft_margin,
            soft_cost=p.soft_cost,
            unknown_cost=p.unknown_cost,
            occupied_above=p.occupied_above,
            max_side=p.max_side,
        )

    def _look(self, context: Context, state: State) -> EventStatus:
        discrete_state: Any = state.get_mutable_discrete_state()
        position = self._pose_input.Eval(context)[:2].copy()
        goal, grid = self._goal_input.Eval(context).copy(), self._grid_input.Eval(context)
        fault = self._fault(position, goal, grid)
        if fault is None:
            try:
                costs = self._costs(grid, position, goal)
            except ValueError:
                fault = "bad_goal"
        if fault is not None:
            self._counts.add(context, discrete_state, **{fault: 1})
            return EventStatus.Succeeded()
        path: Path = context.get_abstract_state(self._path).get_value()
        memory = context.get_discrete_state(self._memory).get_value()
        old = path.points if len(path.points) and np.array_equal(memory[:2], goal) else None
        points, memory, failed = self._renew(old, costs, position, goal, memory, context.get_time())
        if points is not path.points:
            path = Path(stamp=context.get_time(), frame_id=grid.frame_id or "map", points=points)
            state.get_mutable_abstract_state(int(self._path)).set_value(path)
        discrete_state.set_value(self._memory, memory)
        # A comparison with NaN is false: nothing has failed.
        out_of_reach = context.get_time() - memory[4] >= self._parameters.patience
        discrete_state.set_value(self._reachable, [0.0 if out_of_reach else 1.0])
        discrete_state.set_value(self._steer, self._steer_to(points, costs, position, goal))
        self._counts.add(context, discrete_state, no_path=failed)
        return EventStatus.Succeeded()

    @staticmethod
    def _fault(position: Array, goal: Array, grid: OccupancyGrid) -> str | None:
        """Returns what makes the inputs useless, or None."""
        if not np.isfinite(position).all():
            return "bad_pose"
        if not np.isfinite(goal).all():
            return "bad_goal"
        sound = math.isfinite(grid.resolution) and grid.resolution > 0
        sound = sound and bool(np.isfinite(grid.origin).all() and np.isfinite(grid.log_odds).all())
        return None if sound else "bad_grid"

    def _renew(
        self,
        old: Array | None,
        costs: CostMap,
        position: Array,
        goal: Array,
        memory: Array,
        now: float,
    ) -> tuple[Array, Array, bool]:
        """Returns the path to follow from now on, the memory, and whether a plan has failed."""
        p = self._parameters
        ahead = None
        if old is not None:
            ahead = np.concatenate([position[None], rest_of(old, position)])
            if not is_clear(costs, ahead, position, self._radius):
                ahead = None
            elif now - memory[3] < p.replan_period - 1e-6:
                return old, memory, False
        found = plan(costs, position, goal, p.escape)
        complete = found is not None and found.complete
        since = memory[4] if np.array_equal(memory[:2], goal) else math.nan
        if complete:
            since = math.nan
        elif math.isnan(since):
            since = now
        memory = np.array([*goal, complete, now, since])
        points = np.zeros((0, 2)) if found is None else found.points
        if old is not None and ahead is not None and complete and self._reaches(old, goal, costs):
            better = driving_cost(costs, points) < (1 - p.improvement) * driving_cost(costs, ahead)
            points = points if better else old
        return points, memory, not complete

    def _reaches(self, points: Array, goal: Array, costs: CostMap) -> bool:
        """Whether a path ends where one to the goal would end now."""
        into = way_out(costs, costs.cell(goal), self._parameters.escape)
        return into is not None and costs.cell(points[-1]) == into[-1]

    def _steer_to(self, points: Array, costs: CostMap, position: Array, goal: Array) -> Array:
        if len(points) == 0:
            return goal
        p = self._parameters
        rest = rest_of(points, position)
        return steering_point(costs, rest, position, radius=self._radius, lookahead=p.lookahead)
