from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput

from plants.circuit import circuit
from plants.differential_drive import KinematicDifferentialDrive, wheel_speeds
from plants.limo import LimoParameters
from systems.controllers.scripted_driver import (
    ScriptedDriver,
    ScriptedDriverParameters,
    steer_toward,
)
from systems.controllers.wheel_drive import WheelDrive
from systems.planners.closed_curve import ClosedCurve

Array = NDArray[np.float64]
ANGLES = np.linspace(0, 2 * math.pi, 12, endpoint=False)
OVAL = np.stack([2.4 * np.cos(ANGLES), 1.6 * np.sin(ANGLES)], axis=1)


def drive(
    route: Array, p: ScriptedDriverParameters, start: Array | None = None, t: float = 80.0
) -> tuple[Array, Array, Array]:
    """Drives a twin of the LIMO; returns times, poses (n, 3) and `finished` (n,)."""
    builder = DiagramBuilder()
    driver = builder.AddSystem(ScriptedDriver(route=route, parameters=p))
    limo = LimoParameters()
    wheels = builder.AddSystem(WheelDrive(to_wheel_speeds=lambda c: wheel_speeds(c, limo)))
    twin = builder.AddSystem(KinematicDifferentialDrive(parameters=limo))
    builder.Connect(driver.command_output_port(), wheels.command_input_port())
    builder.Connect(wheels.wheel_speeds_output_port(), twin.wheel_speeds_input_port())
    builder.Connect(twin.pose_output_port(), driver.pose_input_port())
    logs = [
        LogVectorOutput(port, builder, 0.1)
        for port in (twin.pose_output_port(), driver.finished_output_port())
    ]
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    if start is None:
        position, heading = ClosedCurve(route).at(0.0)
        start = np.array([*position, heading])
    context.SetContinuousState(start)
    simulator.AdvanceTo(t)
    pose, finished = (log.FindLog(context) for log in logs)
    return pose.sample_times(), pose.data().T, finished.data()[0]


def test_an_arc_by_hand() -> None:
    # From the origin along x: through (1, 1) leads a quarter of a circle of radius 1.
    assert steer_toward([0, 0, 0], [1, 1]) == pytest.approx(1.0)
    assert steer_toward([0, 0, 0], [1, -1]) == pytest.approx(-1.0)
    assert steer_toward([0, 0, 0], [2, 0]) == 0.0
    assert steer_toward([1, 1, math.pi / 2], [1, 5]) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    "route", [OVAL, OVAL[::-1], circuit(1).points], ids=["left", "right", "drawn"]
)
def test_it_goes_round_once_near_the_route(route: Array) -> None:
    p = ScriptedDriverParameters(speed=0.4, sway=0.0)
    curve = ClosedCurve(route)
    t, poses, finished = drive(route, p)
    assert curve.distances(poses[:, :2]).max() < 0.03
    end = t[np.argmax(finished > 0)]
    assert end == pytest.approx((curve.length + p.overrun) / p.speed, rel=0.03)
    # It stops a little past the start, and stays there.
    last = poses[-1]
    assert np.hypot(*(last[:2] - curve.at(p.overrun)[0])) < 0.15
    np.testing.assert_allclose(poses[t > end + 2.0][:, :2], [last[:2]] * int((t > end + 2.0).sum()))
    # At nearly constant speed in between.
    steps = np.hypot(*np.diff(poses[(t > 2) & (t < end)][:, :2], axis=0).T) / 0.1
    np.testing.assert_allclose(steps, 0.4, rtol=0.02)


def test_it_sways_as_much_as_it_is_told() -> None:
    curve = ClosedCurve(OVAL)
    far = {}
    for sway in (0.0, 0.03, 0.06):
        _, poses, _ = drive(OVAL, ScriptedDriverParameters(sway=sway, seed=2), t=40.0)
        far[sway] = float(np.sqrt((curve.distances(poses[:, :2]) ** 2).mean()))
    assert far[0.0] < 0.01
    assert 0.015 < far[0.03] < 0.04
    assert far[0.06] > 1.5 * far[0.03]
    driver = ScriptedDriver(route=OVAL, parameters=ScriptedDriverParameters(sway=0.05))
    ways = np.linspace(0, curve.length, 2000)
    swings = np.array([driver.sway(way) for way in ways])
    assert np.sqrt((swings**2).mean()) == pytest.approx(0.05, rel=0.25)
    assert driver.sway(0.0) == pytest.approx(driver.sway(curve.length))  # it meets itself


def test_a_seed_is_a_drive() -> None:
    drives = [drive(OVAL, ScriptedDriverParameters(seed=seed), t=15.0)[1] for seed in (1, 1, 2)]
    np.testing.assert_array_equal(drives[0], drives[1])
    assert np.abs(drives[0] - drives[2]).max() > 0.005


def test_who_starts_behind_the_start_goes_round_all_the_same() -> None:
    curve = ClosedCurve(OVAL)
    position, heading = curve.at(-0.1)
    t, _, finished = drive(
        OVAL, ScriptedDriverParameters(speed=0.4), np.array([*position, heading])
    )
    assert t[np.argmax(finished > 0)] > curve.length / 0.4


def test_a_route_that_comes_near_itself_is_not_cut_short() -> None:
    # A kidney whose two long sides are 0.5 m apart: no wider than the driver looks ahead and back.
    route = [
        [0, 0],
        [1.5, -0.2],
        [3, 0],
        [3.4, 0.6],
        [2.9, 1.0],
        [1.5, 0.35],
        [0.1, 1.0],
        [-0.4, 0.6],
    ]
    points = np.array(route, float)
    curve = ClosedCurve(points)
    t, poses, finished = drive(points, ScriptedDriverParameters(speed=0.3, sway=0.0, lookahead=0.2))
    assert t[np.argmax(finished > 0)] == pytest.approx(curve.length / 0.3, rel=0.1)
    assert curve.distances(poses[:, :2]).max() < 0.06


def test_bad_poses_are_dropped_and_counted() -> None:
    driver = ScriptedDriver(route=OVAL)
    simulator = Simulator(driver)
    context = simulator.get_mutable_context()
    driver.pose_input_port().FixValue(context, [2.4, 0.0, math.pi / 2])
    simulator.AdvanceTo(0.11)
    command = driver.command_output_port().Eval(context).copy()
    driver.pose_input_port().FixValue(context, [math.nan, 0.0, 0.0])
    simulator.AdvanceTo(0.21)
    np.testing.assert_array_equal(driver.command_output_port().Eval(context), command)
    assert command[0] == 0.3
    assert driver.health_output_port().Eval(context).counts == {"bad_pose": 2}


@pytest.mark.parametrize("field", ["speed", "rate", "lookahead", "sway_length"])
def test_nonsense_is_refused(field: str) -> None:
    for value in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match=f"{field} is {value}: must be greater than 0"):
            ScriptedDriverParameters(**{field: value})
    with pytest.raises(ValueError, match="sway is -1"):
        ScriptedDriverParameters(sway=-1)
    with pytest.raises(ValueError, match="points is"):
        ScriptedDriver(route=[[0, 0], [1, 1]])
