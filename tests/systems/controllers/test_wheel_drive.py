from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from systems.controllers.wheel_drive import WheelDrive, WheelDriveParameters

R, B = 0.03, 0.2


def to_wheel_speeds(command: np.ndarray) -> list[float]:
    v, omega = command
    return [(v + omega * B / 2) / R, (v - omega * B / 2) / R]


class Rig:
    def __init__(self, max_wheel_speed: float = math.inf, **parameters: Any) -> None:
        self.drive = WheelDrive(
            to_wheel_speeds=to_wheel_speeds,
            parameters=WheelDriveParameters(**parameters),
            max_wheel_speed=max_wheel_speed,
        )
        self.simulator = Simulator(self.drive)
        self.context = self.simulator.get_mutable_context()
        self.command(0.0, 0.0)

    def command(self, v: float, omega: float) -> None:
        self.drive.command_input_port().FixValue(self.context, [v, omega])

    def to(self, t: float) -> np.ndarray:
        """What is sent at time t."""
        self.simulator.AdvanceTo(t)
        return self.drive.sent_output_port().Eval(self.context).copy()

    @property
    def bad(self) -> int:
        counts = self.drive.health_output_port().Eval(self.context).counts
        assert list(counts) == ["bad_command"]
        return counts["bad_command"]


def test_a_small_command_is_passed_on_at_the_next_sample() -> None:
    rig = Rig(rate=50.0, max_acceleration=100.0, max_turn_acceleration=100.0)
    rig.to(0.01)
    rig.command(0.2, -0.5)
    np.testing.assert_array_equal(rig.to(0.019), [0.0, 0.0])
    np.testing.assert_allclose(rig.to(0.021), [0.2, -0.5])
    rig.command(0.1, 0.5)
    np.testing.assert_allclose(rig.to(0.039), [0.2, -0.5])
    np.testing.assert_allclose(rig.to(0.041), [0.1, 0.5])
    np.testing.assert_allclose(
        rig.drive.wheel_speeds_output_port().Eval(rig.context),
        [(0.1 + 0.5 * 0.1) / R, (0.1 - 0.5 * 0.1) / R],
    )


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_speeds_are_limited(sign: float) -> None:
    rig = Rig(max_speed=0.4, max_turn_rate=2.0, max_acceleration=10.0, max_turn_acceleration=100.0)
    rig.command(sign * 9.0, -sign * 9.0)
    np.testing.assert_allclose(rig.to(1.0), [sign * 0.4, -sign * 2.0])


def test_accelerations_are_limited_both_ways() -> None:
    rig = Rig(rate=50.0, max_speed=1.0, max_acceleration=0.5, max_turn_acceleration=4.0)
    rig.command(1.0, -2.0)
    # Samples at 0, 0.02, ...: after t there have been 50 t + 1 of them.
    np.testing.assert_allclose(rig.to(0.399), [0.5 * 0.4, -4.0 * 0.4])
    np.testing.assert_allclose(rig.to(1.999), [1.0, -2.0])
    rig.command(-1.0, 0.0)
    np.testing.assert_allclose(rig.to(2.999), [0.5, 0.0])
    np.testing.assert_allclose(rig.to(3.999), [0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("v", "omega"), [(math.nan, 0.3), (0.3, math.nan), (math.inf, 0.0), (0.0, -math.inf)]
)
def test_a_command_that_is_not_finite_is_dropped_and_the_drive_slows_down(
    v: float, omega: float
) -> None:
    rig = Rig(rate=50.0, max_acceleration=1.0, max_turn_acceleration=10.0)
    rig.command(0.3, 0.5)
    rig.to(0.999)
    assert rig.bad == 0
    rig.command(v, omega)
    np.testing.assert_allclose(rig.to(1.199), [0.1, 0.0])
    assert rig.bad == 10
    np.testing.assert_allclose(rig.to(1.399), [0.0, 0.0], atol=1e-12)
    rig.command(0.3, 0.5)
    np.testing.assert_allclose(rig.to(2.399), [0.3, 0.5])
    assert rig.bad == 20


def test_what_no_wheel_can_do_is_driven_slower_on_the_same_curve() -> None:
    # The right wheel is to turn at (0.3 + 2.0 * 0.1) / 0.03 = 16.7 rad/s: it can do 60 % of it.
    limits = {"max_acceleration": 100.0, "max_turn_acceleration": 1000.0}
    rig = Rig(max_wheel_speed=10.0, **limits)
    rig.command(0.3, 2.0)
    np.testing.assert_allclose(rig.to(0.1), [0.18, 1.2])
    rig.command(-0.3, 2.0)  # here it is the left one
    np.testing.assert_allclose(rig.to(0.2), [-0.18, 1.2])
    rig.command(0.1, 0.5)
    np.testing.assert_allclose(rig.to(0.3), [0.1, 0.5])
    rig.command(0.0, 0.0)
    np.testing.assert_array_equal(rig.to(0.4), [0.0, 0.0])


def test_on_the_way_from_one_command_to_the_next_no_wheel_is_to_turn_too_fast() -> None:
    rig = Rig(max_wheel_speed=10.0, max_acceleration=0.2, max_turn_acceleration=30.0)
    rig.command(0.3, 0.0)
    rig.to(3.0)
    rig.command(0.0, 3.0)
    for k in range(100):
        speeds = np.abs(to_wheel_speeds(rig.to(3.0 + (k + 0.5) * 0.02)))
        assert speeds.max() <= 10.0 + 1e-9
    np.testing.assert_allclose(rig.to(8.0), [0.0, 3.0], atol=1e-9)


def test_a_rest_at_the_start_takes_no_command() -> None:
    rig = Rig(rate=50.0, rest=0.5)
    rig.command(0.3, 0.5)
    np.testing.assert_array_equal(rig.to(0.499), [0.0, 0.0])
    assert rig.to(0.501)[0] > 0
    rig = Rig(rate=50.0, rest=0.5)
    rig.command(math.nan, 0.0)
    rig.to(0.199)
    assert rig.bad == 10  # it is counted all the same


def test_a_rest_or_reach_of_nonsense_is_refused() -> None:
    with pytest.raises(ValueError, match=r"rest is -1\.0: must be 0 or greater"):
        WheelDriveParameters(rest=-1.0)
    with pytest.raises(ValueError, match=r"max_wheel_speed is 0\.0: must be greater than 0"):
        Rig(max_wheel_speed=0.0)


@pytest.mark.parametrize("field", [f for f in vars(WheelDriveParameters()) if f != "rest"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan])
def test_nonsense_is_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{field} is {value}: must be greater than 0"):
        WheelDriveParameters(**{field: value})
