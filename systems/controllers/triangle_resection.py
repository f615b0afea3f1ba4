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
from systems.controllers.formation_step import (
    FormationStep,
    FormationStepParameters,
    Status,
    StepTask,
    View,
)
from systems.formation import bearing_filter
from systems.formation.axes import SIDES, marker_centres
from systems.formation.bearing_filter import SIZE, BearingFilterParameters
from systems.formation.bearings import bearing
from systems.formation.building import FORWARD, HOLD, SettlingParameters, settle
from systems.formation.triangles import arrival_heading, gates, next_vertex
from systems.validation import require_positive

Array = NDArray[np.float64]

_ROUND = 2 * math.pi + 0.5
_FACING = math.radians(20.0)  # no driving while the way lies farther aside
_ALIGNED = math.radians(3.0)
_GATE_REACHED = 0.05  # m
_REFUSED = 20  # pictures in a row that mostly contradict the estimate, until it is given up


class Stage(IntEnum):
    """What the robot is at."""

    LOOK = 0
    ENTRY = 1
    EXIT = 2
    ALIGN = 3
    SETTLE = 4


_STATUS = {
    Stage.LOOK: Status.APPROACH,
    Stage.ENTRY: Status.APPROACH,
    Stage.EXIT: Status.PASS,
    Stage.ALIGN: Status.PASS,
    Stage.SETTLE: Status.BUILD,
}


@dataclass
class ResectionTrustParameters:
    """How well the robot must know where it is.

    Attributes:
        start_std: of the place where the task says the robot is, m.
        lost_std: standard deviation of the position along its worst axis beyond which the robot
            stands and looks around, m.
        done_std: above which it is not done, m.
    """

    start_std: float = 0.1
    lost_std: float = 0.25
    done_std: float = 0.01

    def __post_init__(self) -> None:
        require_positive(**vars(self))


