"""Simulates a scenario once and writes the run's folder."""

from __future__ import annotations

import gc
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import Context

from diagrams.mission import FRAME_RATE, Mission
from diagrams.report import finite
from diagrams.scenario import Scenario, save_scenario
from systems.compiled import prepare
from systems.messages import whole_nanoseconds
from systems.periods import align, aligned
from systems.validation import require_non_negative

# Of a run; a team's other robots have theirs with their names.
RESULTS = (
    "report.json",
    "summary.png",
    "summary_robot*.png",
    "replay.html",
    "scenario.yaml",
    "estimate.tum",
    "estimate_robot*.tum",
    "truth.tum",
    "truth_robot*.tum",
    "table1.json",
    "table1.png",
    "table1_robot*.json",
    "table1_robot*.png",
    "calibration.json",
    "estimate_chain.tum",
    "moves.json",
    "*_camera.tum",
    "anchor.json",
)

# s, of the integrator; only kinematic twins have continuous state. Steps end at every event, and at
# 0.3 m/s and 1 rad/s the longest is 3 micrometres wrong.
_MAX_STEP = 0.05


@dataclass(frozen=True)
class Run:
    """A run that has ended.

    Attributes:
        report: what `report.json` holds.
        succeeded: whether the mission was fulfilled.
        mission: what was simulated.
        context: the diagram's context at the end.
    """

    report: dict[str, Any]
    succeeded: bool
    mission: Mission
    context: Context


def simulate(
    scenario: Any,
    *,
    out: Path | None = None,
    meshcat: Meshcat | None = None,
    realtime: float = 0.0,
    progress: Callable[[float, float], None] | None = None,
) -> Run:
    """Simulates a scenario to its end.

    Args:
        scenario: as `load_scenario` gives it.
        out: folder of the results; None writes nothing. An earlier run's results are replaced.
        meshcat: where it is shown; its replay is written too.
        realtime: slows the simulation down to this many times real time; 0 is as fast as it goes,
            or as the scenario wants it.
        progress: called with the simulated time and the duration, s.

    Raises:
        ValueError: the scenario or a file that it names is refused.
    """
    require_non_negative(realtime=realtime)
    if out is not None:
        _make_folder(out)
    ready = scenario.prepared(meshcat=meshcat, out=out, progress=progress)
    if meshcat is not None:
        meshcat.StartRecording(frames_per_second=FRAME_RATE)
    mission: Mission = ready.build(meshcat=meshcat, out=out)
    if out is not None:  # from here on the folder is this run's
        for pattern in RESULTS:
            for path in out.glob(pattern):
                path.unlink()
        save_scenario(scenario, out / "scenario.yaml")
    prepare()  # or the first pictures would wait for the compiler
    gc.freeze()  # diagram and modules stay: to look through them again and again costs 5 %
    try:
        outcome, context, wall = _advance(
            scenario, mission, realtime or ready.realtime_rate, progress
        )
    finally:
        gc.unfreeze()
        if mission.recorder is not None:
            mission.recorder.close()
    report = {
        "scenario": scenario.name,
        "seed": scenario.seed,
        "outcome": outcome,
        "sim_seconds": whole_nanoseconds(context.get_time()),
        "wall_seconds": wall,
        "real_time_factor": context.get_time() / wall,
        "metrics": mission.metrics(context),
        "health": mission.health(context),
    }
    if mission.recorder is not None and mission.recorder.lost:
        report["health"]["recorder"] = {"lost": mission.recorder.lost}
    if out is not None:
        (out / "report.json").write_text(json.dumps(finite(report), indent=1) + "\n")
        mission.write(context, out)
        if meshcat is not None:
            meshcat.PublishRecording()
            (out / "replay.html").write_text(meshcat.StaticHtml())
    return Run(report, mission.succeeded(outcome), mission, context)


def start_meshcat() -> Meshcat:
    """Returns a Meshcat server that listens on localhost only."""
    return Meshcat(MeshcatParams(host="localhost", show_stats_plot=False))


def _advance(
    scenario: Scenario,
    mission: Mission,
    realtime: float,
    progress: Callable[[float, float], None] | None,
) -> tuple[str, Context, float]:
    simulator = Simulator(mission.diagram)
    config = SimulatorConfig(
        integration_scheme="runge_kutta2", max_step_size=_MAX_STEP, use_error_control=False
    )
    ApplySimulatorConfig(config, simulator)
    simulator.set_target_realtime_rate(realtime)
    context = simulator.get_mutable_context()
    with aligned(mission.aligned):
        look = align(0.1)  # s between two looks at the outcome
        end = align(min(scenario.time_limit, mission.station.end_time))
    simulator.Initialize()
    started = time.perf_counter()
    outcome = None
    k = 0
    while outcome is None and context.get_time() < end:
        k += 1
        simulator.AdvanceTo(min(k * look, end))
        outcome = mission.outcome(context)
        if progress is not None:
            progress(context.get_time(), end)
    wall = time.perf_counter() - started
    if outcome is None:
        word = "played" if mission.station.end_time < scenario.time_limit else "timeout"
        outcome = mission.unfinished(context, word)
    return outcome, context, wall


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"--out {out}: {error.strerror}") from error
    if not os.access(out, os.W_OK):
        raise ValueError(f"--out {out}: cannot be written to")
