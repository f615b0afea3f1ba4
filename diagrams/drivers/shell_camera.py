"""Driver of a camera that looks down at a shell: pictures, markers, and points that move."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import OutputPort

from diagrams.channels import matches_signal
from diagrams.drivers.camera import CameraDriver, View
from diagrams.schema import ScenarioError
from diagrams.shell_world import ShellWorldParameters
from diagrams.station import Robot, StationBuilder
from plants.relative_pose import RelativePose
from systems.drawing.shells import DrawnShell
from systems.flow.lucas_kanade import LucasKanadeParameters, PointTracker
from systems.flow.projector import FlowProjector, FlowProjectorParameters
from systems.flow.shell import ShellView, ShellViewParameters
from systems.markers.pnp import rotation_from_vector
from systems.markers.projector import placed_markers
from systems.noise import generator, stream_key
from systems.sensors.missed_passages import MissedPassages
from systems.validation import require, require_non_negative, require_positive

CLIPPING = (0.001, 0.1)  # m: the shell is some millimetres away, and all there is to see
_ROOM = 0.002  # m, between the optical centre and the shell: the lens


@dataclass(kw_only=True)
class ShellCamera(CameraDriver):
    """A calibrated camera under the robot; see `CameraDriver`.

    A further port of the station: `{robot}.{device}.matches` (PointMatches): points of the shell
    found in two pictures, by Lucas-Kanade; under projected sight, from the true motion.

    What is wrong with it (`mounting_tolerance_deg`, `height_tolerance`) is drawn by the seed.

    Attributes:
        height: of the optical centre over the shell, m.
        tilt_deg: how it is turned away from straight down, a rotation vector in base_link.
        flow: how points are found again in pictures.
        flow_projector: how they are without pictures.
        imu: which of the robot's sensors helps to predict where points go; it comes before the
            camera in the list. Empty for none.
        processing_time: from the arrival of a picture to its matches, s.
        mounting_tolerance_deg: the camera is turned about its own centre by up to so much, each
            axis, and nobody knows.
        height_tolerance: it is nearer to the shell or farther by up to such a part.
        missed_passages: part of the passages over a marker in which it is not found at all.
    """

    rate: float = 60.0
    height: float = 0.010
    tilt_deg: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    flow: LucasKanadeParameters = field(default_factory=LucasKanadeParameters)
    flow_projector: FlowProjectorParameters = field(default_factory=FlowProjectorParameters)
    imu: str = "imu"
    processing_time: float = 0.005
    mounting_tolerance_deg: float = 0.0
    height_tolerance: float = 0.0
    missed_passages: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(height=self.height)
        require(
            self.height >= _ROOM,
            "height",
            self.height,
            f"at least {_ROOM:g} m: nearer, the camera touches the shell",
        )
        require(
            len(self.tilt_deg) == 3 and bool(np.isfinite(self.tilt_deg).all()),
            "tilt_deg",
            self.tilt_deg,
            "three numbers",
        )
        require_non_negative(
            processing_time=self.processing_time,
            mounting_tolerance_deg=self.mounting_tolerance_deg,
        )
        require(
            self.processing_time < 1 / self.rate,
            "processing_time",
            self.processing_time,
            f"less than {1 / self.rate:g} s, the time between two pictures",
        )
        tolerance = self.height_tolerance
        require(0 <= tolerance < 0.5, "height_tolerance", tolerance, "from 0 to less than 0.5")
        require(0 <= self.missed_passages <= 1, "missed_passages", self.missed_passages, "0 to 1")

    def planned_view(self, radius: float) -> ShellView:
        """Returns the camera as the robot believes it to be, over a shell of that radius (m)."""
        tilt = [math.radians(angle) for angle in self.tilt_deg]
        return ShellView(
            camera=self.model(),
            parameters=ShellViewParameters(
                radius=radius, camera_height=self.height, camera_tilt=tilt
            ),
        )

    def planned_mounting(self, robot: Robot) -> RigidTransform:
        """Returns `X_BC` as the robot believes it to be."""
        body = robot.body
        X_SC = self.planned_view(body.shell.radius).X_SC
        return RigidTransform(X_SC.rotation(), [0.0, 0.0, self.height - body.parameters.clearance])

    def true_mounting(self, robot: Robot, seed: int) -> RigidTransform:
        """Returns `X_BC` with what is wrong with it."""
        planned = self.planned_mounting(robot)
        random = generator(stream_key(seed, f"{robot.name} camera mounting"), 0)
        bound = math.radians(self.mounting_tolerance_deg)
        turn = RotationMatrix(rotation_from_vector(random.uniform(-bound, bound, 3)))
        scale = 1 + random.uniform(-self.height_tolerance, self.height_tolerance)
        shift = self.height / scale - self.height
        return RigidTransform(
            turn @ planned.rotation(), planned.translation() + np.array([0.0, 0.0, shift])
        )

    def view(self, station: StationBuilder, robot: Robot) -> View:
        """Returns the shell that the robot stands on."""
        world = station.world
        assert isinstance(world, ShellWorldParameters)
        host = station.shells[robot.on]
        shell = DrawnShell(host.frame_id, world.shell.radius, host.markers, parameters=world.looks)
        plant = station.plant
        own = [plant.GetBodyFrameIdOrThrow(i) for i in plant.GetBodyIndices(robot.model)]
        return View(
            X_BC=self.true_mounting(robot, station.seed),
            markers=placed_markers(host.markers, host.frame_id),
            own_frames=[*own, robot.frame_id],
            shells=[shell],
            clipping=CLIPPING,
        )

    def add(self, station: StationBuilder, robot: Robot, device: str) -> None:
        """Wires the camera into a station."""
        super().add(station, robot, device)
        name = f"{robot.name}.{device}"
        signal = matches_signal(name, self.rate)
        station.export_output(self._matches(station, robot, name), signal.port, signal)

    def _seen(self, station: StationBuilder, name: str, detections: OutputPort) -> OutputPort:
        """Returns the detections without the passages that are missed."""
        if not (station.simulated and self.missed_passages):
            return detections
        missed = station.add(
            MissedPassages(
                probability=self.missed_passages, seed=station.seed, rate=self.rate, name=name
            ),
            f"{name}.missed_passages",
        )
        station.connect(detections, missed.detections_input_port())
        port: OutputPort = missed.seen_output_port()
        return port

    def _matches(self, station: StationBuilder, robot: Robot, name: str) -> OutputPort:
        image = station.outputs[f"{name}.image"]
        if not station.simulated and not self._plays_pictures(station, name):
            port: OutputPort = station.play(matches_signal(name, self.rate))
            return port
        if station.simulated and (self.sight or station.sight) == "projected":
            return self._projected(station, robot, name)
        flow = station.add(
            PointTracker(
                view=self.planned_view(robot.body.shell.radius),
                parameters=self.flow,
                rate=self.rate,
                processing_time=self.processing_time,
                imu_rate=getattr(self._imu(robot), "rate", 300.0),
            ),
            f"{name}.flow",
        )
        station.connect(image, flow.image_input_port())
        sample = f"{robot.name}.{self.imu}.sample"
        if self._imu(robot) is not None:
            if sample not in station.outputs:
                raise ScenarioError(f"{robot.name}.sensors: {self.imu} must stand before {name}")
            station.connect(station.outputs[sample], flow.imu_input_port())
        station.export_output(flow.health_output_port(), f"{name}.flow_health")
        return flow.matches_output_port()

    def _imu(self, robot: Robot) -> Any:
        if not self.imu:
            return None
        if self.imu not in robot.sensors:
            known = ", ".join(robot.sensors)
            raise ScenarioError(
                f"{robot.name}.sensors: imu is {self.imu!r}: must be one of {known}, or empty"
            )
        return robot.sensors[self.imu].build()

    def _projected(self, station: StationBuilder, robot: Robot, name: str) -> OutputPort:
        X_RC = station.add(
            RelativePose(
                parent=station.shells[robot.on].frame_id,
                child=robot.frame_id,
                X_CF=self.true_mounting(robot, station.seed),
            ),
            f"{name}.pose",
        )
        station.connect(station.scene_graph.get_query_output_port(), X_RC.query_object_input_port())
        projector = station.add(
            FlowProjector(
                camera=self.model(),
                radius=robot.body.shell.radius,
                parameters=self.flow_projector,
                rate=self.rate,
                latency=self.latency,
                clock_error=self.clock_error,
                seed=station.seed,
                name=f"{name}.flow",
                frame_id=name.replace(".", "/"),
            ),
            f"{name}.flow",
        )
        station.connect(X_RC.pose_output_port(), projector.pose_input_port())
        port: OutputPort = projector.matches_output_port()
        return port
