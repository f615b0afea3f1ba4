from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from plants.motors import DcMotors, MotorModel, MotorParameters

# 6 V behind no bridge: the figures of the sheet themselves.
BARE = MotorParameters(battery_voltage=6.0, bridge_voltage=0.0, bridge_resistance=0.0)
ENABLE, INPUTS = MotorParameters(chopped="enable"), MotorParameters(chopped="inputs")
BOTH = [ENABLE, INPUTS]

# --- The motor's straight lines ---


@pytest.mark.parametrize("chopped", ["enable", "inputs"])
def test_the_curve_goes_through_the_sheets_points(chopped: Any) -> None:
    bare = MotorParameters(
        battery_voltage=6.0, bridge_voltage=0.0, bridge_resistance=0.0, chopped=chopped
    )
    motor = MotorModel(bare)
    for share, current, torque in ((0.0, 1.5, 0.0785), (0.5, 0.825, 0.03925), (1.0, 0.15, 0.0)):
        speed = share * 9.425
        assert motor.current(1.0, speed) == pytest.approx(current)
        assert motor.torque(1.0, speed) - motor.friction == pytest.approx(torque, abs=1e-12)
        assert motor.current(-1.0, -speed) == pytest.approx(-current)
    assert motor.steady_speed(1.0) == pytest.approx(9.425)
    assert motor.max_speed == pytest.approx(9.425)


def test_the_gear_turns_ninety_times_a_minute_and_not_faster_than_the_paper_says() -> None:
    assert BARE.no_load_speed * 60 / (2 * math.pi) == pytest.approx(90, abs=0.01)
    assert MotorParameters().no_load_speed * 0.0325 == pytest.approx(0.306, abs=0.001)


@pytest.mark.parametrize("parameters", BOTH)
@pytest.mark.parametrize(("current", "drop"), [(1.0, 1.35 + 1.2), (2.0, 2.0 + 1.7)])
def test_the_bridge_takes_what_its_sheet_says(
    parameters: MotorParameters, current: float, drop: float
) -> None:
    # Held or turned backward at the speed at which that current flows: U - drop = R I + k_e w.
    motor = MotorModel(parameters)
    speed = (7.4 - drop - 4.0 * current) / motor.back_emf
    assert motor.current(1.0, speed) == pytest.approx(current)


def test_the_dead_band_chopped_at_the_enable_pin() -> None:
    # At rest 6.0 V over 5.15 Ohm for a share D of the time must exceed 0.15 A: D > 0.12875.
    motor = MotorModel(ENABLE)
    np.testing.assert_array_equal(motor.steady_speed(np.arange(-32, 33) / 255), 0.0)
    assert motor.steady_speed(33 / 255) > 0
    assert motor.steady_speed(-33 / 255) < 0
    # Twice as long a pulse, half the back-EMF that is left over: 6 - 0.7725 / D.
    assert motor.steady_speed(0.2575) * motor.back_emf == pytest.approx(3.0)


def test_the_dead_band_chopped_at_the_inputs() -> None:
    # 7.4 D must exceed 1.4 V and 0.15 A times 5.15 Ohm: D > 0.29358.
    motor = MotorModel(INPUTS)
    np.testing.assert_array_equal(motor.steady_speed(np.arange(-74, 75) / 255), 0.0)
    assert motor.steady_speed(75 / 255) > 0
    assert motor.steady_speed(0.5) * motor.back_emf == pytest.approx(3.7 - 1.4 - 0.7725)


@pytest.mark.parametrize("parameters", BOTH)
def test_at_its_steady_speed_the_torque_is_the_friction(parameters: MotorParameters) -> None:
    motor = MotorModel(parameters, [0.9, 1.1])
    for duty in np.array([[0.4, -0.4], [0.7, 0.7], [-1.0, 1.0]]):
        torque = motor.torque(duty, motor.steady_speed(duty))
        np.testing.assert_allclose(torque, np.sign(duty) * motor.friction)


@pytest.mark.parametrize("parameters", BOTH)
def test_the_duty_for_a_speed_is_the_inverse(parameters: MotorParameters) -> None:
    motor = MotorModel(parameters)
    speeds = np.linspace(-0.999, 0.999, 41) * motor.max_speed
    np.testing.assert_allclose(motor.steady_speed(motor.duty(speeds)), speeds, atol=1e-9)
    assert motor.duty(0.0) == 0.0
    np.testing.assert_array_equal(motor.duty([50.0, -50.0]), [1.0, -1.0])


@pytest.mark.parametrize("parameters", BOTH)
def test_a_gain_is_the_ratio_of_speeds_at_any_duty(parameters: MotorParameters) -> None:
    duty = np.linspace(-1, 1, 21)
    for gain in (0.9, 1.05):
        found = MotorModel(parameters, gain).steady_speed(duty)
        np.testing.assert_allclose(found, gain * MotorModel(parameters).steady_speed(duty))


@pytest.mark.parametrize("parameters", BOTH)
def test_torque_falls_with_speed_and_no_steeper_than_the_damping(
    parameters: MotorParameters,
) -> None:
    motor, speeds = MotorModel(parameters), np.linspace(-30, 30, 6001)
    for duty in np.linspace(-1, 1, 9):
        slope = np.diff(motor.torque(duty, speeds)) / np.diff(speeds)
        assert slope.max() <= 1e-9
        assert slope.min() >= -motor.damping * (1 + 1e-6)


