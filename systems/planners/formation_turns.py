"""Lets the robots of a formation move in turns: who drives, who stands, who looks."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import (
    Context,
    DiscreteValues,
    EventStatus,
    InputPort,
    LeafSystem,
    OutputPort,
    State,
)

from systems.controllers.step_task import OFF, STATUS_SIZE, Status, StepTask
from systems.formation.triangles import arrival_heading
from systems.health import Counts
from systems.periods import period
from systems.planners.formation_course import FormationMove
from systems.planners.formation_tasks import not_found, task_of, way_length
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

RECORD_SIZE = 10


class Phase(IntEnum):
    """What the formation is at."""

    LOOK = 0  # all stand and look at each other
    READY = 1  # waiting for the next move
    START = 2  # a robot is about to set out
    DRIVE = 3
    STOP = 4  # it has stopped, or is about to


@dataclass
class FormationTurnsParameters:
    """How long things take.

    Attributes:
        start_time: from the announcement of a move to its task, s.
        stop_time: from the end of a task until the robot stands for sure, s.
        look_time: for which all look at each other then, s.
        look_patience: for how long they go on looking for a robot that is not found, s.
        found_std: standard deviation of its place against some other's, along the worst axis, up to
            which a robot counts as found, m.
        patience: of one move, beside the time that its way takes; it is given up after it, s.
        pace: average speed by which that time is counted, m/s.
    """

    start_time: float = 0.2
    stop_time: float = 0.5
    look_time: float = 1.0
    look_patience: float = 5.0
    found_std: float = 0.1
    patience: float = 120.0
    pace: float = 0.05

    def __post_init__(self) -> None:
        require_non_negative(
            start_time=self.start_time,
            stop_time=self.stop_time,
            look_time=self.look_time,
            look_patience=self.look_patience,
        )
        require_positive(found_std=self.found_std, patience=self.patience, pace=self.pace)


class FormationTurns(LeafSystem):
    """Hands each move to its robot as a task, says who moves, and reports what became of it.

    .. pydrake_system::

        name: FormationTurns
        input_ports:
        - move
        - poses
        - covariance
        - failed
        - status_{k}
        output_ports:
        - task_{k}
        - moving
        - looking
        - progress
        - positions
        - believed
        - record
        - health

    Args:
        start_poses: (N, 3) [x (m), y (m), theta (rad)] of the robots in map at the start.
        parameters: how long things take.
        rate: Hz.

    Ports:
        move (input, FormationMove): of the planner.
        poses (input, vector of 3 N): [x, y, theta] of each robot in map, the estimate; unconnected,
            every robot is believed to stand exactly where its last move was to end, with the anchor
            behind it: that is how the paper's errors add up.
        covariance (input, vector of 9 N N): of them, row by row; unconnected, all robots count as
            found.
        failed (input, vector of N): 0 for robots that can drive, 2 for those that are no beacons
            either; unconnected: all can.
        status_{k} (input, vector of 3): of robot k's controller, k from 0.
        task_{k} (output, StepTask): its task; of its robots, all that stand where they are
            believed to.
        moving (output, vector of N): 1 for the robot that moves, from before it sets out until it
            stands again.
        looking (output, vector of N): 1 for each robot whose cameras are needed: the mover's while
            it moves, everybody's while all stand and look.
        progress (output, vector of 2): number of the move, and 1 when it is done, -1 when it was
            given up (its controller took too long, the robot has failed, or the planner wants
            something else), else 0.
        positions (output, vector of 2 N): x, y of the robots as they are believed to be, where it
            was known last for one that is not known now; NaN for one that is looked for and not
            found.
        believed (output, vector of 3 N): [x, y, theta] of the robots, likewise, but never NaN.
        record (output, vector of 10): number of the last move that ended, its robot, its three
            beacons, its target (2, m), what became of it (1 or -1), how often the robot stood and
            waited, and its tries after the first; zeros before the first move.
        health (output, Health): `bad_pose`, looks at estimates that were not finite, for which
            those before count; `given_up`, moves; `waits`, of all moves; `not_found`, robots that
            all have looked for in vain.

    Raises:
        ValueError: fewer than four robots, poses that are not finite, or a rate out of range.
    """

    def __init__(
        self,
        *,
        start_poses: ArrayLike,
        parameters: FormationTurnsParameters | None = None,
        rate: float = 10.0,
    ) -> None:
        super().__init__()
        require_positive(rate=rate)
        poses = np.array(start_poses, float).reshape(-1, 3)
        require(len(poses) >= 4, "start_poses", poses.tolist(), "poses of at least four robots")
        require(bool(np.isfinite(poses).all()), "start_poses", poses.tolist(), "finite")
        n = self._robots = len(poses)
        self._parameters = parameters or FormationTurnsParameters()
        self._move_input = self.DeclareAbstractInputPort(
            "move", AbstractValue.Make(FormationMove())
        )
        self._poses_input = self.DeclareVectorInputPort("poses", 3 * n)
        self._covariance_input = self.DeclareVectorInputPort("covariance", 9 * n * n)
        self._failed_input = self.DeclareVectorInputPort("failed", n)
        self._status_inputs = [
            self.DeclareVectorInputPort(f"status_{k}", STATUS_SIZE) for k in range(n)
        ]
        self._belief = self.DeclareDiscreteState(poses.ravel())
        # Phase, since when (s), number of the move, its robot, what became of it.
        self._turn = self.DeclareDiscreteState([Phase.LOOK, 0.0, 0.0, -1.0, 0.0])
        # Of the present move: whether its robot waits, how often it did, its tries after the first.
        self._effort = self.DeclareDiscreteState(3)
        # Of each robot: whether it was not found; whether it gave up its last move.
        self._missing = self.DeclareDiscreteState(n)
        self._astray = self.DeclareDiscreteState(n)
        self._task = self.DeclareAbstractState(AbstractValue.Make(OFF))
        self._record = self.DeclareDiscreteState(RECORD_SIZE)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period(rate), 0.0, self._update)
        turn = {self.discrete_state_ticket(self._turn)}
        both = turn | {self.abstract_state_ticket(self._task)}
        self._task_outputs = [
            self.DeclareAbstractOutputPort(
                f"task_{k}",
                lambda: AbstractValue.Make(OFF),
                lambda context, output, k=k: output.set_value(self._task_of(context, k)),
                both,
            )
            for k in range(n)
        ]
        self._moving_output = self.DeclareVectorOutputPort(
            "moving",
            n,
            lambda context, output: output.SetFromVector(self._moving(context)),
            turn,
        )
        self._looking_output = self.DeclareVectorOutputPort(
            "looking",
            n,
            lambda context, output: output.SetFromVector(self._looking(context)),
            turn,
        )
        self._progress_output = self.DeclareVectorOutputPort(
            "progress", 2, self._calc_progress, turn
        )
        self._positions_output = self.DeclareVectorOutputPort(
            "positions",
            2 * n,
            self._calc_positions,
            {self.discrete_state_ticket(self._belief), self.discrete_state_ticket(self._missing)},
        )
        self._believed_output = self.DeclareStateOutputPort("believed", self._belief)
        self._record_output = self.DeclareStateOutputPort("record", self._record)
        self._counts = Counts(self, "bad_pose", "given_up", "waits", "not_found")

    def move_input_port(self) -> InputPort:
        """Returns the port of the planner's moves."""
        return self._move_input

    def poses_input_port(self) -> InputPort:
        """Returns the port of the estimated poses."""
        return self._poses_input

    def covariance_input_port(self) -> InputPort:
        """Returns the port of their covariance."""
        return self._covariance_input

    def failed_input_port(self) -> InputPort:
        """Returns the port of who has failed."""
        return self._failed_input

    def status_input_port(self, robot: int) -> InputPort:
        """Returns the port of a controller's status."""
        return self._status_inputs[robot]

    def task_output_port(self, robot: int) -> OutputPort:
        """Returns the port of a robot's task."""
        return self._task_outputs[robot]

    def moving_output_port(self) -> OutputPort:
        """Returns the port of who moves."""
        return self._moving_output

    def looking_output_port(self) -> OutputPort:
        """Returns the port of whose cameras are needed."""
        return self._looking_output

    def progress_output_port(self) -> OutputPort:
        """Returns the port of what became of the present move."""
        return self._progress_output

    def positions_output_port(self) -> OutputPort:
        """Returns the port of the believed positions."""
        return self._positions_output

    def believed_output_port(self) -> OutputPort:
        """Returns the port of the believed poses."""
        return self._believed_output

    def record_output_port(self) -> OutputPort:
        """Returns the port of the last move that ended."""
        return self._record_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    # --- Outputs ---

    def _now(self, context: Context) -> tuple[float, int]:
        """Returns the phase and the robot of the present move, -1 for none."""
        phase, _, _, mover, _ = context.get_discrete_state(self._turn).get_value().tolist()
        return phase, int(mover)

    def _task_of(self, context: Context, robot: int) -> StepTask:
        phase, mover = self._now(context)
        if robot == mover and phase == Phase.DRIVE:
            task: StepTask = context.get_abstract_state(int(self._task)).get_value()
            return task
        return OFF

    def _moving(self, context: Context) -> Array:
        phase, mover = self._now(context)
        moving = np.zeros(self._robots)
        if phase in _AWAY:
            moving[mover] = 1.0
        return moving

    def _looking(self, context: Context) -> Array:
        phase, _ = self._now(context)
        return np.ones(self._robots) if phase == Phase.LOOK else self._moving(context)

    def _calc_positions(self, context: Context, output: Any) -> None:
        poses = context.get_discrete_state(self._belief).get_value().reshape(-1, 3)
        missing = context.get_discrete_state(self._missing).get_value()
        output.SetFromVector(np.where(missing[:, None] > 0, np.nan, poses[:, :2]).ravel())

    def _calc_progress(self, context: Context, output: Any) -> None:
        phase, _, number, _, outcome = context.get_discrete_state(self._turn).get_value()
        output.SetFromVector([number, outcome if phase == Phase.READY else 0.0])

    # --- One look ---

    def _update(self, context: Context, state: State) -> EventStatus:
        p, t = self._parameters, context.get_time()
        discrete_state: Any = state.get_mutable_discrete_state()
        turn = context.get_discrete_state(self._turn).get_value()
        phase, since, number, mover, outcome = turn.tolist()
        waited = t - since + 1e-9
        counts: Counter[str] = Counter()
        poses = self._believed(context, discrete_state, counts)
        move: FormationMove = self._move_input.Eval(context)
        after: Phase | None = None
        if phase == Phase.LOOK and waited >= p.look_time:
            missing = self._not_found(context)
            if not missing.any() or waited >= p.look_patience:
                counts["not_found"] += int(missing.sum())
                discrete_state.set_value(self._missing, missing.astype(float))
                after = Phase.READY
        elif phase == Phase.READY:
            if move.status == "moving" and move.number > number and move.mover >= 0:
                number, mover, outcome, after = move.number, move.mover, 0.0, Phase.START
        elif phase == Phase.START and (move.number != number or move.status != "moving"):
            outcome, after = -1.0, Phase.LOOK  # it has not moved yet, and is looked at again
        elif phase == Phase.START and waited >= p.start_time:
            slot: Any = state.get_mutable_abstract_state(int(self._task))
            slot.set_value(task_of(move, poses, self._standing(context)))
            discrete_state.set_value(self._effort, np.zeros(3))
            after = Phase.DRIVE
        elif phase == Phase.DRIVE:
            outcome = self._outcome(context, discrete_state, int(mover), move, waited, counts)
            if outcome:
                after = Phase.STOP
        elif phase == Phase.STOP and waited >= p.stop_time:
            self._end(context, discrete_state, poses, int(mover), outcome)
            counts["given_up"] += outcome < 0
            after = Phase.LOOK
        if after is not None:
            discrete_state.set_value(self._turn, [after, t, number, mover, outcome])
        self._counts.add(context, discrete_state, **counts)
        return EventStatus.Succeeded()

    def _standing(self, context: Context) -> NDArray[np.bool_]:
        """Returns which robots stand where they are believed to be, if they do not move, (N,)."""
        standing = context.get_discrete_state(self._missing).get_value() == 0
        if self._failed_input.HasValue(context):
            standing &= self._failed_input.Eval(context) != _NO_BEACON
        if not self._poses_input.HasValue(context):
            standing &= context.get_discrete_state(self._astray).get_value() == 0
        return np.asarray(standing)

    def _not_found(self, context: Context) -> NDArray[np.bool_]:
        """Returns which robots are not known from any other, (N,)."""
        if not self._covariance_input.HasValue(context):
            return np.zeros(self._robots, bool)
        size = 3 * self._robots
        P = self._covariance_input.Eval(context).reshape(size, size)
        return not_found(P, self._parameters.found_std)

    def _believed(
        self, context: Context, discrete_state: DiscreteValues, counts: Counter[str]
    ) -> Array:
        """Returns the poses (N, 3) as they are believed to be, and remembers them."""
        poses = context.get_discrete_state(self._belief).get_value().reshape(-1, 3)
        if not self._poses_input.HasValue(context):
            return poses
        told = self._poses_input.Eval(context).reshape(-1, 3)
        if not np.isfinite(told).all():
            counts["bad_pose"] += 1
            return poses
        # What is told of a robot that nothing places may be anywhere: its last place counts.
        told = np.where(self._not_found(context)[:, None], poses, told)
        discrete_state.set_value(self._belief, told.ravel())
        return told

    def _outcome(
        self,
        context: Context,
        discrete_state: DiscreteValues,
        mover: int,
        move: FormationMove,
        waited: float,
        counts: Counter[str],
    ) -> float:
        """Returns 1 when the present task is done, -1 when it is given up, else 0."""
        task: StepTask = context.get_abstract_state(int(self._task)).get_value()
        number, status, tries = self._status_inputs[mover].Eval(context).tolist()
        if number == task.number:
            was_waiting, waits, _ = context.get_discrete_state(self._effort).get_value()
            waiting = status == Status.WAITING
            begun = waiting and not was_waiting
            counts["waits"] += int(begun)
            discrete_state.set_value(self._effort, [waiting, waits + begun, tries])
            if status == Status.DONE:
                return 1.0
        failed = self._failed_input.HasValue(context) and self._failed_input.Eval(context)[mover]
        late = waited >= self._parameters.patience + way_length(task) / self._parameters.pace
        changed = move.number != task.number or move.status != "moving"
        return -1.0 if failed or late or changed else 0.0

    def _end(
        self,
        context: Context,
        discrete_state: DiscreteValues,
        poses: Array,
        mover: int,
        outcome: float,
    ) -> None:
        """Notes a move that has ended."""
        task: StepTask = context.get_abstract_state(int(self._task)).get_value()
        _, waits, tries = context.get_discrete_state(self._effort).get_value()
        record = [task.number, mover, *task.beacons, *task.target, outcome, waits, tries]
        discrete_state.set_value(self._record, record)
        astray = context.get_discrete_state(self._astray).get_value().copy()
        astray[mover] = outcome < 0
        discrete_state.set_value(self._astray, astray)
        if outcome > 0 and not self._poses_input.HasValue(context):
            heading = arrival_heading(task.target, poses[task.beacons[2], :2])
            moved = poses.copy()
            moved[mover] = [*task.target, math.remainder(float(heading), 2 * math.pi)]
            discrete_state.set_value(self._belief, moved.ravel())


_AWAY = (Phase.START, Phase.DRIVE, Phase.STOP)
_NO_BEACON = 2.0  # as `failed` says it
