from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.systems.analysis import Simulator

from systems.io.meshcat_driver import (
    DONE,
    SPEED,
    STOP,
    STRAIGHT,
    TURN,
    MeshcatDriver,
    MeshcatDriverParameters,
    stick_command,
)

P = MeshcatDriverParameters(max_speed=0.6, max_turn_rate=1.5, dead_zone=0.1)


def test_the_stick_by_hand() -> None:
    # Forward is up, which is negative; to the left turns to the left.
    np.testing.assert_allclose(stick_command([0.0, -1.0], P), [0.6, 0.0])  # type: ignore[arg-type]
    np.testing.assert_allclose(stick_command([-1.0, 0.0], P), [0.0, 1.5])  # type: ignore[arg-type]
    np.testing.assert_allclose(stick_command([1.0, 1.0], P), [-0.6, -1.5])  # type: ignore[arg-type]
    # Half way between the dead zone and the end.
    np.testing.assert_allclose(stick_command([0.55, -0.55], P), [0.3, -0.75])  # type: ignore[arg-type]
    # Beyond the end there is nothing more.
    np.testing.assert_allclose(stick_command([0.0, -1.3], P), [0.6, 0.0])  # type: ignore[arg-type]
    assert stick_command([0.05, -0.09], P) is None
    assert stick_command([], P) is None
    assert stick_command([0.5], P) is None


@pytest.fixture
def meshcat() -> Meshcat:
    return Meshcat(MeshcatParams(host="localhost"))


def test_the_sliders_are_sampled(meshcat: Meshcat) -> None:
    driver = MeshcatDriver(meshcat=meshcat, parameters=P)
    simulator = Simulator(driver)
    context = simulator.get_context()
    simulator.AdvanceTo(0.1)
    command = driver.command_output_port()
    np.testing.assert_array_equal(command.Eval(context), [0.0, 0.0])
    meshcat.SetSliderValue(SPEED, 0.3)
    meshcat.SetSliderValue(TURN, -0.5)
    # The outside world shows at the next sample, not before.
    np.testing.assert_array_equal(command.Eval(context), [0.0, 0.0])
    simulator.AdvanceTo(0.16)
    np.testing.assert_allclose(command.Eval(context), [0.3, -0.5])
    np.testing.assert_array_equal(driver.finished_output_port().Eval(context), [0.0])
    meshcat.SetSliderValue(SPEED, 9.0)
    simulator.AdvanceTo(0.21)
    assert command.Eval(context)[0] == pytest.approx(0.6)  # the slider's end


def test_another_driver_takes_over_the_controls(meshcat: Meshcat) -> None:
    for _ in range(2):
        MeshcatDriver(meshcat=meshcat)
    assert set(meshcat.GetSliderNames()) >= {SPEED, TURN}
    assert {STRAIGHT, STOP, DONE} <= set(meshcat.GetButtonNames())
    assert meshcat.GetSliderValue(SPEED) == 0.0


@pytest.mark.parametrize("field", ["rate", "max_speed", "max_turn_rate", "speed_step", "turn_step"])
def test_nonsense_is_refused(field: str) -> None:
    for value in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match=f"{field} is {value}: must be greater than 0"):
            MeshcatDriverParameters(**{field: value})
    for value in (-0.1, 1.0):
        with pytest.raises(ValueError, match="dead_zone is"):
            MeshcatDriverParameters(dead_zone=value)