def test_a_bridge_that_is_off_does_not_brake_and_a_short_does() -> None:
    # At 8 rad/s the back-EMF is 4.75 V: without pulses, and with pulses too weak for the speed.
    speed = 8.0
    for duty in (0.0, 0.2):
        assert MotorModel(ENABLE).current(duty, speed) >= 0
    emf = 8.0 * 5.4 / 9.425
    assert MotorModel(INPUTS).current(0.0, speed) == pytest.approx(-(emf - 1.4) / 5.15)
    assert MotorModel(INPUTS).current(0.2, speed) == pytest.approx((1.48 - emf + 1.4) / 5.15)
    # Less than the bridge's drop between the two: no current either way.
    assert MotorModel(INPUTS).current(0.6, speed) == 0
    # Reversed, both brake.
    for parameters in BOTH:
        assert MotorModel(parameters).current(-0.5, speed) < -0.5


def circuit(
    parameters: MotorParameters, duty: float, speed: float, frequency: float, inductance: float
) -> float:
    """Mean current of the bridge's circuit stepped through its pulses; duty and speed positive."""
    p = parameters
    emf = (6.0 - 4.0 * 0.15) / 9.425 * speed
    h, t, current, total = 2e-7, 0.0, 0.0, []
    periods = 20
    while t < periods / frequency:
        if (t * frequency) % 1.0 < duty:
            voltage = p.battery_voltage
        elif p.chopped == "enable":  # back into the battery through two diodes of 0.8 V
            voltage = -p.battery_voltage - 1.6 + p.bridge_voltage
        else:
            voltage = 0.0
        rate = voltage - emf - 5.15 * current - p.bridge_voltage * np.sign(current or voltage)
        stepped = current + h / inductance * rate
        # Diodes and transistors let it pass one way: it does not go through zero.
        current = 0.0 if stepped < 0 else stepped
        total.append(current)
        t += h
    return float(np.mean(total[len(total) // 2 :]))


@pytest.mark.parametrize(("duty", "speed"), [(0.3, 0.0), (0.3, 5.0), (0.7, 2.0), (0.9, 8.0)])
def test_the_means_are_those_of_the_circuit(duty: float, speed: float) -> None:
    # Pulses of 490 Hz (the Arduino's) that outlast the winding, and a winding that outlasts pulses.
    expected = circuit(ENABLE, duty, speed, 490.0, 0.1e-3)
    assert MotorModel(ENABLE).current(duty, speed) == pytest.approx(expected, rel=0.05, abs=0.003)


@pytest.mark.parametrize(("duty", "speed"), [(0.5, 0.0), (0.7, 2.0), (0.9, 5.0)])
def test_the_means_of_a_winding_that_outlasts_the_pulses(duty: float, speed: float) -> None:
    expected = circuit(INPUTS, duty, speed, 20e3, 1e-3)
    assert MotorModel(INPUTS).current(duty, speed) == pytest.approx(expected, rel=0.05)


# --- The block ---


def test_the_block_is_two_motors_of_their_own_gains() -> None:
    parameters = MotorParameters(right_gain=0.9, left_gain=1.1)
    motors = DcMotors(parameters=parameters)
    context = motors.CreateDefaultContext()
    pwm, speeds = np.array([204.0, -102.0]), np.array([3.0, -2.0])
    motors.pwm_input_port().FixValue(context, pwm)
    motors.wheel_speeds_input_port().FixValue(context, speeds)
    model = MotorModel(parameters, [0.9, 1.1])
    torque = motors.torque_output_port().Eval(context)
    np.testing.assert_allclose(torque, model.torque([0.8, -0.4], speeds))
    np.testing.assert_allclose(
        motors.current_output_port().Eval(context), torque / model.torque_constant
    )
    steady = motors.steady_speeds_output_port().Eval(context)
    np.testing.assert_allclose(steady, model.steady_speed([0.8, -0.4]))
    servo = motors.servo_speeds_output_port().Eval(context)
    np.testing.assert_allclose(MotorModel(parameters).damping * (servo - speeds), torque)


def test_pulses_are_no_longer_than_their_period() -> None:
    motors = DcMotors()
    context = motors.CreateDefaultContext()
    motors.pwm_input_port().FixValue(context, [900.0, -900.0])
    motors.wheel_speeds_input_port().FixValue(context, [0.0, 0.0])
    np.testing.assert_allclose(motors.current_output_port().Eval(context), [6 / 5.15, -6 / 5.15])


# --- Nonsense ---


@pytest.mark.parametrize("field", [f for f in vars(MotorParameters()) if f != "chopped"])
@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_nonsense_is_refused(field: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{field} is {value}: must be "):
        MotorParameters(**{field: value})


def test_figures_that_contradict_each_other_are_refused() -> None:
    with pytest.raises(ValueError, match=r"stall_current is 0\.1: must be greater than the"):
        MotorParameters(stall_current=0.1)
    with pytest.raises(ValueError, match=r"battery_voltage is 2\.1: must be greater than 2\.17 V"):
        MotorParameters(battery_voltage=2.1)
    with pytest.raises(ValueError, match=r"chopped is 'both': must be 'enable' or 'inputs'"):
        MotorParameters(chopped="both")  # type: ignore[arg-type]
