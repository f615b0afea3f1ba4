from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, Integrator

from systems.sensors.wheel_encoders import WheelEncoderParameters, WheelEncoders, ticks


def test_it_counts_whole_ticks_both_ways() -> None:
    tick = 2 * math.pi / 80
    angles = np.array([0.0, 0.99, 1.01, 80.01, -0.01, -1.01, 1e6 + 0.5]) * tick
    np.testing.assert_array_equal(ticks(angles, 80), [0, 0, 1, 80, -1, -2, 1e6])


def test_it_counts_what_the_wheels_turn() -> None:
    builder = DiagramBuilder()
    speeds = builder.AddSystem(ConstantVectorSource([7.0, -3.0]))
    angles = builder.AddSystem(Integrator(2))
    parameters = WheelEncoderParameters(ticks_per_turn=100)
    encoders = builder.AddSystem(WheelEncoders(parameters=parameters, rate=20.0))
    builder.Connect(speeds.get_output_port(), angles.get_input_port())
    builder.Connect(angles.get_output_port(), encoders.wheel_angles_input_port())
    simulator = Simulator(builder.Build())
    context = encoders.GetMyContextFromRoot(simulator.get_context())
    np.testing.assert_array_equal(encoders.ticks_output_port().Eval(context), [0, 0])
    for t in (0.32, 0.34, 1.01):
        simulator.AdvanceTo(t)
        read = math.floor(t * 20) / 20  # the last reading: held since
        expected = np.floor(100 * read * np.array([7.0, -3.0]) / (2 * math.pi))
        np.testing.assert_array_equal(encoders.ticks_output_port().Eval(context), expected)


def test_nonsense_is_refused() -> None:
    with pytest.raises(ValueError, match=r"ticks_per_turn is 0: must be greater than 0"):
        WheelEncoderParameters(ticks_per_turn=0)
    with pytest.raises(ValueError, match=r"rate is -1\.0: must be greater than 0"):
        WheelEncoders(rate=-1.0)
