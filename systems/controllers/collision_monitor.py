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

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.compiled import compiled, packed
from systems.controllers.braking import CollisionMonitorParameters, as_arrays, mark_safe
from systems.health import Counts
from systems.messages import Scan
from systems.periods import period
from systems.pose_trail import empty_trail, ray_ends, ray_poses, remember
from systems.scans import SCAN_FAULTS, hits, scan_fault
from systems.validation import require, require_positive

Array = NDArray[np.float64]

_SLOWER = np.arange(0.9, 0.05, -0.1)
_TURNS = np.array([1.0, 0.5, 0.25])
_NEAR = 0.1  # m beyond the blind zone; no robot of this kind drives farther between two scans
_REMEMBERED = 128  # points at most
_BEYOND = 0.02  # m; a ray that ends this far behind a point has passed it


def move(pose: Array, twist: Array, dt: float) -> Array:
    """Returns the pose (3,) after driving with the twist [v, omega] along an arc for dt."""
    v, omega = float(twist[0]), float(twist[1])
    x, y, theta = pose.tolist()
    half = omega * dt / 2
    chord = v * dt * (math.sin(half) / half if half else 1.0)
    return np.array(
        (x + chord * math.cos(theta + half), y + chord * math.sin(theta + half), theta + 2 * half)
    )


def into_body(points: Array, pose: Array) -> Array:
    """Returns points (n, 2) in the frame of a body at `pose` (3,), given in the pose's frame."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    turned: Array = (points - pose[:2]) @ np.array([[c, -s], [s, c]])
    return turned


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
    if not command.any():
        return command, 1.0
    allowed = np.array(command)
    scale = _safe_command(
        allowed, packed(sent), packed(held), packed(points), packed(hull),
        *as_arrays(parameters),
    )  # fmt: skip
    return allowed, scale


@compiled("f8(f8[::1], f8[::1], f8[::1], f8[:,::1], f8[::1], f8[::1], f8[::1])")
def _safe_command(
    command: Array,
    sent: Array,
    held: Array,
    points: Array,
    hull: Array,
    times: Array,
    margins: Array,
) -> float:
    """Reduces the command to what is safe; returns by which factor its speed is scaled."""
    v, omega = command[0], command[1]
    one, safe = np.empty((1, 2)), np.empty(3, np.bool_)
    one[0, 0], one[0, 1] = v, omega
    mark_safe(one, sent, held, points, hull, times, margins, safe)
    if safe[0]:
        return 1.0
    first, last = 0, len(_SLOWER)
    while first < last:  # the slower, the safer
        middle = (first + last) // 2
        one[0, 0], one[0, 1] = _SLOWER[middle] * v, _SLOWER[middle] * omega
        mark_safe(one, sent, held, points, hull, times, margins, safe)
        if safe[0]:
            last = middle
        else:
            first = middle + 1
    factor = _SLOWER[last] if last < len(_SLOWER) else 0.0
    command[0], command[1] = factor * v, factor * omega
    if factor == 0 and v != 0 and omega != 0:
        turns = np.empty((3, 2))
        for k in range(3):
            turns[k, 0], turns[k, 1] = 0.0, _TURNS[k] * omega
        mark_safe(turns, sent, held, points, hull, times, margins, safe)
        for k in range(2, -1, -1):
            if safe[k]:
                command[1] = turns[k, 1]
    return factor


def still_hidden(remembered: Array, scan: Scan, rays: Array) -> Array:
    """Returns which of the points too near to be seen may still be there, (m, 2) m.

    A lidar is blind below range_min. What came in there is gone when a ray has seen something
    beyond it, and is not remembered any more when it is far enough to be seen.

    Args:
        remembered: (m, 2) m.
        scan: a scan made since.
        rays: its rays, in the frame of the points.
    """
    if len(remembered) == 0:
        return remembered
    seen_from = rays[:: max(len(rays) // 10, 1), :2]
    distance = np.linalg.norm(remembered[:, None] - seen_from, axis=-1)
    remembered = remembered[distance.min(axis=1) < scan.range_min]
    hit = hits(scan)
    offset = remembered[:, None] - rays[hit, :2]
    c, s = np.cos(rays[hit, 2]), np.sin(rays[hit, 2])
    along = offset[..., 0] * c + offset[..., 1] * s
    aside = np.abs(offset[..., 1] * c - offset[..., 0] * s)
    passed = (along > 0) & (along < scan.ranges[hit] - _BEYOND)
    passed &= aside < 0.001 + along * abs(scan.angle_increment) / 2
    return remembered[~passed.any(axis=1)]


def _filled(near: Array) -> Array:
    """Returns the points that are there, of an array filled up with NaN."""
    return near[np.isfinite(near[:, 0])]


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
        self._period = period(rate)
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
        memory = context.get_discrete_state(self._memory).get_value()
        last_stamp, last_sent = memory[1], memory[2:]
        held = context.get_discrete_state(self._held).get_value()
        bad_sent = not all(map(math.isfinite, sent.tolist()))
        if bad_sent:
            sent = last_sent
        # Dead reckoning in a frame of its own, from where it was switched on.
        trail = discrete_state.get_mutable_value(self._trail).reshape(-1, 4)
        pose = np.zeros(3)
        if not math.isnan(trail[-1, 0]):
            pose = move(trail[-1, 1:], (last_sent + sent) / 2, now - float(trail[-1, 0]))
        trail[:] = remember(trail, now, pose)

        fault = scan_fault(scan, now, self._parameters.max_scan_age)
        bad_command = not all(map(math.isfinite, command.tolist()))
        allowed, scale = np.zeros(2), 0.0
        if fault is None:
            rays = ray_poses(scan, self._lidar_pose, trail)
            points = ray_ends(scan, rays)
            near = context.get_discrete_state(self._near).get_value().reshape(-1, 2)
            if scan.stamp != last_stamp:
                near = self._remember_near(near, points, scan, rays, pose)
                discrete_state.set_value(self._near, near.ravel())
            if not math.isnan(near[0, 0]):
                points = np.concatenate([points, _filled(near)])
            if not bad_command and not bad_sent:
                allowed, scale = safe_command(
                    command, sent, held, into_body(points, pose), self._hull, self._parameters
                )
            last_stamp = scan.stamp
        discrete_state.set_value(self._held, allowed)
        discrete_state.set_value(self._memory, [scale, last_stamp, *sent.tolist()])
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
        kept = still_hidden(_filled(near), scan, rays)
        c, s = math.cos(pose[2]), math.sin(pose[2])
        lidar = pose[:2] + np.array([[c, -s], [s, c]]) @ self._lidar_pose[:2]
        distance = np.hypot(points[:, 0] - lidar[0], points[:, 1] - lidar[1])
        fresh = np.flatnonzero(distance < scan.range_min + _NEAR)
        fresh = fresh[np.argsort(distance[fresh])]
        found = np.concatenate([kept, points[fresh]])[:_REMEMBERED]
        filled = np.full((_REMEMBERED, 2), math.nan)
        filled[: len(found)] = found
        return filled
