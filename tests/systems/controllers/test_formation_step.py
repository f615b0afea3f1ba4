import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator

from systems.cameras import PinholeCamera
from systems.controllers.formation_step import (
    FormationStep,
    FormationStepParameters,
    view,
)
from systems.controllers.step_localizer import ResectionTrustParameters
from systems.controllers.step_task import Status
from systems.controllers.triangle_algorithm1 import TriangleAlgorithm1
from systems.controllers.triangle_resection import TriangleResection
from systems.formation.bearing_filter import BearingFilterParameters
from systems.messages import Detections
from tests.triangle_step import CAMERA, STARTS, Run, World, picture, run_step

STEP = FormationStepParameters(marker_size=0.10)
WAY = [Status.APPROACH, Status.PASS, Status.BUILD, Status.DONE]
both = pytest.mark.parametrize("kind", [TriangleAlgorithm1, TriangleResection])


def block(kind: type, **more: object) -> FormationStep:
    system = kind(front_camera=CAMERA, rear_camera=CAMERA, step=STEP, **more)
    assert isinstance(system, FormationStep)
    return system


@cache
def undisturbed(kind: type) -> Run:
    """The step when nothing goes wrong, which also tells when what happens."""
    return run_step(block(kind), World())


def hidden(robot: int, begin: float, end: float) -> Callable[..., Detections]:
    def tamper(time: float, _: bool, seen: Detections) -> Detections:
        return seen.select(seen.ids // 4 != robot) if begin <= time < end else seen

    return tamper


def swapped(one: int, other: int, begin: float, end: float) -> Callable[..., Detections]:
    def tamper(time: float, _: bool, seen: Detections) -> Detections:
        if not begin <= time < end:
            return seen
        robots, sides = np.divmod(seen.ids, 4)
        robots = np.where(robots == one, other, np.where(robots == other, one, robots))
        return replace(seen, ids=4 * robots + sides)

    return tamper


@pytest.mark.parametrize("mirrored", [False, True])
def test_algorithm1_drives_the_papers_first_step(mirrored: bool) -> None:
    plain = undisturbed(TriangleAlgorithm1)
    run = run_step(block(TriangleAlgorithm1), World().mirrored()) if mirrored else plain
    assert run.statuses == WAY
    assert abs(run.aside) < 0.096 + 0.01  # 24 px and what the latency adds
    assert abs(run.along) < 0.033 + 0.02
    assert not any(run.health.values())


@pytest.mark.parametrize("mirrored", [False, True])
def test_resection_settles_within_millimetres(mirrored: bool) -> None:
    world = World(wheel_scale=(1.02, 0.97))
    run = run_step(block(TriangleResection), world.mirrored() if mirrored else world)
    assert run.statuses == WAY
    assert abs(run.aside) < 0.004
    assert abs(run.along) < 0.003
    assert not any(run.health.values())


# Two more robots behind the paper's four; the last one goes to the front.
SIX = np.vstack([STARTS, [[-0.75, 0.0, 0.0], [-1.5, 1.30, 0.0]]])
POINTS = np.array([[x, 0.65] for x in (-0.375, 0.375, 1.125, 1.875)])


def long_way(**more: object) -> World:
    return World(mover=5, poses=SIX.copy(), points=POINTS, **more)  # type: ignore[arg-type]


@both
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_long_way_leads_through_every_triangle_to_the_vertex(kind: type, mirrored: bool) -> None:
    world = long_way(wheel_scale=(1.02, 0.97))
    world = world.mirrored() if mirrored else world
    run = run_step(block(kind), world)
    assert run.statuses == WAY
    within = 0.106 if kind is TriangleAlgorithm1 else 0.004
    assert math.hypot(run.along, run.aside) < within
    for point in world.points:
        assert np.linalg.norm(run.path[:, :2] - point, axis=1).min() < 0.1
    others = np.delete(world.poses[:, :2], 5, axis=0)
    assert np.linalg.norm(run.path[:, None, :2] - others, axis=2).min() > 0.5
    assert run.health["retries"] == 0


def test_robots_beside_the_way_tell_where_one_is() -> None:
    """None of the step's own beacons can be seen until it is among them."""

    def tamper(time: float, _: bool, seen: Detections) -> Detections:
        return seen.select(~np.isin(seen.ids // 4, [0, 2, 3])) if time < 12.0 else seen

    world = long_way(tamper=tamper)
    alone = replace(world.task(), others=np.zeros(0, np.int64), other_poses=np.zeros((0, 3)))
    helped = run_step(block(TriangleResection), world, limit=12.0)
    unaided = run_step(block(TriangleResection), world, limit=12.0, task=alone)
    assert helped.statuses == [Status.APPROACH, Status.PASS]
    np.testing.assert_allclose(helped.path[-1, 1], 0.65, atol=0.02)
    assert unaided.statuses == [Status.APPROACH]
    assert np.ptp(unaided.path[:, :2], axis=0).max() == 0.0  # it turns round and looks


@both
def test_who_is_not_where_the_task_says_finds_out(kind: type) -> None:
    """Given up halfway before: it stands inside the formation, not at its vertex."""
    poses = SIX.copy()
    poses[5] = [0.2, 0.75, 0.4]
    world = long_way()
    world.poses = poses
    task = replace(world.task(), start=np.array([-1.5, 1.30]))
    run = run_step(block(kind), world, task=task)
    assert run.statuses[-1] == Status.DONE
    assert math.hypot(run.along, run.aside) < (0.106 if kind is TriangleAlgorithm1 else 0.004)


def test_motors_that_are_dead_for_a_time_are_noticed_and_waited_for() -> None:
    world = long_way(dead=(10.0, 25.0))
    run = run_step(block(TriangleResection), world)
    assert run.statuses[-1] == Status.DONE
    assert Status.WAITING in run.statuses
    assert run.health["relocated"] >= 1
    assert run.health["retries"] >= 1
    assert math.hypot(run.along, run.aside) < 0.004


def test_it_keeps_clear_of_the_beacons() -> None:
    run = undisturbed(TriangleAlgorithm1)
    beacons = STARTS[[0, 2, 3], :2]
    gaps = np.linalg.norm(run.path[:, None, :2] - beacons, axis=2)
    assert gaps.min() > 0.5


def test_resection_corrects_a_start_that_is_not_where_it_is_believed() -> None:
    world = World(poses=STARTS + np.array([[0, 0, 0], [0.05, -0.06, 2.0], [0, 0, 0], [0, 0, 0]]))
    task = replace(world.task(), start=np.array([0.0, 1.3]))
    run = run_step(block(TriangleResection), world, task=task)
    assert run.statuses[-1] == Status.DONE
    assert math.hypot(run.along, run.aside) < 0.005


def test_a_camera_off_centre_is_a_state() -> None:
    noise = BearingFilterParameters(centre_std=3.0)
    run = run_step(block(TriangleResection, noise=noise), World(centre_bias=3.0))
    assert run.statuses[-1] == Status.DONE
    assert math.hypot(run.along, run.aside) < 0.008


def test_algorithm1_waits_for_a_hidden_anchor_and_goes_on() -> None:
    begin = undisturbed(TriangleAlgorithm1).since[Status.BUILD] + 3.0
    run = run_step(block(TriangleAlgorithm1), World(tamper=hidden(0, begin, begin + 2.0)))
    assert run.statuses == [*WAY[:3], Status.WAITING, Status.DONE]
    assert run.health["hidden"] == pytest.approx(40, abs=3)  # 2 s of pictures
    assert run.health["retries"] == 0
    assert run.seconds == pytest.approx(undisturbed(TriangleAlgorithm1).seconds + 2.0, abs=1.0)
    assert math.hypot(run.along, run.aside) < 0.1


def test_algorithm1_tries_again_when_it_has_waited_long_enough() -> None:
    begin = undisturbed(TriangleAlgorithm1).since[Status.BUILD] + 3.0
    run = run_step(block(TriangleAlgorithm1), World(tamper=hidden(0, begin, begin + 4.0)))
    assert run.statuses[-1] == Status.DONE
    assert run.health["retries"] == 1


def test_algorithm1_does_not_move_on_beacons_that_are_mixed_up() -> None:
    end = undisturbed(TriangleAlgorithm1).seconds
    world = World(tamper=swapped(2, 3, end - 1.0, end + 1.0))
    run = run_step(block(TriangleAlgorithm1), world)
    assert run.health["misread"] > 20
    assert run.statuses == [*WAY[:3], Status.WAITING, Status.DONE]
    assert math.hypot(run.along, run.aside) < 0.1


def test_resection_refuses_beacons_that_are_mixed_up() -> None:
    end = undisturbed(TriangleResection).seconds
    run = run_step(block(TriangleResection), World(tamper=swapped(2, 3, end - 3.0, end - 2.5)))
    assert run.health["misread"] > 10
    assert run.health["relocated"] == 0
    assert run.statuses == WAY
    assert math.hypot(run.along, run.aside) < 0.006


def test_resection_is_not_done_when_it_does_not_know_where_it_is() -> None:
    world = World(tamper=hidden(2, 0.0, 1e9))
    run = run_step(block(TriangleResection), world, limit=70.0)
    assert Status.WAITING in run.statuses
    assert Status.DONE not in run.statuses
    assert run.health["hidden"] > 0
    assert run.health["retries"] > 0
    # One that trusts whatever it has ends somewhere near.
    trust = ResectionTrustParameters(done_std=1.0)
    rash = run_step(block(TriangleResection, trust=trust), world, limit=70.0)
    assert rash.statuses[-1] == Status.DONE


@both
def test_blind_it_turns_once_then_waits_and_says_so(kind: type) -> None:
    world = World(tamper=lambda _, __, seen: seen.select(seen.ids < 0))
    run = run_step(block(kind), world, limit=26.0)
    assert run.statuses == [Status.APPROACH, Status.WAITING]
    assert np.ptp(run.path[:, :2], axis=0) == pytest.approx([0.0, 0.0])
    turned = np.abs(np.diff(np.unwrap(run.path[:, 2]))).sum()
    assert turned == pytest.approx(2 * math.pi + 0.5, abs=0.1)
    assert run.health["hidden"] > 40


@both
def test_old_pictures_are_counted_and_not_looked_at(kind: type) -> None:
    kept: dict[bool, Detections] = {}

    def frozen(time: float, rear: bool, seen: Detections) -> Detections:
        return kept.setdefault(rear, seen) if time >= 3.0 else seen

    run = run_step(block(kind), World(tamper=frozen), limit=8.0)
    assert run.health["stale"] == pytest.approx(2 * 20 * (8.0 - 4.0), abs=10)


@both
def test_bad_and_absent_tasks_leave_it_standing(kind: type) -> None:
    task = World().task()
    for bad in (
        replace(task, beacons=np.array([2, 2, 0])),
        replace(task, beacons=np.array([2, -3, 0])),
        replace(task, number=math.nan),
        replace(task, number=0),
    ):
        run = run_step(block(kind), World(), limit=1.0, task=bad)
        assert run.statuses == [Status.IDLE]
        assert np.ptp(run.path, axis=0).max() == 0
        assert (run.health["bad_task"] > 0) == (bad.number != 0)


@both
def test_a_new_number_begins_anew(kind: type) -> None:
    system, task = block(kind), World().task()
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    for port in (system.front_detections_input_port(), system.rear_detections_input_port()):
        port.FixValue(context, Detections())
    status = system.status_output_port()
    seen = []
    # Half a minute without a beacon, then none to do, then another step.
    for number, t in ((1, 23.5), (0, 24.0), (2, 24.5)):
        system.task_input_port().FixValue(context, AbstractValue.Make(replace(task, number=number)))
        simulator.AdvanceTo(t)
        seen.append(status.Eval(context).tolist())
    assert [row[:2] for row in seen] == [
        [1, Status.WAITING],
        [0, Status.IDLE],
        [2, Status.APPROACH],
    ]


def test_a_view_drops_what_is_no_reading() -> None:
    world = World(corner_noise=0.0)
    seen = picture(world, np.array([0.0, 1.3, -0.5]), False, 1.0, 0, 0)
    assert len(seen) == 3
    whole = view(seen, np.array([0, 2, 3]), CAMERA)
    assert len(whole.ids) == 3
    assert (
        len(view(seen, np.array([2, 3, 9]), CAMERA).ids) == 2
    )  # another robot's are not looked at
    twice = view(seen.select(np.array([0, 1, 2, 2])), np.array([0, 2, 3]), CAMERA)
    assert (len(twice.ids), twice.strange) == (2, 2)
    corners = seen.corners.copy()
    corners[1, 2, 0] = np.nan
    broken = view(replace(seen, corners=corners), np.array([0, 2, 3]), CAMERA)
    assert (len(broken.ids), broken.strange) == (2, 1)


def test_nonsense_is_refused() -> None:
    narrow = PinholeCamera.from_focal_length(500, 400, 485.0)
    with pytest.raises(ValueError, match="dt is 280"):
        TriangleAlgorithm1(front_camera=CAMERA, rear_camera=narrow)
    for kind in (TriangleAlgorithm1, TriangleResection):
        with pytest.raises(ValueError, match="rate is 0"):
            kind(front_camera=CAMERA, rear_camera=CAMERA, rate=0.0)
    with pytest.raises(ValueError, match="side is -1"):
        FormationStepParameters(side=-1.0)
