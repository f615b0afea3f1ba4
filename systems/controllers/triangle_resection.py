"""A step of a formation by resection: the bearings of beacons at known places give the pose.

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

from systems.angles import wrap
from systems.cameras import PinholeCamera
from systems.controllers.formation_step import FormationStep, FormationStepParameters, View
from systems.controllers.step_localizer import Fix, ResectionTrustParameters, StepLocalizer
from systems.controllers.step_task import Status, StepTask
from systems.formation.bearing_filter import BearingFilterParameters
from systems.formation.building import FORWARD, HOLD, SettlingParameters, settle
from systems.formation.triangles import arrival_heading

Array = NDArray[np.float64]

_ALIGNED = math.radians(3.0)
_SHORT_WAY = 2  # centre points: entry and exit of the beacons' own triangle
_SCALARS = 4


class Stage(IntEnum):
    """What the robot is at."""

    WAY = 0
    ALIGN = 1
    SETTLE = 2


@dataclass
class _Memory:
    """What is remembered from one decision to the next.

    Attributes:
        fix: where the robot is.
        stage: what it is at.
        passed: centre points that lie behind it.
        direction: of the shunt.
        held: since when it stands on the vertex, s.
    """

    fix: Fix
    stage: float = Stage.WAY
    passed: float = 0.0
    direction: float = FORWARD
    held: float = 0.0

    @staticmethod
    def from_vector(v: Array) -> _Memory:
        return _Memory(Fix.from_vector(v[_SCALARS:]), *v[:_SCALARS].tolist())

    def vector(self) -> Array:
        scalars = [self.stage, self.passed, self.direction, self.held]
        return np.concatenate([scalars, self.fix.vector()])


class TriangleResection(FormationStep):
    """Drives a robot through a step of a formation by the pose that the beacons' bearings give.

    .. pydrake_system::

        name: TriangleResection
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
        parameters: speeds, gains and tolerances of settling.
        noise: of sight and motion.
        trust: how well the robot must know where it is.
        rate: of the controller, Hz.

    Ports:
        front_detections (input, Detections): markers that the front camera shows.
        rear_detections (input, Detections): markers that the rear camera shows.
        task (input, StepTask): poses, way, target and start in the world as it is believed to be. A
            robot whose heading is NaN is not used; a start that is NaN is the vertex outside the
            entry.
        command (output, vector of 2): [v (m/s), omega (rad/s)], at `rate`; zeros without a task,
            when done, and while it waits.
        status (output, vector of 3): [number of the task, `Status`, tries after the first], at
            `rate`.
        health (output, Health): vectors that are no task; pictures that came too late or out of
            order; markers that contradict the estimate or were found twice; fresh pictures that
            left it waiting; tries after the first; estimates that were given up.

    The filter (`systems.formation.bearing_filter`) hears of every robot that stands, the beacons
    and those that it passes on its way. It begins with the place that the task gives and the first
    of them that it sees, turning in place to find it; unless a picture of two of them says, by the
    heights of their markers, that the robot is elsewhere. It begins anew with the first picture
    behind the exit that shows three. Its state is of the time of the last picture; the commands
    since then carry it to now, which takes the pictures' latency out. It drives from centre point
    to centre point, through as many triangles as the way has, and settles as `settle` does, and is
    done only when the covariance says that it knows where it is.

    A beacon that is hidden costs accuracy, not the step, unless the estimate gets so uncertain that
    the robot is lost: then it turns round to look, stands (`waiting`), and after `patience` turns
    round again, as often as it must. On the vertex it waits as long when the estimate is too
    uncertain, then shunts again. A marker that is misread is refused by the filter's gate; when
    most of what is seen is refused for 20 pictures, as when the robot does not move as it is told,
    it stands for `patience`, and the estimate is given up for the next picture of two robots.

    Source: ours; the centre points are those of [FORM]'s Algorithm II.

    Raises:
        ValueError: rate or parameters out of range.
    """

    def __init__(
        self,
        *,
        front_camera: PinholeCamera,
        rear_camera: PinholeCamera,
        step: FormationStepParameters | None = None,
        parameters: SettlingParameters | None = None,
        noise: BearingFilterParameters | None = None,
        trust: ResectionTrustParameters | None = None,
        rate: float = 20.0,
    ) -> None:
        self._parameters = parameters or SettlingParameters()
        self._trust = trust or ResectionTrustParameters()
        self._localizer = StepLocalizer(
            cameras=(front_camera, rear_camera),
            step=step or FormationStepParameters(),
            noise=noise or BearingFilterParameters(),
            trust=self._trust,
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
        pose, seen = self._localizer.look(
            m.fix, task, views, command, now, counts, behind=m.stage == Stage.SETTLE
        )
        fresh = any(shown.fresh for shown in views)
        wanted, status = self._localizer.recover(m.fix, fresh, seen, counts) or self._drive(
            m, task, pose, fresh, counts
        )
        return m.vector(), wanted, status

    def _drive(
        self, m: _Memory, task: StepTask, pose: Array, fresh: bool, counts: Counter[str]
    ) -> tuple[list[float], Status]:
        """Returns the command by the pose now, and how far the step is."""
        s, p = self._step_parameters, self._parameters
        anchor = task.poses[2, :2]
        way = task.way()
        speed = p.speed if len(way) <= _SHORT_WAY else max(p.speed, s.way_speed)
        while m.stage == Stage.WAY:
            if m.passed == len(way):
                m.stage = Stage.ALIGN
                break
            wanted = self._localizer.follow(pose, way[int(m.passed) :], speed)
            if wanted is not None:
                return wanted, Status.PASS if m.passed else Status.APPROACH
            m.passed += 1
        if m.stage == Stage.ALIGN:
            heading = float(arrival_heading(task.target, anchor))
            aside = wrap(heading - float(pose[2]))
            if abs(aside) > _ALIGNED:
                return [0.0, s.turn(2 * aside)], Status.PASS
            m.stage, m.direction, m.held = Stage.SETTLE, FORWARD, 0.0
        motion = settle(pose, task.target, anchor, m.direction, m.held, p)
        if motion.done and m.fix.std <= self._trust.done_std:
            return [0.0, 0.0], Status.DONE
        m.direction = float(motion.direction)
        if motion.done and m.held < p.settle + s.patience:
            counts["hidden"] += fresh
            m.held += self._dt
            return [0.0, 0.0], Status.WAITING
        if motion.done:
            counts["retries"] += 1
            m.direction = FORWARD
        m.held = m.held + self._dt if m.direction == HOLD else 0.0
        return motion.command.tolist(), Status.BUILD
