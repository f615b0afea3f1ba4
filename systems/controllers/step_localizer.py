"""Where a robot is on its way through a formation, by the bearings of all that stand.

The filter is `systems.formation.bearing_filter`; here is what it begins with, which pictures it
gets, when it is given up, and what the robot does while it does not know where it is.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from systems.angles import wrap
from systems.cameras import PinholeCamera
from systems.controllers.formation_step import FormationStepParameters, View
from systems.controllers.step_task import Status, StepTask
from systems.formation import bearing_filter
from systems.formation.axes import SIDES
from systems.formation.bearing_filter import SIZE, BearingFilterParameters
from systems.formation.bearings import bearing
from systems.formation.first_fix import marker_centre, place_in_robot, pose_by_places
from systems.formation.triangles import next_vertex
from systems.validation import require_positive

Array = NDArray[np.float64]

_ROUND = 2 * math.pi + 0.5
_REFUSED = 20  # pictures in a row that mostly contradict the estimate, until it is given up
_FACING = math.radians(20.0)  # no driving while the way lies farther aside
_REACHED = 0.05  # m
_SLOW, _K_SLOW = 0.03, 1.0  # m/s, 1/s: least speed before a corner, and by how far it is
_ELSEWHERE = 4.0  # standard deviations from where the task says that the robot is
_SCALARS = 7


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
class Fix:
    """What is remembered of where the robot is, from one decision to the next.

    Attributes:
        x: (7,) state of the filter.
        P: (7, 7) its covariance.
        sent: (n, 2) commands of the last control periods, the newest first.
        time: of the state, s; NaN while there is none.
        waited: lost, s.
        turned: in search, rad.
        located: three robots were in one picture behind.
        refused: pictures in a row that contradict the estimate.
        astray: the place that the task gives has turned out to be wrong.
        standing: how long it still stands after an estimate that was given up, s.
    """

    x: Array
    P: Array
    sent: Array
    time: float = math.nan
    waited: float = 0.0
    turned: float = 0.0
    located: float = 0.0
    refused: float = 0.0
    astray: float = 0.0
    standing: float = 0.0

    @staticmethod
    def from_vector(v: Array) -> Fix:
        """Returns it from what `vector` gives."""
        scalars, rest = v[:_SCALARS].tolist(), v[_SCALARS:]
        P = rest[SIZE : SIZE + SIZE**2].reshape(SIZE, SIZE)
        return Fix(rest[:SIZE], P, rest[SIZE + SIZE**2 :].reshape(-1, 2), *scalars)

    def vector(self) -> Array:
        """Returns it as numbers."""
        scalars = [self.time, self.waited, self.turned, self.located, self.refused]
        scalars += [self.astray, self.standing]
        return np.concatenate([scalars, self.x, self.P.ravel(), self.sent.ravel()])

    @property
    def std(self) -> float:
        """Standard deviation of the position along its worst axis, m."""
        if math.isnan(self.time):
            return math.inf
        a, b, c = float(self.P[0, 0]), float(self.P[0, 1]), float(self.P[1, 1])
        return math.sqrt(max((a + c) / 2 + math.hypot((a - c) / 2, b), 0.0))


class Sighting(NamedTuple):
    """One marker in a picture.

    Attributes:
        robot: that carries it.
        u: lateral pixel of its centre.
        point: (2,) where that is believed to be, m.
        face: direction that it faces, rad.
        rays: (4, 2) x/z, y/z of its corners.
    """

    robot: int
    u: float
    point: Array
    face: float
    rays: Array


class StepLocalizer:
    """Keeps a `Fix` by pictures and commands. What changes is in the fix, not here.

    Args:
        cameras: of front and rear.
        step: dimensions and patience.
        noise: of sight and motion.
        trust: how well the robot must know where it is.
        rate: of the controller, Hz.
    """

    def __init__(
        self,
        *,
        cameras: tuple[PinholeCamera, PinholeCamera],
        step: FormationStepParameters,
        noise: BearingFilterParameters,
        trust: ResectionTrustParameters,
        rate: float,
    ) -> None:
        require_positive(rate=rate)
        self._cameras = cameras
        self._step = step
        self._noise = noise
        self._trust = trust
        self._dt = 1.0 / rate
        self._remembered = math.ceil(step.max_age * rate) + 1

    def begin(self) -> Fix:
        """Returns what is known before the first picture."""
        return Fix(np.zeros(SIZE), np.zeros((SIZE, SIZE)), np.zeros((self._remembered, 2)))

    def look(
        self,
        fix: Fix,
        task: StepTask,
        views: tuple[View, View],
        command: Array,
        now: float,
        counts: Counter[str],
        *,
        behind: bool,
    ) -> tuple[Array, bool]:
        """Takes pictures and the last command into a fix.

        Args:
            fix: is changed.
            task: who stands where.
            views: what front and rear camera show.
            command: (2,) as it was until now.
            now: s.
            counts: for `health`, to be added to.
            behind: whether the robot is behind the exit, and begins anew with the first picture
                there that shows three robots.

        Returns:
            The pose now, (3,), and whether any robot showed.
        """
        fix.sent = np.vstack([command, fix.sent[:-1]])
        fix.turned += abs(command[1]) * self._dt
        # What was commanded earlier is about to be forgotten, pictures or none.
        self._carry(fix, now, now - (self._remembered - 1) * self._dt)
        order = sorted((0, 1), key=lambda rear: views[rear].stamp)
        seen = [self._observe(fix, task, views[k], bool(k), now, counts, behind) for k in order]
        pose = fix.x[:3]
        if not math.isnan(fix.time):
            for arc in bearing_filter.arcs(fix.sent, self._dt, now, fix.time, now):
                pose = bearing_filter.moved(pose, arc)
        return pose, any(seen)

    def recover(
        self, fix: Fix, fresh: bool, seen: bool, counts: Counter[str]
    ) -> tuple[list[float], Status] | None:
        """Returns what a robot does that does not know where it is; None for one that does."""
        if fix.standing > 0:
            fix.standing -= self._dt
            counts["retries"] += fix.standing <= 0
            return [0.0, 0.0], Status.WAITING
        if fix.std <= self._trust.lost_std:
            fix.waited = fix.turned = 0.0
            return None
        if fix.turned < _ROUND:
            return [0.0, self._step.turn_rate], Status.APPROACH
        counts["hidden"] += fresh and not seen
        fix.waited += self._dt
        if fix.waited > self._step.patience:
            counts["retries"] += 1
            fix.waited = fix.turned = 0.0
        return [0.0, 0.0], Status.WAITING

    def follow(self, pose: Array, ahead: Array, speed: float) -> list[float] | None:
        """Returns the command [v, omega] that leads to the next of some points; None when there.

        Before a corner, and the end, it slows down: what a robot runs on for after it was told to
        stop, the commands do not say.

        Args:
            pose: (3,) now.
            ahead: (n, 2) the points, m.
            speed: m/s.
        """
        way = ahead[0] - pose[:2]
        distance = float(np.hypot(*way))
        if distance <= _REACHED:
            return None
        aside = wrap(math.atan2(way[1], way[0]) - float(pose[2]))
        legs = np.diff(ahead, axis=0)
        bends = np.abs(np.diff(np.unwrap(np.arctan2(legs[:, 1], legs[:, 0])))) > _FACING
        corner = int(np.argmax(bends)) + 1 if bends.any() else len(ahead) - 1
        if len(legs):
            first = wrap(math.atan2(legs[0, 1], legs[0, 0]) - math.atan2(way[1], way[0]))
            corner = 0 if abs(first) > _FACING else corner
        left = distance + float(np.hypot(*legs[:corner].T).sum())
        v = min(speed, _SLOW + _K_SLOW * left) * max(0.0, 1.0 - abs(aside) / _FACING)
        return [v, self._step.turn(2 * aside)]

    def _sightings(self, task: StepTask, shown: View, rear: bool) -> list[Sighting]:
        focal_length = self._cameras[rear].K[0, 0]
        poses = dict(zip(task.robots().tolist(), task.robot_poses(), strict=True))
        found = []
        for marker_id, rays in zip(shown.ids.tolist(), shown.rays, strict=True):
            robot, side = divmod(marker_id, SIDES)
            pose = poses[robot]
            if not np.isfinite(pose).all():
                continue
            face = float(pose[2]) + side * math.pi / 2
            outward = np.array([math.cos(face), math.sin(face)])
            point = pose[:2] + self._step.marker_distance * outward
            found.append(Sighting(robot, marker_centre(rays) * focal_length, point, face, rays))
        return found

    def _observe(
        self,
        fix: Fix,
        task: StepTask,
        shown: View,
        rear: bool,
        now: float,
        counts: Counter[str],
        behind: bool,
    ) -> bool:
        """Takes a fresh picture into the state; returns whether it showed any robot."""
        sightings = self._sightings(task, shown, rear)
        if not shown.fresh:
            return bool(sightings)
        if not sightings:
            self._carry(fix, now, shown.stamp)
            return False
        focal_length = self._cameras[rear].K[0, 0]
        if math.isnan(fix.time):
            first = self._first(fix, task, sightings, focal_length, rear)
            if first is None:
                return True
            fix.x, fix.P = first
            fix.time = shown.stamp
        if shown.stamp < fix.time - 1e-6:
            counts["stale"] += 1
            return True
        self._carry(fix, now, shown.stamp)
        if behind and rear and self._restarted(fix, sightings, focal_length):
            return True
        refused = 0
        for s in sightings:
            fix.x, fix.P, _, strange = bearing_filter.correct(
                fix.x, fix.P, s.u, s.point, focal_length, self._noise, rear=rear
            )
            refused += int(strange)
        counts["misread"] += refused
        fix.refused = fix.refused + 1 if 2 * refused > len(sightings) else 0.0
        if fix.refused > _REFUSED:
            counts["relocated"] += 1
            fix.located = fix.refused = 0.0
            fix.time, fix.astray, fix.standing = math.nan, 1.0, self._step.patience
        return True

    def _carry(self, fix: Fix, now: float, time: float) -> None:
        """Carries the state on to a time, by the commands."""
        if math.isnan(fix.time):
            return
        for arc in bearing_filter.arcs(fix.sent, self._dt, now, fix.time, time):
            fix.x, fix.P = bearing_filter.predict(fix.x, fix.P, arc, self._noise)
        fix.time = max(fix.time, time)

    def _first(
        self,
        fix: Fix,
        task: StepTask,
        sightings: list[Sighting],
        focal_length: float,
        rear: bool,
    ) -> tuple[Array, Array] | None:
        """Returns state and covariance from one picture and the task, which may be wrong."""
        std = self._trust.start_std
        start = task.start
        if not np.isfinite(start).all():
            start = next_vertex(task.poses[::-1, :2])  # outside the entry: off beacon 1
        size = self._step.marker_size
        places = np.array([place_in_robot(s.rays, size, rear=rear) for s in sightings])
        points = np.array([s.point for s in sightings])
        pose = pose_by_places(places, points, np.array([s.face for s in sightings]))
        elsewhere = pose is not None and np.hypot(*(pose[:2] - start)) > _ELSEWHERE * std
        if pose is not None and (fix.astray or elsewhere):
            return bearing_filter.start(pose, np.diag([std**2, std**2, std**2]), self._noise)
        if fix.astray:
            return None
        line = sightings[0].point - start
        seen_at = float(bearing(sightings[0].u, focal_length, backward=rear))
        slack = std / max(float(np.hypot(*line)), std)
        first = np.array([*start, wrap(math.atan2(line[1], line[0]) - seen_at)])
        return bearing_filter.start(first, np.diag([std**2, std**2, slack**2]), self._noise)

    def _restarted(self, fix: Fix, sightings: list[Sighting], focal_length: float) -> bool:
        """Begins anew, once behind the exit, at the first picture of three robots."""
        if fix.located or len({s.robot for s in sightings}) < 3:
            return False
        u, points = (np.array([s[k] for s in sightings]) for k in (1, 2))
        x, P, found = bearing_filter.restart(
            u, points, focal_length, fix.x[:3], self._noise, rear=True
        )
        # A misread marker puts it elsewhere: not believed unless the filter knows nothing better.
        if not found or np.hypot(*(x[:2] - fix.x[:2])) > 5 * max(fix.std, 0.02):
            return False
        fix.x, fix.P, fix.located, fix.refused = x, P, 1.0, 0.0
        return True
