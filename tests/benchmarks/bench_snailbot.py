"""The whole SnailBot: how exact, how honest, how fast; beside it the paper's rule.

Five iterations of the routine, in the plant, driven on the estimate.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from diagrams.run import simulate
from diagrams.scenario import load_scenario
from diagrams.shell_metrics import AXES, ShellLog
from diagrams.shell_mission import ShellMission
from diagrams.shell_table import PAPER
from tests.benchmarks.table import Row, show

ITERATIONS = 5
DARK = (5.0, 5.5)  # s: no marker from, and for how long: a quarter of an iteration


def rows() -> Iterator[Row]:
    """Yields the measurements."""
    ours, _, factor = drive("drawn")
    rule, _, _ = drive("drawn", estimator="rule")
    what = "snailbot, drawn"
    worst = max(rmse(ours))
    yield Row(f"{what}: RMSE by axis", three(ours), "<= 0.5 deg", worst <= 0.5,
              f"the rule: {three(rule)}, the paper: {paper('rmse_deg')}")  # fmt: skip
    most = ours["max_error_deg"]
    yield Row(f"{what}: largest error", f"{most:.2f} deg", "<= 2.5 deg", most <= 2.5,
              f"the paper: {paper('maximum_deg')}")  # fmt: skip
    below = all(a < b for a, b in zip(rmse(rule), PAPER["rmse_deg"], strict=True))
    yield Row(f"{what}, the rule: RMSE by axis", three(rule), "below the paper's", below)
    beyond = rule["outlier_rate_15deg"]
    yield Row(f"{what}, the rule: above 15 deg", f"{beyond:.4f}", "0", beyond == 0)
    ratio = float(np.linalg.norm(rmse(ours)) / np.linalg.norm(rmse(rule)))
    yield Row(f"{what}: RMSE by the rule's", f"{ratio:.2f}", "<= 0.3", ratio <= 0.3)
    yield Row(f"{what}: NEES per dimension", f"{ours['nees_mean']:.2f}")
    yield Row(f"{what}: position RMSE", f"{1e3 * ours['position_rmse_m']:.2f} mm", "< 10 mm",
              ours["position_rmse_m"] < 0.01, "the paper: below a centimetre")  # fmt: skip
    yield Row(f"{what}: real-time factor", f"{factor:.2f}", ">= 1", factor >= 1.0)
    yield from projected_rows()
    harsh, _, _ = drive("drawn", errors="harsh")
    yield Row(f"{what}, harsh errors: RMSE by axis", three(harsh), "<= 0.8 deg",
              max(rmse(harsh)) <= 0.8)  # fmt: skip
    most = harsh["max_error_deg"]
    yield Row(f"{what}, harsh errors: largest", f"{most:.2f} deg", "<= 5 deg", most <= 5.0)
    yield from dark_rows()


def projected_rows() -> Iterator[Row]:
    """Without pictures."""
    ours, _, factor = drive("projected")
    what = "snailbot, projected"
    yield Row(f"{what}: RMSE by axis", three(ours), "<= 0.35 deg", max(rmse(ours)) <= 0.35)
    p95, most = ours["p95_error_deg"], ours["max_error_deg"]
    yield Row(f"{what}: P95, largest", f"{p95:.2f}, {most:.2f} deg", "<= 0.8, 2 deg",
              p95 <= 0.8 and most <= 2.0)  # fmt: skip
    yield Row(f"{what}: real-time factor", f"{factor:.1f}", ">= 5", factor >= 5.0)


def dark_rows() -> Iterator[Row]:
    """No marker for a quarter of the routine."""
    start, duration = DARK
    fault = {
        "signal": "camera.detections", "kind": "silent", "start": start, "duration": duration,
    }  # fmt: skip
    _, log, _ = drive("projected", iterations=1, **{"robot.faults": [fault]})
    dark = (log.t >= start) & (log.t < start + duration)
    errors = log.errors()[dark]
    sigma = np.degrees(np.sqrt(np.diagonal(log.covariance[dark], axis1=1, axis2=2)[:, :3]))
    most = float(np.abs(errors).max())
    inside = float((np.abs(errors) <= 2 * sigma).all(axis=1).mean())
    yield Row("snailbot, a quarter without a marker: largest error, within 2 sigma",
              f"{most:.2f} deg, {100 * inside:.0f} %", "<= 2 deg, >= 90 %",
              most <= 2.0 and inside >= 0.9)  # fmt: skip


def drive(sight: str, **changes: Any) -> tuple[dict[str, Any], ShellLog, float]:
    """Returns metrics, log and real-time factor of a run."""
    settings = {"sight": sight, "iterations": ITERATIONS, "record.bag": False} | changes
    run = simulate(load_scenario("snailbot", settings))
    assert run.succeeded, run.report["outcome"]
    assert isinstance(run.mission, ShellMission)
    log = run.mission.shell_log(run.context)
    assert log is not None
    return run.report["metrics"], log, float(run.report["real_time_factor"])


def rmse(metrics: dict[str, Any]) -> list[float]:
    """Returns the three RMSE, deg."""
    return [float(metrics[f"{axis}_rmse_deg"]) for axis in AXES]


def three(metrics: dict[str, Any]) -> str:
    """Returns the three RMSE as text."""
    return "/".join(f"{value:.2f}" for value in rmse(metrics)) + " deg"


def paper(row: str) -> str:
    """Returns a row of the paper's table as text."""
    return "/".join(f"{value:.2f}" for value in PAPER[row])


if __name__ == "__main__":
    show("SnailBot", rows())
