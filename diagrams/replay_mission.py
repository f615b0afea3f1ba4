"""The wired diagram of a replay: its outcome, its metrics, its results.

camera -> localizer -> filter -> tracker -> supervisor -> drive
encoders, gyro -^        lidar -> clearance -^
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context
from pydrake.systems.primitives import Multiplexer

from diagrams.channels import estimate_signal, planar_frames
from diagrams.metrics import PoseLog, nis_mean, path_length, pose_metrics
from diagrams.mission import FRAME_RATE, Mission, Wiring
from diagrams.replay_log import ReplayLog, replay_metrics
from diagrams.replay_viewer import show_route
from diagrams.tables import Choice
from diagrams.trajectories import write_tum
from diagrams.viewer import EstimateViewer
from systems.controllers.path_tracking import TrackingParameters
from systems.controllers.replay_supervisor import STATUSES, ReplaySupervisor
from systems.controllers.wheel_drive import WheelDriveParameters
from systems.estimators.planar_kalman import UNKNOWN
from systems.io.ros_types import message_class
from systems.markers.layout import MarkerMap
from systems.markers.localizer import Localizer, MapLocalizer
from systems.markers.markers_seen import MarkersSeen
from systems.planners.route import Route
from systems.planners.route_clearance import RouteClearance

if TYPE_CHECKING:
    from diagrams.replay import ReplayScenario
    from diagrams.teach_replay import TeachReplayScenario

ROBOT = "limo"
_RATE = 20.0  # Hz, of tracker and supervisor unless the scenario says otherwise
_AFTER = 0.001  # s, by which the supervisor looks later than the tracker
# Statuses in which a robot that has no time left has failed for that reason.
_STUCK = ("lost", "doubtful", "off_route", "blind_ahead", "blocked")


class ReplayMission(Mission):
    """The wired diagram of a scenario with the keys of `ReplayKeys`.

    Args:
        scenario: robot, world, blocks.
        known: the tags as the robot knows them.
        route: what to follow.
        meshcat: where it is shown, if anywhere.
        out: folder of the run; None records nothing.
    """

    def __init__(
        self,
        scenario: ReplayScenario | TeachReplayScenario,
        *,
        known: MarkerMap,
        route: Route,
        meshcat: Meshcat | None,
        out: Path | None,
    ) -> None:
        wiring = Wiring(
            scenario, world=scenario.world, robots={ROBOT: scenario.robot}, meshcat=meshcat
        )
        self.station = wiring.station
        self._scenario, self._wiring, self.route, self.known = scenario, wiring, route, known
        self._truth = f"truth.{ROBOT}.pose"
        self._has_truth = wiring.has_output(self._truth)
        self._add_blocks()
        self._connect()
        self._log_and_record()
        if meshcat is not None:
            self._show(meshcat)
        self.recorder = wiring.add_recorder(out)
        self.diagram, self.logs = wiring.build("replay")

    def _add_blocks(self) -> None:
        scenario, wiring = self._scenario, self._wiring
        camera = scenario.robot.sensors[scenario.camera].build()
        localizer = MapLocalizer(
            marker_map=self.known,
            camera=camera.model(),
            X_BC=camera.mounting(),
            parameters=scenario.localizer,
        )
        wiring.add(Localizer(localizer=localizer, rate=camera.rate), "localizer")
        wiring.add(MarkersSeen(marker_map=self.known, rate=camera.rate, enough=2), "tags_seen")
        wiring.add(scenario.estimator.build(), "estimator")
        wiring.add(scenario.robot.sensors[scenario.encoders].build().speeds(), "wheel_speeds")
        controller = _within_drive(scenario.controller, scenario.robot.drive.build().parameters)
        wiring.add(controller.build(route=self.route, laps=scenario.laps), "tracker")
        rate = scenario.controller.arguments.get("rate", _RATE)
        supervisor = ReplaySupervisor(parameters=scenario.supervisor, rate=rate, offset=_AFTER)
        wiring.add(supervisor, "supervisor")
        if scenario.lidar is not None:
            lidar = scenario.robot.sensors[scenario.lidar].build()
            front, _, half_width = scenario.robot.body.build().hull
            wiring.add(
                RouteClearance(
                    route=self.route,
                    lidar_pose=lidar.planar_mounting(),
                    parameters=replace(scenario.clearance, front=front, half_width=half_width),
                    rate=rate,
                ),
                "clearance",
            )

    def _connect(self) -> None:
        scenario, wiring = self._scenario, self._wiring
        detections = f"{ROBOT}.{scenario.camera}.detections"
        wiring.connect(detections, "localizer.detections")
        wiring.connect(detections, "tags_seen.detections")
        # An estimator or a controller may do without some of what there is.
        wiring.connect_if_wanted(f"{ROBOT}.drive.sent", "estimator.command")
        wiring.connect_if_wanted(f"{ROBOT}.{scenario.imu}.sample", "estimator.imu")
        wiring.connect(f"{ROBOT}.{scenario.encoders}.ticks", "wheel_speeds.ticks")
        wiring.connect_if_wanted("wheel_speeds.wheel_speeds", "estimator.wheel_speeds")
        wiring.connect_if_wanted("localizer.pose", "estimator.marker_pose")
        wiring.connect_if_wanted("localizer.alternative", "estimator.marker_alternative")
        wiring.connect("estimator.pose", "tracker.pose")
        wiring.connect_if_wanted("estimator.covariance", "tracker.covariance")
        wiring.connect_if_wanted(f"{ROBOT}.drive.sent", "tracker.sent")
        wiring.connect("tracker.command", "supervisor.command")
        wiring.connect("tracker.state", "supervisor.tracking")
        wiring.connect("estimator.covariance", "supervisor.covariance")
        wiring.connect("estimator.health", "supervisor.estimator_health")
        if scenario.lidar is not None:
            wiring.connect("estimator.pose", "clearance.pose")
            wiring.connect("tracker.state", "clearance.tracking")
            wiring.connect(f"{ROBOT}.{scenario.lidar}.scan", "clearance.scan")
            wiring.connect("clearance.free_distance", "supervisor.free_distance")
        wiring.connect("supervisor.command", f"{ROBOT}.drive.command")

    def _log_and_record(self) -> None:
        wiring = self._wiring
        together = wiring.add(Multiplexer([3, 9]), "estimate")
        for index, port in enumerate(("pose", "covariance")):
            wiring.builder.Connect(
                wiring.output(f"estimator.{port}"), together.get_input_port(index)
            )
        names = ["estimator.pose", "estimator.covariance", "supervisor.verdict", "tags_seen.seen"]
        truth = [f"truth.{ROBOT}.{kind}" for kind in ("pose", "clearance", "contacts")]
        for name in [*names, *filter(wiring.has_output, ["estimator.nis", *truth])]:
            wiring.log(name)
        signal = estimate_signal(ROBOT, rate=50.0)
        wiring.record("estimate.y0", signal)
        frames = planar_frames([f"{ROBOT}/base_link"])
        wiring.record("estimate.y0", replace(signal, port="tf", topic="/tf", encode=frames))
        wiring.record(
            "supervisor.verdict",
            replace(
                signal, port="status", topic=f"/{ROBOT}/replay_status", encode=_status, model=6,
                rate=10.0,
            ),
        )  # fmt: skip

    def _show(self, meshcat: Meshcat) -> None:
        scenario, wiring = self._scenario, self._wiring
        show_route(meshcat, self.route, self.known)
        wiring.add(
            EstimateViewer(
                meshcat=meshcat,
                ghost=scenario.robot.body.build().ghost(),
                waypoints=np.zeros((0, 2)),
                radius=1.0,
                rate=FRAME_RATE,
                show_truth=self._has_truth,
            ),
            "viewer",
        )
        wiring.connect("estimator.pose", "viewer.pose")
        wiring.connect("estimator.covariance", "viewer.covariance")
        if self._has_truth:
            wiring.connect(self._truth, "viewer.truth")

    def outcome(self, context: Context) -> str | None:
        """Returns `replayed` once the laps are driven; `contact` if anything was touched."""
        if self._wiring.value("tracker.state", context).status != "arrived":
            return None
        return "contact" if self._touched(context) else "replayed"

    def unfinished(self, context: Context, word: str) -> str:
        """Returns why a robot stood when its time was up, if it did."""
        if self._touched(context):
            return "contact"
        status = STATUSES[int(self._wiring.value("supervisor.verdict", context)[1])]
        return status if status in _STUCK and word == "timeout" else word

    def _touched(self, context: Context) -> bool:
        name = f"truth.{ROBOT}.contacts"
        return self._wiring.has_output(name) and self._wiring.value(name, context)[0] > 0

    def succeeded(self, outcome: str) -> bool:
        """Whether the route was driven to its end."""
        return outcome in ("replayed", "played")

    def metrics(self, context: Context) -> dict[str, Any]:
        """Returns the metrics (see `diagrams.replay_log`)."""
        log = self.replay_log(context)
        nis = self.log("estimator.nis", context)[1] if "estimator.nis" in self.logs else None
        driven = log.poses.estimate[log.poses.known] if log.poses.truth is None else log.poses.truth
        return {
            **replay_metrics(log),
            **pose_metrics(log.poses),
            "nis_mean": None if nis is None else nis_mean(nis),
            "path_length_m": path_length(driven[:, :2]),
            "contacts": int(self._wiring.value(f"truth.{ROBOT}.contacts", context)[0])
            if self._wiring.has_output(f"truth.{ROBOT}.contacts")
            else None,
        }

    def replay_log(self, context: Context) -> ReplayLog:
        """Returns what the run left."""
        t, estimate = self.log("estimator.pose", context)
        covariance = self.log("estimator.covariance", context)[1].reshape(-1, 3, 3)
        truth = self.log(self._truth, context)[1] if self._has_truth else None
        poses = PoseLog(t, truth, estimate, covariance, covariance[:, 0, 0] < UNKNOWN)
        return ReplayLog(
            poses=poses,
            verdict=self.log("supervisor.verdict", context)[1],
            two_tag_fraction=float(self._wiring.value("tags_seen.seen", context)[2]),
            route=self.route,
            tags=self._scenario.world.true_markers(self._scenario.seed),
            arrived=self._wiring.value("tracker.state", context).status == "arrived",
        )

    def write(self, context: Context, out: Path) -> None:
        """Writes `summary.png`, `truth.tum`, `estimate.tum`, and what was followed."""
        from diagrams.replay_plots import plot_replay  # loads Matplotlib

        log = self.replay_log(context)
        poses = log.poses
        write_tum(out / "estimate.tum", poses.t[poses.known], poses.estimate[poses.known])
        if poses.truth is not None:
            write_tum(out / "truth.tum", poses.t, poses.truth)
        self.route.save(out / "route.json")
        self.known.save(out / "map.json")
        plot_replay(out / "summary.png", log, known=self.known)


def _within_drive(controller: Choice, drive: WheelDriveParameters) -> Choice:
    """Returns the tracker with no more speed and acceleration than the drive allows."""
    own = controller.arguments.get("parameters")
    if not isinstance(own, TrackingParameters):
        return controller
    names = ("max_speed", "max_turn_rate", "max_acceleration", "max_turn_acceleration")
    limits = {name: min(getattr(own, name), getattr(drive, name)) for name in names}
    least = max(own.min_speed, -limits["max_speed"])
    known = replace(own, min_speed=least, **limits)
    return replace(controller, arguments=controller.arguments | {"parameters": known})


def _status(value: np.ndarray, _: float) -> Any:
    return message_class("std_msgs/msg/String")(STATUSES[int(value[1])])
