from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from systems.planners.waypoint_sequencer import WaypointSequencer

WAYPOINTS = np.array([[1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


class Rig:
    def __init__(self, **arguments: Any) -> None:
        self.sequencer = WaypointSequencer(**({"waypoints": WAYPOINTS, "rate": 20.0} | arguments))
        self.simulator = Simulator(self.sequencer)
        self.context = self.simulator.get_mutable_context()

    def at(self, x: float, y: float, theta: float = 0.0, looks: int = 1) -> tuple[list[float], int]:
        """Stands there for some looks; returns goal and number of waypoints reached."""
        self.sequencer.pose_input_port().FixValue(self.context, [x, y, theta])
        k = round(self.context.get_time() * 20 - 0.5) if self.context.get_time() else -1
        self.simulator.AdvanceTo((k + looks + 0.5) / 20)
        goal = self.sequencer.goal_output_port().Eval(self.context)
        reached = self.sequencer.waypoints_reached_output_port().Eval(self.context)
        return goal.tolist(), int(reached[0])


def test_waypoints_come_one_after_the_other() -> None:
    rig = Rig()
    assert rig.at(0.0, 0.0) == ([1.0, 0.0], 0)
    assert rig.at(0.69, 0.0, looks=5) == ([1.0, 0.0], 0)
    assert rig.at(0.71, 0.0) == ([1.0, 1.0], 1)  # inside 0.30 m
    assert rig.at(0.0, 1.0, looks=5) == ([1.0, 1.0], 1)  # the last one does not count yet
    assert rig.at(1.2, 1.2) == ([0.0, 1.0], 2)
    assert rig.at(0.1, 0.9) == ([0.0, 1.0], 3)  # the last one for good
    assert rig.at(5.0, 5.0, looks=5) == ([0.0, 1.0], 3)


def test_before_the_first_look_the_first_waypoint_is_the_goal() -> None:
    rig = Rig()
    assert rig.sequencer.goal_output_port().Eval(rig.context).tolist() == [1.0, 0.0]


def test_waypoints_within_one_radius_take_a_look_each() -> None:
    rig = Rig(radius=5.0)
    assert [rig.at(0.0, 0.0)[1] for _ in range(4)] == [1, 2, 3, 3]


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_pose_that_is_not_finite_does_not_arrive(bad: float) -> None:
    rig = Rig(radius=1e9)
    assert rig.at(bad, 0.0, looks=3) == ([1.0, 0.0], 0)
    assert rig.at(0.0, bad, looks=3) == ([1.0, 0.0], 0)
    assert rig.at(0.0, 0.0, theta=math.nan) == ([1.0, 1.0], 1)  # the heading plays no part


def test_one_waypoint_may_be_given_as_it_is() -> None:
    assert Rig(waypoints=[2.0, 3.0]).at(0.0, 0.0) == ([2.0, 3.0], 0)


@pytest.mark.parametrize(
    "waypoints", [[], [[]], [[1.0, 2.0, 3.0]], [[1.0, math.nan]], np.zeros((2, 2, 2))]
)
def test_waypoints_that_are_none_are_refused(waypoints: Any) -> None:
    with pytest.raises(
        ValueError, match=r"waypoints is .*: must be a list of at least one \[x, y\]"
    ):
        WaypointSequencer(waypoints=waypoints)


@pytest.mark.parametrize("field", ["radius", "rate"])
def test_nonsense_is_refused(field: str) -> None:
    with pytest.raises(ValueError, match=rf"{field} is 0\.0: must be greater than 0"):
        WaypointSequencer(waypoints=WAYPOINTS, **{field: 0.0})
