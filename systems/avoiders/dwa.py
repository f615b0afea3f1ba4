"""The dynamic window approach: the best of the arcs that the robot can drive and still stop on.

[DWA]: Fox, Burgard, Thrun, "The dynamic window approach to collision avoidance", IEEE Robotics and
Automation Magazine 4(1), 1997, pages 23-33.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import OutputPort

from systems.angles import wrap
from systems.avoiders.base import Avoider, AvoiderParameters, Choice, Hull, View
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

_DIRECTIONS = 120  # 3 degrees each: 1 cm at 0.2 m
_STRAIGHT = 1e-3  # rad/s; a slower turn counts as this, to have a centre
_FUZZ = 0.005  # m, by which the room may shrink without counting as coming nearer
_ARRIVED = 0.02  # m from the goal, where it stops
_TOUCHING = 0.9  # part of the room left that is kept free, where it is less than the margin


@dataclass
class DwaParameters(AvoiderParameters):
    """Limits of the robot, arcs and objective of the dynamic window approach.

    Attributes:
        max_speed: m/s.
        max_turn_rate: rad/s.
        max_acceleration: of speeding up and of braking, m/s^2.
        max_turn_acceleration: rad/s^2.
        window_time: how long the robot may accelerate to reach the next command, s.
        reaction_time: what passes before it begins to brake, s.
        margin: room between hull and obstacles, m. Where there is less already, it is content with
            what there is.
        comfort: room beside the hull that is enough, m; what moves may come nearer by a part of it
            before the next scan shows it.
        speeds: how many speeds are tried,
        turn_rates: and turning rates; an odd number, so that none is among them.
        preview: how long an arc is followed to see where it leads, s.
        look_ahead: how much free way, along the arc and then straight on, is enough, m.
        slow_down: speed by distance near the goal, 1/s.
        heading_weight: of the direction toward the goal at the arc's end,
        clearance_weight: of the free way,
        velocity_weight: of the speed,
        comfort_weight: and of the room beside the hull, in the objective.
        least_speed: a direction is free when an arc of at least this speed leads there, m/s.
    """

    max_speed: float = 0.3
    max_turn_rate: float = 1.5
    max_acceleration: float = 0.6
    max_turn_acceleration: float = 4.0
    window_time: float = 0.25
    reaction_time: float = 0.25
    margin: float = 0.06
    comfort: float = 0.15
    speeds: int = 5
    turn_rates: int = 21
    preview: float = 0.8
    look_ahead: float = 1.2
    slow_down: float = 0.8
    heading_weight: float = 1.0
    clearance_weight: float = 1.0
    velocity_weight: float = 0.2
    comfort_weight: float = 0.4
    least_speed: float = 0.03

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(
            max_speed=self.max_speed,
            max_turn_rate=self.max_turn_rate,
            max_acceleration=self.max_acceleration,
            max_turn_acceleration=self.max_turn_acceleration,
            window_time=self.window_time,
            preview=self.preview,
            look_ahead=self.look_ahead,
            comfort=self.comfort,
            slow_down=self.slow_down,
            least_speed=self.least_speed,
        )
        require_non_negative(
            reaction_time=self.reaction_time,
            margin=self.margin,
            heading_weight=self.heading_weight,
            clearance_weight=self.clearance_weight,
            velocity_weight=self.velocity_weight,
            comfort_weight=self.comfort_weight,
        )
        require(self.speeds >= 2, "speeds", self.speeds, "2 or more")
        odd = self.turn_rates >= 3 and self.turn_rates % 2 == 1
        require(odd, "turn_rates", self.turn_rates, "an odd number from 3")
        require(
            self.least_speed < self.max_speed,
            "least_speed",
            self.least_speed,
            f"below the max_speed of {self.max_speed} m/s",
        )


def dynamic_window(twist: Array, parameters: DwaParameters) -> tuple[Array, Array]:
    """Returns the commands that can be reached: speeds (a,) m/s and turning rates (a,) rad/s.

    Those of one turning rate stand together: (turn_rates, speeds), ravelled. A turning rate of
    exactly 0 is among them when it can be reached.

    Args:
        twist: (2,) [v, omega] now.
        parameters: limits, window time, numbers.
    """
    p = parameters
    change = np.array([p.max_acceleration, p.max_turn_acceleration]) * p.window_time
    least, most = np.array([0.0, -p.max_turn_rate]), np.array([p.max_speed, p.max_turn_rate])
    low, high = np.clip(twist - change, least, most), np.clip(twist + change, least, most)
    v = np.linspace(low[0], high[0], p.speeds)
    omega = np.linspace(low[1], high[1], p.turn_rates)
    if low[1] < 0 < high[1]:
        omega[np.argmin(np.abs(omega))] = 0.0
    return np.tile(v, p.turn_rates), np.repeat(omega, p.speeds)


def thinned(points: Array, far: float) -> Array:
    """Returns the nearest point in each of `_DIRECTIONS` directions, if it is nearer than `far` m.

    Args:
        points: (k, 2) m, in the body's frame.
        far: m.
    """
    distances = np.hypot(points[:, 0], points[:, 1])
    order = np.flatnonzero(distances < far)
    order = order[np.argsort(-distances[order])]
    angle = np.arctan2(points[order, 1], points[order, 0]) / (2 * math.pi)
    nearest = np.full(_DIRECTIONS, -1)
    nearest[np.floor(angle * _DIRECTIONS).astype(int) % _DIRECTIONS] = order
    return points[nearest[nearest >= 0]]


def distance_outside(points: Array, hull: Hull) -> Array:
    """Returns how far points (..., 2) in the body's frame are outside the hull, m; 0 inside."""
    dx = np.maximum(points[..., 0] - hull.front, -hull.rear - points[..., 0])
    dy = np.abs(points[..., 1]) - hull.half_width
    distances: Array = np.hypot(np.maximum(dx, 0.0), np.maximum(dy, 0.0))
    return distances


