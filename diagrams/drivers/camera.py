"""Drivers of cameras: rendered, drawn, projected, or played back; always with their detections."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from itertools import chain
from typing import Annotated, Any, Literal

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import FrameId
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.framework import OutputPort
from pydrake.systems.primitives import ConstantValueSource, PassThrough

from diagrams.channels import detections_signal, image_signal, topic_of
from diagrams.schema import File, ScenarioError, file_path
from diagrams.station import RENDERER, Robot, StationBuilder
from systems.cameras import PinholeCamera, load_camera
from systems.drawing.shells import DrawnShell
from systems.image_effects import ImageEffects
from systems.io.ros_vision import camera_to_ros, image_from_ros
from systems.markers.detector import Detector, DetectorParameters, MarkerDetector
from systems.markers.projector import (
    MarkerProjector,
    PlacedMarker,
    ProjectorParameters,
    placed_markers,
)
from systems.messages import CameraImage, Health
from systems.sensors.drawn_camera import DrawnCamera
from systems.sensors.rendered_camera import RenderedCamera
from systems.validation import require, require_non_negative, require_positive

# Columns: the optical frame's axes (right, down, forward) in a frame with x forward and z up.
R_FORWARD_OPTICAL = RotationMatrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))


@dataclass(frozen=True, eq=False)
class View:
    """What a simulated camera sees.

    Attributes:
        X_BC: true pose of the optical frame in base_link.
        markers: boards, flat or bent.
        own_frames: the robot's own geometry, which hides nothing.
        shells: what is drawn in place of flat boards, if anything.
        clipping: nearest and farthest distance that is seen, m.
    """

    X_BC: RigidTransform
    markers: list[PlacedMarker]
    own_frames: list[FrameId]
    shells: list[DrawnShell] = field(default_factory=list)
    clipping: tuple[float, float] = (0.01, 50.0)


@dataclass(kw_only=True)
class CameraDriver(ABC):
    """What all cameras on robots have; where one is mounted, and what it sees, its own class says.

    Ports of the station: `{robot}.{device}.image` (CameraImage; of size 0 when there are none, as
    under projected sight), `{robot}.{device}.detections` (Detections), `{robot}.{device}.health`;
    an input `{robot}.{device}.active` (vector of 1): while it is 0 no pictures are taken, of a
    simulated camera; it may be left unconnected.

    Attributes:
        calibration: camera file (bundled, or beside the scenario).
        rate: pictures a second, Hz.
        latency: from the middle of the exposure to the arrival of the picture, s.
        clock_error: its stamps are so late, s; at most its latency.
        sight: `rendered`, `drawn` or `projected`; left out, the scenario's.
        effects: what lens and sensor do to pictures.
        detector: how markers are found in pictures.
        projector: how markers are found without pictures.
    """

    calibration: Annotated[str, File("cameras")]
    rate: float = 15.0
    latency: float = 0.0
    clock_error: float = 0.0
    sight: Literal["rendered", "drawn", "projected"] | None = None
    effects: ImageEffects = field(default_factory=ImageEffects)
    detector: DetectorParameters = field(default_factory=DetectorParameters)
    projector: ProjectorParameters = field(default_factory=ProjectorParameters)

    def __post_init__(self) -> None:
        require_positive(rate=self.rate)
        require_non_negative(latency=self.latency, clock_error=self.clock_error)
        require(
            self.clock_error <= self.latency,
            "clock_error",
            self.clock_error,
            f"at most the latency, {self.latency:g} s: pictures do not come from the future",
        )

    def model(self) -> PinholeCamera:
        """Returns the calibrated camera."""
        return load_camera(file_path(self.calibration, "cameras"))

    @abstractmethod
    def planned_mounting(self, robot: Robot) -> RigidTransform:
        """Returns `X_BC`, the pose of the optical frame in base_link, as the robot knows it."""

    @abstractmethod
    def view(self, station: StationBuilder, robot: Robot) -> View:
        """Returns what there is to see, and from where."""

    def add(self, station: StationBuilder, robot: Robot, device: str) -> None:
        """Wires the camera into a station."""
        name = f"{robot.name}.{device}"
        camera = self.model()
        frame_id = name.replace(".", "/")
        station.static_messages[topic_of(f"{name}.camera_info")] = (
            "sensor_msgs/msg/CameraInfo",
            camera_to_ros(camera, stamp=0.0, frame_id=frame_id),
        )
        station.mountings[frame_id] = (robot.name, self.planned_mounting(robot))
        images, found = image_signal(name, self.rate), detections_signal(name, self.rate)
        image, detections = self._sources(station, robot, name, camera)
        if image is None:
            if images.port in station.faults:
                raise ScenarioError(f"faults: there are no pictures here; let {found.port} fail")
            no_image = ConstantValueSource(AbstractValue.Make(CameraImage(frame_id=frame_id)))
            image = station.add(no_image, f"{name}.no_image").get_output_port()
        image = station.spoiled(image, images)
        if detections is None:
            detector = station.add(
                Detector(
                    detector=MarkerDetector(
                        family=station.marker_map.family,
                        parameters=self.detector,
                        camera=camera,
                    ),
                    rate=self.rate,
                ),
                f"{name}.detector",
            )
            station.connect(image, detector.image_input_port())
            detections = detector.detections_output_port()
            station.export_output(detector.health_output_port(), f"{name}.health")
        else:
            health = ConstantValueSource(AbstractValue.Make(Health()))
            station.add(health, f"{name}.no_health")
            station.export_output(health.get_output_port(), f"{name}.health")
        station.export_output(image, images.port, images)
        station.export_output(self._seen(station, name, detections), found.port, found)

    def _seen(self, station: StationBuilder, name: str, detections: OutputPort) -> OutputPort:
        """Returns the port of the detections as the robot gets them: all, unless one knows more."""
        del station, name
        return detections

    def _check_recorded_size(
        self, station: StationBuilder, name: str, camera: PinholeCamera
    ) -> None:
        """Raises `ScenarioError` when the recorded pictures are not of the calibration's size."""
        assert station.player is not None
        info, pictures = topic_of(f"{name}.camera_info"), image_signal(name, self.rate).topic
        for topic in [t for t in (info, pictures) if t in station.player.topics()][:1]:
            message = next(station.player.messages([topic]))[2]
            if topic == info:
                width, height = message.width, message.height
            else:
                height, width = image_from_ros(message).data.shape[:2]
            if (width, height) != (camera.width, camera.height):
                raise ScenarioError(
                    f"camera file {self.calibration} is for pictures of {camera.width}x"
                    f"{camera.height}: {topic} of the recording is of {width}x{height}"
                )

    def _plays_pictures(self, station: StationBuilder, name: str) -> bool:
        """Whether the recording that is played has pictures, for the detector to look at."""
        assert station.player is not None
        return image_signal(name, self.rate).topic in station.player.topics()

    def _sources(
        self, station: StationBuilder, robot: Robot, name: str, camera: PinholeCamera
    ) -> tuple[OutputPort | None, OutputPort | None]:
        """Returns the ports of pictures and detections, None for one that there is not.

        Without detections there are pictures, for the detector to look at.
        """
        if not station.simulated:
            self._check_recorded_size(station, name, camera)
            unheard = station.add(PassThrough(1), f"{name}.switch")
            station.export_input(unheard.get_input_port(), f"{name}.active")
            if self._plays_pictures(station, name):
                return station.play(image_signal(name, self.rate)), None
            return None, station.play(detections_signal(name, self.rate))
        view = self.view(station, robot)
        shared: dict[str, Any] = {
            "camera": camera,
            "parent_frame": robot.frame_id,
            "X_PC": view.X_BC,
            "rate": self.rate,
            "latency": self.latency,
            "clock_error": self.clock_error,
            "seed": station.seed,
            "name": name,
            "frame_id": name.replace(".", "/"),
        }
        sight = self.sight or station.sight
        if sight == "projected":
            projector = station.add(
                MarkerProjector(
                    markers=view.markers,
                    family=station.marker_map.family,
                    parameters=self.projector,
                    transparent_frames=view.own_frames,
                    **shared,
                ),
                f"{name}.projector",
            )
            station.connect(
                station.scene_graph.get_query_output_port(), projector.query_object_input_port()
            )
            station.export_input(projector.active_input_port(), f"{name}.active")
            return None, projector.detections_output_port()
        shared |= {"effects": self.effects, "clipping": view.clipping}
        sensor: DrawnCamera | RenderedCamera
        if sight == "drawn":
            sensor = DrawnCamera(
                markers=() if view.shells else view.markers,
                family=station.marker_map.family,
                shells=view.shells,
                transparent_frames=view.own_frames if view.shells else (),
                **shared,
            )
        else:
            station.need_renderer()
            try:
                sensor = RenderedCamera(renderer=RENDERER, **shared)
            except ValueError as error:  # a distortion that cannot be rendered
                raise ScenarioError(f"camera file {self.calibration}: {error}") from error
        station.add(sensor, name)
        station.connect(
            station.scene_graph.get_query_output_port(), sensor.query_object_input_port()
        )
        station.connect(
            robot.state.GetOutputPort("spatial_velocity"), sensor.spatial_velocity_input_port()
        )
        station.export_input(sensor.active_input_port(), f"{name}.active")
        return sensor.image_output_port(), None


