"""The last look before the wheels: no command may end in contact with what the lidar sees.

A command passes if the robot could keep it for a moment and then brake without its hull coming too
near to any point of the scan. If not, it is slowed along its own arc, else reduced to its turn,
else stopped. As each command that passes leaves room to brake, stopping is always safe (the
"passive safety" of Macek, Vasquez, Fraichard, Siegwart, "Towards safe vehicle navigation in dynamic
urban scenarios", Automatika 50, 2009) as long as nothing moves towards the robot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.compiled import compiled, packed
from systems.health import Counts
from systems.messages import Scan
from systems.pose_trail import empty_trail, ray_poses, remember
from systems.scans import SCAN_FAULTS, scan_fault
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

_STEP = 0.025  # s, between the looks at a stopping path
_FUZZ = 1e-4  # m, by which a clearance may shrink without counting as coming nearer
_SLOWER = np.arange(0.9, 0.05, -0.1)
_TURNS = np.array([1.0, 0.5, 0.25])
_NEAR = 0.1  # m beyond the blind zone; no robot of this kind drives farther between two scans
_REMEMBERED = 128  # points at most
_BEYOND = 0.02  # m; a ray that ends this far behind a point has passed it


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


def move(pose: Array, twist: Array, dt: float) -> Array:
    """Returns the pose (3,) after driving with the twist [v, omega] along an arc for dt."""
    half = twist[1] * dt / 2
    chord = twist[0] * dt * np.sinc(half / np.pi)
    step = [chord * math.cos(pose[2] + half), chord * math.sin(pose[2] + half), 2 * half]
    return pose + np.array(step)


def into_body(points: Array, pose: Array) -> Array:
    """Returns points (n, 2) in the frame of a body at `pose` (3,), given in the pose's frame."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    turned: Array = (points - pose[:2]) @ np.array([[c, -s], [s, c]])
    return turned


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
    return _stopping_paths(packed(commands), packed(sent), packed(held), _times(parameters))


def _times(parameters: CollisionMonitorParameters) -> Array:
    p = parameters
    return np.array((p.deceleration, p.turn_deceleration, p.reaction_time, p.slowdown_time))


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
    margins = np.array((parameters.margin, parameters.contact_margin))
    safe = np.empty(len(commands), bool)
    _are_safe(
        packed(commands), packed(sent), packed(held), packed(points), packed(hull),
        _times(parameters), margins, safe,
    )  # fmt: skip
    return safe


@compiled("void(f8[:,::1], f8[::1], f8[::1], f8[:,::1], f8[::1], f8[::1], f8[::1], b1[::1])")
def _are_safe(
    commands: Array,
    sent: Array,
    held: Array,
    points: Array,
    hull: Array,
    times: Array,
    margins: Array,
    safe: NDArray[np.bool_],
) -> None:
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


def safe_command(
    command: Array,
    sent: Array,
    held: Array,
    points: Array,
    hull: Array,
    parameters: CollisionMonitorParameters,
) -> tuple[Array, float]:
    """Returns what of a command may be sent, and by which factor its speed is scaled.

    The command itself; else the fastest along the same arc that is safe; else its turn alone, in
    place, at up to its rate; else nothing. Arguments as in `are_safe`.
    """

    def are_fine(choices: Array) -> NDArray[np.bool_]:
        return are_safe(choices, sent, held, points, hull, parameters)

    if not command.any() or are_fine(command[None])[0]:
        return command, 1.0
    first, last = 0, len(_SLOWER)
    while first < last:  # the slower, the safer
        middle = (first + last) // 2
        if are_fine(_SLOWER[middle] * command[None])[0]:
            last = middle
        else:
            first = middle + 1
    if last < len(_SLOWER):
        return _SLOWER[last] * command, float(_SLOWER[last])
    if command[0] != 0 and command[1] != 0:
        turns = _TURNS[:, None] * np.array([0.0, command[1]])
        fine = are_fine(turns)
        if fine.any():
            return turns[np.argmax(fine)], 0.0
    return np.zeros(2), 0.0


