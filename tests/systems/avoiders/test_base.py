from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from systems.avoiders.dwa import DwaAvoider, DwaParameters
from systems.avoiders.sector import SectorAvoider, SectorParameters
from systems.avoiders.vfh_plus import VfhPlus, VfhPlusParameters
from systems.messages import Scan
from tests.avoider_world import RAYS, Bench, World

KINDS = [SectorAvoider, VfhPlus, DwaAvoider]
PARAMETERS = {
    SectorAvoider: SectorParameters,
    VfhPlus: VfhPlusParameters,
    DwaAvoider: DwaParameters,
}
every_kind = pytest.mark.parametrize("kind", KINDS)

POSE = np.array([1.0, 2.0, 0.5])
GOAL = np.array([4.0, 3.0])
OPEN = World()
# Too narrow for any of them to find a way, wide enough to turn.
CELL = World(
    discs=[(1 + 0.26 * math.cos(a), 2 + 0.26 * math.sin(a), 0.05) for a in np.arange(0, 6.28, 0.25)]
)


def scan_at(t: float, world: World = OPEN, pose: np.ndarray = POSE) -> Scan:
    return world.scan(pose, t - 0.1)


def started(kind: Any, world: World = OPEN, **parameters: float) -> Bench:
    bench = Bench(kind(parameters=PARAMETERS[kind](**parameters)))
    bench.look(0.0, pose=POSE, goal=GOAL, scan=Scan(), command=np.zeros(2))
    bench.look(0.1, scan=scan_at(0.1, world))
    return bench


def counts(bench: Bench) -> dict[str, int]:
    return {reason: n for reason, n in bench.output("health").counts.items() if n}


@every_kind
def test_before_the_first_scan_it_stands(kind: Any) -> None:
    bench = Bench(kind())
    bench.look(0.0, pose=POSE, goal=GOAL, scan=Scan(), command=np.zeros(2))
    assert bench.output("state").status == "blind"
    np.testing.assert_array_equal(bench.output("goal"), POSE[:2])
    assert counts(bench) == {"no_scan": 1}
    np.testing.assert_array_equal(bench.command(POSE), [0.0, 0.0])


@every_kind
def test_with_a_free_way_the_local_goal_is_the_goal(kind: Any) -> None:
    bench = started(kind)
    state = bench.output("state")
    assert state.status == "clear"
    assert state.stamp == 0.0
    assert state.free.all()
    np.testing.assert_array_equal(bench.output("goal"), GOAL)


def broken(**changes: Any) -> Callable[[float], Scan]:
    return lambda t: replace(scan_at(t), **changes)


@every_kind
@pytest.mark.parametrize(
    ("reason", "scan"),
    [
        ("no_scan", lambda _: Scan()),
        ("stale_scan", lambda t: scan_at(t - 0.6)),
        ("stale_scan", lambda t: scan_at(t + 0.2)),
        ("garbled_scan", broken(ranges=np.full(RAYS, -1.0))),
        ("garbled_scan", broken(ranges=np.full(RAYS, math.nan))),
        ("garbled_scan", broken(angle_increment=math.nan)),
    ],
)
def test_without_a_sound_scan_it_stops_and_counts(
    kind: Any, reason: str, scan: Callable[[float], Scan]
) -> None:
    bench = started(kind)
    already = counts(bench).get(reason, 0)
    for k in range(3):
        t = 0.2 + 0.1 * k
        bench.look(t, scan=scan(t))
        assert bench.output("state").status == "blind"
    assert counts(bench)[reason] == already + 3
    # Where it stands when asked, not where it stood at the update: nothing to drive back to.
    later = POSE + np.array([0.02, 0.01, 0.1])
    np.testing.assert_array_equal(bench.command(later), [0.0, 0.0])
    bench.look(0.5, scan=scan_at(0.5), pose=POSE)
    assert bench.output("state").status == "clear"


@every_kind
@pytest.mark.parametrize(
    ("port", "value", "reason"),
    [
        ("pose", np.array([math.nan, 0.0, 0.0]), "bad_pose"),
        ("goal", np.array([math.inf, 0.0]), "bad_goal"),
    ],
)
def test_without_a_pose_or_a_goal_it_stops_and_counts(
    kind: Any, port: str, value: np.ndarray, reason: str
) -> None:
    bench = started(kind)
    bench.look(0.2, scan=scan_at(0.2), **{port: value})
    assert bench.output("state").status == "blind"
    np.testing.assert_array_equal(bench.output("goal"), POSE[:2])  # the last that was sound
    assert counts(bench) == {"no_scan": 1, reason: 1}
    if bench.drives:
        np.testing.assert_array_equal(bench.output("command"), [0.0, 0.0])
    sound = {"pose": POSE, "goal": GOAL}[port]
    bench.look(0.3, scan=scan_at(0.3), **{port: sound})
    assert bench.output("state").status == "clear"


@every_kind
def test_a_bad_command_counts_as_standing(kind: Any) -> None:
    bench = started(kind)
    bench.look(0.2, scan=scan_at(0.2), command=np.array([math.nan, 0.0]))
    assert bench.output("state").status == "clear"
    assert counts(bench) == {"no_scan": 1, "bad_command": 1}


def turn_in_the_cell(bench: Bench, seconds: float, turn_rate: float, first: int = 2) -> list[str]:
    """Looks at 10 Hz, turning; returns the statuses."""
    statuses = []
    for k in range(first, first + round(10 * seconds)):
        t = k / 10
        pose = POSE + np.array([0.0, 0.0, turn_rate * (t - 0.1)])
        scan = CELL.scan(pose, t)
        bench.look(t, pose=pose, scan=scan, command=np.array([0.0, turn_rate]))
        statuses.append(bench.output("state").status)
    return statuses


