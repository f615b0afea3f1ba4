from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial.transform import Rotation

from plants.shell_rover import ShellRover
from systems.controllers.shell_route import (
    Leg,
    OnLeg,
    ShellRoute,
    ShellRouteParameters,
    follow,
    on_leg,
    routine,
)
from systems.shell.angles import angle_differences, angles_of, rotation, rotation_error

RADIUS = 0.075
DEG = math.radians(1.0)
P = ShellRouteParameters()


# --- Where a robot is with regard to a leg ---


def test_along_left_and_heading_by_construction() -> None:
    rng = np.random.default_rng(0)
    for _ in range(100):
        R_RL = rotation(rng.uniform(-1.5, 1.5, 3))
        along, left, heading = rng.uniform([-3, -1.4, -3], [3, 1.4, 3])
        # Along the circle, then sideways, then turned away from it.
        R_LB = (
            Rotation.from_euler("y", along)
            * Rotation.from_euler("x", -left)
            * Rotation.from_euler("z", -heading)
        )
        found = on_leg(R_RL @ R_LB.as_matrix(), R_RL)
        np.testing.assert_allclose(found, [along, left, heading], atol=1e-12)


def test_on_the_equator_the_signs_are_those_of_the_map() -> None:
    # Westward along the equator from yaw 180: left is south.
    leg = Leg(90 * DEG, 0.0, np.pi, np.pi).frame()
    where = on_leg(rotation(np.radians([80.0, -3.0, 150.0])), leg)
    assert where.along == pytest.approx(30 * DEG)
    assert where.left == pytest.approx(3 * DEG)
    # Roll 80 is 10 degrees short of 90, to which one turns left.
    assert where.heading == pytest.approx(10 * DEG, abs=0.1 * DEG)


def test_off_by_a_right_angle_there_is_no_direction_and_no_failure() -> None:
    assert on_leg(rotation(np.array([0.3, np.pi / 2, 0.0])), Leg(np.pi / 2, 0, 0, 1).frame()) == (
        pytest.approx(OnLeg(0.0, -np.pi / 2, 0.0), abs=4.0)
    )
    command = follow(OnLeg(0.0, np.pi / 2, 0.0), 1.0, RADIUS, P)
    assert np.isfinite(command).all()


# --- The law ---


def test_on_the_circle_it_drives_straight_on_at_full_speed() -> None:
    assert follow(OnLeg(0.0, 0.0, 0.0), 1.0, RADIUS, P) == [P.speed, 0.0]


def test_left_of_the_circle_it_turns_right_and_the_other_way_round() -> None:
    for left in (0.5 * DEG, -0.5 * DEG):
        v, omega = follow(OnLeg(0.0, left, 0.0), 1.0, RADIUS, P)
        assert omega == pytest.approx(
            -P.k_heading * math.atan(RADIUS * math.tan(left) / P.lookahead)
        )
        assert 0 < v < P.speed


def test_limits() -> None:
    assert follow(OnLeg(0.0, 0.0, 2.0), 1.0, RADIUS, P) == [0.0, P.max_turn_rate]
    assert follow(OnLeg(0.0, 0.0, -2.0), 1.0, RADIUS, P) == [0.0, -P.max_turn_rate]
    assert follow(OnLeg(0.0, 0.0, 0.0), 0.05, RADIUS, P)[0] == pytest.approx(
        P.k_speed * 0.05 * RADIUS
    )
    assert follow(OnLeg(0.0, 0.0, 0.0), 1e-6, RADIUS, P)[0] == P.min_speed


# --- Driving ---


@dataclass
class Drive:
    """What a rover did: at 60 Hz the times, `R_RB`, legs and commands."""

    times: np.ndarray
    R: np.ndarray
    legs: np.ndarray
    commands: np.ndarray

    def at_end_of(self, leg: int) -> np.ndarray:
        return self.R[np.flatnonzero(self.legs == leg)[-1]]


def drive(
    legs: Sequence[Leg],
    duration: float,
    *,
    start: Sequence[float] = (0.0, 0.0, 0.0),
    parameters: ShellRouteParameters | None = None,
) -> Drive:
    builder = DiagramBuilder()
    route = builder.AddSystem(ShellRoute(legs=legs, radius=RADIUS, parameters=parameters))
    rover = builder.AddSystem(ShellRover(radius=RADIUS, initial_angles=tuple(start)))
    builder.Connect(rover.pose_output_port(), route.pose_input_port())
    builder.Connect(route.command_output_port(), rover.command_input_port())
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    of_route = route.GetMyContextFromRoot(context)
    of_rover = rover.GetMyContextFromRoot(context)
    log = []
    for t in np.arange(0.0, duration, 1 / 60):
        simulator.AdvanceTo(t)
        log.append(
            (
                t,
                rover.pose_output_port().Eval(of_rover).rotation().matrix(),
                route.progress_output_port().Eval(of_route)[0],
                route.command_output_port().Eval(of_route).copy(),
            )
        )
        if log[-1][2] == len(legs):
            break
    return Drive(*(np.array(column) for column in zip(*log, strict=True)))


