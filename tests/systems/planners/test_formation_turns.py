"""Who moves when: the announcements, the tasks and the reports of one move after the other."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.systems.analysis import Simulator

from systems.controllers.step_task import Status, StepTask
from systems.planners.formation_course import FormationMove
from systems.planners.formation_lattice import strip
from systems.planners.formation_tasks import not_found
from systems.planners.formation_turns import FormationTurns, FormationTurnsParameters

Array = NDArray[np.float64]

START = np.column_stack([strip(4, 1.5), np.zeros(4)])
TARGET = np.array([3.0, 1.299])
MOVE = FormationMove(
    stamp=0.0, status="moving", number=1, mover=1, beacons=np.array([2, 3, 0]), target=TARGET,
    points=np.array([[1.125, 0.65], [1.875, 0.65], TARGET]),
)  # fmt: skip
TIMES = FormationTurnsParameters(
    start_time=0.2, stop_time=0.5, look_time=1.0, patience=5.0, pace=10.0
)


class Rig:
    """The block with its inputs in hand; time goes on by tenths of a second."""

    def __init__(self, *, estimate: bool = False) -> None:
        self.block = FormationTurns(start_poses=START, parameters=TIMES)
        self.simulator = Simulator(self.block)
        self.context = self.simulator.get_mutable_context()
        self.block.move_input_port().FixValue(self.context, FormationMove())
        for k in range(4):
            self.status(k, 0, Status.IDLE)
        if estimate:
            self.block.poses_input_port().FixValue(self.context, START.ravel())
        self.k = 0

    def status(self, robot: int, number: int, status: Status, tries: int = 0) -> None:
        self.block.status_input_port(robot).FixValue(self.context, [number, status, tries])

    def move(self, move: FormationMove) -> None:
        self.block.move_input_port().FixValue(self.context, move)

    def wait(self, duration: float) -> None:
        self.k += round(10 * duration)
        self.simulator.AdvanceTo(self.k / 10 + 0.05)

    def output(self, name: str) -> Any:
        return self.block.GetOutputPort(name).Eval(self.context).copy()

    def task(self, robot: int) -> StepTask:
        task: StepTask = self.block.task_output_port(robot).Eval(self.context)
        return task


def test_first_all_look_and_nobody_moves() -> None:
    rig = Rig()
    rig.move(MOVE)
    rig.wait(0.9)
    np.testing.assert_array_equal(rig.output("looking"), [1, 1, 1, 1])
    np.testing.assert_array_equal(rig.output("moving"), [0, 0, 0, 0])
    assert all(rig.task(k).number == 0 for k in range(4))


def test_a_move_is_announced_before_its_robot_gets_the_task() -> None:
    rig = Rig()
    rig.move(MOVE)
    seen = []
    for _ in range(16):
        rig.wait(0.1)
        seen.append((rig.output("moving")[1], rig.task(1).number))
    announced = next(k for k, (moving, _) in enumerate(seen) if moving)
    driven = next(k for k, (_, number) in enumerate(seen) if number)
    assert driven - announced == 2
    np.testing.assert_array_equal(rig.output("looking"), [0, 1, 0, 0])


def driving(rig: Rig) -> Rig:
    rig.move(MOVE)
    rig.wait(2.0)
    return rig


def test_the_task_says_who_stands_where() -> None:
    task = driving(Rig()).task(1)
    assert task.number == 1
    np.testing.assert_array_equal(task.beacons, [2, 3, 0])
    np.testing.assert_allclose(task.poses, START[[2, 3, 0]])
    np.testing.assert_allclose(task.target, TARGET)
    np.testing.assert_allclose(task.start, START[1, :2])


def test_the_task_says_by_which_way_and_who_else_stands() -> None:
    poses = np.column_stack([strip(6, 1.5), np.zeros(6)])
    block = FormationTurns(start_poses=poses, parameters=TIMES)
    simulator = Simulator(block)
    context = simulator.get_mutable_context()
    block.move_input_port().FixValue(context, MOVE)
    block.failed_input_port().FixValue(context, [0, 0, 0, 0, 1, 2])
    for k in range(6):
        block.status_input_port(k).FixValue(context, [0, 0, 0])
    simulator.AdvanceTo(2.05)
    task: StepTask = block.task_output_port(1).Eval(context)
    np.testing.assert_allclose(task.points, MOVE.points[:-1])
    np.testing.assert_array_equal(task.others, [4])  # 5 is no beacon any more
    np.testing.assert_allclose(task.other_poses, poses[[4]])


def test_waits_and_tries_are_written_down() -> None:
    rig = driving(Rig())
    for status, tries in (
        (Status.WAITING, 0), (Status.APPROACH, 1), (Status.WAITING, 1), (Status.BUILD, 2),
    ):  # fmt: skip
        rig.status(1, 1, status, tries)
        rig.wait(0.5)
    rig.status(1, 1, Status.DONE, 2)
    rig.wait(2.0)
    np.testing.assert_allclose(rig.output("record")[7:], [1, 2, 2])
    assert rig.block.health_output_port().Eval(rig.context).counts["waits"] == 2


def test_a_planner_that_thinks_again_calls_the_robot_back() -> None:
    rig = driving(Rig())
    rig.move(FormationMove(stamp=2.0, status="moving", number=2, mover=2, beacons=MOVE.beacons))
    rig.wait(0.2)
    assert rig.task(1).number == 0
    rig.wait(0.6)
    np.testing.assert_allclose(rig.output("record")[[0, 7]], [1, -1])


@pytest.mark.parametrize("lost", [False, True])
def test_a_robot_that_is_not_found_is_looked_for_and_then_said_to_be_nowhere(lost: bool) -> None:
    rig = Rig(estimate=True)
    P = np.eye(12) * 1e-4
    rig.block.covariance_input_port().FixValue(rig.context, P.ravel())
    driving(rig)
    rig.status(1, 1, Status.DONE)
    P[3, 3] = P[4, 4] = 900.0
    rig.block.covariance_input_port().FixValue(rig.context, P.ravel())
    rig.wait(3.0)
    np.testing.assert_array_equal(rig.output("progress"), [1, 0])
    np.testing.assert_array_equal(rig.output("looking"), [1, 1, 1, 1])  # longer than look_time
    if not lost:
        P[3, 3] = P[4, 4] = 1e-4
        rig.block.covariance_input_port().FixValue(rig.context, P.ravel())
    rig.wait(3.0)
    np.testing.assert_array_equal(rig.output("progress"), [1, 1])
    known = np.isfinite(rig.output("positions").reshape(4, 2)).all(axis=1)
    np.testing.assert_array_equal(known, [True, not lost, True, True])
    assert rig.block.health_output_port().Eval(rig.context).counts["not_found"] == int(lost)


def test_found_is_who_is_known_from_another_however_far_from_the_start() -> None:
    far = np.full((12, 12), 4.0) + 1e-4 * np.eye(12)  # all share what is not known
    assert not not_found(far, 0.1).any()
    alone = far + np.diag([0, 0, 0, 0.05, 0, 0, 0, 0, 0, 0, 0, 0])
    np.testing.assert_array_equal(not_found(alone, 0.1), [False, True, False, False])


def test_a_move_that_is_done_is_reported_after_all_have_looked() -> None:
    rig = driving(Rig())
    rig.status(1, 1, Status.DONE)
    rig.wait(0.3)
    assert rig.output("moving")[1] == 1  # until it stands for sure
    rig.wait(0.6)
    np.testing.assert_array_equal(rig.output("looking"), [1, 1, 1, 1])
    np.testing.assert_array_equal(rig.output("moving"), [0, 0, 0, 0])
    np.testing.assert_array_equal(rig.output("progress"), [1, 0])
    rig.wait(1.0)
    np.testing.assert_array_equal(rig.output("progress"), [1, 1])
    np.testing.assert_allclose(rig.output("record"), [1, 1, 2, 3, 0, *TARGET, 1, 0, 0])


def test_without_an_estimate_the_robot_is_believed_to_be_where_it_was_to_go() -> None:
    rig = driving(Rig())
    rig.status(1, 1, Status.DONE)
    rig.wait(2.0)
    expected = START[:, :2].copy()
    expected[1] = TARGET
    np.testing.assert_allclose(rig.output("positions").reshape(4, 2), expected)


@pytest.mark.parametrize("instead", ["moving", "blocked"])
def test_a_robot_whose_move_is_planned_anew_stops_first(instead: str) -> None:
    rig = driving(Rig())
    other = dataclasses.replace(MOVE, number=2, mover=1, beacons=np.array([3, 0, 2]))
    rig.move(other if instead == "moving" else FormationMove(stamp=2.0, status=instead, number=1))
    rig.wait(0.1)
    assert rig.task(1).number == 0
    assert rig.output("moving")[1] == 1  # until it stands for sure
    rig.wait(0.6)
    np.testing.assert_array_equal(rig.output("looking"), [1, 1, 1, 1])
    rig.wait(0.8)
    assert rig.output("record")[7] == -1  # not done: nobody is believed to stand at the target
    np.testing.assert_allclose(rig.output("positions").reshape(4, 2), START[:, :2])
    rig.wait(1.0)
    assert rig.task(1).number == (2 if instead == "moving" else 0)


def test_a_move_that_is_planned_anew_before_it_begins_is_none() -> None:
    rig = Rig()
    rig.move(MOVE)
    while not rig.output("moving")[1]:
        rig.wait(0.1)
    rig.move(dataclasses.replace(MOVE, number=2, mover=0, beacons=np.array([1, 2, 3])))
    rig.wait(0.1)
    np.testing.assert_array_equal(rig.output("moving"), np.zeros(4))
    rig.wait(1.0)
    assert rig.output("record")[0] == 0
    rig.wait(0.6)
    assert [rig.task(k).number for k in range(4)] == [2, 0, 0, 0]


def test_the_believed_poses_are_those_of_the_positions() -> None:
    rig = driving(Rig(estimate=True))
    told = START + 0.01
    rig.block.poses_input_port().FixValue(rig.context, told.ravel())
    rig.wait(0.2)
    np.testing.assert_allclose(rig.output("believed").reshape(4, 3), told)
    np.testing.assert_allclose(rig.output("positions").reshape(4, 2), told[:, :2])


def test_with_one_it_is_believed() -> None:
    rig = driving(Rig(estimate=True))
    told = START + 0.01
    rig.block.poses_input_port().FixValue(rig.context, told.ravel())
    rig.status(1, 1, Status.DONE)
    rig.wait(2.0)
    np.testing.assert_allclose(rig.output("positions").reshape(4, 2), told[:, :2])


def test_an_estimate_that_is_not_finite_is_dropped_and_counted() -> None:
    rig = Rig(estimate=True)
    rig.wait(0.2)
    rig.block.poses_input_port().FixValue(rig.context, np.full(12, math.nan))
    rig.wait(0.5)
    np.testing.assert_allclose(rig.output("positions").reshape(4, 2), START[:, :2])
    counts = rig.block.health_output_port().Eval(rig.context).counts
    assert counts["bad_pose"] == 5


def test_a_robot_that_waits_too_long_gives_up() -> None:
    rig = driving(Rig())
    rig.status(1, 1, Status.WAITING)
    rig.wait(8.0)
    np.testing.assert_array_equal(rig.output("progress"), [1, -1])
    np.testing.assert_allclose(rig.output("positions").reshape(4, 2), START[:, :2])
    assert rig.block.health_output_port().Eval(rig.context).counts["given_up"] == 1


def test_a_robot_that_fails_on_the_way_gives_up_at_once() -> None:
    rig = driving(Rig())
    rig.block.failed_input_port().FixValue(rig.context, [0, 1, 0, 0])
    rig.wait(2.0)
    np.testing.assert_array_equal(rig.output("progress"), [1, -1])


def test_what_a_controller_says_of_an_earlier_task_does_not_count() -> None:
    rig = driving(Rig())
    rig.status(1, 0, Status.DONE)
    rig.wait(1.0)
    np.testing.assert_array_equal(rig.output("moving"), [0, 1, 0, 0])


def test_a_move_that_was_made_already_is_not_made_again() -> None:
    rig = driving(Rig())
    rig.status(1, 1, Status.DONE)
    rig.wait(5.0)
    np.testing.assert_array_equal(rig.output("moving"), [0, 0, 0, 0])


@pytest.mark.parametrize(
    ("poses", "message"),
    [(START[:3], "start_poses is .*four robots"), (START * math.nan, "start_poses is .*finite")],
)
def test_a_start_that_is_none_is_refused(poses: Array, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FormationTurns(start_poses=poses)


def test_of_a_robot_that_nothing_places_the_last_place_counts() -> None:
    rig = driving(Rig(estimate=True))
    known = np.tile(1e-4, 12)
    told = START.copy()
    told[1] = [1.0, 1.0, 0.5]
    rig.block.poses_input_port().FixValue(rig.context, told.ravel())
    rig.block.covariance_input_port().FixValue(rig.context, np.diag(known).ravel())
    rig.wait(0.2)
    np.testing.assert_allclose(rig.output("believed").reshape(4, 3), told)
    astray = told.copy()
    astray[1] = [-7.0, 4.0, 2.0]  # anywhere on a circle about a robot that it sees
    lost = known.copy()
    lost[3:6] = 25.0
    rig.block.poses_input_port().FixValue(rig.context, astray.ravel())
    rig.block.covariance_input_port().FixValue(rig.context, np.diag(lost).ravel())
    rig.wait(0.2)
    np.testing.assert_allclose(rig.output("believed").reshape(4, 3), told)
    np.testing.assert_allclose(rig.output("positions").reshape(4, 2), told[:, :2])
