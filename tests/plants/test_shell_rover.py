from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from scipy.integrate import solve_ivp

from plants.shell_rover import ShellRover, body_rate
from systems.shell.angles import rotation

RADIUS = 0.075


def drive(
    command: tuple[float, float], duration: float, rate: float = 300.0, **arguments: object
) -> RigidTransform:
    rover = ShellRover(radius=RADIUS, rate=rate, **arguments)  # type: ignore[arg-type]
    simulator = Simulator(rover)
    context = simulator.get_mutable_context()
    rover.command_input_port().FixValue(context, command)
    simulator.AdvanceTo(duration - 0.5 / rate)  # as many steps as fit in the duration
    return rover.pose_output_port().Eval(context)


def test_forward_from_the_equator_leads_over_the_pole_and_round() -> None:
    v = 0.03
    quarter = RADIUS * np.pi / 2 / v
    for k, degrees in enumerate([(0, 90, 0), (180, 0, 180), (180, -90, 180), (0, 0, 0)], start=1):
        steps = 400 * k
        found = drive((v, 0.0), k * quarter, rate=steps / (k * quarter))
        np.testing.assert_allclose(
            found.rotation().matrix(), rotation(np.radians(degrees)), atol=1e-9
        )


def test_turning_changes_roll_alone() -> None:
    start = (0.3, 0.5, -1.0)
    found = drive((0.0, 0.8), 1.0, rate=100.0, initial_angles=start)
    np.testing.assert_allclose(
        found.rotation().matrix(), rotation(np.add(start, [0.8, 0, 0])), atol=1e-12
    )


def test_it_rolls_without_slip() -> None:
    # The point of contact moves forward with v over the surface and not sideways.
    v, dt = 0.05, 1e-3
    for height in (0.0, 0.01):
        a, b = (
            drive((v, 0.6), t, rate=1 / dt, height=height, initial_angles=(1.0, 0.4, 2.0))
            for t in (0.1, 0.1 + dt)
        )
        contact = [RADIUS * X.rotation().matrix()[:, 2] for X in (a, b)]
        velocity_B = a.rotation().matrix().T @ (contact[1] - contact[0]) / dt
        np.testing.assert_allclose(velocity_B, [v, 0.0, 0.0], atol=1e-4)
        np.testing.assert_allclose(
            b.translation(), (RADIUS + height) * b.rotation().matrix()[:, 2], atol=1e-15
        )


def test_a_constant_command_is_integrated_exactly_at_any_rate() -> None:
    command, start = (0.04, -0.7), (0.3, 0.9, 1.0)
    w = body_rate(np.array(command), RADIUS)
    np.testing.assert_allclose(w, [0.0, 0.04 / 0.075, -0.7])

    def derivative(_: float, R: np.ndarray) -> np.ndarray:
        # Column by column: what turns with w in the body.
        return np.column_stack([R.reshape(3, 3) @ np.cross(w, e) for e in np.eye(3)]).ravel()

    R0 = rotation(np.array(start))
    expected = solve_ivp(derivative, (0.0, 4.0), R0.ravel(), rtol=1e-12, atol=1e-12).y[:, -1]
    for rate in (2.0, 60.0, 300.0):
        found = drive(command, 4.0, rate=rate, initial_angles=start)
        np.testing.assert_allclose(found.rotation().matrix().ravel(), expected, atol=1e-9)


def test_a_curve_is_a_circle_of_the_known_geodesic_curvature() -> None:
    # On a sphere omega / v = cot(rho) / radius, with rho the angle from the circle's centre.
    rho = 0.5
    v = 0.03
    omega = v / (RADIUS * math.tan(rho))
    # Eastward (roll -90) a left turn circles the pole.
    start = (-np.pi / 2, np.pi / 2 - rho, 0.0)
    around = 2 * np.pi * RADIUS * math.sin(rho) / v
    for share in (0.25, 0.5, 1.0):
        found = drive((v, omega), share * around, rate=200 / (share * around), initial_angles=start)
        expected = rotation(np.array([-np.pi / 2, np.pi / 2 - rho, 2 * np.pi * share]))
        np.testing.assert_allclose(found.rotation().matrix(), expected, atol=1e-9)


def test_ports_and_bad_commands() -> None:
    rover = ShellRover(radius=RADIUS, rate=100.0)
    simulator = Simulator(rover)
    context = simulator.get_mutable_context()
    rover.command_input_port().FixValue(context, [0.03, 0.2])
    np.testing.assert_allclose(
        rover.angular_velocity_output_port().Eval(context), [0.0, 0.4, 0.2], atol=1e-15
    )
    simulator.AdvanceTo(0.1)
    before = rover.pose_output_port().Eval(context).GetAsMatrix34()
    rover.command_input_port().FixValue(context, [math.nan, 0.0])
    simulator.AdvanceTo(0.2)
    np.testing.assert_array_equal(rover.angular_velocity_output_port().Eval(context), 0.0)
    after = rover.pose_output_port().Eval(context).GetAsMatrix34()
    np.testing.assert_allclose(after, before, atol=1e-14)
    assert rover.health_output_port().Eval(context).counts == {"bad_command": 10}


def test_the_rotation_stays_one_for_long() -> None:
    R = drive((0.05, 0.31), 60.0, rate=300.0).rotation().matrix()
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-14)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"radius": 0.0}, "radius is 0.0"),
        ({"height": -0.1}, r"height is -0\.1"),
        ({"rate": math.inf}, "rate is inf"),
        ({"initial_angles": (0.0, math.nan, 0.0)}, "initial_angles is .*: must be three finite"),
    ],
)
def test_bad_arguments_are_refused(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ShellRover(**({"radius": RADIUS} | arguments))  # type: ignore[arg-type]
