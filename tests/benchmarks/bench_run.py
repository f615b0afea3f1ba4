"""The bundled run: how exact it is, and how much faster than real time."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

from diagrams.run import simulate
from diagrams.scenario import load_scenario
from tests.benchmarks.table import Row, show


def rows() -> Iterator[Row]:
    """Yields the measurements, recording included."""
    for sight, factor in (("rendered", 2.0), ("projected", 15.0)):
        with tempfile.TemporaryDirectory() as folder:
            scenario = load_scenario("navigation", {"sight": sight})
            report = simulate(scenario, out=Path(folder)).report
        metrics, speed = report["metrics"], report["real_time_factor"]
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


if __name__ == "__main__":
    show("Bundled run", rows())