@dataclass(kw_only=True)
class Camera(CameraDriver):
    """A calibrated camera fixed to the robot, anywhere; see `CameraDriver`.

    Attributes:
        position: [x, y, z] of the optical centre in base_link, m.
        rpy_deg: roll, pitch, yaw of the camera; zeros look forward, positive pitch looks down.
        yaw_error_deg: how far to the left of that it truly looks, though nobody knows.
    """

    position: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.1])
    rpy_deg: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    yaw_error_deg: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("position", "rpy_deg"):
            value = getattr(self, name)
            require(
                len(value) == 3 and bool(np.isfinite(value).all()), name, value, "three numbers"
            )
        aside = self.yaw_error_deg
        require(math.isfinite(aside), "yaw_error_deg", aside, "finite")

    def mounting(self) -> RigidTransform:
        """Returns `X_BC`, the pose of the optical frame in base_link as the robot believes it."""
        R_BMount = RollPitchYaw(*(math.radians(a) for a in self.rpy_deg)).ToRotationMatrix()
        return RigidTransform(R_BMount.multiply(R_FORWARD_OPTICAL), self.position)

    def true_mounting(self) -> RigidTransform:
        """Returns `X_BC` with its error."""
        X_BC = self.mounting()
        aside = RotationMatrix.MakeZRotation(math.radians(self.yaw_error_deg))
        return RigidTransform(aside @ X_BC.rotation(), X_BC.translation())

    def planned_mounting(self, robot: Robot) -> RigidTransform:
        """Returns `X_BC`."""
        del robot
        return self.mounting()

    def view(self, station: StationBuilder, robot: Robot) -> View:
        """Returns the boards of the world and those on other robots."""
        world = station.scene_graph.world_frame_id()
        others = [m for name, m in station.carried_markers.items() if name != robot.name]
        return View(
            X_BC=self.true_mounting(),
            markers=[*placed_markers(station.true_markers, world), *chain(*others)],
            own_frames=[robot.frame_id],
        )
