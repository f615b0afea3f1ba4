"""The blocks between the devices of a robot on a shell: markers, flow, estimator, steering."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context
from pydrake.systems.primitives import ConstantVectorSource, Multiplexer

from diagrams.channels import shell_estimate_signal
from diagrams.mission import FRAME_RATE, LOG_RATE, Wiring
from diagrams.shell_viewer import ShellViewer
from diagrams.shell_world import REFERENCE
from plants.relative_pose import RelativePose
from systems.controllers.shell_route import Leg, ShellRoute
from systems.estimators.madgwick import Madgwick
from systems.estimators.reference_motion import CarriedShellMotion, KnownShellMotion
from systems.flow.mean_flow import MeanFlow
from systems.flow.sphere_flow import SphereFlow, SphereFlowEstimator
from systems.markers.markers_seen import MarkersSeen
from systems.pose_vector import PoseFromVector, PoseToVector
from systems.sensors.pose_outliers import PoseOutliers
from systems.shell.marker_pose import ShellMarkerPose, shell_localizer

if TYPE_CHECKING:
    from diagrams.snailbot import SnailBotScenario

_MARGIN_RATE = 10.0  # Hz: it changes with the place, by a millimetre or so in between


class ShellRobot:
    """Adds the blocks of one robot, and asks them.

    Args:
        wiring: has the station.
        scenario: which blocks, and their parameters.
        name: of the robot.
        number: in the team, from 1; blocks of the second and later ones bear it.
        legs: what it drives; empty: it stands.
        speed: along them, m/s; None for the scenario's.
        carrier: the robot on whose shell it stands; None for the reference robot.

    Raises:
        ScenarioError: a block that is refused, or does not fit.
    """

    def __init__(
        self,
        wiring: Wiring,
        scenario: SnailBotScenario,
        *,
        name: str,
        number: int,
        legs: list[Leg],
        speed: float | None,
        carrier: ShellRobot | None,
    ) -> None:
        self.name = name
        self.legs = legs
        self.body = wiring.station.robots[name]
        self.camera = self.body.sensors[scenario.camera].build()
        self.has_truth = wiring.has_output(f"truth.{name}.pose")
        self._wiring = wiring
        self._scenario = scenario
        self._suffix = f"_{number}" if number > 1 else ""
        self._carrier = carrier
        self._view = self.camera.planned_view(scenario.world.shell.radius)
        self._add_marker_pose()
        self._add_estimator()
        self._add_motion_sensing()
        self._add_reference()
        self._add_steering(speed)
        self._log_and_record()

    def block(self, name: str) -> str:
        """Returns the name of one of its blocks in the diagram."""
        return f"{name}{self._suffix}"

    def value(self, port: str, context: Context) -> Any:
        """Returns what an output of one of its blocks says: `{block}.{port}`."""
        block, _, port = port.partition(".")
        return self._wiring.value(f"{self.block(block)}.{port}", context)

    def finished(self, context: Context) -> bool:
        """Whether it has driven its route; at once when it stands."""
        return not self.legs or bool(self.value("route.progress", context)[0] >= len(self.legs))

    def detached(self, context: Context) -> bool:
        """Whether it has come off the shell."""
        port = f"truth.{self.name}.detached"
        return self._wiring.has_output(port) and bool(self._wiring.value(port, context)[0] > 0)

    def _add(self, system: Any, name: str) -> Any:
        return self._wiring.add(system, self.block(name))

    def _connect(self, source: str, target: str, *, if_wanted: bool = False) -> None:
        """Connects `{block}.{port}` of this robot, or a port of the station, to such an input."""
        connect = self._wiring.connect_if_wanted if if_wanted else self._wiring.connect
        if not source.startswith((f"{self.name}.", "truth.", f"{REFERENCE}.")):
            block, _, port = source.partition(".")
            source = f"{self.block(block)}.{port}"
        block, _, port = target.partition(".")
        connect(source, f"{self.block(block)}.{port}")

    def _wants(self, port: str) -> bool:
        return bool(self.estimator.HasInputPort(port))

    def _sensor(self, port: str) -> str:
        device = self._scenario.imu if port == "sample" else self._scenario.camera
        return f"{self.name}.{device}.{port}"

    def _add_marker_pose(self) -> None:
        scenario, station = self._scenario, self._wiring.station
        localizer = shell_localizer(
            marker_map=station.marker_map,
            camera=self._view.camera,
            X_BC=self.camera.planned_mounting(self.body),
            parameters=scenario.localizer,
            marker_rotation=scenario.marker_rotation,
        )
        rate = self.camera.rate
        self._add(ShellMarkerPose(localizer=localizer, rate=rate), "marker_pose")
        self._add(MarkersSeen(marker_map=station.marker_map, rate=rate), "seen")
        for block in ("marker_pose", "seen"):
            self._connect(self._sensor("detections"), f"{block}.detections")
        errors = scenario.bounds()
        self._poses = "marker_pose.pose"
        if errors is not None and errors.outliers > 0 and station.simulated:
            self._add(
                PoseOutliers(
                    probability=errors.outliers,
                    angle=errors.outlier_angle,
                    seed=scenario.seed,
                    rate=rate,
                    name=f"{self.name}.outliers",
                ),
                "outliers",
            )
            self._connect("marker_pose.pose", "outliers.pose")
            self._poses = "outliers.told"

    def _add_estimator(self) -> None:
        scenario = self._scenario
        parameters = self.body.body.parameters
        imu = scenario.robot.sensors[scenario.imu].build()
        self.estimator = self._add(
            scenario.estimator.build(
                view=self._view,
                marker_map=self._wiring.station.marker_map,
                radius=scenario.world.shell.radius,
                height=parameters.clearance,
                rate=imu.rate,
            ),
            "estimator",
        )
        self._connect(self._poses, "estimator.marker_pose")
        self._connect(self._sensor("sample"), "estimator.imu", if_wanted=True)

    def _add_motion_sensing(self) -> None:
        """Adds the flow and the attitude filter, as far as the estimator wants them."""
        scenario, rate = self._scenario, self.camera.rate
        if self._wants("increment"):
            estimator = SphereFlowEstimator(view=self._view, parameters=scenario.sphere_flow)
            self._add(SphereFlow(estimator=estimator, rate=rate), "sphere_flow")
            self._connect(self._sensor("matches"), "sphere_flow.matches")
            self._connect("sphere_flow.increment", "estimator.increment")
        if self._wants("flow"):
            self._add(MeanFlow(view=self._view, rate=rate), "mean_flow")
            self._connect(self._sensor("matches"), "mean_flow.matches")
            self._connect(self._sensor("sample"), "mean_flow.imu")
            self._connect("mean_flow.velocity", "estimator.flow")
        if self._wants("orientation"):
            imu = scenario.robot.sensors[scenario.imu].build()
            self._add(Madgwick(parameters=scenario.attitude, rate=imu.rate), "attitude")
            self._connect(self._sensor("sample"), "attitude.imu")
            self._connect("attitude.orientation", "estimator.orientation")

    def _add_reference(self) -> None:
        """Adds what tells the estimator how the shell under the robot moves, if it does."""
        wiring = self._wiring
        if not self._wants("reference_velocity"):
            return
        if self._carrier is not None:
            self._add(CarriedShellMotion(), "shell_motion")
            wiring.connect(
                f"{self._carrier.name}.{self._scenario.imu}.sample",
                f"{self.block('shell_motion')}.imu",
            )
            calibration = f"{self._carrier.block('estimator')}.calibration"
            if wiring.has_output(calibration):
                wiring.connect(calibration, f"{self.block('shell_motion')}.calibration")
        elif wiring.has_output(f"{REFERENCE}.pose"):
            self._add(KnownShellMotion(), "shell_motion")
            for port in ("pose", "spatial_velocity"):
                self._connect(f"{REFERENCE}.{port}", f"shell_motion.{port}")
        else:
            return
        self._connect("shell_motion.reference_velocity", "estimator.reference_velocity")

    def _add_steering(self, speed: float | None) -> None:
        command = f"{self.name}.drive.command"
        if not self.legs:
            still = self._add(ConstantVectorSource([0.0, 0.0]), "still")
            self._wiring.builder.Connect(still.get_output_port(), self._wiring.input(command))
            return
        scenario = self._scenario
        parameters = scenario.steering
        if speed is not None:
            slowest = min(parameters.min_speed, speed)
            parameters = replace(parameters, speed=speed, min_speed=slowest)
        self._add(
            ShellRoute(
                legs=self.legs,
                radius=scenario.world.shell.radius,
                parameters=parameters,
                rate=self.camera.rate,
            ),
            "route",
        )
        if scenario.drive_on == "truth" and self.has_truth:
            self._add(PoseFromVector(), "true_pose")
            self._connect(f"truth.{self.name}.pose", "true_pose.vector")
            self._connect("true_pose.pose", "route.pose")
        else:
            self._connect("estimator.pose", "route.pose")
        self._wiring.connect(f"{self.block('route')}.command", command)

    def _log_and_record(self) -> None:
        wiring = self._wiring
        self._add(PoseToVector(), "estimate_vector")
        self._connect("estimator.pose", "estimate_vector.pose")
        self._add(Multiplexer([7, 36]), "estimate")
        for index, port in enumerate(("estimate_vector.vector", "estimator.covariance")):
            block, _, name = port.partition(".")
            wiring.builder.Connect(
                wiring.output(f"{self.block(block)}.{name}"),
                wiring.input(f"{self.block('estimate')}.u{index}"),
            )
        for port in ("estimate.y0", "seen.seen", "route.progress", "estimator.nis"):
            block, _, name = port.partition(".")
            if wiring.has_output(f"{self.block(block)}.{name}"):
                wiring.log(f"{self.block(block)}.{name}")
        for port, rate in (("pose", LOG_RATE), ("margin", _MARGIN_RATE)):
            if wiring.has_output(f"truth.{self.name}.{port}"):
                wiring.log(f"truth.{self.name}.{port}", rate)
        signal = shell_estimate_signal(self.name, rate=50.0)
        wiring.record(f"{self.block('estimate')}.y0", signal)

    def show(self, meshcat: Meshcat) -> None:
        """Adds what shows the estimate, its covariance and the paths."""
        wiring, parameters = self._wiring, self.body.body.parameters
        self._add(
            ShellViewer(
                meshcat=meshcat,
                body=parameters,
                shell=self._scenario.world.shell,
                rate=FRAME_RATE,
                name=self.name,
            ),
            "viewer",
        )
        for port in ("pose", "covariance"):
            self._connect(f"estimator.{port}", f"viewer.{port}")
        if self.has_truth:
            if not wiring.has_block(self.block("true_pose")):
                self._add(PoseFromVector(), "true_pose")
                self._connect(f"truth.{self.name}.pose", "true_pose.vector")
            self._connect("true_pose.pose", "viewer.truth")
        shell = wiring.station.shells.get(self.body.on)
        if shell is not None:
            world = wiring.station.scene_graph.world_frame_id()
            self._add(RelativePose(parent=world, child=shell.frame_id), "shell_pose")
            wiring.connect("scene.query_object", f"{self.block('shell_pose')}.query_object")
            self._connect("shell_pose.pose", "viewer.reference_pose")
