"""A step of a formation by [FORM]'s Algorithm I: lateral pixels, a known side, and no pose at all.

[FORM]: Kang, Kwon, Bae, Kim, "Monocular Vision-Based Swarm Robot Localization Using Equilateral
Triangular Formations".
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from systems.cameras import PinholeCamera
from systems.controllers.formation_step import (
    FormationStep,
    FormationStepParameters,
    View,
    check_view,
)
from systems.controllers.step_localizer import Fix, ResectionTrustParameters, StepLocalizer
from systems.controllers.step_task import Status, StepTask
from systems.formation.axes import beacon_axes
from systems.formation.bearing_filter import BearingFilterParameters
from systems.formation.building import FORWARD, Algorithm1Parameters, algorithm1
from systems.formation.triangles import HEIGHT, arrival_heading, next_vertex, orientation

Array = NDArray[np.float64]

_CENTRED = math.radians(2.0)
_HALF_TURN_OF_PASS = math.radians(30.0)  # from the entry's line to the inside, and out again
_ROUND = 2 * math.pi + 0.5
_SCALARS = 6
_SHORT_WAY = 2  # centre points: entry and exit of the beacons' own triangle
_AT_VERTEX = 0.3  # sides


class Stage(IntEnum):
    """What the robot is at."""

    AIM = 0
    RECEDE = 1
    ENTER = 2
    TURN_IN = 3
    CROSS = 4
    TURN_OUT = 5
    BUILD = 6
    RETREAT = 7
    WAY = 8


_STATUS = {
    Stage.AIM: Status.APPROACH,
    Stage.RECEDE: Status.APPROACH,
    Stage.ENTER: Status.APPROACH,
    Stage.TURN_IN: Status.PASS,
    Stage.CROSS: Status.PASS,
    Stage.TURN_OUT: Status.PASS,
    Stage.BUILD: Status.BUILD,
    Stage.RETREAT: Status.BUILD,
    Stage.WAY: Status.APPROACH,
}


@dataclass
class _Memory:
    """What is remembered from one decision to the next.

    Attributes:
        fix: where the robot is, on a long way.
        stage: what it is at.
        left: distance (m) or angle (rad) that is left of the stage, by the commands.
        turn: +1 when the pivot is to the left at the entry, -1 to the right, 0 not yet known.
        direction: of the shunt.
        waited: for a beacon, s.
        passed: centre points of a long way that lie behind the robot.
    """

    fix: Fix
    stage: float = Stage.AIM
    left: float = _ROUND
    turn: float = 0.0
    direction: float = FORWARD
    waited: float = 0.0
    passed: float = 0.0

    @staticmethod
    def from_vector(v: Array) -> _Memory:
        return _Memory(Fix.from_vector(v[_SCALARS:]), *v[:_SCALARS].tolist())

    def vector(self) -> Array:
        scalars = [self.stage, self.left, self.turn, self.direction, self.waited, self.passed]
        return np.concatenate([scalars, self.fix.vector()])

    def enter(self, stage: Stage, left: float) -> None:
        self.stage, self.left, self.waited = stage, left, 0.0


class TriangleAlgorithm1(FormationStep):
    """Drives a robot through a step of a formation by lateral pixels: [FORM]'s Algorithm I.

    .. pydrake_system::

        name: TriangleAlgorithm1
        input_ports:
        - front_detections
        - rear_detections
        - task
        output_ports:
        - command
        - status
        - health

    Args:
        front_camera: intrinsics.
        rear_camera: intrinsics.
        step: dimensions and patience.
        parameters: thresholds and gains.
        rate: of the controller, Hz.

    Ports:
        front_detections (input, Detections): markers that the front camera shows.
        rear_detections (input, Detections): markers that the rear camera shows.
        task (input, StepTask): of the poses it uses nothing but which way the beacons' faces look,
            to tell a marker's place from the robot's axis; on a long way all of it.
        command (output, vector of 2): [v (m/s), omega (rad/s)], at `rate`; zeros without a task,
            when done, and while it waits.
        status (output, vector of 3): [number of the task, `Status`, tries after the first], at
            `rate`.
        health (output, Health): vectors that are no task; pictures that came too late; markers
            that cannot be what they say (found twice, or a beacon on the wrong side of the anchor);
            fresh pictures without a beacon that was needed; tries after the first; estimates of a
            long way that were given up.

    Approach: the front camera keeps beacon 1 centred. From where the other two are 280 px aside, or
    leave the picture, the entry is as far as the triangle is high, and that is driven by the
    commands. Pass: 30 degrees toward the pivot, half a side straight on, and 30 degrees more; by
    the commands, since nothing that would help is in the picture. Build: the rear camera keeps the
    anchor centred and Algorithm I finds the vertex; see `systems.formation.building`.

    A long way is one of more than two centre points, or from elsewhere than the vertex outside the
    entry. [FORM] does not say what leads the robot there; no single beacon ahead does. Here it is
    the bearings of all that stand at their believed places, as in `TriangleResection`, up to the
    exit. From there on it is lateral pixels again, so a step's error is that of Algorithm I.

    A beacon that is not seen where it is needed: the robot stands (`waiting`) and goes on when it
    sees it; after `patience` it goes back by `retreat`, or turns round once, and tries again, as
    often as it must: whoever gave the task decides when that is enough.

    Source: [FORM] 2, as far as it is legible; passing and steering are our reading, the long way is
    ours.

    Raises:
        ValueError: rate or parameters out of range, or a camera whose picture does not hold `dt`.
    """

    def __init__(
        self,
        *,
        front_camera: PinholeCamera,
        rear_camera: PinholeCamera,
        step: FormationStepParameters | None = None,
        parameters: Algorithm1Parameters | None = None,
        rate: float = 20.0,
    ) -> None:
        self._parameters = parameters or Algorithm1Parameters()
        for whose, camera in (("front_camera", front_camera), ("rear_camera", rear_camera)):
            check_view(camera, self._parameters.dt, "dt", whose)
        self._localizer = StepLocalizer(
            cameras=(front_camera, rear_camera),
            step=step or FormationStepParameters(),
            noise=BearingFilterParameters(),
            trust=ResectionTrustParameters(),
            rate=rate,
        )
        super().__init__(
            front_camera=front_camera,
            rear_camera=rear_camera,
            step=step,
            rate=rate,
            memory=self._reset(),
            reasons=("relocated",),
        )

    def _reset(self) -> Array:
        return _Memory(self._localizer.begin()).vector()

    def _act(
        self,
        task: StepTask,
        memory: Array,
        views: tuple[View, View],
        command: Array,
        now: float,
        counts: Counter[str],
    ) -> tuple[Array, list[float], Status]:
        m = _Memory.from_vector(memory)
        if m.stage == Stage.AIM and self._is_long(task):
            m.stage = Stage.WAY
        if m.stage == Stage.WAY:
            wanted, status = self._follow_way(m, task, views, command, now, counts)
            return m.vector(), wanted, status
        m.left -= abs(command[0] or command[1]) * self._dt
        setback = self._step_parameters.marker_distance / self._step_parameters.marker_size
        fresh = any(shown.fresh for shown in views)
        # Ahead at the entry is beacon 1, behind at the exit the anchor: lines along the way.
        front, rear = (
            beacon_axes(shown.ids, shown.rays, task.beacons, task.poses[:, 2], k, line, setback)
            for shown, k, line in zip(views, (0, 2), _lines(task.poses[:, :2]), strict=True)
        )
        stage = Stage(int(m.stage))
        found: list[float] | None
        if stage == Stage.BUILD:
            focal_length = self._cameras[1].K[0, 0]
            found, done = self._build(m, rear * focal_length, focal_length, fresh, counts)
            if done:
                return m.vector(), [0.0, 0.0], Status.DONE
        elif stage in (Stage.AIM, Stage.RECEDE, Stage.ENTER):
            found = self._approach(m, stage, front, fresh, counts)
        else:
            found = self._pass(m, stage, rear[2])
        if found is None:
            counts["hidden"] += fresh
            m.waited += self._dt
            if m.waited > self._step_parameters.patience:
                counts["retries"] += 1
                self._retry(m, stage)
            return m.vector(), [0.0, 0.0], Status.WAITING
        m.waited = 0.0
        return m.vector(), found, _STATUS[Stage(int(m.stage))]

    def _is_long(self, task: StepTask) -> bool:
        """Whether the way is more than entry and exit, or does not begin before the entry."""
        off = np.hypot(*(task.start - next_vertex(task.poses[::-1, :2])))
        elsewhere = bool(off > _AT_VERTEX * self._step_parameters.side)
        return elsewhere or len(task.way()) > _SHORT_WAY

    def _follow_way(
        self,
        m: _Memory,
        task: StepTask,
        views: tuple[View, View],
        command: Array,
        now: float,
        counts: Counter[str],
    ) -> tuple[list[float], Status]:
        """Returns the command on a long way, by where all that stand are seen."""
        pose, seen = self._localizer.look(m.fix, task, views, command, now, counts, behind=False)
        fresh = any(shown.fresh for shown in views)
        if recovering := self._localizer.recover(m.fix, fresh, seen, counts):
            return recovering
        way = task.way()
        speed = max(self._parameters.speed, self._step_parameters.way_speed)
        while m.passed < len(way):
            wanted = self._localizer.follow(pose, way[int(m.passed) :], speed)
            if wanted is not None:
                return wanted, Status.PASS if m.passed else Status.APPROACH
            m.passed += 1
        # Beacons that are listed counterclockwise have the pivot to the left of who enters.
        m.turn = float(orientation(task.poses[:, :2]))
        m.enter(Stage.TURN_OUT, _HALF_TURN_OF_PASS)
        return [0.0, 0.0], Status.PASS

    def _retry(self, m: _Memory, stage: Stage) -> None:
        if stage == Stage.BUILD:
            m.enter(Stage.RETREAT, self._step_parameters.retreat)
        elif stage == Stage.TURN_OUT:
            m.enter(stage, 0.0)
        else:
            m.enter(Stage.AIM, _ROUND)

    def _approach(
        self, m: _Memory, stage: Stage, front: Array, fresh: bool, counts: Counter[str]
    ) -> list[float] | None:
        """Returns the command with beacon 1 ahead; None to wait."""
        p, s = self._parameters, self._step_parameters
        ahead, pivot, anchor = front
        if math.isnan(ahead):
            # It turns round to look for it, but not while it is on its way.
            return [0.0, s.turn_rate] if stage == Stage.AIM and m.left > 0 else None
        centring = s.turn(-math.atan(ahead))
        pair = not math.isnan(pivot + anchor)
        if pair and (pivot - ahead) * (anchor - ahead) >= 0:
            counts["misread"] += fresh
            return None
        if stage == Stage.AIM:
            if abs(math.atan(ahead)) < _CENTRED:
                m.enter(Stage.RECEDE, s.retreat)
            return [0.0, centring]
        if stage == Stage.RECEDE:
            if pair:
                m.turn = 1.0 if pivot < ahead else -1.0
                m.enter(Stage.ENTER, HEIGHT * s.side)
            return [-p.speed, centring] if m.left > 0 else None
        aside = abs(pivot - anchor) / 2 * self._cameras[0].K[0, 0]
        if aside < p.dt:
            m.left = HEIGHT * s.side
        if m.left <= 0:
            m.enter(Stage.TURN_IN, _HALF_TURN_OF_PASS)
        return [p.speed, centring]

    def _pass(self, m: _Memory, stage: Stage, anchor: float) -> list[float] | None:
        """Returns the command inside the triangle, or when it retreats; None to wait."""
        p, s = self._parameters, self._step_parameters
        if stage == Stage.TURN_IN:
            if m.left <= 0:
                m.enter(Stage.CROSS, s.side / 2)
            return [0.0, m.turn * s.turn_rate]
        if stage == Stage.CROSS:
            if m.left <= 0:
                m.enter(Stage.TURN_OUT, _HALF_TURN_OF_PASS)
            return [p.speed, 0.0]
        if stage == Stage.RETREAT:
            if m.left <= 0:
                m.direction = FORWARD
                m.enter(Stage.BUILD, self._reach())
            return [-p.speed, 0.0 if math.isnan(anchor) else s.turn(-math.atan(anchor))]
        if math.isnan(anchor):  # a turn by the commands, and once round in search
            return [0.0, m.turn * s.turn_rate] if m.left > -_ROUND else None
        if abs(math.atan(anchor)) < _CENTRED:
            m.enter(Stage.BUILD, self._reach())
        return [0.0, s.turn(-math.atan(anchor))]

    def _reach(self) -> float:
        """Returns how far it may drive before all three beacons must show, m."""
        return HEIGHT * self._step_parameters.side + self._step_parameters.retreat

    def _build(
        self, m: _Memory, u: Array, focal_length: float, fresh: bool, counts: Counter[str]
    ) -> tuple[list[float] | None, bool]:
        """Returns the command behind the triangle, None to wait; and whether the robot is there."""
        # With the pivot to the left at the entry, it is to the robot's left here, too: to the right
        # of the picture behind.
        sides = (u[:2] - u[2]) * np.array([-m.turn, m.turn])
        if (sides < 0).any():
            counts["misread"] += fresh
            return None, False
        motion = algorithm1(u, m.direction, focal_length, self._parameters)
        m.direction = float(motion.direction)
        if not math.isnan(sides.sum()):
            m.left = max(m.left, self._step_parameters.retreat)
        if math.isnan(u[2]) or m.left <= 0:
            return None, False
        return motion.command.tolist(), bool(motion.done)


def _lines(beacons: Array) -> tuple[float, float]:
    """Returns the directions of the lines of sight to beacon 1 at the start, anchor at the end."""
    ahead = arrival_heading(beacons[0], next_vertex(beacons[::-1]))
    behind = arrival_heading(beacons[2], next_vertex(beacons))
    return float(ahead), float(behind)
