from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from plants.clearance import ClearanceMonitor, touches
from plants.planar_shapes import PlanarShapes


def rectangle(x: float, y: float, length: float, width: float) -> PlanarShapes:
    return PlanarShapes(centres=[[x, y]], headings=[0.0], sizes=[[length, width]], radii=[0.0])


ROBOT = rectangle(0.0, 0.0, 0.4, 0.2)
WALL = rectangle(2.05, 0.0, 0.1, 4.0)  # its face is at x = 2
POST = PlanarShapes(centres=[[0.0, 1.0]], headings=[0.0], sizes=[[0.0, 0.0]], radii=[0.1])


def counted(
    gaps: Sequence[float], tolerance: float = 0.001, release: float = 0.01, hold: float = 0.1
) -> list[int]:
    """Contacts, while a robot stands for a while at each of these distances from the wall."""
    times = hold * np.arange(len(gaps) + 1)
    x = 2.0 - 0.2 - np.array([*gaps, gaps[-1]])
    poses = np.stack([x, 0 * x, 0 * x])
    builder = DiagramBuilder()
    source = builder.AddSystem(TrajectorySource(PiecewisePolynomial.ZeroOrderHold(times, poses)))
    monitor = builder.AddSystem(
        ClearanceMonitor(
            footprint=ROBOT,
            standing=PlanarShapes.joined([WALL, POST]),
            tolerance=tolerance,
            release=release,
        )
    )
    builder.Connect(source.get_output_port(), monitor.pose_input_port())
    simulator = Simulator(builder.Build())
    context = monitor.GetMyContextFromRoot(simulator.get_context())
    found = []
    for k, gap in enumerate(gaps):
        simulator.AdvanceTo((k + 0.9) * hold)
        assert monitor.clearance_output_port().Eval(context)[0] == pytest.approx(gap, abs=1e-12)
        found.append(int(monitor.contacts_output_port().Eval(context)[0]))
    return found


def test_a_touch_counts_again_only_after_it_was_clear() -> None:
    #        far  near   touch  on it  off a little  again  clear  again  through  clear
    gaps = [0.3, 0.002, 0.0009, 0.0, 0.009, 0.0005, 0.011, 0.0, -0.05, 0.011]
    assert counted(gaps) == [0, 0, 1, 1, 1, 1, 1, 2, 2, 2]
    assert counted(gaps, tolerance=0.003, release=0.005) == [0, 1, 1, 1, 1, 2, 2, 3, 3, 3]


def test_a_robot_that_starts_in_an_obstacle_touches_it() -> None:
    assert counted([-0.01, 0.2]) == [1, 1]


def test_each_obstacle_has_touches_of_its_own() -> None:
    now = touches(np.array([0.0, 0.005, 0.005, 0.02]), np.array([0, 0, 1, 1]), 0.001, 0.01)
    assert now.tolist() == [True, False, True, False]


def test_it_looks_at_what_moves_where_it_is_now() -> None:
    monitor = ClearanceMonitor(footprint=ROBOT, standing=WALL, moving_radii=[0.1, 0.2])
    context = monitor.CreateDefaultContext()
    monitor.pose_input_port().FixValue(context, [0.0, 0.0, math.pi / 2])
    port = monitor.moving_input_port()
    for positions, expected in (
        ([0.5, 0.0, -3.0, 0.0], [1.9, 0.3, 2.7]),
        ([0.0, 0.5, -0.2, 0.0], [1.9, 0.2, -0.1]),
    ):
        port.FixValue(context, positions)
        distances = monitor.distances_output_port().Eval(context)
        np.testing.assert_allclose(distances, expected, atol=1e-12)
        assert monitor.clearance_output_port().Eval(context)[0] == min(distances)


def test_in_an_empty_world_nothing_is_near() -> None:
    builder = DiagramBuilder()
    monitor = builder.AddSystem(ClearanceMonitor(footprint=ROBOT, standing=PlanarShapes.joined([])))
    pose = builder.AddSystem(ConstantVectorSource([1.0, 2.0, 3.0]))
    builder.Connect(pose.get_output_port(), monitor.pose_input_port())
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(0.1)
    context = monitor.GetMyContextFromRoot(simulator.get_context())
    assert monitor.clearance_output_port().Eval(context)[0] == math.inf
    assert monitor.contacts_output_port().Eval(context)[0] == 0


def test_nonsense_is_refused() -> None:
    with pytest.raises(ValueError, match=r"footprint is .*: must be of at least one shape"):
        ClearanceMonitor(footprint=PlanarShapes.joined([]), standing=WALL)
    with pytest.raises(ValueError, match=r"tolerance is -1: must be 0 or greater"):
        ClearanceMonitor(footprint=ROBOT, standing=WALL, tolerance=-1)
    with pytest.raises(ValueError, match=r"release is 0\.01: must be at least the tolerance"):
        ClearanceMonitor(footprint=ROBOT, standing=WALL, tolerance=0.02)
    with pytest.raises(ValueError, match="rate is 0: must be greater than 0"):
        ClearanceMonitor(footprint=ROBOT, standing=WALL, rate=0)
