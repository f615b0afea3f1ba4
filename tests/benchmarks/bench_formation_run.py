"""The bundled formation: how much faster than real time, recording included.

As in `bench_run`, factors are given too as they would be where the plant alone, which is all
Drake's own, takes as long as where the goals were set.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from diagrams.run import simulate
from diagrams.scenario import load_scenario
from tests.benchmarks.bench_run import REFERENCE, plant_alone
from tests.benchmarks.table import Row, show


class Goal(NamedTuple):
    """What a run is to reach.

    Attributes:
        name: in the table.
        changes: of the scenario.
        real_time_factor: at least.
        seconds: that are simulated: a move takes 50.
    """

    name: str
    changes: dict[str, Any]
    real_time_factor: float
    seconds: float


PROJECTED = {"sight": "projected"}
TWIN = PROJECTED | {"dynamics": "kinematic"}
GOALS = (
    Goal("kinematic twins, projected", TWIN, 40.0, 100.0),
    Goal("... not recorded", TWIN | {"record.bag": False}, 40.0, 100.0),
    Goal("plant, projected", PROJECTED, 8.0, 50.0),
    Goal("plant, rendered", {}, 1.5, 20.0),
)


def rows() -> Iterator[Row]:
    """Yields the measurements."""
    for goal in GOALS:
        factors, around = [], [plant_alone(0.005)]
        for _ in range(2):
            factors.append(_factor(goal))
            around.append(plant_alone(0.005))
        speed, plant = max(factors), max(around)  # what disturbs only slows
        yield Row(
            f"four robots, {goal.name}: real-time factor",
            f"{speed:.1f}",
            f">= {goal.real_time_factor:g}",
            bool(speed >= goal.real_time_factor),
            f"{speed * REFERENCE / plant:.1f} where the plant alone makes {REFERENCE}",
        )


def _factor(goal: Goal) -> float:
    scenario = load_scenario("formation", goal.changes | {"duration": goal.seconds})
    with tempfile.TemporaryDirectory() as folder:
        return float(simulate(scenario, out=Path(folder)).report["real_time_factor"])


if __name__ == "__main__":
    show("Formation", rows())
