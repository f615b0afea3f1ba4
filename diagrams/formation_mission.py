"""The wired diagram of a formation: its outcome, its metrics, its results."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context
from pydrake.systems.primitives import ConstantVectorSource

from diagrams.formation_faults import COMMAND, faults_of
from diagrams.formation_metrics import FormationLog, formation_metrics
from diagrams.formation_recording import look_rate, record_estimates
from diagrams.formation_sensing import (
    add_obstacles,
    obstacle_metrics,
    sensed_obstacles,
    touched,
)
from diagrams.formation_viewer import FormationViewer
from diagrams.mission import Mission, Wiring
from diagrams.schema import ScenarioError
from diagrams.trajectories import write_tum
from systems.controllers.formation_cameras import FormationCameras
from systems.planners.failure import Failure
from systems.planners.formation_planner import FormationPlanner
from systems.planners.formation_turns import FormationTurns
from systems.sensors.faults import FaultInjector

if TYPE_CHECKING:
    from diagrams.formation import FormationScenario

Array = NDArray[np.float64]

CAMERAS = ("front_camera", "rear_camera")


class FormationMission(Mission):
    """The wired diagram of a `FormationScenario`."""

    def __init__(
        self, scenario: FormationScenario, *, meshcat: Meshcat | None, out: Path | None
    ) -> None:
        """See `FormationScenario.build`."""
        wiring = Wiring(
            scenario,
            world=scenario.world,
            robots=scenario.station_robots(),
            meshcat=meshcat,
            frame_rate=_FRAME_RATE,
        )
        self.station = wiring.station
        self._scenario = scenario
        self._wiring = wiring
        self._names = scenario.names()
        # What is heard may still turn out to be less than it seemed.
        self._hope = _HOPE if scenario.obstacles == "sensed" else 0.0
        self._add_blocks()
        self._connect()
        self._has_truth = wiring.has_output(f"truth.{self._names[0]}.pose")
        self._log()
        if meshcat is not None:
            self._show(meshcat)
        record_estimates(wiring, self._names)
        controllers = [f"controller_{k + 1}" for k in range(scenario.robots)]
        deciding = [*controllers, "turns", *filter(wiring.has_block, ["estimator"])]
        rate = look_rate(wiring.block(name) for name in deciding)
        self.recorder = wiring.add_recorder(out, rate=rate)
        self.diagram, self.logs = wiring.build("formation")

    def _add_blocks(self) -> None:
        wiring, scenario = self._wiring, self._scenario
        cameras = {name: scenario.robot.sensors[name].build().model() for name in CAMERAS}
        for k in range(scenario.robots):
            controller = scenario.controller.build(step=scenario.step, **cameras)
            wiring.add(controller, f"controller_{k + 1}")
        start = scenario.start_poses()
        wiring.add(FormationTurns(start_poses=start, parameters=scenario.turns), "turns")
        wiring.add(
            FormationPlanner(
                start=start[:, :2], rule=scenario.planner, parameters=scenario.formation
            ),
            "planner",
        )
        if scenario.estimator is not None:
            estimator = scenario.estimator.build(start_poses=start, camera=cameras[CAMERAS[0]])
            wiring.add(estimator, "estimator")
        fails = None if scenario.fail_robot is None else scenario.fail_robot - 1
        failure = Failure(
            robots=scenario.robots,
            robot=fails,
            at=scenario.fail_at,
            beacon=scenario.fail_as == "beacon",
        )
        wiring.add(failure, "failure")
        wiring.add(ConstantVectorSource(scenario.destination), "destination")
        wiring.add(FormationCameras(robots=scenario.robots, cameras=CAMERAS), "cameras")

    def _connect(self) -> None:
        wiring = self._wiring
        for k, name in enumerate(self._names):
            for camera in CAMERAS:
                detections = f"{name}.{camera}.detections"
                wiring.connect(detections, f"controller_{k + 1}.{camera.split('_')[0]}_detections")
                if wiring.has_block("estimator"):
                    wiring.connect(detections, f"estimator.robot{k}_{camera}")
                wiring.connect(detections, f"cameras.robot{k}_{camera}")
                active = f"{name}.{camera}.active"
                if wiring.has_input(active):
                    wiring.connect(f"cameras.robot{k}_{camera}_active", active)
            wiring.connect(f"turns.task_{k}", f"controller_{k + 1}.task")
            wiring.connect(f"controller_{k + 1}.status", f"turns.status_{k}")
            wiring.connect(self._command(k), f"{name}.drive.command")
        wiring.connect("turns.looking", "cameras.looking")
        if wiring.has_block("estimator"):
            wiring.connect("turns.moving", "estimator.moving")
            wiring.connect("estimator.poses", "turns.poses")
            wiring.connect("estimator.covariance", "turns.covariance")
        wiring.connect("planner.move", "turns.move")
        wiring.connect("turns.positions", "planner.positions")
        wiring.connect("turns.progress", "planner.progress")
        for block in ("turns", "planner"):
            wiring.connect("failure.failed", f"{block}.failed")
        wiring.connect("destination.y0", "planner.destination")
        wiring.connect(add_obstacles(wiring, self._scenario), "planner.obstacles")

    def _command(self, robot: int) -> str:
        """Returns the output that commands a robot, with the faults that its motors have."""
        command = f"controller_{robot + 1}.command"
        faults = [f for f in faults_of(self._scenario, robot + 1) if f.signal == COMMAND]
        if not faults:
            return command
        name = self._names[robot]
        try:
            injector = FaultInjector(
                model=2, faults=faults, rate=_COMMAND_RATE, seed=self._scenario.seed, name=name
            )
        except ValueError as error:
            raise ScenarioError(f"faults of {name}.{COMMAND}: {error}") from error
        self._wiring.add(injector, f"motors_{robot + 1}")
        self._wiring.connect(command, f"motors_{robot + 1}.input")
        return f"motors_{robot + 1}.output"

    def _log(self) -> None:
        kinds = ("pose", "contacts", "clearance")
        truth = [f"truth.{name}.{kind}" for name in self._names for kind in kinds]
        names = ["turns.record", "turns.positions", *truth]
        for name in [*names, "estimator.poses", "estimator.covariance"]:
            if self._wiring.has_output(name):
                self._wiring.log(name, _LOG_RATE)

    def _show(self, meshcat: Meshcat) -> None:
        wiring, scenario = self._wiring, self._scenario
        viewer = FormationViewer(
            meshcat=meshcat,
            robots=scenario.robots,
            destination=np.array(scenario.destination),
            rate=_FRAME_RATE,
        )
        wiring.add(viewer, "viewer")
        wiring.connect("planner.move", "viewer.move")
        for name in ("moving", "record", "positions"):
            wiring.connect(f"turns.{name}", f"viewer.{name}")
        if wiring.has_block("estimator"):
            for name in ("poses", "covariance"):
                wiring.connect(f"estimator.{name}", f"viewer.{name}")
        for k, name in enumerate(self._names):
            if self._has_truth:
                wiring.connect(f"truth.{name}.pose", f"viewer.truth_{k}")
        if not scenario.world.arena.walls:  # else all that matters is between them
            meshcat.SetCameraPose(*_view(np.vstack([scenario.places(), scenario.destination])))

    def outcome(self, context: Context) -> str | None:
        """Returns how the planner says that the formation fares, once it is at an end.

        A run in which a robot touched an obstacle ends as `contact`, wherever it got to.
        """
        move = self._wiring.value("planner.move", context)
        ends = ("reached", "blocked", "broken", "too_few_robots")
        if move.status not in ends:
            return None
        if move.status == "blocked" and context.get_time() < move.stamp + self._hope:
            return None
        return self.unfinished(context, str(move.status))

    def unfinished(self, context: Context, word: str) -> str:
        """Returns `contact` for a run in which a robot touched an obstacle."""
        return "contact" if touched(self._wiring, self._names, context) else word

    def succeeded(self, outcome: str) -> bool:
        """Whether the destination was reached."""
        return outcome == "reached"

    def metrics(self, context: Context) -> dict[str, Any]:
        """Returns the metrics (see `diagrams.formation_metrics`)."""
        metrics = formation_metrics(self.formation_log(context), self._scenario.formation.side)
        return metrics | obstacle_metrics(self, self._names, context)

    def formation_log(self, context: Context) -> FormationLog:
        """Returns truth, belief and moves over time."""
        t, record = self.log("turns.record", context)
        n = self._scenario.robots
        truth = None
        if self._has_truth:
            each = [self.log(f"truth.{name}.pose", context)[1] for name in self._names]
            truth = np.stack(each, axis=1)
        estimate = covariance = None
        if "estimator.poses" in self.logs:
            estimate = self.log("estimator.poses", context)[1].reshape(-1, n, 3)
            covariance = self.log("estimator.covariance", context)[1].reshape(-1, 3 * n, 3 * n)
        return FormationLog(
            t=t,
            record=record,
            truth=truth,
            believed=self.log("turns.positions", context)[1].reshape(-1, n, 2),
            estimate=estimate,
            covariance=covariance,
        )

    def write(self, context: Context, out: Path) -> None:
        """Writes `summary.png`, trajectories and the moves."""
        from diagrams.formation_summary import plot_formation  # loads Matplotlib

        log = self.formation_log(context)
        for k, name in enumerate(self._names):
            if log.truth is not None:
                write_tum(out / f"truth_{name}.tum", log.t, log.truth[:, k])
            if log.estimate is not None:
                known = log.known(k)
                write_tum(out / f"estimate_{name}.tum", log.t[known], log.estimate[known, k])
        moves = [move.to_plain() for move in log.moves()]
        if log.truth is not None:
            plot_formation(
                out / "summary.png",
                log,
                arena=self._scenario.world.arena,
                destination=self._scenario.destination,
                side=self._scenario.formation.side,
                sensed=sensed_obstacles(self._wiring, context),
            )
        (out / "moves.json").write_text(json.dumps(moves, indent=1) + "\n")


def _view(places: Array) -> tuple[Array, Array]:
    """Returns a place to the south of places (n, 2) and above, and their middle, (3,) m each."""
    low, high = places.min(axis=0), places.max(axis=0)
    middle, (wide, deep) = (low + high) / 2, high - low
    distance = max(2.0, 0.55 * wide, 0.9 * deep)  # windows are wider than high
    eye = [middle[0], middle[1] - 0.6 * distance, 0.8 * distance]
    return np.array(eye), np.array([*middle, 0.0])


_COMMAND_RATE = 20.0  # Hz
_FRAME_RATE = 10.0  # Hz: runs are long and robots slow; twice as many make the replay as large
_LOG_RATE = 5.0  # Hz: moves take half a minute
_HOPE = 5.0  # s, for which the way must be blocked
