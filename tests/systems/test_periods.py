from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from itertools import combinations

import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from systems.periods import aligned, period

RATES = [1, 2, 4, 5, 10, 15, 20, 25, 30, 50, 60, 75, 100, 120, 125, 200, 250, 300, 500, 600, 1000]


@pytest.fixture(autouse=True)
def alignment() -> Iterator[None]:
    with aligned():
        yield


def test_what_falls_together_is_equal() -> None:
    for slow, fast in combinations(RATES, 2):
        if fast % slow:
            continue
        each = fast // slow
        for k in (1, 2, 3, 7, 59, 601, 12_345, 360_001):
            assert k * period(slow) == (each * k) * period(fast)
    # It is not so of what floats make of it.
    assert any(k * (1 / 60) != (5 * k) * (1 / 300) for k in range(100))


@pytest.mark.parametrize("rate", RATES)
def test_it_is_the_period_and_never_early(rate: int) -> None:
    late = Fraction(period(rate)) * rate - 1
    assert 0 <= late < Fraction(1, 10**12)


@pytest.mark.parametrize("rate", [5.5, 7.0, 29.97, 1 / 3e-4, 20_000.0])
def test_other_rates_have_their_own(rate: float) -> None:
    assert period(rate) == 1 / rate


@pytest.mark.parametrize("rate", [0.5, 0.1, 1 / 600])
def test_slow_ones_are_multiples_too(rate: float) -> None:
    assert period(rate) == round(1 / rate) * period(1.0)


def steps(periods: list[float]) -> int:
    builder = DiagramBuilder()
    for p in periods:
        system = LeafSystem()
        system.DeclareDiscreteState(1)
        system.DeclarePeriodicDiscreteUpdateEvent(p, 0.0, lambda *_: None)
        builder.AddSystem(system)
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(10.001)
    return int(simulator.get_num_steps_taken())


def test_the_simulator_makes_one_step_of_them() -> None:
    rates = [300, 60, 50, 20, 10]
    assert steps([period(rate) for rate in rates]) == 3001
    assert steps([1 / rate for rate in rates]) > 3300


def test_elsewhere_a_block_goes_with_drakes_own() -> None:
    with pytest.raises(KeyError), aligned(False):
        raise KeyError  # what goes wrong within leaves nothing behind
    assert period(300.0) != 1 / 300
    with aligned(False):
        for rate in RATES:
            assert period(rate) == 1 / rate
