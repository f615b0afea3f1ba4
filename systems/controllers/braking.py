"""Whether a robot that follows a command can still brake before its hull comes too near.

See `collision_monitor`, which asks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled, packed
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

_STEP = 0.025  # s, between the looks at a stopping path
_FUZZ = 1e-4  # m, by which a clearance may shrink without counting as coming nearer


@dataclass
class CollisionMonitorParameters:
    """How much room the robot is to have.

    Attributes:
        deceleration: how fast the drive changes its speed, m/s^2.
        turn_deceleration: how fast it changes its turning rate, rad/s^2.
        reaction_time: from this block's sample until the wheels begin to follow it, s: at least
            its period and that of the drive.
        slowdown_time: how long a command must be safe to keep before braking, s; the larger, the
            earlier it slows before an obstacle.
        margin: room that driving must leave about the hull, m. A robot that is to turn in place
            where it has stopped needs what its corners swing out.
        contact_margin: room that turning in place must leave, m; what range noise and the gaps
            between rays may hide.
        max_scan_age: how long after its first ray a scan may be driven by, s.
    """

    deceleration: float = 1.0
    turn_deceleration: float = 10.0
    reaction_time: float = 0.1
    slowdown_time: float = 0.4
    margin: float = 0.06
    contact_margin: float = 0.005
    max_scan_age: float = 0.6

    def __post_init__(self) -> None:
        require_positive(
            deceleration=self.deceleration,
            turn_deceleration=self.turn_deceleration,
            slowdown_time=self.slowdown_time,
            max_scan_age=self.max_scan_age,
        )
        require_non_negative(
            reaction_time=self.reaction_time,
            margin=self.margin,
            contact_margin=self.contact_margin,
        )
        require(
            self.contact_margin <= self.margin,
            "contact_margin",
            self.contact_margin,
            f"at most the margin of {self.margin} m",
        )


def clearance(points: Array, hull: Array) -> Array:
    """Returns how far points (..., 2) m in the body are outside the hull, m; negative inside.

    Args:
        points: (..., 2) in the body's frame, m.
        hull: (3,) [front, rear, half_width] m: the rectangle from -rear to front along x, and half
            the width to either side.
    """
    distances = [_clearance(x, y, packed(hull)) for x, y in points.reshape(-1, 2).tolist()]
    return np.array(distances).reshape(points.shape[:-1])


@compiled("f8(f8, f8, f8[::1])")
def _clearance(x: float, y: float, hull: Array) -> float:
    front, rear, half_width = hull[0], hull[1], hull[2]
    dx = abs(x - (front - rear) / 2) - (front + rear) / 2
    dy = abs(y) - half_width
    return max(dx, dy) if dx <= 0 or dy <= 0 else math.sqrt(dx * dx + dy * dy)


def stopping_paths(
    commands: Array, sent: Array, held: Array, parameters: CollisionMonitorParameters
) -> Array:
    """Returns the ways to a stop: follow each command for the slowdown time, then brake.

    Args:
        commands: (c, 2) [v (m/s), omega (rad/s)].
        sent: (2,) what the wheels do now.
        held: (2,) what they have been told last, and follow until they react.
        parameters: times and decelerations.

    Returns:
        (c, n, 3) poses in the body's frame of now, evenly in time until all stand.
    """
    times, _ = as_arrays(parameters)
    return _stopping_paths(packed(commands), packed(sent), packed(held), times)


def as_arrays(parameters: CollisionMonitorParameters) -> tuple[Array, Array]:
    """Returns the times (4,) and the margins (2,), as compiled functions take them."""
    p = parameters
    times = np.array((p.deceleration, p.turn_deceleration, p.reaction_time, p.slowdown_time))
    return times, np.array((p.margin, p.contact_margin))


@compiled()
def _toward(start: float, end: float, change: float) -> float:
    return start + min(max(end - start, -change), change)


@compiled("f8[:,:,::1](f8[:,::1], f8[::1], f8[::1], f8[::1])")
def _stopping_paths(commands: Array, sent: Array, held: Array, times: Array) -> Array:
    reaction, slowdown = times[2], times[3]
    longest = 0.0
    for i in range(2):
        fastest = max(abs(sent[i]), abs(held[i]))
        for k in range(len(commands)):
            fastest = max(fastest, abs(commands[k, i]))
        longest = max(longest, fastest / times[i])
    n = math.ceil((reaction + slowdown + longest) / _STEP)
    paths = np.empty((len(commands), n, 3))
    speed = np.empty(2)
    for k in range(len(commands)):
        x, y, turned = 0.0, 0.0, 0.0
        for j in range(n):
            t = (j + 0.5) * _STEP
            following = min(max(t - reaction, 0.0), slowdown)
            braking = max(t - reaction - slowdown, 0.0)
            for i in range(2):
                now = _toward(sent[i], held[i], times[i] * min(t, reaction))
                now = _toward(now, commands[k, i], times[i] * following)
                speed[i] = _toward(now, 0.0, times[i] * braking)
            heading = turned + speed[1] * _STEP / 2
            x += speed[0] * math.cos(heading) * _STEP
            y += speed[0] * math.sin(heading) * _STEP
            turned += speed[1] * _STEP
            paths[k, j, 0], paths[k, j, 1], paths[k, j, 2] = x, y, turned
    return paths


def are_safe(
    commands: Array,
    sent: Array,
    held: Array,
    points: Array,
    hull: Array,
    parameters: CollisionMonitorParameters,
) -> NDArray[np.bool_]:
    """Returns which of the commands (c, 2) leave room to brake: (c,).

    On the way to a stop no point may come nearer to the hull than the margin; when something is
    nearer already, nothing may come nearer than that is, down to the contact margin; and what is
    within the contact margin may not come nearer at all. So the robot can always drive away.

    Args:
        commands: see `stopping_paths`.
        sent: see `stopping_paths`.
        held: see `stopping_paths`.
        points: (k, 2) obstacles in the body's frame of now, m.
        hull: see `clearance`.
        parameters: margins, times and decelerations.
    """
    safe = np.empty(len(commands), bool)
    mark_safe(
        packed(commands), packed(sent), packed(held), packed(points), packed(hull),
        *as_arrays(parameters), safe,
    )  # fmt: skip
    return safe


@compiled("void(f8[:,::1], f8[::1], f8[::1], f8[:,::1], f8[::1], f8[::1], f8[::1], b1[::1])")
def mark_safe(
    commands: Array,
    sent: Array,
    held: Array,
    points: Array,
    hull: Array,
    times: Array,
    margins: Array,
    safe: NDArray[np.bool_],
) -> None:
    """Writes which commands are safe; see `are_safe`, and `as_arrays` for times and margins."""
    margin, contact = margins[0], margins[1]
    paths = _stopping_paths(commands, sent, held, times)
    reach = 0.0
    for k in range(len(commands)):
        for j in range(paths.shape[1]):
            reach = max(reach, math.hypot(paths[k, j, 0], paths[k, j, 1]))
    reach += math.hypot(max(hull[0], hull[1]), hull[2]) + margin
    near, now, least = np.empty(len(points), np.intp), np.empty(len(points)), math.inf
    n = 0
    for m in range(len(points)):
        if math.hypot(points[m, 0], points[m, 1]) < reach:
            near[n], now[n] = m, _clearance(points[m, 0], points[m, 1], hull)
            least = min(least, now[n])
            n += 1
    driving = min(max(least, contact), margin)
    for k in range(len(commands)):
        safe[k] = True
        room = contact if commands[k, 0] == 0 else driving
        for j in range(paths.shape[1]):
            c, s = math.cos(paths[k, j, 2]), math.sin(paths[k, j, 2])
            for m in range(n):
                x, y = points[near[m], 0] - paths[k, j, 0], points[near[m], 1] - paths[k, j, 1]
                there = _clearance(c * x + s * y, c * y - s * x, hull)
                if there < min(room, now[m]) - _FUZZ:
                    safe[k] = False
                    break
            if not safe[k]:
                break
