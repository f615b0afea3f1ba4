"""The navigation robot: finds its way along waypoints by markers, gyro and commands.

The robot of Hussein, Lazkani, Saad, Yehia, "Real-time robot navigation with QR-based localization
and lidar obstacle mapping".
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context
from pydrake.systems.primitives import Multiplexer

from diagrams.avoidance import AVOIDERS, PLANNERS, Avoidance
from diagrams.channels import estimate_signal, planar_frames
from diagrams.metrics import (
    PoseLog,
    clearance_metrics,
    integrated_jerk,
    nis_mean,
    path_length,
    pose_metrics,
)
from diagrams.mission import FRAME_RATE, Mission, Wiring
from diagrams.scenario import Scenario
from diagrams.station import RobotParameters
from diagrams.tables import Choice, Table
from diagrams.trajectories import write_tum
from diagrams.viewer import EstimateViewer
from diagrams.world import WorldParameters
from plants.arena import check_free
from systems.controllers.braking import CollisionMonitorParameters
from systems.controllers.search import SearchParameters, SearchWhenLost
from systems.estimators.planar_kalman import UNKNOWN
from systems.markers.localizer import Localizer, LocalizerParameters, MapLocalizer
from systems.planners.occupancy import OccupancyParameters
from systems.planners.progress import ProgressParameters
from systems.planners.waypoint_sequencer import WaypointSequencer
from systems.validation import require, require_positive

ESTIMATORS = Table(
    "estimator",
    {
        "ekf": "systems.estimators.planar_ekf:PlanarEkf",
        "kf": "systems.estimators.planar_kalman:PlanarKalmanFilter",
    },
)
CONTROLLERS = Table(
    "controller",
    {"waypoint": "systems.controllers.waypoints:WaypointController"},
    resources=frozenset({"waypoints"}),
)

ROBOT = "robot"


@dataclass(kw_only=True)
class NavigationScenario(Scenario):
    """A robot, its world and its waypoints.

    Attributes:
        world: markers and walls.
        robot: the robot; needs a camera and an IMU among its sensors.
        waypoints: [[x, y], ...] to visit in this order, m.
        arrival_radius: a waypoint counts as reached inside this distance, m.
        camera: which of the sensors looks for markers.
        imu: which of the sensors measures the yaw rate.
        lidar: which of the sensors scans for obstacles; none without one.
        encoders: which of the sensors counts the wheels' turns, for an estimator with the port
            `wheel_speeds`; none without one: the robot knows its commands only.
        localizer: what is trusted of a picture.
        estimator: a block with the ports command, imu, marker_pose, marker_alternative, pose,
            covariance; nis if it has any.
        controller: a block with the ports pose, goal, command.
        planner: finds the way around what the lidar has seen: a block with the ports pose, goal,
            grid, path; `none` heads straight for the waypoint.
        mapper: how the planner's grid is built.
        avoider: keeps off what the lidar sees: a block with the ports pose, goal, scan, command,
            state; with an output `command` it takes the controller's place. Or `none`.
        monitor: when the wheels are slowed and stopped before a contact.
        progress: when a robot that comes no nearer to its waypoint gives up.
        search: what to do while lost.
    """

    world: WorldParameters
    robot: RobotParameters
    waypoints: list[list[float]]
    arrival_radius: float = 0.30
    camera: str = "front_camera"
    imu: str = "imu"
    lidar: str | None = None
    encoders: str | None = None
    localizer: LocalizerParameters = field(default_factory=LocalizerParameters)
    estimator: Annotated[Choice, ESTIMATORS]
    controller: Annotated[Choice, CONTROLLERS]
    planner: Annotated[Choice | None, PLANNERS] = None
    mapper: OccupancyParameters = field(default_factory=OccupancyParameters)
    avoider: Annotated[Choice | None, AVOIDERS] = None
    monitor: CollisionMonitorParameters = field(default_factory=CollisionMonitorParameters)
    progress: ProgressParameters = field(default_factory=ProgressParameters)
    search: SearchParameters = field(default_factory=SearchParameters)

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(arrival_radius=self.arrival_radius)
        require(len(self.waypoints) > 0, "waypoints", self.waypoints, "at least one [x, y]")
        for k, point in enumerate(self.waypoints):
            require(
                len(point) == 2 and bool(np.isfinite(point).all()),
                f"waypoints[{k}]",
                point,
                "[x, y] in metres",
            )
        if self.lidar is None:
            for key in ("planner", "avoider"):
                require(
                    getattr(self, key) is None,
                    "lidar",
                    None,
                    f"one of the sensors, or {key}: none",
                )
        for key, method in (
            ("camera", "model"),
            ("imu", "add"),
            ("lidar", "planar_mounting"),
            ("encoders", "speeds"),
        ):
            self.robot.require_sensor(key, getattr(self, key), method)
        body = self.robot.body
        fits = hasattr(body.target, "hull_radius")
        require(fits, "robot.body", body.type, "one that drives on the ground")
        room = body.build().hull_radius
        for k, point in enumerate(self.waypoints):
            check_free(self.world.arena, point, room, f"waypoints[{k}]")
        start = self.robot.start
        check_free(self.world.arena, [start.x, start.y], room, "robot.start", moving=True)

    def build(self, *, meshcat: Meshcat | None = None, out: Path | None = None) -> Mission:
        """Wires station, estimator and controller.

        Args:
            meshcat: where it is shown, if anywhere.
            out: folder of the run; the recording goes there. None records nothing.

        Raises:
            ValueError: something of the scenario is refused; one line.
        """
        return NavigationMission(self, meshcat=meshcat, out=out)


class NavigationMission(Mission):
    """The wired diagram of a `NavigationScenario`."""

    def __init__(
        self, scenario: NavigationScenario, *, meshcat: Meshcat | None, out: Path | None
    ) -> None:
        """See `NavigationScenario.build`."""
        wiring = Wiring(
            scenario, world=scenario.world, robots={ROBOT: scenario.robot}, meshcat=meshcat
        )
        self.station = wiring.station
        self._scenario = scenario
        self._add_blocks(wiring)
        self._avoidance = Avoidance(wiring, scenario, ROBOT)
        _connect(wiring, scenario)
        self._avoidance.connect()
        self._has_truth = wiring.has_output(f"truth.{ROBOT}.pose")
        self._log_and_record(wiring)
        if meshcat is not None:
            _show(wiring, scenario, meshcat, self._has_truth)
            self._avoidance.show(meshcat)
        self.recorder = wiring.add_recorder(out)
        self.diagram, self.logs = wiring.build("navigation")
        self._wiring = wiring

    def _add_blocks(self, wiring: Wiring) -> None:
        scenario = self._scenario
        camera = scenario.robot.sensors[scenario.camera].build()
        localizer = MapLocalizer(
            marker_map=wiring.station.marker_map,
            camera=camera.model(),
            X_BC=camera.mounting(),
            parameters=scenario.localizer,
        )
        waypoints = np.array(scenario.waypoints)
        wiring.add(Localizer(localizer=localizer, rate=camera.rate), "localizer")
        wiring.add(scenario.estimator.build(), "estimator")
        wiring.add(
            WaypointSequencer(waypoints=waypoints, radius=scenario.arrival_radius), "sequencer"
        )
        wiring.add(scenario.controller.build(waypoints=waypoints), "controller")
        wiring.add(SearchWhenLost(parameters=scenario.search), "search")
        if scenario.encoders is not None:
            wiring.add(scenario.robot.sensors[scenario.encoders].build().speeds(), "wheel_speeds")

    def _log_and_record(self, wiring: Wiring) -> None:
        together = wiring.add(Multiplexer([3, 9]), "estimate")
        for index, port in enumerate(("pose", "covariance")):
            wiring.builder.Connect(
                wiring.output(f"estimator.{port}"), together.get_input_port(index)
            )
        names = ["estimator.pose", "estimator.covariance", "sequencer.waypoints_reached"]
        truth = [f"truth.{ROBOT}.{kind}" for kind in ("pose", "clearance", "contacts")]
        for name in [*names, *filter(wiring.has_output, ["estimator.nis", *truth])]:
            wiring.log(name)
        signal = estimate_signal(ROBOT, rate=50.0)
        wiring.record("estimate.y0", signal)
        frames = planar_frames([f"{ROBOT}/base_link"])
        wiring.record("estimate.y0", replace(signal, port="tf", topic="/tf", encode=frames))

    def outcome(self, context: Context) -> str | None:
        """Returns `reached` when the last waypoint is, `blocked` when the robot gives up.

        A run in which the robot touched something ends as `contact`, wherever it got to.
        """
        reached = self._wiring.value("sequencer.waypoints_reached", context)[0]
        if reached == len(self._scenario.waypoints):
            return "contact" if self._touched(context) else "reached"
        if self._avoidance.blocked(context):
            return "contact" if self._touched(context) else "blocked"
        return None

    def unfinished(self, context: Context, word: str) -> str:
        """Returns `contact` for a run in which the robot touched something."""
        return "contact" if self._touched(context) else word

    def _touched(self, context: Context) -> bool:
        name = f"truth.{ROBOT}.contacts"
        return self._wiring.has_output(name) and self._wiring.value(name, context)[0] > 0

    def succeeded(self, outcome: str) -> bool:
        """Whether all waypoints were reached."""
        return outcome == "reached"

    def metrics(self, context: Context) -> dict[str, Any]:
        """Returns the metrics (see `diagrams.metrics`)."""
        log = self.pose_log(context)
        reached = int(self.log("sequencer.waypoints_reached", context)[1][-1, 0])
        total = len(self._scenario.waypoints)
        now = int(self._wiring.value("sequencer.waypoints_reached", context)[0])
        path = log.estimate[log.known] if log.truth is None else log.truth
        return {
            "waypoints_reached": max(now, reached),
            "waypoints_total": total,
            **pose_metrics(log),
            "nis_mean": self._nis_mean(context),
            "path_length_m": path_length(path[:, :2]),
            "integrated_jerk": None if log.truth is None else integrated_jerk(log.t, path[:, :2]),
            **self._clearance(context),
            "time_to_first_fix_s": float(log.t[log.known][0]) if log.known.any() else None,
            "time_to_goal_s": context.get_time() if now == total else None,
        }

    def _nis_mean(self, context: Context) -> float | None:
        name = "estimator.nis"
        return nis_mean(self.log(name, context)[1]) if name in self.logs else None

    def _clearance(self, context: Context) -> dict[str, Any]:
        names = [f"truth.{ROBOT}.{kind}" for kind in ("clearance", "contacts")]
        if not all(name in self.logs for name in names):
            return dict.fromkeys(("contacts", "min_clearance_m", "mean_clearance_m"))
        clearance, contacts = (self.log(name, context)[1][:, 0] for name in names)
        return clearance_metrics(clearance, contacts)

    def pose_log(self, context: Context) -> PoseLog:
        """Returns truth and estimate over time."""
        t, estimate = self.log("estimator.pose", context)
        covariance = self.log("estimator.covariance", context)[1].reshape(-1, 3, 3)
        truth = self.log(f"truth.{ROBOT}.pose", context)[1] if self._has_truth else None
        return PoseLog(t, truth, estimate, covariance, covariance[:, 0, 0] < UNKNOWN)

    def write(self, context: Context, out: Path) -> None:
        """Writes `summary.png`, `truth.tum` and `estimate.tum`."""
        from diagrams.plots import plot_navigation  # loads Matplotlib

        log = self.pose_log(context)
        write_tum(out / "estimate.tum", log.t[log.known], log.estimate[log.known])
        if log.truth is not None:
            write_tum(out / "truth.tum", log.t, log.truth)
        plot_navigation(
            out / "summary.png",
            log,
            waypoints=np.array(self._scenario.waypoints),
            radius=self._scenario.arrival_radius,
            arena=self._scenario.world.arena,
            markers=self.station.marker_map,
        )


def _connect(wiring: Wiring, scenario: NavigationScenario) -> None:
    wiring.connect(f"{ROBOT}.{scenario.camera}.detections", "localizer.detections")
    # An estimator or a controller may do without some of what there is.
    wiring.connect_if_wanted(f"{ROBOT}.drive.sent", "estimator.command")
    wiring.connect_if_wanted(f"{ROBOT}.{scenario.imu}.sample", "estimator.imu")
    if scenario.encoders is not None:
        wiring.connect(f"{ROBOT}.{scenario.encoders}.ticks", "wheel_speeds.ticks")
        wiring.connect_if_wanted("wheel_speeds.wheel_speeds", "estimator.wheel_speeds")
    wiring.connect_if_wanted("localizer.pose", "estimator.marker_pose")
    wiring.connect_if_wanted("localizer.alternative", "estimator.marker_alternative")
    wiring.connect("estimator.pose", "sequencer.pose")
    wiring.connect_if_wanted("estimator.pose", "controller.pose")
    wiring.connect("estimator.covariance", "search.covariance")


def _show(wiring: Wiring, scenario: NavigationScenario, meshcat: Meshcat, has_truth: bool) -> None:
    wiring.add(
        EstimateViewer(
            meshcat=meshcat,
            ghost=scenario.robot.body.build().ghost(),
            waypoints=np.array(scenario.waypoints),
            radius=scenario.arrival_radius,
            rate=FRAME_RATE,
            show_truth=has_truth,
        ),
        "viewer",
    )
    wiring.connect("estimator.pose", "viewer.pose")
    wiring.connect("estimator.covariance", "viewer.covariance")
    if has_truth:
        wiring.connect(f"truth.{ROBOT}.pose", "viewer.truth")
