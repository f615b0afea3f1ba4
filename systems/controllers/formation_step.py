"""One step of a formation: what is to be done, how far it is, and the ports of whoever does it.

A robot leaves its vertex, enters the triangle of three beacons, leaves it by another edge and
settles on the vertex of a new triangle there ([FORM] 2). `systems.formation.triangles` says how the
three beacons are told apart.

[FORM]: Kang, Kwon, Bae, Kim, "Monocular Vision-Based Swarm Robot Localization Using Equilateral
Triangular Formations".
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections import Counter
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.cameras import PinholeCamera
from systems.formation.axes import SIDES
from systems.health import Counts
from systems.messages import Detections
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

TASK_SIZE = 17


class Status(IntEnum):
    """How far a step is."""

    IDLE = 0
    APPROACH = 1
    PASS = 2
    BUILD = 3
    DONE = 4
    WAITING = 5


class StepTask(NamedTuple):
    """What a robot is to do; a vector on a port.

    Attributes:
        number: of the step; a new number begins anew, 0 is no task.
        beacons: (3,) numbers of the robots that stand as beacons 1, 2 and 3.
        poses: (3, 3) what is believed of theirs, [x (m), y (m), theta (rad)]. Where a
            heading is NaN, the axis of the robot is found from a marker's shape.
        target: (2,) the vertex to settle on, m.
        start: (2,) where the robot is believed to be, m.
    """

    number: int
    beacons: NDArray[np.int64]
    poses: Array
    target: Array
    start: Array

    def vector(self) -> Array:
        """Returns it as (17,) [number, beacons, poses row by row, target, start]."""
        return np.concatenate(
            [[self.number], self.beacons, np.ravel(self.poses), self.target, self.start]
        )

    @staticmethod
    def from_vector(vector: Array) -> StepTask | None:
        """Returns the task of a vector; None if it is none.

        Those are: numbers that are not whole or negative, and beacons that are not different.
        """
        numbers = vector[:4]
        if not (np.isfinite(numbers).all() and (numbers == np.round(numbers)).all()):
            return None
        beacons = numbers[1:].astype(np.int64)
        if numbers[0] < 0 or beacons.min() < 0 or len(set(beacons.tolist())) < 3:
            return None
        return StepTask(
            int(numbers[0]), beacons, vector[4:13].reshape(3, 3), vector[13:15], vector[15:17]
        )


OFF = StepTask(0, np.arange(3), np.zeros((3, 3)), np.zeros(2), np.zeros(2))


@dataclass
class FormationStepParameters:
    """The formation's dimensions, and how a robot behaves that does not see what it should.

    Attributes:
        side: of the triangles, m.
        marker_size: side of the markers' black squares, m.
        marker_distance: of their centres from the robot's axis, m.
        turn_rate: of turns in place, rad/s.
        k_turn: turning rate by the angle that is left, 1/s.
        max_age: pictures older than this are not looked at, s.
        patience: how long the robot stands and waits before it tries again, s.
        retreat: how far it goes back for another try, m.
    """

    side: float = 1.5
    marker_size: float = 0.16
    marker_distance: float = 0.15
    turn_rate: float = 0.3
    k_turn: float = 1.0
    max_age: float = 1.0
    patience: float = 3.0
    retreat: float = 0.3

    def __post_init__(self) -> None:
        values = dict(vars(self))
        require_non_negative(marker_distance=values.pop("marker_distance"))
        require_positive(**values)

    def turn(self, angle: float) -> float:
        """Returns the turning rate (rad/s) by the angle that is left to turn (rad)."""
        return min(max(self.k_turn * angle, -self.turn_rate), self.turn_rate)


class View(NamedTuple):
    """What one camera shows.

    Attributes:
        stamp: of the picture, s; NaN when there is none that may be looked at.
        fresh: it was not looked at before.
        ids: (n,) of the markers of the step's beacons.
        rays: (n, 4, 2) x/z, y/z of their corners.
        strange: markers that are no readings: corners not finite, or the same id twice.
    """

    stamp: float
    fresh: bool
    ids: NDArray[np.int64]
    rays: Array
    strange: int


NOTHING = View(math.nan, False, np.zeros(0, np.int64), np.zeros((0, 4, 2)), 0)


def view(detections: Detections, beacons: NDArray[np.int64], camera: PinholeCamera) -> View:
    """Returns what detections show of the beacons; none of an id that was found twice."""
    ids, found = np.asarray(detections.ids), np.isin(detections.ids // SIDES, beacons)
    counts = Counter(ids.tolist())
    sound = np.array([counts[k] == 1 for k in ids.tolist()], bool)
    sound &= np.isfinite(detections.corners).all(axis=(1, 2))
    strange = int((found & ~sound).sum())
    corners = detections.corners[found & sound]
    rays = camera.undistort(corners) if len(corners) else NOTHING.rays
    return View(detections.stamp, True, ids[found & sound], rays, strange)


class FormationStep(LeafSystem):
    """Base of the blocks that drive a robot through one step of a formation: their ports.

    A subclass declares its state and implements `_reset` and `_act`.

    Args:
        front_camera: intrinsics.
        rear_camera: intrinsics.
        step: dimensions and patience.
        rate: of the controller, Hz.
        memory: initial value of the subclass' state.
        reasons: of the subclass, for `health`.
    """

    def __init__(
        self,
        *,
        front_camera: PinholeCamera,
        rear_camera: PinholeCamera,
        step: FormationStepParameters | None,
        rate: float,
        memory: Array,
        reasons: tuple[str, ...],
    ) -> None:
        super().__init__()
        require_positive(rate=rate)
        self._cameras = (front_camera, rear_camera)
        self._step_parameters = step or FormationStepParameters()
        self._dt = 1.0 / rate
        nothing = AbstractValue.Make(Detections())
        self._view_inputs = (
            self.DeclareAbstractInputPort("front_detections", nothing),
            self.DeclareAbstractInputPort("rear_detections", nothing),
        )
        self._task_input = self.DeclareVectorInputPort("task", TASK_SIZE)
        self._command = self.DeclareDiscreteState(2)
        self._status = self.DeclareDiscreteState(2)
        self._stamps = self.DeclareDiscreteState([math.nan, math.nan])  # of the last pictures used
        self._memory = self.DeclareDiscreteState(memory)
        self.DeclarePeriodicDiscreteUpdateEvent(self._dt, 0.0, self._update)
        self._command_output = self.DeclareStateOutputPort("command", self._command)
        self._status_output = self.DeclareStateOutputPort("status", self._status)
        self._counts = Counts(self, "bad_task", "stale", "misread", "hidden", "retries", *reasons)

    def front_detections_input_port(self) -> InputPort:
        """Returns the port of the front camera's markers."""
        return self._view_inputs[0]

    def rear_detections_input_port(self) -> InputPort:
        """Returns the port of the rear camera's markers."""
        return self._view_inputs[1]

    def task_input_port(self) -> InputPort:
        """Returns the port of the task."""
        return self._task_input

    def command_output_port(self) -> OutputPort:
        """Returns the port of the drive command."""
        return self._command_output

    def status_output_port(self) -> OutputPort:
        """Returns the port of how far the step is."""
        return self._status_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    @abstractmethod
    def _reset(self) -> Array:
        """Returns the memory at the beginning of a step."""

    @abstractmethod
    def _act(
        self,
        task: StepTask,
        memory: Array,
        views: tuple[View, View],
        command: Array,
        now: float,
        counts: Counter[str],
    ) -> tuple[Array, list[float], Status]:
        """Decides.

        Args:
            task: what to do.
            memory: of this step so far.
            views: what the front and the rear camera show.
            command: (2,) as it was until now.
            now: s.
            counts: for `health`, to be added to.

        Returns:
            Memory, the new command [v, omega], and how far the step is.
        """

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        counts: Counter[str] = Counter()
        task = StepTask.from_vector(self._task_input.Eval(context))
        number, status = context.get_discrete_state(self._status).get_value()
        memory = context.get_discrete_state(self._memory).get_value()
        if task is None:
            counts["bad_task"] += 1
            task = OFF
        if task.number != number:
            status, memory = Status.IDLE, self._reset()
        command = [0.0, 0.0]
        if task.number == 0:
            status = Status.IDLE
        elif status != Status.DONE:
            views = self._look(context, discrete_state, task, counts)
            memory, command, status = self._act(
                task,
                memory,
                views,
                context.get_discrete_state(self._command).get_value(),
                context.get_time(),
                counts,
            )
        discrete_state.set_value(self._command, command)
        discrete_state.set_value(self._status, [task.number, float(status)])
        discrete_state.set_value(self._memory, memory)
        self._counts.add(context, discrete_state, **counts)

    def _look(
        self, context: Context, discrete_state: DiscreteValues, task: StepTask, counts: Counter[str]
    ) -> tuple[View, View]:
        """Returns what front and rear camera show, and remembers which pictures those were."""
        last = context.get_discrete_state(self._stamps).get_value()
        views, stamps = [], []
        for port, camera, before in zip(self._view_inputs, self._cameras, last, strict=True):
            detections: Detections = port.Eval(context)
            stamp, shown = detections.stamp, NOTHING
            age = context.get_time() - stamp
            if -self._dt <= age <= self._step_parameters.max_age:
                shown = view(detections, task.beacons, camera)._replace(fresh=stamp != before)
                counts["misread"] += shown.strange * shown.fresh
            elif not math.isnan(stamp):
                counts["stale"] += 1
            views.append(shown)
            stamps.append(stamp)
        discrete_state.set_value(self._stamps, stamps)
        return views[0], views[1]


def check_view(camera: PinholeCamera, pixels: float, name: str) -> None:
    """Raises `ValueError` unless the camera's picture holds `pixels` on either side of its axis."""
    centre = camera.K[0, 2]
    room = min(centre + 0.5, camera.width - 0.5 - centre)
    require(pixels < room, name, pixels, f"less than {room:g}, what the picture holds aside")