def with_room(points: Array, hull: Hull, margin: float) -> Hull:
    """Returns the hull with room around it, less where the points leave less.

    Where it stops before something it is to be able to turn: so ahead there is room for what its
    corners swing out, too.

    Args:
        points: (k, 2) m, in the body's frame.
        hull: outline.
        margin: m.
    """
    outside = float(np.min(distance_outside(points, hull), initial=math.inf))
    margin = min(margin, _TOUCHING * outside)
    wide = Hull(hull.front + margin, hull.rear + margin, hull.half_width + margin)
    beside = np.abs(points[:, 1]) < wide.half_width
    ahead = points[beside & (points[:, 0] > 0), 0] - wide.front
    swing = min(hull.radius - hull.front, _TOUCHING * float(np.min(ahead, initial=math.inf)))
    return Hull(wide.front + max(swing, 0.0), wide.rear, wide.half_width)


def contact_times(points: Array, hull: Hull, v: Array, omega: Array) -> Array:
    """Returns when the hull meets the first of the points, driving an arc for good: (a,) s, or inf.

    Seen from the robot, a point moves on a circle about the arc's centre; it is met where that
    circle first crosses one of the four sides.

    Args:
        points: (k, 2) m, in the body's frame. One inside the hull is met at once.
        hull: outline.
        v: (a,) m/s, forward or 0.
        omega: (a,) rad/s.
    """
    times = np.full(len(v), math.inf)
    if len(points) == 0:
        return times
    # Mirrored, so that every arc turns left.
    side = np.where(omega < 0, -1.0, 1.0)[:, None]
    rate = np.maximum(np.abs(omega), _STRAIGHT)
    centre = (v / rate)[:, None]
    x, y = points[:, 0][None], side * points[:, 1][None] - centre
    square = x * x + y * y
    for along_x, c in ((True, hull.front), (True, -hull.rear), (False, 1.0), (False, -1.0)):
        fixed = np.full_like(centre, c) if along_x else c * hull.half_width - centre
        root = np.sqrt(np.maximum(square - fixed * fixed, 0.0))
        meets = square >= fixed * fixed
        for other in (root, -root):
            if along_x:
                valid = meets & (np.abs(other + centre) <= hull.half_width)
            else:
                valid = meets & (other <= hull.front) & (other >= -hull.rear)
            arc, point = np.nonzero(valid)
            across = np.broadcast_to(fixed, valid.shape)[arc, point]
            crossing_x, crossing_y = (
                (across, other[arc, point]) if along_x else (other[arc, point], across)
            )
            at = np.arctan2(y[arc, point], x[0, point])
            turn = np.remainder(at - np.arctan2(crossing_y, crossing_x), 2 * math.pi)
            np.minimum.at(times, arc, turn / rate[arc])
    inside = (np.abs(points[:, 1]) < hull.half_width) & (points[:, 0] < hull.front)
    if (inside & (points[:, 0] > -hull.rear)).any():
        times[:] = 0.0
    return times


