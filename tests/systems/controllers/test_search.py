from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from systems.controllers.search import SearchParameters, SearchWhenLost

COMMAND = [0.2, -0.3]
STAND = [0.0, 0.0]
TURN = [0.0, 0.6]
GOOD = np.diag([0.01, 0.02, 0.5])
LOST = np.diag([0.01, 0.26, 0.0])  # 0.51 m in y


class Rig:
    def __init__(self, **parameters: float) -> None:
        self.search = SearchWhenLost(parameters=SearchParameters(**parameters), rate=20.0)
        self.simulator = Simulator(self.search)
        self.context = self.simulator.get_mutable_context()
        self.search.command_input_port().FixValue(self.context, COMMAND)

    def estimate(self, covariance: np.ndarray) -> None:
        self.search.covariance_input_port().FixValue(self.context, np.ravel(covariance))

    def to(self, t: float) -> list[float]:
        """What is commanded at time t; the estimate is looked at every 0.05 s."""
        self.simulator.AdvanceTo(t)
        return self.search.command_output_port().Eval(self.context).tolist()

    @property
    def lost(self) -> int:
        return self.search.health_output_port().Eval(self.context).counts["lost"]


def test_while_the_estimate_is_good_the_command_is_passed_on() -> None:
    rig = Rig()
    rig.estimate(GOOD)
    for t in (0.01, 0.5, 1.0):
        assert rig.to(t) == COMMAND
    rig.search.command_input_port().FixValue(rig.context, [0.1, 0.1])
    assert rig.search.command_output_port().Eval(rig.context).tolist() == [0.1, 0.1]
    assert rig.lost == 0


def test_until_the_estimate_has_been_looked_at_it_stands() -> None:
    rig = Rig()
    rig.estimate(GOOD)
    assert rig.search.command_output_port().Eval(rig.context).tolist() == STAND


def test_lost_it_stands_then_turns_and_goes_on_when_found() -> None:
    rig = Rig(patience=0.5)
    rig.estimate(GOOD)
    rig.to(0.99)
    rig.estimate(LOST)
    assert rig.to(0.995) == COMMAND  # not looked at yet
    assert rig.to(1.01) == STAND
    assert rig.to(1.44) == STAND
    assert rig.to(1.56) == TURN
    assert rig.to(5.01) == TURN
    rig.estimate(GOOD)
    assert rig.to(5.04) == TURN
    assert rig.to(5.06) == COMMAND
    assert rig.lost == 81  # at 1.00, 1.05, ..., 5.00
    rig.estimate(LOST)  # patience starts anew
    assert rig.to(5.54) == STAND
    assert rig.to(5.71) == TURN


def test_from_the_start_it_searches() -> None:
    rig = Rig(patience=0.2)
    rig.estimate(1e6 * np.eye(3))
    assert rig.to(0.01) == STAND
    assert rig.to(0.31) == TURN


def test_without_patience_it_turns_at_once() -> None:
    rig = Rig(patience=0.0, turn_rate=1.5)
    rig.estimate(LOST)
    assert rig.to(0.01) == [0.0, 1.5]


@pytest.mark.parametrize(("correlation", "lost"), [(0.0, False), (0.95, True), (-0.95, True)])
def test_what_counts_is_the_worst_axis(correlation: float, lost: bool) -> None:
    # 0.4 m along x and y, but together 0.56 m along a diagonal.
    rig = Rig()
    c = 0.16 * correlation
    rig.estimate([[0.16, c, 0.0], [c, 0.16, 0.0], [0.0, 0.0, 9.0]])
    assert (rig.to(0.01) == COMMAND) != lost


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_covariance_that_is_not_finite_counts_as_lost(value: float) -> None:
    rig = Rig()
    rig.estimate(np.diag([0.01, value, 0.01]))
    assert rig.to(0.01) == STAND
    assert rig.lost == 1


@pytest.mark.parametrize(
    ("field", "value"),
    [("max_position_std", 0.0), ("turn_rate", -1.0), ("patience", -0.1), ("patience", math.nan)],
)
def test_nonsense_is_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{field} is {value}: must be "):
        SearchParameters(**{field: value})
