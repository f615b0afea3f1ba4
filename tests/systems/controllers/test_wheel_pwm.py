from __future__ import annotations

import numpy as np

from plants.motors import MotorModel, MotorParameters
from systems.controllers.wheel_pwm import WheelPwm, pulse_widths


def test_duty_cycles_become_whole_numbers_of_eight_bits_and_a_sign() -> None:
    duty = np.array([0.0, 1.0, -1.0, 0.5, -0.5, 0.1, 0.0019, 0.0021, 3.0, -3.0])
    # 127.5 is rounded to the even number.
    expected = [0, 255, -255, 128, -128, 26, 0, 1, 255, -255]
    np.testing.assert_array_equal(pulse_widths(duty), expected)


def test_the_block_asks_the_model() -> None:
    motor = MotorModel(MotorParameters())
    pwm = WheelPwm(to_duty=motor.duty)
    context = pwm.CreateDefaultContext()
    for speeds in ([0.0, 0.0], [3.0, -5.0], [0.01, 40.0]):
        pwm.wheel_speeds_input_port().FixValue(context, speeds)
        found = pwm.pwm_output_port().Eval(context)
        np.testing.assert_array_equal(found, np.rint(255 * motor.duty(speeds)))


def test_a_step_of_the_pulse_is_what_the_speed_is_off_by() -> None:
    # The speed of the rounded pulse is within half a step of the curve about it.
    for chopped in ("enable", "inputs"):
        motor = MotorModel(MotorParameters(chopped=chopped))
        for speed in np.linspace(0.2, 9.0, 50):
            width = float(pulse_widths(motor.duty(speed)))
            least, most = motor.steady_speed(np.array([width - 0.501, width + 0.501]) / 255)
            assert least <= speed <= most