def poses_on_arcs(v: Array, omega: Array, t: Array) -> tuple[Array, Array, Array]:
    """Returns x, y (m) and heading (rad) in the body's frame of now, after driving arcs for t s."""
    turn = omega * t
    chord = v * t * np.sinc(turn / (2 * math.pi))
    return chord * np.cos(turn / 2), chord * np.sin(turn / 2), turn


def seen_from(points: Array, x: Array, y: Array, theta: Array) -> Array:
    """Returns points (k, 2) in the frames of poses (a,) that the points' frame holds: (a, k, 2)."""
    c, s = np.cos(theta)[:, None], np.sin(theta)[:, None]
    dx, dy = points[:, 0] - x[:, None], points[:, 1] - y[:, None]
    return np.stack([c * dx + s * dy, c * dy - s * dx], axis=-1)


def straight_room(points: Array, hull: Hull, x: Array, y: Array, theta: Array) -> Array:
    """Returns how far the hull gets straight on from each of those poses, (a,) m; inf if free."""
    seen = seen_from(points, x, y, theta)
    ahead = seen[..., 0] - hull.front
    met = (np.abs(seen[..., 1]) < hull.half_width) & (ahead > -hull.front - hull.rear)
    room: Array = np.where(met, np.maximum(ahead, 0.0), math.inf).min(axis=1, initial=math.inf)
    return room


def choose(view: View, parameters: DwaParameters, hull: Hull) -> Choice:
    """Chooses by the dynamic window approach.

    Args:
        view: what stands around.
        parameters: limits, arcs, objective.
        hull: of the robot.
    """
    p = parameters
    v, omega = dynamic_window(view.twist, p)
    points = thinned(view.points, p.max_speed * p.preview + p.look_ahead + hull.radius)
    room = with_room(points, hull, p.margin)
    braking = np.maximum(v / p.max_acceleration, np.abs(omega) / p.max_turn_acceleration) / 2
    stopping = p.reaction_time + braking
    matters = p.max_speed * max(p.preview, float(stopping.max())) + room.radius
    near = points[np.hypot(points[:, 0], points[:, 1]) <= matters]
    contact = contact_times(near, room, v, omega)
    # And not still nearer to what is too near already, as something that moves may be.
    beside = seen_from(near, *poses_on_arcs(v, omega, stopping))
    now, then = (
        distance_outside(seen, hull).min(axis=-1, initial=math.inf) for seen in (near, beside)
    )
    admissible = (contact > stopping) & (then >= min(p.margin, float(now)) - _FUZZ)
    forward = admissible & (v >= p.least_speed)

    # No farther than the goal: what stands behind it does not matter.
    distance, bearing = view.distance, view.bearing
    t = np.minimum(np.minimum(p.preview, contact), distance / np.maximum(v, 1e-9))
    x, y, theta = poses_on_arcs(v, omega, t)
    gx, gy = distance * math.cos(bearing), distance * math.sin(bearing)
    left = np.hypot(gx - x, gy - y)
    off = np.abs(wrap(np.arctan2(gy - y, gx - x) - theta))
    heading = 1 - np.where(left > 0.05, off, 0.0) / math.pi
    enough = max(min(p.look_ahead, distance), 1e-9)
    way = np.where(contact > t, straight_room(points, room, x, y, theta), 0.0) + v * t
    clearance = np.minimum(way / enough, 1.0)
    comfort = np.minimum(then / p.comfort, 1.0)
    wanted = min(p.max_speed, p.slow_down * distance)
    velocity = 1 - np.abs(v - wanted) / p.max_speed
    value = (
        p.heading_weight * heading
        + p.clearance_weight * clearance
        + p.velocity_weight * velocity
        + p.comfort_weight * comfort
    )

    columns = (p.turn_rates, p.speeds)
    free = forward.reshape(columns).any(axis=1)
    rates = omega.reshape(columns)[:, 0]
    angles = wrap(rates * p.preview / 2)
    crowded = np.where(admissible, 1 - clearance, 1.0).reshape(columns).min(axis=1)
    if not free.any():
        spin = np.array([p.max_turn_rate, -p.max_turn_rate])
        meets = contact_times(near, hull, np.zeros(2), spin)
        may = meets > p.reaction_time + p.max_turn_rate / p.max_turn_acceleration / 2
        return Choice(None, angles, crowded, free, turns=np.where(may, p.max_turn_rate, 0.0))
    # To stand still is no way out while there is one, nor is turning to and fro on the spot: there
    # it turns toward the goal only.
    moves = admissible & ((v >= p.least_speed) | (omega * np.sign(bearing) > _STRAIGHT))
    best = int(np.argmax(np.where(moves, value, -math.inf)))
    to_goal = straight_room(points, room, *np.array([[0.0], [0.0], [bearing]]))[0]
    clear = bool(to_goal >= enough)
    if distance < _ARRIVED:
        command, local_goal = np.zeros(2), view.goal
    else:
        command, local_goal = np.array([v[best], omega[best]]), view.goal
        if not clear:
            end = math.atan2(y[best], x[best]), math.hypot(x[best], y[best])
            on = max(0.0, min(float(way[best]), enough) - float(v[best] * t[best]))
            direction = view.ahead(float(theta[best]), on) - view.pose[:2]
            local_goal = view.ahead(*end) + direction
    return Choice(float(theta[best]), angles, crowded, free, clear, local_goal, command=command)


