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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.cameras import PinholeCamera
from systems.controllers.step_task import OFF, STATUS_SIZE, Status, StepTask
from systems.formation.axes import SIDES
from systems.health import Counts
from systems.messages import Detections
from systems.periods import period
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]


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
        way_speed: on a way of more than two centre points, where nothing is built yet, m/s.
    """

    side: float = 1.5
    marker_size: float = 0.16
    marker_distance: float = 0.15
    turn_rate: float = 0.3
    k_turn: float = 1.0
    max_age: float = 1.0
    patience: float = 3.0
    retreat: float = 0.3
    way_speed: float = 0.2

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
        ids: (n,) of the markers of robots that stand.
        rays: (n, 4, 2) x/z, y/z of their corners.
        strange: markers that are no readings: corners not finite, or the same id twice.
    """

    stamp: float
    fresh: bool
    ids: NDArray[np.int64]
    rays: Array
    strange: int


NOTHING = View(math.nan, False, np.zeros(0, np.int64), np.zeros((0, 4, 2)), 0)


def view(detections: Detections, robots: NDArray[np.int64], camera: PinholeCamera) -> View:
    """Returns what detections show of some robots; none of an id that was found twice."""
    ids, wanted = detections.ids.tolist(), robots.tolist()
    finite = np.atleast_1d(np.isfinite(detections.corners).all(axis=(1, 2)))
    found = [k for k, marker in enumerate(ids) if marker // SIDES in wanted]
    sound = [k for k in found if finite[k] and ids.count(ids[k]) == 1]
    rays = camera.undistort(detections.corners[sound]) if sound else NOTHING.rays
    return View(detections.stamp, True, detections.ids[sound], rays, len(found) - len(sound))


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
        self._dt = period(rate)
        nothing = AbstractValue.Make(Detections())
        self._view_inputs = (
            self.DeclareAbstractInputPort("front_detections", nothing),
            self.DeclareAbstractInputPort("rear_detections", nothing),
        )
        self._task_input = self.DeclareAbstractInputPort("task", AbstractValue.Make(OFF))
        self._command = self.DeclareDiscreteState(2)
        self._status = self.DeclareDiscreteState(STATUS_SIZE)
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
        task: StepTask = self._task_input.Eval(context)
        number, status, tries = context.get_discrete_state(self._status).get_value().tolist()
        if number == 0 and task is OFF:
            return  # as most robots are, most of the time
        counts: Counter[str] = Counter()
        memory = context.get_discrete_state(self._memory).get_value()
        if not task.sound:
            counts["bad_task"] += 1
            task = OFF
        if task.number != number:
            status, memory, tries = Status.IDLE, self._reset(), 0.0
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
        tries += counts["retries"]
        discrete_state.set_value(self._status, [task.number, float(status), tries])
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
                shown = view(detections, task.robots(), camera)._replace(fresh=stamp != before)
                counts["misread"] += shown.strange * shown.fresh
            elif not math.isnan(stamp):
                counts["stale"] += 1
            views.append(shown)
            stamps.append(stamp)
        discrete_state.set_value(self._stamps, stamps)
        return views[0], views[1]


def check_view(camera: PinholeCamera, pixels: float, name: str, whose: str) -> None:
    """Raises `ValueError` unless the camera's picture holds `pixels` on either side of its axis.

    Args:
        camera: intrinsics.
        pixels: that it must hold.
        name: of the number, for the message.
        whose: name of the camera, for the message.
    """
    centre = camera.K[0, 2]
    room = min(centre + 0.5, camera.width - 0.5 - centre)
    allowed = f"less than {room:g}, what the picture of {whose} holds aside"
    require(pixels < room, name, pixels, allowed)
