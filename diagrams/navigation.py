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

from diagrams.channels import estimate_signal
from diagrams.metrics import PoseLog, path_length, pose_metrics
from diagrams.mission import FRAME_RATE, Mission, Wiring
from diagrams.plots import plot_navigation
from diagrams.scenario import Scenario
from diagrams.station import RobotParameters, WorldParameters
from diagrams.tables import Choice, Table
from diagrams.trajectories import write_tum
from diagrams.viewer import EstimateViewer
from plants.arena import check_free
from systems.angles import spatial_pose
from systems.controllers.search import SearchParameters, SearchWhenLost
from systems.estimators.planar_kalman import UNKNOWN
from systems.io.ros_motion import FrameTransform, transforms_to_ros
from systems.markers.localizer import Localizer, LocalizerParameters, MapLocalizer
from systems.planners.waypoint_sequencer import WaypointSequencer
from systems.validation import require, require_positive

ESTIMATORS = Table("estimator", {"kf": "systems.estimators.planar_kalman:PlanarKalmanFilter"})
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
        localizer: what is trusted of a picture.
        estimator: a block with the ports command, imu, marker_pose, marker_alternative, pose,
            covariance.
        controller: a block with the ports pose, goal, command.
        search: what to do while lost.
    """

    world: WorldParameters
    robot: RobotParameters
    waypoints: list[list[float]]
    arrival_radius: float = 0.30
    camera: str = "front_camera"
    imu: str = "imu"
    localizer: LocalizerParameters = field(default_factory=LocalizerParameters)
    estimator: Annotated[Choice, ESTIMATORS]
    controller: Annotated[Choice, CONTROLLERS]
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
        for key, method in (("camera", "mounting"), ("imu", "add")):
            name = getattr(self, key)
            fit = [n for n, s in self.robot.sensors.items() if hasattr(s.target, method)]
            have = ", ".join(fit) or "none"
            require(name in fit, key, name, f"one of the robot's sensors that fit: {have}")
        room = self.robot.body.build().hull_radius
        for k, point in enumerate(self.waypoints):
            check_free(self.world.arena, point, room, f"waypoints[{k}]")
        start = self.robot.start
        check_free(self.world.arena, [start.x, start.y], room, "robot.start")

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
        _connect(wiring, scenario)
        self._has_truth = wiring.has_output(f"truth.{ROBOT}.pose")
        self._log_and_record(wiring)
        if meshcat is not None:
            _show(wiring, scenario, meshcat, self._has_truth)
        self.recorder = wiring.add_recorder(out)
        self.diagram, self.logs = wiring.build("navigation")
        self._sequencer = self.diagram.GetSubsystemByName("sequencer")

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

    def _log_and_record(self, wiring: Wiring) -> None:
        together = wiring.add(Multiplexer([3, 9]), "estimate")
        for index, port in enumerate(("pose", "covariance")):
            wiring.builder.Connect(
                wiring.output(f"estimator.{port}"), together.get_input_port(index)
            )
        names = ["estimator.pose", "estimator.covariance", "sequencer.waypoints_reached"]
        if self._has_truth:
            names.append(f"truth.{ROBOT}.pose")
        for name in names:
            wiring.log(name)
        signal = estimate_signal(ROBOT, rate=50.0)
        wiring.record("estimate.y0", signal)
        wiring.record(
            "estimate.y0", replace(signal, port="tf", topic="/tf", encode=_estimate_to_tf)
        )

    def outcome(self, context: Context) -> str | None:
        """Returns `reached` when the last waypoint is."""
        own = self._sequencer.GetMyContextFromRoot(context)
        reached = self._sequencer.GetOutputPort("waypoints_reached").Eval(own)[0]
        return "reached" if reached == len(self._scenario.waypoints) else None

    def succeeded(self, outcome: str) -> bool:
        """Whether all waypoints were reached."""
        return outcome == "reached"

    def metrics(self, context: Context) -> dict[str, Any]:
        """Returns the metrics (see `diagrams.metrics`)."""
        log = self.pose_log(context)
        reached = int(self.log("sequencer.waypoints_reached", context)[1][-1, 0])
        done = self.outcome(context) is not None
        path = log.estimate[log.known] if log.truth is None else log.truth
        return {
            "waypoints_reached": len(self._scenario.waypoints) if done else reached,
            "waypoints_total": len(self._scenario.waypoints),
            **pose_metrics(log),
            "path_length_m": path_length(path[:, :2]),
            "time_to_first_fix_s": float(log.t[log.known][0]) if log.known.any() else None,
            "time_to_goal_s": context.get_time() if done else None,
        }

    def pose_log(self, context: Context) -> PoseLog:
        """Returns truth and estimate over time."""
        t, estimate = self.log("estimator.pose", context)
        covariance = self.log("estimator.covariance", context)[1].reshape(-1, 3, 3)
        truth = self.log(f"truth.{ROBOT}.pose", context)[1] if self._has_truth else None
        return PoseLog(t, truth, estimate, covariance, covariance[:, 0, 0] < UNKNOWN)

    def write(self, context: Context, out: Path) -> None:
        """Writes `summary.png`, `truth.tum` and `estimate.tum`."""
        log = self.pose_log(context)
        write_tum(out / "estimate.tum", log.t[log.known], log.estimate[log.known])
        if log.truth is not None:
            write_tum(out / "truth.tum", log.t, log.truth)
        plot_navigation(
            out / "summary.png",
            log,
            waypoints=np.array(self._scenario.waypoints),
            radius=self._scenario.arrival_radius,
            walls=self._scenario.world.arena.walls,
            markers=self.station.marker_map,
        )


def _connect(wiring: Wiring, scenario: NavigationScenario) -> None:
    wiring.connect(f"{ROBOT}.{scenario.camera}.detections", "localizer.detections")
    # An estimator or a controller may do without some of what there is.
    wiring.connect_if_wanted(f"{ROBOT}.drive.sent", "estimator.command")
    wiring.connect_if_wanted(f"{ROBOT}.{scenario.imu}.sample", "estimator.imu")
    wiring.connect_if_wanted("localizer.pose", "estimator.marker_pose")
    wiring.connect_if_wanted("localizer.alternative", "estimator.marker_alternative")
    wiring.connect("estimator.pose", "sequencer.pose")
    wiring.connect_if_wanted("estimator.pose", "controller.pose")
    wiring.connect_if_wanted("sequencer.goal", "controller.goal")
    wiring.connect("controller.command", "search.command")
    wiring.connect("estimator.covariance", "search.covariance")
    wiring.connect("search.command", f"{ROBOT}.drive.command")


def _show(wiring: Wiring, scenario: NavigationScenario, meshcat: Meshcat, has_truth: bool) -> None:
    wiring.add(
        EstimateViewer(
            meshcat=meshcat,
            body=scenario.robot.body.build().parameters,
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


def _estimate_to_tf(value: np.ndarray, t: float) -> Any:
    X_WB = spatial_pose(value[:3])
    return transforms_to_ros([FrameTransform(t, "map", f"{ROBOT}/base_link", X_WB)])