class DwaAvoider(Avoider):
    """Drives itself along the best arc of its dynamic window (DWA).

    .. pydrake_system::

        name: DwaAvoider
        input_ports:
        - pose
        - goal
        - scan
        - command
        output_ports:
        - goal
        - state
        - health
        - command

    Args:
        parameters: limits of the robot, arcs, objective.
        rate: how often it looks, Hz.
        lidar_pose: (3,) [x (m), y (m), yaw (rad)] of the lidar in base_link.
        hull: [front, rear, half_width] of the robot about base_link, m.

    Ports:
        pose (input, vector of 3): [x (m), y (m), theta (rad)] of base_link in map, the estimate.
        goal (input, vector of 2): [x, y] (m) in map, where to go.
        scan (input, Scan): of the lidar.
        command (input, vector of 2): [v (m/s), omega (rad/s)] as last sent to the wheels, the
            middle of the window; one that is not finite counts as standing.
        goal (output, vector of 2): [x, y] (m) in map: the goal itself while the straight way to it
            is free, else where the chosen arc and the free way straight on from it lead; a
            millimetre beside the robot while it turns in place; the robot's own place when it
            stops. For viewers: this avoider drives. The latter two follow the pose.
        state (output, AvoiderState): the turning rates of the window, at `rate`: the angles are
            where their arcs point, density is 0 where enough of the way is free and 1 where none
            is, `free` those with an arc that leads forward and on which it can still stop.
        health (output, Health): updates without a scan, with a stale or a garbled one, with a pose
            or a goal that is not finite (all of them stop the robot), with a command that is not.
        command (output, vector of 2): [v (m/s), omega (rad/s)], at `rate`; zeros when it stops.

    Source: [DWA]. The objective is the weighted sum of heading, clearance and velocity, without
    smoothing. We differ in a fourth term, the room beside the hull; in that clearance goes on
    straight at the end of the arc (along a slow arc alone everything looks clear); in the
    rectangular hull, whose contact with the points is exact; in that nothing beyond the goal
    counts; and in that it turns on the spot toward the goal only. As in [DWA], what moves is taken
    to stand: the robot stops before it, but may be run into.

    Raises:
        ValueError: rate, lidar_pose or hull out of range.
    """

    def __init__(
        self,
        *,
        parameters: DwaParameters | None = None,
        rate: float = 10.0,
        lidar_pose: Sequence[float] | Array = (0.0, 0.0, 0.0),
        hull: Sequence[float] | Array = (0.11, 0.11, 0.0975),
    ) -> None:
        self._parameters = parameters or DwaParameters()
        super().__init__(
            parameters=self._parameters,
            rate=rate,
            lidar_pose=lidar_pose,
            hull=hull,
            sectors=self._parameters.turn_rates,
            memory=np.zeros(1),
        )
        self._command_output = self.DeclareStateOutputPort("command", self._command)

    def command_output_port(self) -> OutputPort:
        """Returns the port of the drive command."""
        return self._command_output

    def _choose(self, view: View, memory: Array) -> Choice:
        del memory  # the command as sent is all that it goes on from
        return choose(view, self._parameters, self._hull)
