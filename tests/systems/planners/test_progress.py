from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator

from systems.messages import Path
from systems.planners.progress import ProgressMonitor, ProgressParameters, left_to_go


def test_what_is_left_to_go() -> None:
    path = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 4.0]])
    nothing = np.zeros((0, 2))
    assert left_to_go(nothing, np.array([0.0, 0.0]), np.array([3.0, 4.0])) == pytest.approx(5.0)
    assert left_to_go(path, np.array([1.0, 0.0]), np.array([3.0, 4.0])) == pytest.approx(6.0)
    assert left_to_go(path, np.array([1.0, 0.5]), np.array([3.0, 4.0])) == pytest.approx(6.5)
    # A path that ends before the waypoint: on from its end.
    assert left_to_go(path, np.array([3.0, 1.0]), np.array([3.0, 6.0])) == pytest.approx(5.0)


class Rig:
    def __init__(self, **parameters: float) -> None:
        self.monitor = ProgressMonitor(parameters=ProgressParameters(**parameters), rate=5.0)
        self.simulator = Simulator(self.monitor)
        self.context = self.simulator.get_mutable_context()
        self.goal([5.0, 0.0])

    def goal(self, goal: Any) -> None:
        self.monitor.goal_input_port().FixValue(self.context, np.array(goal, float))

    def path(self, *points: Any) -> None:
        path = Path(stamp=0.0, points=np.array(points, float).reshape(-1, 2))
        self.monitor.path_input_port().FixValue(self.context, AbstractValue.Make(path))

    def to(self, t: float, x: float, y: float = 0.0) -> bool:
        """Whether it is stuck at time t, when it has stood there since the last time."""
        self.monitor.pose_input_port().FixValue(self.context, [x, y, 0.0])
        self.simulator.AdvanceTo(t)
        return bool(self.monitor.stuck_output_port().Eval(self.context)[0])

    @property
    def counts(self) -> dict[str, int]:
        counts = self.monitor.health_output_port().Eval(self.context).counts
        return {reason: number for reason, number in counts.items() if number}


def test_who_stands_is_stuck_after_the_patience() -> None:
    rig = Rig(patience=10.0)
    assert not rig.to(10.1, 1.0)
    assert rig.to(10.3, 1.0)
    assert rig.to(60.0, 1.0)
    assert not rig.to(60.3, 1.2)  # it has come nearer after all
    assert not rig.to(70.1, 1.2)
    assert rig.to(70.7, 1.2)


def test_a_step_too_small_is_no_progress() -> None:
    rig = Rig(patience=10.0, step=0.1)
    assert not rig.to(5.01, 1.0)
    assert not rig.to(9.99, 1.09)
    assert rig.to(10.3, 1.09)
    assert not rig.to(10.5, 1.11)


def test_slow_progress_is_progress() -> None:
    rig = Rig(patience=10.0, step=0.1)
    assert not any(rig.to(0.2 * k + 0.01, 0.02 * 0.2 * k) for k in range(1000))


def test_another_waypoint_starts_anew() -> None:
    rig = Rig(patience=10.0)
    assert rig.to(20.0, 1.0)
    rig.goal([9.0, 0.0])  # farther
    assert not rig.to(20.3, 1.0)
    assert not rig.to(30.1, 1.0)
    assert rig.to(30.5, 1.0)


def test_a_detour_gets_the_time_that_it_takes_and_a_circle_does_not() -> None:
    # A wall is found at x = 3: the planner sends the robot back and around, 14 m at 0.2 m/s.
    around = [[3.0, 0.0], [-3.0, 0.0], [-3.0, 1.0], [5.0, 1.0], [5.0, 0.0]]
    detour = Rig(patience=20.0, slowest=0.15)
    detour.path([0.0, 0.0], [5.0, 0.0])
    t, x = 0.0, 0.0
    while x < 3.0:
        t, x = t + 0.2, x + 0.04
        assert not detour.to(t, x)
    detour.path(*around)
    for a, b in pairwise(around):
        n = round(math.dist(a, b) / 0.04)
        for k in range(n):
            t += 0.2
            at = np.array(a) + (np.array(b) - np.array(a)) * k / n
            assert not detour.to(t, *at)
    assert t > 80
    assert not detour.to(t + 19.0, 5.0, 0.0)
    # One that only drives round and round is given the time to come back once.
    circle = Rig(patience=20.0, slowest=0.15)
    stuck = [circle.to(0.2 * k + 0.1, 2 + math.cos(0.1 * k), math.sin(0.1 * k)) for k in range(400)]
    assert stuck[-1]
    assert stuck.index(True) * 0.2 < 20 + 6.3 * 2 + 2 / 0.15 + 1


def test_wavering_between_two_paths_is_found_out() -> None:
    rig = Rig(patience=20.0, slowest=0.1)
    for k in range(60):
        bend = 2.0 if k % 2 else -3.0
        rig.path([0.0, 0.0], [0.0, bend], [5.0, bend], [5.0, 0.0])
        stuck = rig.to(2.0 * k + 0.1, 0.0, 0.3 * (k % 2))
    assert stuck


def test_bad_samples_are_dropped_and_counted_while_the_time_goes_on() -> None:
    rig = Rig(patience=10.0)
    assert not rig.to(1.01, 1.0)
    rig.goal([math.nan, 0.0])
    assert not rig.to(2.01, math.nan)
    rig.goal([5.0, 0.0])
    rig.path([math.nan, 0.0], [1.0, 1.0])
    assert not rig.to(3.01, 1.0)
    assert rig.counts == {"bad_pose": 5, "bad_goal": 5, "bad_path": 5}
    assert not rig.to(9.9, math.nan)
    assert rig.to(10.3, math.nan)


def test_without_a_waypoint_it_waits_for_one() -> None:
    rig = Rig(patience=1.0)
    rig.goal([math.nan, math.nan])
    assert not rig.to(30.0, 1.0)
    rig.goal([5.0, 0.0])
    assert not rig.to(30.9, 1.0)
    assert rig.to(31.5, 1.0)


@pytest.mark.parametrize(
    ("field", "value"), [("step", 0.0), ("patience", -1.0), ("slowest", math.nan)]
)
def test_parameters_out_of_range_are_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{field} is {value}: must be "):
        ProgressParameters(**{field: value})