@every_kind
def test_when_nothing_is_free_it_turns_in_place_and_gives_up_after_a_whole_turn(kind: Any) -> None:
    bench = started(kind, CELL)
    assert bench.output("state").status == "turning"
    assert not bench.output("state").free.any()
    assert math.isnan(bench.output("state").direction)
    v, omega = bench.command(POSE)
    assert v < 0.002
    assert abs(omega) == 1.5
    side = math.copysign(1.0, omega)
    statuses = turn_in_the_cell(bench, 6.5, side)
    # 2 pi at 1 rad/s.
    assert statuses.index("blocked") == pytest.approx(62, abs=2)
    assert set(statuses[:60]) == {"turning"}
    assert set(statuses[64:]) == {"blocked"}
    pose = bench.last["pose"]
    np.testing.assert_array_equal(bench.output("goal"), pose[:2])
    np.testing.assert_array_equal(bench.command(pose), [0.0, 0.0])


@every_kind
def test_it_keeps_the_side_to_which_it_turns(kind: Any) -> None:
    for sign in (1.0, -1.0):
        bench = Bench(kind())
        pose = np.array([1.0, 2.0, 0.0])
        goal = np.array([1.0, 2.0 + 2 * sign])
        bench.look(0.0, pose=pose, goal=goal, scan=CELL.scan(pose, 0.0), command=np.zeros(2))
        assert bench.command(pose)[1] * sign > 0
        pose = np.array([1.0, 2.0, sign * 2.5])  # the goal is now on the other side
        bench.look(0.1, pose=pose, scan=CELL.scan(pose, 0.1))
        assert bench.output("state").status == "turning"
        assert bench.command(pose)[1] * sign > 0


@every_kind
def test_it_gives_up_after_a_time_when_it_cannot_turn(kind: Any) -> None:
    bench = started(kind, CELL, give_up_after=1.0)
    statuses = turn_in_the_cell(bench, 1.5, 0.0)
    assert statuses.index("blocked") == pytest.approx(10, abs=1)


@every_kind
def test_it_goes_on_when_a_direction_becomes_free(kind: Any) -> None:
    bench = started(kind, CELL, give_up_after=0.5)
    assert turn_in_the_cell(bench, 1.0, 0.0)[-1] == "blocked"
    bench.look(1.2, scan=OPEN.scan(POSE, 1.2))
    assert bench.output("state").status == "clear"
    np.testing.assert_array_equal(bench.output("goal"), GOAL)


@every_kind
def test_what_appears_is_seen_at_once(kind: Any) -> None:
    bench = started(kind)
    ahead = POSE[:2] + 0.45 * np.array([math.cos(0.5), math.sin(0.5)])
    goal = POSE[:2] + 3 * np.array([math.cos(0.5), math.sin(0.5)])
    bench.look(0.2, scan=scan_at(0.2), goal=goal)
    assert bench.output("state").status == "clear"
    bench.look(0.3, scan=scan_at(0.3, World(discs=[(*ahead, 0.1)])))
    state = bench.output("state")
    assert state.status in ("avoiding", "turning")
    assert not np.allclose(bench.output("goal"), goal)
    if not bench.drives:
        assert abs(state.direction - 0.5) > math.radians(20)


@every_kind
def test_a_jump_of_the_estimate_moves_the_obstacles_with_the_robot(kind: Any) -> None:
    # The wall was seen from the old estimate; it stands before the robot all the same.
    wall = World(walls=[(1.45, 0.5, 1.45, 3.5)])
    here = np.array([1.0, 2.0, 0.0])
    for jump in (np.zeros(3), np.array([-0.8, 0.6, 0.0])):
        bench = Bench(kind())
        scan = wall.scan(here, 0.05)
        start = {"pose": here, "goal": here[:2] + np.array([3.0, 0.0]), "command": np.zeros(2)}
        bench.look(0.0, scan=Scan(), **start)
        bench.look(0.1, scan=scan)
        bench.look(0.2, pose=here + jump, goal=(here + jump)[:2] + np.array([3.0, 0.0]))
        assert bench.output("state").status != "clear"


@every_kind
def test_a_second_context_gives_the_same(kind: Any) -> None:
    avoider = kind()
    world = World(discs=[(1.5, 2.2, 0.1), (1.9, 2.6, 0.2)])
    results = []
    for _ in range(2):
        bench = Bench(avoider)
        for k in range(20):
            pose = POSE + k * np.array([0.02, 0.01, 0.0])
            scan = world.scan(pose, 0.1 * k)
            bench.look(0.1 * k, pose=pose, goal=GOAL, scan=scan, command=np.array([0.22, 0.0]))
        state = bench.output("state")
        results.append([bench.output("goal"), state.angles, state.density, state.free])
    for one, other in zip(*results, strict=True):
        np.testing.assert_array_equal(one, other)


@every_kind
@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("rate", 0.0),
        ("lidar_pose", [0.0, 0.0]),
        ("lidar_pose", [0.0, 0.0, math.nan]),
        ("hull", [0.1, 0.1]),
        ("hull", [0.1, 0.0, 0.1]),
    ],
)
def test_bad_arguments_are_refused(kind: Any, field: str, value: Any) -> None:
    with pytest.raises(ValueError, match=rf"^{field} is .*: must be "):
        kind(**{field: value})
