"""The bundled run: how exact it is, and how much faster than real time.

Machines differ, and one differs from hour to hour: the plant alone, which is all Drake's own, is
timed in the same run, to compare with.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from diagrams.run import simulate
from diagrams.scenario import load_scenario
from plants.arena import add_arena
from plants.differential_drive import DifferentialDriveParameters, add_differential_drive
from tests.benchmarks.table import Row, show


def rows() -> Iterator[Row]:
    """Yields the measurements, recording included."""
    for sight, factor in (("rendered", 2.0), ("projected", 15.0)):
        with tempfile.TemporaryDirectory() as folder:
            scenario = load_scenario("navigation_open", {"sight": sight})
            reports = [simulate(scenario, out=Path(folder)).report for _ in range(2)]
        metrics = reports[0]["metrics"]
        speed = max(report["real_time_factor"] for report in reports)  # what disturbs only slows
        what = f"bundled run, {sight}"
        waypoints = f"{metrics['waypoints_reached']} of {metrics['waypoints_total']}"
        done = metrics["waypoints_reached"] == metrics["waypoints_total"]
        yield Row(f"{what}: waypoints", waypoints, "all", done)
        position, heading = metrics["position_rmse_m"], metrics["heading_rmse_deg"]
        yield Row(f"{what}: position RMSE", f"{100 * position:.2f} cm", "<= 5 cm", position <= 0.05)
        yield Row(f"{what}: heading RMSE", f"{heading:.2f} deg", "<= 2 deg", heading <= 2)
        yield Row(
            f"{what}: real-time factor", f"{speed:.1f}", f">= {factor:g}", bool(speed >= factor)
        )
    yield Row("the same plant alone, 10 ms steps: real-time factor", f"{plant_alone():.0f}")


def plant_alone(seconds: float = 10.0) -> float:
    """Returns how much faster than real time the plant is without the other blocks."""
    scenario = load_scenario("navigation_open")
    config = MultibodyPlantConfig(
        time_step=scenario.time_step, discrete_contact_approximation="lagged",
        use_sampled_output_ports=False,
    )  # fmt: skip
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(config, builder)
    add_arena(plant, scenario.world.arena, scenario.world.marker_map())
    model = add_differential_drive(plant, DifferentialDriveParameters(), "robot")
    plant.Finalize()
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    port = plant.get_desired_state_input_port(model)
    port.FixValue(context, [0.0, 0.0, 6.0, 5.0])  # wheel speeds, rad/s
    simulator.AdvanceTo(0.5)
    started = time.perf_counter()
    simulator.AdvanceTo(0.5 + seconds)
    return seconds / (time.perf_counter() - started)


if __name__ == "__main__":
    show("Bundled run", rows())
