"""Every avoider drives through worlds: a turning lidar, an inert drive, no monitor below."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from systems.avoiders.dwa import DwaAvoider
from systems.avoiders.sector import SectorAvoider
from systems.avoiders.vfh_plus import VfhPlus
from systems.messages import Scan
from tests.avoider_world import World, drive

KINDS = [SectorAvoider, VfhPlus, DwaAvoider]
every_kind = pytest.mark.parametrize("kind", KINDS)

ROOM = [
    (-1.0, -2.0, 5.0, -2.0),
    (5.0, -2.0, 5.0, 2.0),
    (5.0, 2.0, -1.0, 2.0),
    (-1.0, 2.0, -1.0, -2.0),
]


def clutter(seed: int) -> World:
    """Up to 14 discs with free passages of 0.6 m between start and goal at (4.2, 0)."""
    random = np.random.default_rng(seed)
    discs: list[tuple[float, float, float]] = []
    for _ in range(400):
        x, y, radius = random.uniform([0.6, -1.5, 0.05], [3.6, 1.5, 0.2])
        if len(discs) < 14 and all(
            math.hypot(x - disc[0], y - disc[1]) > radius + disc[2] + 0.6 for disc in discs
        ):
            discs.append((x, y, radius))
    return World(discs=discs, walls=ROOM)


WORLDS: dict[str, tuple[World, dict[str, Any]]] = {
    "nothing": (World(), {}),
    "gap of 0.6 m": (World(walls=[(1.5, 0.3, 1.5, 3.0), (1.5, -0.3, 1.5, -3.0)]), {}),
    "gap of 0.6 m aside": (World(walls=[(1.5, 1.0, 1.5, 3.0), (1.5, 0.4, 1.5, -3.0)]), {}),
    "corridor of 0.6 m": (World(walls=[(0.5, 0.3, 3.0, 0.3), (0.5, -0.3, 3.0, -0.3)]), {}),
    "wall ahead": (World(walls=[(1.5, -0.6, 1.5, 0.6)]), {}),
    "post ahead": (World(discs=[(1.5, 0.0, 0.05)]), {}),
    "goal before a wall": (World(walls=[(1.5, -2.0, 1.5, 2.0)]), {"goal": (1.2, 0.0)}),
    **{f"clutter {seed}": (clutter(seed), {"goal": (4.2, 0.0)}) for seed in range(6)},
}


@every_kind
@pytest.mark.parametrize("name", WORLDS)
def test_it_gets_there_and_touches_nothing(kind: Any, name: str) -> None:
    world, options = WORLDS[name]
    run = drive(kind(), world, **options)
    assert run.contacts == 0
    assert run.reached, run.states[-1].status


def test_the_way_of_a_free_goal_is_the_straight_one() -> None:
    for kind in KINDS:
        run = drive(kind(), World(walls=[(0.0, 0.7, 3.0, 0.7)]))
        assert run.length == pytest.approx(3.0 - 0.15, abs=0.02)
        assert {state.status for state in run.states[4:]} == {"clear"}


@every_kind
def test_in_a_closed_cell_it_touches_nothing_and_gives_up_unless_it_can_move(kind: Any) -> None:
    cell = [
        (0.4, -0.4, 0.4, 0.4),
        (0.4, 0.4, -0.4, 0.4),
        (-0.4, 0.4, -0.4, -0.4),
        (-0.4, -0.4, 0.4, -0.4),
    ]
    run = drive(kind(), World(walls=cell), duration=30.0)
    assert run.contacts == 0
    if kind is DwaAvoider:  # finds free arcs of a few centimetres
        assert "turning" in run.statuses
    else:
        assert run.states[-1].status == "blocked"
        assert not run.commands[-1].any()


@every_kind
def test_in_a_trap_it_touches_nothing(kind: Any) -> None:
    # Whether it gets out is a matter of luck: that is what planners are for.
    trap = [(2.5, -1.2, 2.5, 1.2), (0.8, 1.2, 2.5, 1.2), (0.8, -1.2, 2.5, -1.2)]
    run = drive(kind(), World(walls=trap), start=(1.2, 0.1, 0.0), goal=(4.0, 0.0), duration=60.0)
    assert run.contacts == 0
    assert run.length > 0.5


def crossing(speed: float) -> World:
    """A disc that would meet the robot at (1.5, 0), after five seconds."""
    return World(walls=ROOM, movers=[lambda t: (1.5, speed * (t - 5), 0.15)])


@pytest.mark.parametrize("kind", [VfhPlus, DwaAvoider])
def test_it_lets_a_slow_thing_cross(kind: Any) -> None:
    run = drive(kind(), crossing(0.1))
    assert run.contacts == 0
    assert run.reached


def test_vfh_plus_makes_way_for_what_comes_straight_at_it() -> None:
    for aside in (-0.1, 0.0, 0.1):
        world = World(walls=ROOM, movers=[lambda t, y=aside: (3.2 - 0.1 * t, y, 0.15)])  # type: ignore[misc]
        run = drive(VfhPlus(), world)
        assert run.contacts == 0
        assert run.reached


@every_kind
def test_it_stops_while_the_lidar_is_covered(kind: Any) -> None:
    def covered(t: float, scan: Scan) -> Scan:
        return Scan(scan.stamp, ranges=np.full(360, math.nan)) if 3 < t < 6 else scan

    run = drive(kind(), WORLDS["post ahead"][0], scale=covered)
    times = np.array(run.times)
    dark = (times > 3.8) & (times < 6)
    assert {run.states[k].status for k in np.flatnonzero(dark)} == {"blind"}
    assert np.ptp(np.array(run.poses)[dark, :2], axis=0).max() < 1e-3
    assert run.reached
    assert run.contacts == 0