def hits(scan: Scan, rays: Array) -> tuple[NDArray[np.bool_], Array]:
    """Returns which rays hit something (n,), and where: (k, 2) m, in the frame of the rays.

    Args:
        scan: n rays.
        rays: (n, 3), see `systems.pose_trail.ray_poses`.
    """
    hit = (scan.ranges >= scan.range_min) & (scan.ranges <= scan.range_max)
    hit &= np.isfinite(scan.ranges)
    x, y, direction = rays[hit].T
    along = scan.ranges[hit]
    return hit, np.stack([x + along * np.cos(direction), y + along * np.sin(direction)], axis=-1)


def still_hidden(remembered: Array, scan: Scan, rays: Array) -> Array:
    """Returns which of the points too near to be seen may still be there, (m, 2) m.

    A lidar is blind below range_min. What came in there is gone when a ray has seen something
    beyond it, and is not remembered any more when it is far enough to be seen.

    Args:
        remembered: (m, 2) m.
        scan: a scan made since.
        rays: its rays, in the frame of the points.
    """
    seen_from = rays[:: max(len(rays) // 10, 1), :2]
    distance = np.linalg.norm(remembered[:, None] - seen_from, axis=-1)
    remembered = remembered[distance.min(axis=1) < scan.range_min]
    hit = hits(scan, rays)[0]
    offset = remembered[:, None] - rays[hit, :2]
    c, s = np.cos(rays[hit, 2]), np.sin(rays[hit, 2])
    along = offset[..., 0] * c + offset[..., 1] * s
    aside = np.abs(offset[..., 1] * c - offset[..., 0] * s)
    passed = (along > 0) & (along < scan.ranges[hit] - _BEYOND)
    passed &= aside < 0.001 + along * abs(scan.angle_increment) / 2
    return remembered[~passed.any(axis=1)]


class CollisionMonitor(LeafSystem):
    """Slows and stops the wheels before the hull touches what the lidar sees.

    .. pydrake_system::

        name: CollisionMonitor
        input_ports:
        - command
        - scan
        - sent
        output_ports:
        - command
        - health

    Args:
        hull: [front, rear, half_width] of the robot about base_link, m.
        lidar_pose: (3,) [x (m), y (m), yaw (rad)] of the lidar in base_link.
        parameters: how much room the robot is to have.
        rate: how often a command is looked at and sent on, Hz.

    Ports:
        command (input, vector of 2): the wanted [v (m/s), omega (rad/s)]; counts as zeros when it
            is not finite.
        scan (input, Scan): from the lidar. One that is missing, stale or garbled stops the robot.
        sent (input, vector of 2): [v, omega] as sent to the wheels, which is what the robot is
            taken to do; the command is zeros when it is not finite.
        command (output, vector of 2): what may be sent, held between samples at `rate`: the wanted
            command, or less of it along the same arc, or its turn alone, or zeros. Zeros before
            the first sample.
        health (output, Health): samples without a scan, with a stale or garbled one, whose command
            was slowed or stopped, and whose command or `sent` was not finite.

    The rays of a scan are measured at different times: each is placed by the way that `sent` has
    led since. Points that come nearer than the lidar can see (range_min) are remembered until a ray
    passes where they were, or they are far enough to be seen again.

    Raises:
        ValueError: hull, lidar_pose or rate out of range.
    """

    def __init__(
        self,
        *,
        hull: Sequence[float],
        lidar_pose: Sequence[float],
        parameters: CollisionMonitorParameters | None = None,
        rate: float = 20.0,
    ) -> None:
        super().__init__()
        require_positive(rate=rate)
        sound = len(hull) == 3 and bool(np.isfinite(hull).all()) and min(hull) > 0
        require(sound, "hull", hull, "[front, rear, half_width], each greater than 0 (m)")
        sound = len(lidar_pose) == 3 and bool(np.isfinite(lidar_pose).all())
        require(sound, "lidar_pose", lidar_pose, "[x (m), y (m), yaw (rad)]")
        self._hull = np.array(hull, float)
        self._lidar_pose = np.array(lidar_pose, float)
        self._parameters = parameters or CollisionMonitorParameters()
        self._period = 1.0 / rate
        self._command_input = self.DeclareVectorInputPort("command", 2)
        self._scan_input = self.DeclareAbstractInputPort("scan", AbstractValue.Make(Scan()))
        self._sent_input = self.DeclareVectorInputPort("sent", 2)
        self._held = self.DeclareDiscreteState(2)
        # Scale of the last command, stamp of the last scan looked at, the last `sent`.
        self._memory = self.DeclareDiscreteState(np.array([1.0, math.nan, 0.0, 0.0]))
        trail = empty_trail(duration=self._parameters.max_scan_age, rate=rate)
        self._trail = self.DeclareDiscreteState(trail.ravel())
        self._near = self.DeclareDiscreteState(np.full(2 * _REMEMBERED, math.nan))
        self.DeclarePeriodicDiscreteUpdateEvent(self._period, 0.0, self._look)
        self._command_output = self.DeclareStateOutputPort("command", self._held)
        self._counts = Counts(self, *SCAN_FAULTS, "slowed", "stopped", "bad_command")

    def command_input_port(self) -> InputPort:
        """Returns the port of the wanted command."""
        return self._command_input

    def scan_input_port(self) -> InputPort:
        """Returns the port of the scans."""
        return self._scan_input

    def sent_input_port(self) -> InputPort:
        """Returns the port of the command as sent to the wheels."""
        return self._sent_input

    def command_output_port(self) -> OutputPort:
        """Returns the port of the command that may be sent."""
        return self._command_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    def scale(self, context: Context) -> float:
        """Returns by which factor the last command was slowed: 1 is not at all, 0 stops it."""
        return float(context.get_discrete_state(self._memory)[0])

    def _look(self, context: Context, discrete_state: DiscreteValues) -> None:
        now = context.get_time()
        command, scan = self._command_input.Eval(context), self._scan_input.Eval(context)
        sent = self._sent_input.Eval(context)
        _, last_stamp, *last_sent = context.get_discrete_state(self._memory).get_value()
        held = context.get_discrete_state(self._held).get_value()
        bad_sent = not np.isfinite(sent).all()
        if bad_sent:
            sent = np.array(last_sent)
        # Dead reckoning in a frame of its own, from where it was switched on.
        trail = context.get_discrete_state(self._trail).get_value().reshape(-1, 4)
        pose = np.zeros(3)
        if not math.isnan(trail[-1, 0]):
            pose = move(trail[-1, 1:], (np.array(last_sent) + sent) / 2, now - trail[-1, 0])
        trail = remember(trail, now, pose)

        fault = scan_fault(scan, now, self._parameters.max_scan_age)
        if fault is None and not scan.range_max > scan.range_min:
            fault = "garbled_scan"
        bad_command = not np.isfinite(command).all()
        allowed, scale = np.zeros(2), 0.0
        if fault is None:
            rays = ray_poses(scan, self._lidar_pose, trail)
            points = hits(scan, rays)[1]
            near = context.get_discrete_state(self._near).get_value().reshape(-1, 2)
            if scan.stamp != last_stamp:
                near = self._remember_near(near, points, scan, rays, pose)
                discrete_state.set_value(self._near, near.ravel())
            points = np.concatenate([points, near[np.isfinite(near[:, 0])]])
            if not bad_command and not bad_sent:
                allowed, scale = safe_command(
                    command, sent, held, into_body(points, pose), self._hull, self._parameters
                )
            last_stamp = scan.stamp
        discrete_state.set_value(self._held, allowed)
        discrete_state.set_value(self._memory, [scale, last_stamp, *sent])
        discrete_state.set_value(self._trail, trail.ravel())
        counts = {fault: 1} if fault else {}
        if bad_command or bad_sent:
            counts["bad_command"] = 1
        elif fault is None and scale < 1:
            counts["slowed" if allowed.any() else "stopped"] = 1
        self._counts.add(context, discrete_state, **counts)

    def _remember_near(
        self, near: Array, points: Array, scan: Scan, rays: Array, pose: Array
    ) -> Array:
        """Returns the points that the next scan may be blind to: (_REMEMBERED, 2), NaN-filled."""
        kept = still_hidden(near[np.isfinite(near[:, 0])], scan, rays)
        c, s = math.cos(pose[2]), math.sin(pose[2])
        lidar = pose[:2] + np.array([[c, -s], [s, c]]) @ self._lidar_pose[:2]
        distance = np.hypot(*(points - lidar).T)
        order = np.argsort(distance)
        fresh = points[order[distance[order] < scan.range_min + _NEAR]]
        found = np.concatenate([kept, fresh])[:_REMEMBERED]
        filled = np.full((_REMEMBERED, 2), math.nan)
        filled[: len(found)] = found
        return filled
