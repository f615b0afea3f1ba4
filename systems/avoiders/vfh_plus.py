"""VFH+: a polar histogram of what stands around, and the cheapest of its openings.

[VFH+]: Ulrich and Borenstein, "VFH+: reliable obstacle avoidance for fast mobile robots", IEEE
International Conference on Robotics and Automation, 1998, pages 1572-1577.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.angles import wrap
from systems.avoiders.base import Avoider, AvoiderParameters, Choice, Hull, View
from systems.avoiders.polar_histogram import (
    binary_histogram,
    free_distance,
    primary_histogram,
    sector_middles,
    turning_limits,
)
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Part of the distance to the nearest point by which that point is widened, once the robot is nearer
# to it than radius and safety distance: below 1, so that driving along it stays free.
_TOUCHING = 0.95
# What the disc that is moved ahead of the robot is smaller than that of the histogram, m: a
# direction may be off by half a sector from one that is free.
_SLACK = 0.02
# Of the turn to the chosen direction, where it is looked how far that disc gets.
_TOWARD = np.linspace(0.0, 1.0, 12)


@dataclass
class VfhPlusParameters(AvoiderParameters):
    """Histogram, openings and cost of VFH+.

    Attributes:
        sectors: how many the circle has; 72 of 5 degrees as in [VFH+].
        window: what is farther away does not matter, m.
        threshold_low: a sector becomes free below this density, and
        threshold_high: blocked above this one, in points. Each point counts 1 - (d / window)^2, so
            one that is near blocks and far ones must be several.
        safety_distance: room between the robot and obstacles, m. Where the robot is nearer already,
            it is content with what there is.
        wide_opening: an opening at least this wide is passed along its side, a narrower one in its
            middle, rad; 80 degrees (16 sectors) as in [VFH+].
        target_cost: cost of the angle to the goal,
        current_cost: to the present heading,
        previous_cost: to the direction chosen last; 5, 2, 2 as in [VFH+], where the first must
            exceed the sum of the others.
        max_turn_rate: of the robot, rad/s; with its speed it gives the turning radius of the mask.
        turn_in_place_below: slower than this it can turn in place, m/s, and there is no mask.
        look_ahead: distance of the local goal, m.
    """

    sectors: int = 72
    window: float = 1.5
    threshold_low: float = 0.4
    threshold_high: float = 0.8
    safety_distance: float = 0.08
    wide_opening: float = math.radians(80)
    target_cost: float = 5.0
    current_cost: float = 2.0
    previous_cost: float = 2.0
    max_turn_rate: float = 1.5
    turn_in_place_below: float = 0.1
    look_ahead: float = 0.6

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.sectors >= 4, "sectors", self.sectors, "4 or more")
        require_positive(
            window=self.window,
            threshold_low=self.threshold_low,
            threshold_high=self.threshold_high,
            wide_opening=self.wide_opening,
            target_cost=self.target_cost,
            max_turn_rate=self.max_turn_rate,
            look_ahead=self.look_ahead,
        )
        require_non_negative(
            safety_distance=self.safety_distance,
            current_cost=self.current_cost,
            previous_cost=self.previous_cost,
            turn_in_place_below=self.turn_in_place_below,
        )
        require(
            self.threshold_low <= self.threshold_high,
            "threshold_low",
            self.threshold_low,
            f"at most the threshold_high of {self.threshold_high}",
        )
        require(
            self.target_cost > self.current_cost + self.previous_cost,
            "target_cost",
            self.target_cost,
            f"above current_cost + previous_cost = {self.current_cost + self.previous_cost:g}",
        )


def candidate_directions(free: Mask, target: float, wide: float) -> list[float]:
    """Returns the directions worth choosing from, rad.

    The middle of a narrow opening; of a wide one the directions half of `wide` inside its ends; and
    the target itself wherever it is free. ([VFH+] takes the target only between the former two,
    which turns the robot off a way that is free already: its safety distance is in the widening.)

    Args:
        free: (n,) sectors that may be chosen; the first is centred on 0.
        target: direction of the goal, rad, in the same frame.
        wide: from which width on an opening is wide, rad.
    """
    n = len(free)
    width = 2 * math.pi / n
    if free.all():
        return [target]
    candidates: list[float] = []
    is_free = free.tolist()
    for first in range(n):
        if not is_free[first] or is_free[first - 1]:
            continue
        length = 1
        while is_free[(first + length) % n]:
            length += 1
        right, left = first * width, (first + length - 1) * width
        if length * width < wide:
            candidates.append((right + left) / 2)
        else:  # half a sector: an opening ends at its sectors' edges
            candidates += [right + (wide - width) / 2, left - (wide - width) / 2]
    if is_free[math.floor(target / width + 0.5) % n]:
        candidates.append(target)
    return [wrap(candidate) for candidate in candidates]


def cheapest(
    candidates: list[float],
    target: float,
    heading: float,
    previous: float,
    parameters: VfhPlusParameters,
) -> float:
    """Returns the candidate of the least cost ([VFH+]); of two that cost the same the left one.

    Args:
        candidates: rad, in map.
        target: direction of the goal, rad.
        heading: rad.
        previous: direction chosen last, rad; NaN when there is none.
        parameters: costs.
    """
    p = parameters

    def cost(angle: float) -> float:
        off = wrap(angle - target)
        total = p.target_cost * abs(off) + p.current_cost * abs(wrap(angle - heading))
        if not math.isnan(previous):
            total += p.previous_cost * abs(wrap(angle - previous))
        return float(total - 1e-9 * (off > 0))

    return min(candidates, key=cost)


def choose(view: View, memory: Array, parameters: VfhPlusParameters, hull: Hull) -> Choice:
    """Chooses by VFH+.

    Args:
        view: what stands around.
        memory: (sectors + 1,) which sectors were blocked, and the direction chosen last in map
            (rad, NaN if none).
        parameters: histogram, openings, cost.
        hull: of the robot.
    """
    p = parameters
    heading = float(view.pose[2])
    away = np.hypot(view.points[:, 0], view.points[:, 1])
    near = (away < p.window) & (away <= view.distance + hull.radius)
    points = view.points[near]
    radius = widened_radius(away[near], hull, p.safety_distance)
    c, s = math.cos(heading), math.sin(heading)
    in_map = points @ np.array(((c, s), (-s, c)))
    density = primary_histogram(in_map, radius, window=p.window, sectors=p.sectors)
    blocked = binary_histogram(density, memory[:-1] > 0.5, p.threshold_low, p.threshold_high)
    bearings = wrap(sector_middles(p.sectors) - heading)
    free = ~blocked
    speed = float(view.twist[0])
    if speed > p.turn_in_place_below:
        right, left = turning_limits(points, radius, speed / p.max_turn_rate)
        free &= (bearings > right) & (bearings < left)
    must_stop = not free.any()  # to turn where it can turn no more at this speed
    if must_stop:
        free = ~blocked
    shown = bearings, density, free
    if not free.any():
        return Choice(None, *shown, memory=np.append(blocked, math.nan))
    target = wrap(heading + view.bearing)
    candidates = candidate_directions(free, target, p.wide_opening)
    direction = cheapest(candidates, target, heading, float(memory[-1]), p)
    bearing = wrap(direction - heading)
    ahead = free_distance(
        points,
        bearing * _TOWARD,
        max(radius - _SLACK, hull.half_width),
    )
    room = float(ahead.min())
    clear = direction == target and not must_stop and room >= min(p.look_ahead, view.distance)
    reach = min(p.look_ahead, room, view.distance)
    if clear:
        local_goal = view.goal
    elif must_stop or reach <= 0:
        local_goal = None
    else:
        local_goal = view.ahead(bearing, reach)
    return Choice(bearing, *shown, clear, local_goal, np.append(blocked, direction))


def widened_radius(distances: Array, hull: Hull, safety_distance: float) -> float:
    """Returns by what radius points are widened, m.

    That of the robot and the safety distance; less where something is nearer than that already, so
    that the way along it stays free, but at least half the robot's width.

    Args:
        distances: (k,) of the points from the body's origin, m.
        hull: of the robot.
        safety_distance: m.
    """
    nearest = float(np.min(distances, initial=math.inf))
    return max(hull.half_width, min(hull.radius + safety_distance, _TOUCHING * nearest))


class VfhPlus(Avoider):
    """Drives toward the cheapest opening of a polar histogram (VFH+).

    .. pydrake_system::

        name: VfhPlus
        input_ports:
        - pose
        - goal
        - scan
        - command
        output_ports:
        - goal
        - state
        - health

    Args:
        parameters: histogram, openings, cost.
        rate: how often it looks, Hz.
        lidar_pose: (3,) [x (m), y (m), yaw (rad)] of the lidar in base_link.
        hull: [front, rear, half_width] of the robot about base_link, m.

    Ports:
        pose (input, vector of 3): [x (m), y (m), theta (rad)] of base_link in map, the estimate.
        goal (input, vector of 2): [x, y] (m) in map, where to go.
        scan (input, Scan): of the lidar.
        command (input, vector of 2): [v (m/s), omega (rad/s)] as last sent to the wheels; one that
            is not finite counts as standing.
        goal (output, vector of 2): [x, y] (m) in map, where to steer to: the goal itself while the
            way is free, else a point ahead in the chosen direction, nearer the less room there is;
            a millimetre beside the robot to turn in place; the robot's own place to stop. Chosen at
            `rate`; the latter two follow the pose.
        state (output, AvoiderState): the sectors, at `rate`; density is the primary histogram,
            `free` the masked one.
        health (output, Health): updates without a scan, with a stale or a garbled one, with a pose
            or a goal that is not finite (all of them stop the robot), with a command that is not.

    Source: [VFH+]. We differ in that the points of the last scan take the place of its grid of
    certainties; in the target as a candidate wherever it is free (see `candidate_directions`); in
    a safety distance that gives way where the robot is nearer already; in that what stands behind
    the goal does not matter; and in that a robot that can turn in place stops to do so when its
    turning radius leaves no direction.

    Raises:
        ValueError: rate, lidar_pose or hull out of range.
    """

    def __init__(
        self,
        *,
        parameters: VfhPlusParameters | None = None,
        rate: float = 10.0,
        lidar_pose: Sequence[float] | Array = (0.0, 0.0, 0.0),
        hull: Sequence[float] | Array = (0.11, 0.11, 0.0975),
    ) -> None:
        self._parameters = parameters or VfhPlusParameters()
        n = self._parameters.sectors
        super().__init__(
            parameters=self._parameters,
            rate=rate,
            lidar_pose=lidar_pose,
            hull=hull,
            sectors=n,
            memory=np.append(np.zeros(n), math.nan),
        )

    def _choose(self, view: View, memory: Array) -> Choice:
        return choose(view, memory, self._parameters, self._hull)