@dataclass
class _Memory:
    """What is remembered from one decision to the next.

    Attributes:
        x: (7,) state of the filter.
        P: (7, 7) its covariance.
        sent: (n, 2) commands of the last control periods, the newest first.
        stage: what the robot is at.
        time: of the state, s; NaN while there is none.
        direction: of the shunt.
        held: since when it stands on the vertex, s.
        waited: lost, s.
        turned: in search, rad.
        located: three beacons were in one picture behind.
        refused: pictures in a row that contradict the estimate.
    """

    x: Array
    P: Array
    sent: Array
    stage: float = Stage.LOOK
    time: float = math.nan
    direction: float = FORWARD
    held: float = 0.0
    waited: float = 0.0
    turned: float = 0.0
    located: float = 0.0
    refused: float = 0.0

    @staticmethod
    def from_vector(v: Array) -> _Memory:
        scalars, rest = v[:8].tolist(), v[8:]
        P = rest[SIZE : SIZE + SIZE**2].reshape(SIZE, SIZE)
        return _Memory(rest[:SIZE], P, rest[SIZE + SIZE**2 :].reshape(-1, 2), *scalars)

    def vector(self) -> Array:
        scalars = [self.stage, self.time, self.direction, self.held]
        scalars += [self.waited, self.turned, self.located, self.refused]
        return np.concatenate([scalars, self.x, self.P.ravel(), self.sent.ravel()])

    @property
    def std(self) -> float:
        """Standard deviation of the position along its worst axis, m."""
        if math.isnan(self.time):
            return math.inf
        return math.sqrt(max(float(np.linalg.eigvalsh(self.P[:2, :2])[-1]), 0.0))


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
        task (input, vector of 17): a `StepTask`, with beacons' poses, target and start in the world
            as it is believed to be. A beacon whose heading is NaN is not used; a start that is NaN
            is the vertex outside the entry.
        command (output, vector of 2): [v (m/s), omega (rad/s)], at `rate`; zeros without a task,
            when done, and while it waits.
        status (output, vector of 2): [number of the task, `Status`], at `rate`.
        health (output, Health): vectors that are no task; pictures that came too late or out of
            order; markers that contradict the estimate or were found twice; fresh pictures that
            left it waiting; tries after the first; estimates that were given up.

    The filter (`systems.formation.bearing_filter`) begins with the first beacon that it sees,
    turning in place, and begins anew with the first picture behind that shows three. Its state is
    of the time of the last picture; the commands since then carry it to now, which takes the
    pictures' latency out. It drives through entry and exit and settles as `settle` does, and is
    done only when the covariance says that it knows where it is.

    A beacon that is hidden costs accuracy, not the step, unless the estimate gets so uncertain that
    the robot is lost: then it turns round to look, stands (`waiting`), and after `patience` turns
    round again, as often as it must. On the vertex it waits as long when the estimate is too
    uncertain, then shunts again. A marker that is misread is refused by the filter's gate; when
    most of what is seen is refused for 20 pictures, the estimate is given up for the next picture
    of three beacons, or, without one, for the next search.

    Source: ours; entry and exit are the centre points of [FORM]'s Algorithm II.

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
        require_positive(rate=rate)
        self._parameters = parameters or SettlingParameters()
        self._noise = noise or BearingFilterParameters()
        self._trust = trust or ResectionTrustParameters()
        max_age = (step or FormationStepParameters()).max_age
        self._remembered = math.ceil(max_age * rate) + 1
        super().__init__(
            front_camera=front_camera,
            rear_camera=rear_camera,
            step=step,
            rate=rate,
            memory=self._reset(),
            reasons=("relocated",),
        )

    def _reset(self) -> Array:
        memory = _Memory(np.zeros(SIZE), np.zeros((SIZE, SIZE)), np.zeros((self._remembered, 2)))
        return memory.vector()

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
        m.sent = np.vstack([command, m.sent[:-1]])
        m.turned += abs(command[1]) * self._dt
        # What was commanded earlier is about to be forgotten, pictures or none.
        self._carry(m, now, now - (self._remembered - 1) * self._dt)
        order = sorted((0, 1), key=lambda rear: views[rear].stamp)
        seen = [self._observe(m, task, views[k], bool(k), now, counts) for k in order]
        pose = m.x[:3]
        if not math.isnan(m.time):
            for arc in bearing_filter.arcs(m.sent, self._dt, now, m.time, now):
                pose = bearing_filter.moved(pose, arc)
        fresh = any(shown.fresh for shown in views)
        if m.std > self._trust.lost_std:
            wanted = self._search(m)
            if wanted is None:
                counts["hidden"] += fresh and not any(seen)
                m.waited += self._dt
                if m.waited > self._step_parameters.patience:
                    counts["retries"] += 1
                    m.waited = m.turned = 0.0
                return m.vector(), [0.0, 0.0], Status.WAITING
            return m.vector(), wanted, Status.APPROACH
        m.waited = m.turned = 0.0
        wanted, status = self._drive(m, task, pose, fresh, counts)
        return m.vector(), wanted, status

    # --- Where it is ---

    def _sightings(self, task: StepTask, shown: View, rear: bool) -> list[tuple[int, float, Array]]:
        """Returns beacon (0, 1, 2), lateral pixel and point in the world of all that is seen."""
        focal_length = self._cameras[rear].K[0, 0]
        index = {int(robot): k for k, robot in enumerate(task.beacons)}
        found = []
        for marker_id, rays in zip(shown.ids.tolist(), shown.rays, strict=True):
            beacon = index[marker_id // SIDES]
            if not np.isfinite(task.poses[beacon]).all():
                continue
            centres = marker_centres(task.poses[beacon], self._step_parameters.marker_distance)
            found.append((beacon, _centre(rays) * focal_length, centres[marker_id % SIDES]))
        return found

    def _observe(
        self, m: _Memory, task: StepTask, shown: View, rear: bool, now: float, counts: Counter[str]
    ) -> bool:
        """Takes a fresh picture into the state; returns whether it showed any beacon."""
        sightings = self._sightings(task, shown, rear)
        if not shown.fresh:
            return bool(sightings)
        if not sightings:
            self._carry(m, now, shown.stamp)
            return False
        focal_length = self._cameras[rear].K[0, 0]
        if math.isnan(m.time):
            m.x, m.P = self._first(task, sightings[0], focal_length, rear)
            m.time = shown.stamp
        if shown.stamp < m.time - 1e-6:
            counts["stale"] += 1
            return True
        self._carry(m, now, shown.stamp)
        if self._restarted(m, sightings, focal_length, rear):
            return True
        refused = 0
        for _, u, point in sightings:
            m.x, m.P, _, strange = bearing_filter.correct(
                m.x, m.P, u, point, focal_length, self._noise, rear=rear
            )
            refused += int(strange)
        counts["misread"] += refused
        m.refused = m.refused + 1 if 2 * refused > len(sightings) else 0.0
        if m.refused > _REFUSED:
            counts["relocated"] += 1
            m.located = m.refused = 0.0
            m.P = m.P.copy()
            m.P[:3, :3] += np.eye(3) * self._trust.lost_std**2
        return True

    def _carry(self, m: _Memory, now: float, time: float) -> None:
        """Carries the state on to a time, by the commands."""
        if math.isnan(m.time):
            return
        for arc in bearing_filter.arcs(m.sent, self._dt, now, m.time, time):
            m.x, m.P = bearing_filter.predict(m.x, m.P, arc, self._noise)
        m.time = max(m.time, time)

    def _first(
        self, task: StepTask, sighting: tuple[int, float, Array], focal_length: float, rear: bool
    ) -> tuple[Array, Array]:
        """Returns state and covariance from where the robot should be and one beacon."""
        start = task.start
        if not np.isfinite(start).all():
            start = next_vertex(task.poses[::-1, :2])  # outside the entry: off beacon 1
        _, u, point = sighting
        line = point - start
        heading = math.atan2(line[1], line[0]) - float(bearing(u, focal_length, backward=rear))
        std = self._trust.start_std
        slack = std / max(float(np.hypot(*line)), std)
        pose = np.array([*start, wrap(heading)])
        return bearing_filter.start(pose, np.diag([std**2, std**2, slack**2]), self._noise)

    def _restarted(
        self,
        m: _Memory,
        sightings: list[tuple[int, float, Array]],
        focal_length: float,
        rear: bool,
    ) -> bool:
        """Begins anew, once behind the exit, at the first picture of all three beacons."""
        if (
            m.located
            or not rear
            or m.stage != Stage.SETTLE
            or len({b for b, _, _ in sightings}) < 3
        ):
            return False
        u = np.array([pixel for _, pixel, _ in sightings])
        points = np.array([point for _, _, point in sightings])
        x, P, found = bearing_filter.restart(
            u, points, focal_length, m.x[:3], self._noise, rear=rear
        )
        # A misread marker puts it elsewhere: not believed unless the filter knows nothing better.
        if not found or np.hypot(*(x[:2] - m.x[:2])) > 5 * max(m.std, 0.02):
            return False
        m.x, m.P, m.located, m.refused = x, P, 1.0, 0.0
        return True

    # --- What it does ---

    def _search(self, m: _Memory) -> list[float] | None:
        """Returns the command that turns round once; None when that was of no use."""
        return [0.0, self._step_parameters.turn_rate] if m.turned < _ROUND else None

    def _drive(
        self, m: _Memory, task: StepTask, pose: Array, fresh: bool, counts: Counter[str]
    ) -> tuple[list[float], Status]:
        """Returns the command by the pose now, and how far the step is."""
        s, p = self._step_parameters, self._parameters
        beacons = task.poses[:, :2]
        if m.stage == Stage.LOOK:
            m.stage = Stage.ENTRY
        while m.stage in (Stage.ENTRY, Stage.EXIT):
            way = gates(beacons)[int(m.stage) - Stage.ENTRY] - pose[:2]
            if np.hypot(*way) > _GATE_REACHED:
                aside = wrap(math.atan2(way[1], way[0]) - float(pose[2]))
                v = p.speed * max(0.0, 1.0 - abs(aside) / _FACING)
                return [v, s.turn(2 * aside)], _STATUS[Stage(int(m.stage))]
            m.stage += 1
        if m.stage == Stage.ALIGN:
            heading = float(arrival_heading(task.target, beacons[2]))
            aside = wrap(heading - float(pose[2]))
            if abs(aside) > _ALIGNED:
                return [0.0, s.turn(2 * aside)], Status.PASS
            m.stage, m.direction, m.held = Stage.SETTLE, FORWARD, 0.0
        motion = settle(pose, task.target, beacons[2], m.direction, m.held, p)
        if motion.done and m.std <= self._trust.done_std:
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


def _centre(rays: Array) -> float:
    """Returns x/z of a marker's centre: where the picture's diagonals cross."""
    a, b, c, d = rays
    along, across = c - a, d - b
    offset = b - a
    share = (offset[0] * across[1] - offset[1] * across[0]) / (
        along[0] * across[1] - along[1] * across[0]
    )
    return float(a[0] + share * along[0])
