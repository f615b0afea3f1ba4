"""Wheel speeds from ticks: known motions, the error of a tick, resets and bad counts."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.systems.analysis import Simulator

from systems.estimators.wheel_speeds import WheelSpeeds
from systems.sensors.wheel_encoders import ticks

Array = NDArray[np.float64]
TURN = 80.0


def listen(
    angles: Callable[[float], Array], duration: float, bad: dict[int, Array] | None = None
) -> tuple[list[Array], dict[str, int]]:
    """The speeds told after each of the readings at 50 Hz, and the counts."""
    block = WheelSpeeds(ticks_per_turn=TURN)
    simulator = Simulator(block)
    context = simulator.get_mutable_context()
    told = []
    for k in range(round(50 * duration)):
        value = ticks(angles(k / 50), TURN) if k not in (bad or {}) else (bad or {})[k]
        block.ticks_input_port().FixValue(context, value)
        simulator.AdvanceTo((k + 0.5) / 50)
        told.append(block.wheel_speeds_output_port().Eval(context).copy())
    return told, dict(block.health_output_port().Eval(context).counts)


def test_steady_wheels_are_told_within_a_tick() -> None:
    told, _ = listen(lambda t: np.array([7.7 * t, -3.0 * t]), 1.0)
    one_tick = 2 * math.pi / (TURN * 0.1)
    settled = np.array(told[6:])
    assert np.abs(settled - [7.7, -3.0]).max() <= one_tick
    np.testing.assert_allclose(settled.mean(axis=0), [7.7, -3.0], atol=0.1)


def test_what_is_summed_up_is_the_way_to_a_tick() -> None:
    """The errors of ticks do not add up: a filter that integrates the speeds keeps the way."""
    told, _ = listen(lambda t: np.array([5 * math.sin(t), 2 * t * t]), 3.0)
    way = np.array(told).sum(axis=0) / 50
    end = np.array([5 * math.sin(3.0), 18.0])
    # A window is half its length behind: that much of the way at the last speed is missing.
    behind = 0.06 * np.array([5 * math.cos(3.0), 12.0])
    np.testing.assert_allclose(way, end - behind, atol=2 * math.pi / TURN)


def test_the_speed_is_zero_before_the_second_reading() -> None:
    told, _ = listen(lambda t: np.array([50.0 + t, 50.0]), 0.02)
    np.testing.assert_array_equal(told[0], [0, 0])


def test_a_counter_that_was_reset_is_no_motion() -> None:
    told, counts = listen(lambda t: np.array([6 * t, 6 * t]) - (60.0 if t > 0.49 else 0.0), 1.0)
    assert counts["leap"] == 1
    assert np.abs(np.array(told[6:]) - 6).max() < 2.1


def test_bad_counts_are_dropped_and_the_wheels_taken_to_go_on() -> None:
    nothing = np.array([math.nan, 0.0])
    bad = dict.fromkeys(range(20, 24), nothing)
    told, counts = listen(lambda t: np.array([10 * t, 10 * t]), 1.0, bad)
    assert counts["bad_ticks"] == 4
    assert np.abs(np.array(told[6:]) - 10).max() < 1.7


@pytest.mark.parametrize("window", [0.0, 0.005])
def test_a_window_without_a_reading_is_refused(window: float) -> None:
    with pytest.raises(ValueError, match=r"window is .*: must be at least 0.02"):
        WheelSpeeds(ticks_per_turn=TURN, window=window)
