"""One picture of the obstacles from the ultrasonic range finders of all robots."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, EventStatus, InputPort, LeafSystem, OutputPort, State

from systems.angles import wrap
from systems.health import Counts
from systems.messages import Message, Scan
from systems.periods import period
from systems.planners.formation_obstacles import Obstacles
from systems.planners.sonar_grid import (
    Cones,
    SonarGrid,
    SonarGridParameters,
    empty_sonar_grid,
    rectangles,
    with_cones,
)
from systems.scans import scan_fault
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

REASONS = (
    "stale_scan", "garbled_scan", "bad_reading", "on_robot", "lost", "turning", "bad_pose",
    "out_of_bounds",
)  # fmt: skip


@dataclass
class SonarTrustParameters:
    """Which scans and readings are used.

    Attributes:
        robot_radius: of the circle about a robot's axis that holds it, m.
        robot_margin: an echo this near to that circle comes from the robot, m.
        max_scan_age: scans that are older are skipped, s.
        max_position_std: a robot must be known from another one this well along the worst axis, m.
        max_heading_std: likewise of its heading, rad.
        max_turn_rate: of a robot whose scans are used, rad/s: a pose is as old as the picture that
            it comes from.
    """

    robot_radius: float = 0.2
    robot_margin: float = 0.1
    max_scan_age: float = 0.5
    max_position_std: float = 0.05
    max_heading_std: float = 0.03
    max_turn_rate: float = 0.1

    def __post_init__(self) -> None:
        values = dict(vars(self))
        require_non_negative(robot_margin=values.pop("robot_margin"))
        require_positive(**values)


class RingGeometry(NamedTuple):
    """Where range finders are on a robot; ray i of a scan is the axis of the i-th.

    Attributes:
        pose: (3,) [x (m), y (m), yaw (rad)] of the scan's frame in base_link.
        offset: of the faces from its origin along the rays, m.
        half_angle: from the axis of a cone to its edge, rad.
    """

    pose: Array
    offset: float
    half_angle: float


def cones_of(
    scan: Scan,
    pose: Array,
    ring: RingGeometry,
    others: Array,
    radii: Array,
    parameters: SonarGridParameters,
) -> tuple[Cones, Counter[str]]:
    """Returns what a scan says, and how many readings were dropped.

    Args:
        scan: n ranges from the faces.
        pose: (3,) of the robot in map.
        ring: where its range finders are.
        others: (m, 2) where the other robots are, m.
        radii: (m,) of the circles in which they surely are, m.
        parameters: for how far a sector is free, and up to where echoes count.
    """
    p = parameters
    c, s = math.cos(pose[2]), math.sin(pose[2])
    middle = pose[:2] + np.array([[c, -s], [s, c]]) @ ring.pose[:2]
    directions = pose[2] + ring.pose[2] + scan.angles
    faces = middle + ring.offset * np.stack([np.cos(directions), np.sin(directions)], axis=-1)
    nothing = np.isposinf(scan.ranges)
    heard = (scan.ranges >= scan.range_min) & (scan.ranges <= scan.range_max)
    echoes = np.where(heard, scan.ranges, math.nan)
    free = np.where(heard, echoes - p.resolution / 2 - p.margin, 0.0)
    free[nothing] = min(p.max_free_range, scan.range_max)
    free = np.minimum(free, p.max_free_range)
    on_robot = np.zeros(len(scan), bool)
    for other, radius in zip(others, radii, strict=True):
        away = other - faces
        distance = np.hypot(*away.T)
        aside = np.abs(wrap(np.arctan2(away[:, 1], away[:, 0]) - directions))
        width = np.arcsin(np.minimum(radius / np.maximum(distance, 1e-9), 1.0))
        near = (np.abs(echoes - distance) <= radius) & (aside <= ring.half_angle + width)
        on_robot |= near | (distance <= radius)
    on_robot &= heard
    echoes[on_robot | (echoes > p.max_echo_range)] = math.nan
    counts = Counter(bad_reading=int((~heard & ~nothing).sum()), on_robot=int(on_robot.sum()))
    half_angles = np.full(len(scan), ring.half_angle)
    return Cones(faces, directions, half_angles, free, echoes), counts


def known_from_others(covariance: Array) -> Array:
    """Returns how well each robot is known from the one that it is known best from.

    Args:
        covariance: (3 N, 3 N) of the poses [x (m), y (m), theta (rad)].

    Returns:
        (N, 2) standard deviations of the position along its worst axis (m) and of the heading
        (rad); inf where the covariance is not finite.
    """
    n = len(covariance) // 3
    P = covariance.reshape(n, 3, n, 3)
    known = np.full((n, 2), math.inf)
    for i in range(n):
        for j in range(n):
            D = P[i, :, i] + P[j, :, j] - P[i, :, j] - P[j, :, i]
            if i != j and np.isfinite(D).all():
                square = (D[0, 0] + D[1, 1]) / 2 + math.hypot((D[0, 0] - D[1, 1]) / 2, D[0, 1])
                deviations = np.sqrt(np.maximum([square, D[2, 2]], 0.0))
                if deviations[0] < known[i, 0]:
                    known[i] = deviations
    return known


@dataclass(frozen=True, eq=False)
class _Memory(Message):
    """What is kept from one look to the next.

    Attributes:
        known: the grid.
        obstacles: as sent.
        poses: (N, 3) at the last look; NaN before the first.
        stamps: (N,) of the last scans that were looked at, s.
    """

    known: SonarGrid
    obstacles: Obstacles = field(default_factory=lambda: Obstacles(frame_id="map"))
    poses: Array = field(default_factory=lambda: np.zeros((0, 3)))
    stamps: Array = field(default_factory=lambda: np.zeros(0))


class SonarObstacles(LeafSystem):
    """Merges what the ultrasonic range finders of all robots hear into obstacles that all share.

    .. pydrake_system::

        name: SonarObstacles
        input_ports:
        - poses
        - covariance
        - moving
        - scan_{k}
        output_ports:
        - obstacles
        - health

    Args:
        robots: how many.
        ring_pose: (3,) [x (m), y (m), yaw (rad)] of the scans' frame in base_link, of each robot.
        offset: of the range finders' faces from its origin, m.
        half_angle: from the axis of a range finder's cone to its edge, rad.
        parameters: how the grid is built.
        trust: which scans are used.
        rate: how often new scans are looked for, Hz.

    Ports:
        poses (input, vector of 3 N): [x (m), y (m), theta (rad)] of each robot in map, estimated.
        covariance (input, vector of 9 N N): (3 N, 3 N) of them, row by row; unconnected, those that
            stand are taken to be where they are said to be, and those that move to be lost.
        moving (input, vector of N): other than 0 for each robot that moves; unconnected: none does.
        scan_{k} (input, Scan): of robot k, k from 0; ray i is the axis of a range finder, its range
            that of the nearest surface in the cone. Used once for each stamp.
        obstacles (output, Obstacles): in map; the same message for as long as nothing changes.
            Without a stamp until the first scan: the ground counts as free.
        health (output, Health): scans that were stale, garbled, led beyond the largest grid
            (`out_of_bounds`), or came from a robot that is `lost` or `turning`; readings that were
            no range (`bad_reading`) and echoes from where a robot is (`on_robot`); looks with poses
            that were not finite (`bad_pose`).

    A wide cone tells the distance of a thing and not its direction: an obstacle comes out as wide
    as the cone until another robot, or the same one from elsewhere, has listened past its ends. An
    echo from too far away, or from where a robot may be, is no obstacle: all that it says is that
    nothing is nearer. The ground under a robot is free.

    How well a robot is known counts from the robot that it is known best from: by how much the
    whole formation has drifted is no matter to what it meets next.

    Source: Moravec and Elfes 1985, see `systems.planners.sonar_grid` for what differs; that they
    are shared among the robots is from [FORM] 3.

    Raises:
        ValueError: fewer than two robots, or a ring or rate out of range.
    """

    def __init__(
        self,
        *,
        robots: int,
        ring_pose: Sequence[float] = (0.0, 0.0, 0.0),
        offset: float = 0.1,
        half_angle: float = math.radians(7.5),
        parameters: SonarGridParameters | None = None,
        trust: SonarTrustParameters | None = None,
        rate: float = 10.0,
    ) -> None:
        super().__init__()
        require(robots >= 2, "robots", robots, "2 or greater")
        require_positive(rate=rate)
        require_non_negative(offset=offset)
        sound = len(ring_pose) == 3 and bool(np.isfinite(ring_pose).all())
        require(sound, "ring_pose", ring_pose, "[x (m), y (m), yaw (rad)]")
        require(0 < half_angle < math.pi / 2, "half_angle", half_angle, "between 0 and pi / 2")
        self._ring = RingGeometry(np.array(ring_pose, float), offset, half_angle)
        self._parameters = parameters or SonarGridParameters()
        self._trust = trust or SonarTrustParameters()
        self._dt = period(rate)
        self._robots = robots
        self._poses_input = self.DeclareVectorInputPort("poses", 3 * robots)
        self._covariance_input = self.DeclareVectorInputPort("covariance", 9 * robots**2)
        self._moving_input = self.DeclareVectorInputPort("moving", robots)
        nothing = AbstractValue.Make(Scan())
        self._scan_inputs = [
            self.DeclareAbstractInputPort(f"scan_{k}", nothing) for k in range(robots)
        ]
        first = _Memory(
            empty_sonar_grid(self._parameters),
            poses=np.full((robots, 3), math.nan),
            stamps=np.full(robots, math.nan),
        )
        self._memory = self.DeclareAbstractState(AbstractValue.Make(first))
        self.DeclarePeriodicUnrestrictedUpdateEvent(self._dt, 0.0, self._look)
        self._obstacles_output = self.DeclareAbstractOutputPort(
            "obstacles",
            lambda: AbstractValue.Make(Obstacles()),
            lambda context, output: output.set_value(self._remembered(context).obstacles),
            {self.abstract_state_ticket(self._memory)},
        )
        self._counts = Counts(self, *REASONS)

    def poses_input_port(self) -> InputPort:
        """Returns the port of the estimated poses."""
        return self._poses_input

    def covariance_input_port(self) -> InputPort:
        """Returns the port of their covariance."""
        return self._covariance_input

    def moving_input_port(self) -> InputPort:
        """Returns the port of who moves."""
        return self._moving_input

    def scan_input_port(self, robot: int) -> InputPort:
        """Returns the port of a robot's scans."""
        return self._scan_inputs[robot]

    def obstacles_output_port(self) -> OutputPort:
        """Returns the port of the obstacles."""
        return self._obstacles_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    def _remembered(self, context: Context) -> _Memory:
        memory: _Memory = context.get_abstract_state(self._memory).get_value()
        return memory

    def _look(self, context: Context, state: State) -> EventStatus:
        before = self._remembered(context)
        poses = self._poses_input.Eval(context).reshape(-1, 3).copy()
        counts: Counter[str] = Counter()
        known, stamps = before.known, before.stamps.copy()
        if np.isfinite(poses).all():
            turned = np.abs(wrap(poses[:, 2] - before.poses[:, 2]))
            turning = turned > self._trust.max_turn_rate * self._dt
            scans: list[Scan] = [port.Eval(context) for port in self._scan_inputs]
            new = [k for k, scan in enumerate(scans) if _is_new(scan, stamps[k])]
            std = self._deviations(context) if new else np.zeros((self._robots, 2))
            for k in new:
                scan = scans[k]
                stamps[k] = scan.stamp
                fault = scan_fault(scan, context.get_time(), self._trust.max_scan_age)
                if fault is None and self._is_lost(std[k]):
                    fault = "lost"
                if fault is None and turning[k]:
                    fault = "turning"
                if fault is None:
                    known, fault = self._heard(known, scan, k, poses, std[:, 0], counts)
                if fault is not None:
                    counts[fault] += 1
        else:
            counts["bad_pose"] += 1
            poses = before.poses
        obstacles = before.obstacles
        # Occupied cells are the same array for as long as none of them changes.
        first = math.isnan(obstacles.stamp) and not math.isnan(known.grid.stamp)
        if first or known.occupied is not before.known.occupied:
            shapes = rectangles(known, self._parameters.max_shapes)
            if first or not np.array_equal(shapes, obstacles.polygons):
                obstacles = Obstacles(known.grid.stamp, "map", polygons=shapes)
        slot: Any = state.get_mutable_abstract_state(int(self._memory))
        slot.set_value(_Memory(known, obstacles, poses, stamps))
        self._counts.add(context, state.get_mutable_discrete_state(), **counts)
        return EventStatus.Succeeded()

    def _is_lost(self, std: Array) -> bool:
        limits = self._trust.max_position_std, self._trust.max_heading_std
        return not bool((std <= limits).all())

    def _deviations(self, context: Context) -> Array:
        """Returns how well each robot is known, (N, 2) m and rad."""
        if self._covariance_input.HasValue(context):
            covariance = self._covariance_input.Eval(context)
            return known_from_others(covariance.reshape(3 * self._robots, -1))
        std = np.zeros((self._robots, 2))
        if self._moving_input.HasValue(context):
            std[self._moving_input.Eval(context) != 0] = math.inf
        return std

    def _heard(
        self,
        known: SonarGrid,
        scan: Scan,
        robot: int,
        poses: Array,
        std: Array,
        counts: Counter[str],
    ) -> tuple[SonarGrid, str | None]:
        """Returns the grid after one robot's scan, and why it was dropped if it was."""
        trust, pose = self._trust, poses[robot]
        others = np.delete(np.arange(self._robots), robot)
        radii = trust.robot_radius + trust.robot_margin + 2 * std[others]
        cones, dropped = cones_of(
            scan, pose, self._ring, poses[others, :2], radii, self._parameters
        )
        own = Cones(
            faces=np.concatenate([cones.faces, pose[None, :2]]),
            directions=np.append(cones.directions, 0.0),
            half_angles=np.append(cones.half_angles, math.pi),
            free=np.append(cones.free, trust.robot_radius),
            echoes=np.append(cones.echoes, math.nan),
        )
        try:
            known = with_cones(known, own, scan.stamp, self._parameters)
        except ValueError:
            return known, "out_of_bounds"
        counts.update(dropped)
        return known, None


def _is_new(scan: Scan, last: float) -> bool:
    return not math.isnan(scan.stamp) and scan.stamp != last