def test_the_papers_routine_is_driven_and_repeats() -> None:
    legs = routine(2)
    assert len(legs) == 5
    done = drive(legs, 80.0)
    assert done.legs[-1] == len(legs)
    end = rotation_error(done.R[-1], rotation(np.zeros(3)))
    assert np.linalg.norm(end) < 0.8 * DEG
    ends = [(180, 0, 180), (90, 0, 0), (180, 0, 180), (90, 0, 0)]
    for k, degrees in enumerate(ends):
        off = angle_differences(done.at_end_of(k), rotation(np.radians(degrees)))
        assert np.abs(off).max() < 0.5 * DEG
    first = done.legs == 0
    # Over the pole, all the way on the meridians of yaw 0 and 180.
    assert np.abs(done.R[first][:, 1, 2]).max() < 0.001
    assert done.R[first][:, 2, 2].max() > 1 - 1e-5
    second = done.legs == 1
    assert np.abs(done.R[second][:, 2, 2]).max() < 0.02  # on the equator, past yaw 90
    assert done.R[second][:, 1, 2].max() > 1 - 1e-5
    # 180 degrees of 75 mm at 30 mm/s, a leg; what else there is are turns and slowing down.
    least = 4 * np.pi * RADIUS / P.speed
    assert least < done.times[-1] < least + 5 * np.pi / 2 / P.max_turn_rate + 10.0


def test_at_the_end_it_stands() -> None:
    done = drive([Leg(0.0, 0.0, 0.0, 0.2), Leg(0.5, 0.2, 0.0, 0.0)], 20.0)
    np.testing.assert_array_equal(done.commands[-1], 0.0)
    found = angles_of(done.R[-1])
    np.testing.assert_allclose(found, [0.5, 0.2, 0.0], atol=P.heading_tolerance * 1.01)
    assert 0.2 - found[1] <= P.position_tolerance / RADIUS


@pytest.mark.parametrize("pole", [False, True])
def test_from_beside_the_circle_it_comes_onto_it(pole: bool) -> None:
    # 3 mm off and looking 40 degrees away: on the equator, and on a circle over the pole.
    leg = Leg(0.0, 0.0, 0.0, 3.0) if pole else Leg(-90 * DEG, 0.0, 0.0, 3.0)
    frame = leg.frame()
    off = Rotation.from_euler("x", -0.04) * Rotation.from_euler("z", 40 * DEG)
    done = drive([leg], 20.0, start=angles_of(frame @ off.as_matrix()))
    places = [on_leg(R, frame) for R in done.R]
    left = np.array([place.left for place in places])
    along = np.array([place.along for place in places]) * RADIUS
    assert left[0] == pytest.approx(0.04)
    # Critically damped: it does not shoot over; after x lookaheads (1 + 2 x) e^(-2 x) is left.
    assert left.min() > -0.001 * 0.04
    assert abs(left[along > 2.5 * P.lookahead]).max() < 0.1 * 0.04
    assert abs(left[-1]) < 0.01 * 0.04
    assert done.legs[-1] == 1


def test_turning_the_wrong_way_would_not_do() -> None:
    # The wrong answer: a law of the opposite sign leaves the circle.
    leg = Leg(-90 * DEG, 0.0, 0.0, 3.0)
    frame = leg.frame()
    R = frame @ Rotation.from_euler("x", -0.01).as_matrix()
    for sign, low, high in ((1, 0.0, 0.001), (-1, 0.015, np.inf)):
        moving = R
        for _ in range(300):
            v, omega = follow(on_leg(moving, frame), 1.0, RADIUS, P)
            step = np.array([0.0, v / RADIUS, sign * omega]) / 60
            moving = moving @ Rotation.from_rotvec(step).as_matrix()
        assert low <= abs(on_leg(moving, frame).left) < high


def test_a_leg_of_more_than_half_a_turn_is_driven_whole() -> None:
    arc = 1.75 * np.pi
    fast = ShellRouteParameters(speed=0.06)
    done = drive([Leg(-90 * DEG, 0.0, 0.0, arc)], 20.0, parameters=fast)
    assert done.legs[-1] == 1
    assert done.times[-1] > arc * RADIUS / 0.06
    assert math.remainder(angles_of(done.R[-1])[2] - arc, 2 * np.pi) == pytest.approx(0, abs=0.01)


def test_shot_past_the_end_of_half_a_circle_the_leg_is_done_all_the_same() -> None:
    route = ShellRoute(legs=[Leg(0.0, 0.0, 0.0, np.pi)], radius=RADIUS)
    simulator = Simulator(route)
    context = simulator.get_mutable_context()
    # `along` goes from 170 degrees to -170: 190 of way, not a step back to the start.
    for k, degrees in enumerate((60.0, 120.0, 170.0, 190.0)):
        X = RigidTransform(
            RotationMatrix(Leg(0, 0, 0, 0).frame()) @ RotationMatrix.MakeYRotation(degrees * DEG)
        )
        route.pose_input_port().FixValue(context, X)
        simulator.AdvanceTo((k + 0.5) / 60)
        leg, along = route.progress_output_port().Eval(context)
        assert (leg, along) == (
            (0.0, pytest.approx(degrees * DEG)) if degrees < 180 else (1.0, 0.0)
        )


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: ShellRoute(legs=[], radius=RADIUS), r"legs is \[\]"),
        (lambda: ShellRoute(legs=routine(1), radius=-1.0), "radius is -1.0"),
        (lambda: ShellRoute(legs=routine(1), radius=RADIUS, rate=0.0), "rate is 0.0"),
        (lambda: routine(0), "iterations is 0"),
        (lambda: Leg(0.0, math.nan, 0.0, 1.0), "pitch is nan"),
        (lambda: Leg(0.0, 0.0, 0.0, -1.0), "arc is -1.0"),
        (lambda: ShellRouteParameters(lookahead=0.0), "lookahead is 0.0"),
        (lambda: ShellRouteParameters(min_speed=0.1), "min_speed is 0.1: must be at most"),
    ],
)
def test_bad_arguments_are_refused(build: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build()  # type: ignore[operator]
